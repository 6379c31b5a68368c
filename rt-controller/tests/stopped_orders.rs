//! The loop and its queue of orders: what stops the motion comes before the orders that wait. No process, no clock, no robot.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

use std::sync::atomic::{AtomicU64, Ordering::SeqCst};

use rt_controller::control_loop::{LoopState, Outside};
use rt_controller::core::{Order, Refusal, Settings};
use rt_controller::exchange::{Asked, Event, Exchange};
use shared::config::Config;
use shared::control::EndReason;
use shared::messages::Feature;

/// A clock that goes on by itself, and no camera.
#[derive(Default)]
struct Nothing(AtomicU64);

impl Outside for Nothing {
    fn now_ns(&self) -> u64 {
        self.0.fetch_add(1_000_000, SeqCst)
    }

    fn receive(&self) -> Option<Feature> {
        None
    }

    fn meet_feature_worker(&self) {}
}

/// The answers to orders that the loop has given since the last call.
fn answers(exchange: &Exchange) -> Vec<(u64, Result<(), Refusal>)> {
    let events = std::iter::from_fn(|| exchange.events.pop());
    events.filter_map(|e| if let Event::Ordered(episode, answer) = e { Some((episode, answer)) } else { None }).collect()
}

/// An order of the pour `episode` that was given when so many aborts had been.
fn pour(episode: u64, aborts: u64) -> Asked {
    Asked { order: Order::Pour { episode, goal_ml: 50.0, flows_by_deg: None }, aborts }
}

fn settings() -> Settings {
    Settings::new(&Config::parse(include_str!("../../config/sim.toml"), "config/sim.toml").expect("the shipped configuration is valid"))
}

/// Protects people from a pour that begins after they have stopped everything: orders that wait when an abort or the end comes are refused
/// by name, all in the same tick, and none is left for a later one.
#[test]
fn orders_that_wait_are_refused_when_the_motion_is_stopped() {
    for shutdown in [false, true] {
        let (exchange, outside) = (Exchange::default(), Nothing::default());
        let mut state = LoopState::new(settings(), 100_000_000, &outside, &exchange);
        state.tick(0);
        assert!(answers(&exchange).is_empty());
        for episode in 1..=3 {
            exchange.orders.push(pour(episode, 0)).expect("room");
        }
        if shutdown {
            exchange.shutdown.store(true, SeqCst)
        } else {
            exchange.abort()
        }
        state.tick(33_000_000);
        assert_eq!(answers(&exchange), [1, 2, 3].map(|episode| (episode, Err(Refusal::Stopped))), "shutdown {shutdown}");
        assert!(exchange.orders.is_empty());
        state.tick(66_000_000);
        assert!(answers(&exchange).is_empty(), "shutdown {shutdown}");
    }
}

/// Protects people from a pour that begins after an abort has said that the container is upright: an order that was given before the abort, and comes into
/// the loop's queue only after it was obeyed, is refused by name. One that was given after it has its turn.
#[test]
fn an_order_from_before_an_abort_is_refused_however_late_it_comes() {
    let (exchange, outside) = (Exchange::default(), Nothing::default());
    let mut state = LoopState::new(settings(), 100_000_000, &outside, &exchange);
    state.tick(0);
    exchange.abort();
    assert_ne!(exchange.aborts_obeyed.load(SeqCst), exchange.aborts.load(SeqCst), "not yet");
    state.tick(33_000_000);
    assert_eq!(exchange.aborts_obeyed.load(SeqCst), exchange.aborts.load(SeqCst));
    for asked in [pour(1, 0), pour(2, 1), pour(3, 0)] {
        exchange.orders.push(asked).expect("room");
    }
    state.tick(66_000_000);
    let robot_is_missing = Err(Refusal::Robot(EndReason::RobotLost));
    assert_eq!(answers(&exchange), [(1, Err(Refusal::Stopped)), (2, robot_is_missing)], "one order a tick");
    state.tick(100_000_000);
    assert_eq!(answers(&exchange), [(3, Err(Refusal::Stopped))]);
}
