//! How much may leave a vessel after a fault could first be noticed: flow at that moment times reaction, and what flows on the way upright.
//!
//! Pure; allocates nothing; cannot fail. The bound is not a number for all vessels: it is reckoned from the liquid as it is at that moment. A copy
//! of the vessel is tilted as high as the commands that the joint still follows ask for, held there for the longest reaction, and brought upright at the rate of the
//! way upright. Whoever reacts as fast as the documents say lets no more leave.

use simulator::physics::container::Container;

/// The longest reaction of a robot without lag, s: a tick of 33 ms, the patience of its program of 100 ms, its average over 64 ms, servoj's
/// lookahead of 50 ms, and a packet each way (ARCHITECTURE.md's table of deadlines).
const REACTION_S: f64 = 0.26;
/// How many time constants of its lag a joint is behind besides, until it goes as fast as its command.
const LAGS: f64 = 2.0;
/// For how long targets may go on at their present rate, s: two ticks, and a packet on its way.
const GOES_ON_S: f64 = 0.08;
/// Step of the copy, s: that of the simulated cell.
const STEP_S: f64 = 0.004;
/// For how long it is looked at after it is upright, s: a surface that swings has come to rest, and the film is added whole.
const REST_S: f64 = 0.5;
/// What two copies that are tilted a little differently may differ by, ml, and as a share: a surface that swings at 2 Hz gives its waves sooner or
/// later.
const SWING: (f64, f64) = (1.5, 0.1);

/// The cell at a moment.
#[derive(Debug, Clone, Copy)]
pub struct Moment<'a> {
    /// The vessel.
    pub container: &'a Container,
    /// Its tilt, degrees.
    pub alpha_deg: f64,
    /// The highest target that the joint still follows, degrees, and the rate at which targets come, degrees/s, if there is one.
    pub target: Option<(f64, f64)>,
    /// Time constant of the joint's lag, s.
    pub lag_s: f64,
    /// Rate of the way upright, degrees/s.
    pub return_deg_s: f64,
    /// When it is, s.
    pub at_s: f64,
}

/// The most that may leave from now on until the vessel is upright, if the controller or the robot's program reacts now, ml.
pub fn most_ml(now: &Moment<'_>) -> f64 {
    let mut copy = now.container.clone();
    let aimed_deg = now.target.map_or(now.alpha_deg, |(target_deg, rate)| target_deg + GOES_ON_S * rate.max(0.0));
    let held_deg = now.alpha_deg.max(aimed_deg);
    let held_s = REACTION_S + LAGS * now.lag_s;
    let whole_s = held_s + held_deg.max(0.0) / now.return_deg_s.max(1.0) + REST_S;
    for k in 1..=(whole_s / STEP_S).ceil() as u32 {
        let back_s = (f64::from(k) * STEP_S - held_s).max(0.0);
        copy.step(STEP_S, (held_deg - now.return_deg_s * back_s).max(0.0));
    }
    let most_ml = copy.poured_ml() + copy.film_ml() - now.container.poured_ml();
    SWING.0 + (1.0 + SWING.1) * most_ml
}

#[cfg(test)]
mod tests {
    use super::*;
    use simulator::physics::container::Shape;

    fn moment(container: &Container, alpha_deg: f64) -> Moment<'_> {
        Moment { container, alpha_deg, target: None, lag_s: 0.012, return_deg_s: 60.0, at_s: 0.0 }
    }

    /// Protects the bound from being none: a vessel that gives nothing may give next to nothing, one that flows may give what it gives while it is
    /// brought upright as fast as that is done, and not what it gives when it is held for half a second longer.
    #[test]
    fn the_bound_is_what_a_prompt_way_upright_gives() {
        let mut container = Container::new(Shape::Cylinder { radius_mm: 38.0, height_mm: 115.0 }, 20.0, 1.0, 300.0);
        assert!(most_ml(&moment(&container, 10.0)) < 2.0, "nothing flows at 10 degrees");
        let tilt_deg = container.spill_angle_deg() + 8.0;
        for _ in 0..25 {
            container.step(STEP_S, tilt_deg);
        }
        let given_ml = |reaction_s: f64| {
            let mut real = container.clone();
            for k in 0..1000 {
                real.step(STEP_S, (tilt_deg - 60.0 * (f64::from(k) * STEP_S - reaction_s).max(0.0)).max(0.0));
            }
            real.poured_ml() - container.poured_ml()
        };
        let most = most_ml(&moment(&container, tilt_deg));
        assert!(given_ml(0.2) < most && given_ml(0.75) > most, "{} < {most} < {}", given_ml(0.2), given_ml(0.75));
    }
}
