//! Journals as files from anywhere: whatever is changed in them, reading them gives an answer or one line, and never a panic.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

#[path = "../../shared/examples/write_weights.rs"]
#[allow(dead_code)]
mod write_weights;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::process::Command;
use std::sync::{PoisonError, RwLock};

use rt_controller::core::{Core, Input, Order, Robot, Settings};
use rt_controller::journal::{Tick, Times, Writer, replay_from};
use shared::agent::Agent;
use shared::config::Config;
use shared::messages::{Feature, LAYOUT_VERSION, Telemetry};

fn settings() -> Settings {
    Settings::new(&Config::parse(include_str!("../../config/sim.toml"), "config/sim.toml").expect("the shipped configuration is valid"))
}

/// Two parts of a journal of `ticks` ticks, the second of which begins at `cut`, with pours ordered at `orders` and a wrong answer in the tick `lie`, from a cell in which a stream begins
/// at 20 degrees.
fn parts(ticks: u64, cut: u64, orders: &[u64], lie: u64) -> [Vec<u8>; 2] {
    parts_without(ticks, cut, orders, lie, &(0..0))
}

/// The same without the ticks `lost`, which the writer was never told.
fn parts_without(ticks: u64, cut: u64, orders: &[u64], lie: u64, lost: &std::ops::Range<u64>) -> [Vec<u8>; 2] {
    let settings = settings();
    let weights = write_weights::constant_action(3);
    let (mut bytes, mut later) = (Vec::new(), Vec::new());
    let mut writer = Writer::begin(&mut bytes, &settings).expect("memory");
    let known = [(1, weights.to_bytes().expect("valid"))].into();
    let mut second = Writer::continued(&mut later, &settings, known, Some(1)).expect("memory");
    writer.weights(1, &weights).expect("memory");
    let mut core = Core::new(settings);
    let mut alpha_deg = 0.0;
    for k in 0..ticks {
        let agent = (k == 1).then_some(1);
        if agent.is_some() {
            core.exchange(Box::new(Agent::new(&weights)));
        }
        let now_ns = 1_000_000_000 + k * settings.period_ns;
        let mut features = heapless::Vec::new();
        let feature = Feature {
            version: LAYOUT_VERSION,
            sequence: k,
            worker_epoch_ns: 7,
            captured_at_ns: now_ns - 20_000_000,
            received_at_ns: now_ns - 1_000_000,
            published_at_ns: now_ns - 500_000,
            area_px2: 30.0 * f32::max(alpha_deg - 20.0, 0.0),
            confidence: 1.0,
            ..Feature::default()
        };
        features.push(feature).expect("room");
        let robot = Robot::that_may_move(alpha_deg, now_ns - 4_000_000);
        let order = orders.contains(&k).then_some(Order::Pour { episode: 1, goal_ml: 50.0, flows_by_deg: None });
        let output = core.step(&Input { now_ns, features: &features, robot, order });
        alpha_deg = output.target_deg.unwrap_or(alpha_deg);
        let times = Times { deadline_ns: now_ns, decided_at_ns: now_ns, written_at_ns: now_ns, done_ns: now_ns, margin_ns: 0 };
        let d_ml = output.telemetry.d_ml + f32::from(u8::from(k == lie));
        let target_deg = output.target_deg;
        let to = if k < cut { &mut writer } else { &mut second };
        let telemetry = Telemetry { weights_id: u64::from(k >= 1), ..output.telemetry };
        if !lost.contains(&k) {
            to.tick(Box::new(Tick { now_ns, features, robot, order, agent, target_deg, d_ml, times }), &telemetry).expect("memory");
        }
    }
    writer.flush().and_then(|()| second.flush()).expect("memory");
    drop((writer, second));
    [bytes, later]
}

/// Written while a process is started, read while files are locked: until it becomes its program, a new process holds each lock that was held when it
/// was begun, also when its own holder has let go.
static STARTING: RwLock<()> = RwLock::new(());

/// A tick in which nothing happens.
fn idle_tick() -> Tick {
    let robot = Robot::that_may_move(0.0, 1);
    let features = heapless::Vec::new();
    Tick { now_ns: 1, features, robot, order: None, agent: None, target_deg: None, d_ml: 0.0, times: Times::default() }
}

/// A journal of `ticks` ticks with one pour.
fn journal(ticks: u64) -> Vec<u8> {
    let [whole, _] = parts(ticks, u64::MAX, &[5], u64::MAX);
    whole
}

/// Protects who looks for yesterday: a journal's file ends after a day, however little was written into it.
#[test]
fn a_journal_ends_after_a_day() {
    let mut writer = Writer::begin(Vec::new(), &settings()).expect("memory");
    for (hour, is_full) in [(100, false), (112, false), (124, false), (125, true)] {
        let now_ns = hour * 3600 * 1_000_000_000;
        writer.tick(Box::new(Tick { now_ns, ..idle_tick() }), &Telemetry::default()).expect("memory");
        assert_eq!(writer.is_full(), is_full, "hour {hour}");
    }
}

