//! What the robot's trace says about a motion: how far, how fast, how hard, and when it was at rest and upright.

use simulator::ur::{Series, TraceRow};

/// What a trace shows, from its first row on.
pub struct Motion {
    pub start_deg: f64,
    pub peak_deg: f64,
    /// When the joint first came to rest.
    pub rest_s: f64,
    /// When it was upright and stayed so.
    pub upright_s: Option<f64>,
    /// Taken from the angles given to servoj, by the time of the program's cycles.
    pub fastest_deg_s: f64,
    pub hardest_deg_s2: f64,
}

impl Motion {
    /// The motion that a trace of the robot's cycles shows.
    pub fn of(trace: &[TraceRow], series: Series) -> Self {
        let alpha = |r: &TraceRow| r.actual_q[5].to_degrees();
        let rate = |r: &TraceRow| r.actual_qd[5].to_degrees();
        let (first, last) = (trace.first().unwrap(), trace.last().unwrap());
        let upright = |r: &TraceRow| alpha(r).abs() < 1.0 && rate(r).abs() < 1.0;
        let upright_from = trace.iter().rposition(|r| !upright(r)).map_or(0, |i| i + 1);
        let rest = trace.iter().find(|r| rate(r).abs() < 1.0).unwrap_or(last);
        // Only cycles in which servoj moves the joint: what a stop or a jog does is the robot's own. After those, what counts is
        // where the joint then is and how fast.
        let cycle_s = 1.0 / series.rate_hz();
        let (mut at, mut speed) = (f64::NAN, f64::NAN);
        let (mut fastest_deg_s, mut hardest_deg_s2) = (0.0f64, 0.0f64);
        for pair in trace.windows(2) {
            let (before, now) = (&pair[0], &pair[1]);
            if !before.servoing {
                (at, speed) = (before.target_q[5], before.target_qd[5]);
            }
            if now.servoing && now.servoj_calls != before.servoj_calls {
                let new_speed = (now.commanded_q[5] - at) / cycle_s;
                // A trace that begins in the middle of a motion tells neither at first; maxima leave NaN out.
                fastest_deg_s = fastest_deg_s.max(new_speed.abs().to_degrees());
                hardest_deg_s2 = hardest_deg_s2.max(((new_speed - speed).abs() / cycle_s).to_degrees());
                (at, speed) = (now.commanded_q[5], new_speed);
            }
        }
        Self {
            start_deg: alpha(first),
            peak_deg: trace.iter().map(alpha).fold(f64::MIN, f64::max),
            rest_s: rest.timestamp_s - first.timestamp_s,
            upright_s: trace.get(upright_from).map(|r| r.timestamp_s - first.timestamp_s),
            fastest_deg_s,
            hardest_deg_s2,
        }
    }
}
