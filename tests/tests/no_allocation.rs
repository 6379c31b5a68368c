//! The loop's ticks under an allocator that aborts the process when a tick allocates or frees. It is a second proof beside the counter in
//! `status`, and its code comes from somebody else. The ticks are those of `rt-controller run`, driven here faster than in a cell, with
//! real shared memory, real sockets, and the program on the simulated robot.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

use std::process::Command;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::time::{Duration, Instant};

use assert_no_alloc::{AllocDisabler, assert_no_alloc};
use rt_controller::control_loop::LoopState;
use rt_controller::core::{Order, Settings};
use rt_controller::exchange::{Asked, Event, Exchange};
use rt_controller::link::network::System;
use rt_controller::robot_thread::{RobotNote, keep_robot_connected};
use shared::agent::Agent;
use shared::config::Config;
use shared::ipc;
use shared::messages::{Feature, LAYOUT_VERSION};
use shared::os::now_ns;
use simulator::ur::{Controller, ControllerOptions, Fault};
use tests::steady_weights;

#[global_allocator]
static ALLOCATOR: AllocDisabler = AllocDisabler;

const TICKS: u64 = 10_000;
const PERIOD: Duration = Duration::from_millis(3);
/// The camera's frame time, ns.
const FRAME_NS: u64 = 20_000_000;
/// The environment variable of the child that is to abort: its worker comes while a pour is under way, so that a tick meets it.
const PLANT: &str = "DECANT_TEST_PLANT";

/// Runs `TICKS` ticks with pours, a weight swap before each, an abort, and a robot that is lost and comes back. With `plant`, the worker is
/// replaced in the middle of a pour.
fn run(plant: bool) {
    let name = format!("no-allocation-{}", std::process::id());
    let address = std::net::IpAddr::from([127, 45, plant.into(), 1]);
    let mut config = Config::parse(include_str!("../../config/sim.toml"), "config/sim.toml").expect("valid");
    config.cell.name.clone_from(&name);
    config.robot.address = address.into();
    config.camera.fps = 1e9 / FRAME_NS as f64;
    let robot = Controller::start(ControllerOptions::new(address)).expect("free");
    let (exchange, note) = (Exchange::default(), RobotNote::default());
    let (stop, connections) = (AtomicBool::new(false), AtomicU64::new(0));
    let ended = AtomicU64::new(0);

    std::thread::scope(|scope| {
        scope.spawn(|| keep_robot_connected(&System, &config, &exchange, &note, &connections, &stop, &|_, _| {}));
        // The ordinary thread gives orders, weights and faults, and drops what the loop gives back.
        scope.spawn(|| {
            let worker = ipc::Cell::join(&name).expect("shared memory");
            let topic = worker.features().expect("shared memory");
            let mut publisher = Some(topic.publisher_builder().create().expect("shared memory"));
            let (epoch_ns, mut sequence, mut number, mut poured) = (now_ns(), 0, 0, 0);
            while !stop.load(Relaxed) {
                let alpha_deg = robot.joints().actual_q[5].to_degrees();
                sequence += 1;
                let now = epoch_ns + sequence * FRAME_NS;
                let feature = Feature {
                    version: LAYOUT_VERSION,
                    sequence,
                    worker_epoch_ns: epoch_ns,
                    captured_at_ns: now,
                    received_at_ns: now,
                    published_at_ns: now,
                    area_px2: (40.0 * (alpha_deg - 40.0).max(0.0)) as f32,
                    confidence: 1.0,
                    ..Feature::default()
                };
                if let Some(publisher) = &publisher {
                    publisher.send_copy(feature).expect("shared memory");
                }
                while exchange.old_agents.pop().is_some() {}
                while let Some(event) = exchange.events.pop() {
                    if let Event::Ended(_) = event {
                        ended.fetch_add(1, Relaxed);
                    }
                }
                if sequence % 100 == 0 {
                    number += 1;
                    drop(exchange.agents.force_push((number, Box::new(Agent::new(&steady_weights(13))))));
                    poured += 1;
                    let order = Order::Pour { episode: poured, goal_ml: 20.0, flows_by_deg: None };
                    let _ = exchange.orders.push(Asked { order, aborts: exchange.aborts.load(Relaxed) });
                }
                match sequence {
                    450 => exchange.abort(),
                    700 => robot.inject(Fault::Reset),
                    _ => {}
                }
                if plant && sequence > 300 && alpha_deg > 5.0 {
                    drop(publisher.take());
                    publisher = Some(topic.publisher_builder().create().expect("shared memory"));
                }
                std::thread::sleep(Duration::from_nanos((now + FRAME_NS).saturating_sub(now_ns())));
            }
        });

        let cell = ipc::Cell::join(&name).expect("shared memory");
        let features = cell.features().expect("shared memory").subscriber_builder().buffer_size(8).create().expect("shared memory");
        let mut ticks = LoopState::new(Settings::new(&config), 100_000_000, &features, &exchange);
        let mut next = Instant::now();
        for _ in 0..TICKS {
            ticks.meet_feature_worker();
            assert_no_alloc(|| ticks.tick(now_ns()));
            next += PERIOD;
            std::thread::sleep(next.saturating_duration_since(Instant::now()));
        }
        stop.store(true, Relaxed);
        assert!(ended.load(Relaxed) >= 3, "{} pours ended", ended.load(Relaxed));
        assert!(connections.load(Relaxed) >= 2, "the robot was lost and came back");
        assert!(exchange.agents_taken.load(Relaxed) >= 3, "weights were swapped");
    });
    ipc::remove_files(&name);
}

/// Protects the loop's deadline from the allocator: no tick allocates or frees.
#[test]
fn no_tick_allocates() {
    if std::env::var_os(PLANT).is_some() {
        return run(true);
    }
    run(false);
}

/// Protects the check above: a tick that has to open shared memory allocates, and the process aborts.
#[test]
fn a_tick_that_allocates_aborts() {
    if std::env::var_os(PLANT).is_some() {
        return;
    }
    let exe = std::env::current_exe().expect("tests have a path");
    let output = Command::new(exe).args(["--exact", "no_tick_allocates", "--nocapture"]).env(PLANT, "1").output().expect("it starts");
    assert!(!output.status.success(), "it ran to its end");
    use std::os::unix::process::ExitStatusExt;
    assert_eq!(output.status.signal(), Some(6), "SIGABRT: {}", String::from_utf8_lossy(&output.stderr));
}