/// Protects the reader of a journal on a failing disk: an error is one, and does not look like a journal that was cut.
#[test]
fn an_error_of_the_disk_is_no_cut_journal() {
    use std::io::Read;
    struct Failing;
    impl Read for Failing {
        fn read(&mut self, _: &mut [u8]) -> std::io::Result<usize> {
            Err(std::io::Error::other("input/output error"))
        }
    }
    let whole = journal(300);
    for length in [4, 20, whole.len() / 2, whole.len() - 3] {
        assert!(replay_from(&whole[..length], "cut", |_, _| {}).is_ok_and(|r| r.cut_off) || length < 20, "{length}");
        let failed = replay_from((&whole[..length]).chain(Failing), "j.bin", |_, _| {}).err().map(|e| e.to_string());
        assert_eq!(failed.as_deref(), Some("j.bin: input/output error"), "{length}");
    }
}

/// Protects a long run's journal: its later part begins with the weights that the loop has, and from its first order on it replays to the bit; a tick
/// that was changed there is found.
#[test]
fn a_later_part_replays_from_its_first_order_on() {
    let [first, second] = parts(1200, 700, &[5, 800], u64::MAX);
    let replayed = replay_from(&first[..], "first", |_, _| {}).expect("whole");
    assert_eq!((replayed.ticks, replayed.different, replayed.continued, replayed.ended.len()), (700, 0, false, 1));
    let mut compared = 0;
    let replayed = replay_from(&second[..], "second", |tick, output| {
        compared += u32::from(tick.target_deg == output.target_deg);
    })
    .expect("whole");
    assert_eq!((replayed.ticks, replayed.different, replayed.continued, replayed.ended.len()), (500, 0, true, 1), "{replayed:?}");
    assert!(compared > 400, "{compared}");
    for (lie, found) in [(750, 0), (900, 1)] {
        let [_, second] = parts(1200, 700, &[5, 800], lie);
        let replayed = replay_from(&second[..], "changed", |_, _| {}).expect("whole");
        assert_eq!(replayed.different, found, "a wrong answer in tick {lie}");
    }
}

/// Protects whoever replays a run whose ordinary side fell behind: the ticks that were lost are counted, a pour that they cut has no result and no
/// differences, and behind them the next pour replays to the bit, with the weights that were exchanged in the gap; a tick that was changed there is found.
#[test]
fn lost_ticks_are_said_and_the_next_pour_replays() {
    for (lost, orders, results) in [(100..140, [20, 600], 1), (0..40, [20, 600], 1), (450..500, [20, 600], 2)] {
        let [bytes, _] = parts_without(1000, u64::MAX, &orders, u64::MAX, &lost);
        let replayed = replay_from(&bytes[..], "lost", |_, _| {}).expect("whole");
        let found = (replayed.ticks, replayed.lost, replayed.different, replayed.ended.len());
        let missing = lost.end - lost.start;
        assert_eq!(found, (1000 - missing, missing, 0, results), "{lost:?} {replayed:?}");
    }
    for (lie, found) in [(145, 0), (700, 1)] {
        let [bytes, _] = parts_without(1000, u64::MAX, &[20, 600], lie, &(100..140));
        assert_eq!(replay_from(&bytes[..], "changed", |_, _| {}).expect("whole").different, found, "a wrong answer in tick {lie}");
    }
}

/// Protects a crash from the starts after it: each start keeps the journals before it, the newest first, and more than one; what is no journal in any of
/// their places is left, and so is everything else.
#[test]
fn starts_keep_the_journals_before_them() {
    let _locks = STARTING.read().unwrap_or_else(PoisonError::into_inner);
    let dir = tempfile::tempdir().expect("a directory");
    let path = dir.path().join("new/j.bin");
    let start = |number: u32| {
        let mut writer = Writer::create(&path, &settings()).expect("writable");
        let weights = write_weights::constant_action(number as i32 % 10);
        writer.weights(u64::from(number), &weights).expect("space");
        writer.tick(Box::new(idle_tick()), &Telemetry::default()).and_then(|()| writer.flush()).expect("space");
    };
    (0..5).for_each(start);
    let begun = |name: &str| rt_controller::journal::replay(&dir.path().join("new").join(name), |_, _| {}).is_ok();
    for name in ["j.bin", "j.before.bin", "j.before-2.bin", "j.before-3.bin", "j.before-4.bin"] {
        assert!(begun(name), "{name}");
    }
    let bytes = |name: &str| std::fs::read(dir.path().join("new").join(name)).expect("there");
    assert_ne!(bytes("j.before-4.bin"), bytes("j.before.bin"), "the oldest is the first");
    // 30 starts keep 20, and 1 GiB.
    (0..30).for_each(start);
    assert_eq!(std::fs::read_dir(dir.path().join("new")).expect("there").count(), 21);
    std::fs::File::options().write(true).open(dir.path().join("new/j.before-3.bin")).and_then(|f| f.set_len(1 << 30)).expect("sparse");
    start(0);
    assert_eq!(std::fs::read_dir(dir.path().join("new")).expect("there").count(), 4, "the large one and what is older went");
    std::fs::write(dir.path().join("new/j.before-2.bin"), b"a letter").expect("writable");
    assert!(Writer::create(&path, &settings()).is_err());
    assert_eq!(bytes("j.before-2.bin"), b"a letter");
    assert!(begun("j.bin") && begun("j.before.bin"));
}

