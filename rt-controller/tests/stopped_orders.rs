//! The loop and its queue of orders: what stops the motion comes before the orders that wait. No process, no clock, no robot.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

use std::sync::atomic::{AtomicU64, Ordering::SeqCst};

use rt_controller::control_loop::{LoopState, Outside};
use rt_controller::core::{Order, Refusal, Settings};
use rt_controller::exchange::{Event, Exchange};
use shared::config::Config;
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
fn answers(exchange: &Exchange) -> Vec<Result<(), Refusal>> {
    std::iter::from_fn(|| exchange.events.pop()).filter_map(|e| if let Event::Ordered(answer) = e { Some(answer) } else { None }).collect()
}

/// Protects people from a pour that begins after they have stopped everything: orders that wait when an abort or the end comes are refused
/// by name, all in the same tick, and none is left for a later one.
#[test]
fn orders_that_wait_are_refused_when_the_motion_is_stopped() {
    let config = Config::parse(include_str!("../../config/sim.toml"), "config/sim.toml").expect("the shipped configuration is valid");
    for shutdown in [false, true] {
        let (exchange, outside) = (Exchange::default(), Nothing::default());
        let mut state = LoopState::new(Settings::new(&config), 100_000_000, &outside, &exchange);
        state.tick(0);
        assert!(answers(&exchange).is_empty());
        for episode in 1..=3 {
            exchange.orders.push(Order::Pour { episode, goal_ml: 50.0, flows_by_deg: None }).expect("room");
        }
        if shutdown { &exchange.shutdown } else { &exchange.abort }.store(true, SeqCst);
        state.tick(33_000_000);
        assert_eq!(answers(&exchange), vec![Err(Refusal::Stopped); 3], "shutdown {shutdown}");
        assert!(exchange.orders.is_empty());
        state.tick(66_000_000);
        assert!(answers(&exchange).is_empty(), "shutdown {shutdown}");
    }
}