/// Protects the journals of real runs from a full disk and from starts that were refused: one in which nothing happened, or not even its beginning was
/// written, takes no place when the next one begins, however often that is tried.
#[test]
fn a_journal_without_a_tick_pushes_none_out() {
    let _locks = STARTING.read().unwrap_or_else(PoisonError::into_inner);
    let dir = tempfile::tempdir().expect("a directory");
    let path = dir.path().join("j.bin");
    let mut writer = Writer::create(&path, &settings()).expect("writable");
    writer.tick(Box::new(idle_tick()), &Telemetry::default()).and_then(|()| writer.flush()).expect("space");
    drop(writer);
    let real = std::fs::read(&path).expect("there");
    for round in 0..50 {
        let mut writer = Writer::create(&path, &settings()).expect("writable");
        writer.weights(1, &write_weights::constant_action(1)).and_then(|()| writer.flush()).expect("space");
        drop(writer);
        // As a full disk leaves it.
        let cut = [0, 3, 8, 40, 2000][round % 5];
        std::fs::File::options().write(true).open(&path).and_then(|f| f.set_len(cut)).expect("ours");
    }
    drop(Writer::create(&path, &settings()).expect("writable"));
    assert_eq!(std::fs::read(dir.path().join("j.before.bin")).expect("kept"), real);
    assert_eq!(std::fs::read_dir(dir.path()).expect("there").count(), 2);
}

/// Protects whoever replays a journal from a defect in it: bytes, whole words and lengths are changed at seeded places, mostly in the settings
/// and the first ticks; none of it is a panic. The whole journal replays to the bit.
#[test]
fn a_changed_journal_is_an_answer_or_a_line() {
    let whole = journal(120);
    let replayed = replay_from(&whole[..], "whole", |_, _| {}).expect("whole");
    assert_eq!((replayed.ticks, replayed.different), (120, 0));
    // The tests beside this one still say why they fail.
    let (say, here) = (std::panic::take_hook(), std::thread::current().id());
    std::panic::set_hook(Box::new(move |panic| {
        if std::thread::current().id() != here {
            say(panic);
        }
    }));
    let mut seed = 0x2545_f491_4f6c_dd1du64;
    let mut random = move |below: usize| {
        seed ^= seed << 13;
        seed ^= seed >> 7;
        seed ^= seed << 17;
        (seed >> 16) as usize % below
    };
    let (mut panics, mut refused) = (Vec::new(), 0);
    // The settings are the first entry, before the weights.
    let settings_end = 12 + u32::from_le_bytes(whole[8..12].try_into().unwrap()) as usize;
    for round in 0..4000 {
        let mut changed = whole.clone();
        for _ in 0..=random(3) {
            let at = match round % 3 {
                0 => 12 + random(settings_end - 12),
                1 => settings_end + random(whole.len() - settings_end),
                // Past the weights, where a checksum does not keep changes out.
                _ => whole.len() - 1 - random(whole.len() / 3),
            };
            match random(3) {
                0 => changed[at] = random(256) as u8,
                1 => changed[at] ^= 1 << random(8),
                _ => {
                    let end = (at + 4).min(changed.len());
                    changed[at..end].fill([0, 0xff, 0x7f, 0x80][random(4)]);
                }
            }
        }
        match catch_unwind(AssertUnwindSafe(|| replay_from(&changed[..], "changed", |_, _| {}).is_err())) {
            Ok(err) => refused += usize::from(err),
            Err(what) => panics.push((round, what.downcast_ref::<String>().cloned().unwrap_or_default())),
        }
    }
    let _ = std::panic::take_hook();
    assert!(panics.is_empty(), "{} panics, the first: {:?}", panics.len(), &panics[..panics.len().min(3)]);
    assert!(refused > 300, "{refused} of the changed journals are refused");
}

/// Protects who trusts the exit code of `replay`: a part in which no pour begins has nothing that can be compared, and that is no "all the same".
#[test]
fn a_replay_that_compared_nothing_fails() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("journal.bin");
    for (orders, code, compared) in [(&[5, 800][..], 0, 400), (&[5][..], 1, 0)] {
        let [_, second] = parts(1200, 700, orders, u64::MAX);
        std::fs::write(&file, second).unwrap();
        let output = {
            let _starting = STARTING.write().unwrap_or_else(PoisonError::into_inner);
            Command::new(env!("CARGO_BIN_EXE_rt-controller")).args(["replay", "--json"]).arg(&file).output().unwrap()
        };
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        let summary: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!((output.status.code(), summary["compared"].as_u64()), (Some(code), Some(compared)), "{said}");
        assert_eq!(said.contains("nothing could be compared"), compared == 0, "{said}");
    }
}
