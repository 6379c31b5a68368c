//! `decant metrics` beside a whole cell: what it serves is OpenMetrics, and it is the cell's own figures.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpStream;
use std::process::Stdio;
use std::time::Duration;

use shared::control::EndReason;
use tests::{CellUnderTest, steady_weights};

/// The answer to `GET path`: its status, content type and body.
fn get(address: &str, path: &str, host: &str) -> (u16, String, String) {
    let mut stream = TcpStream::connect(address).unwrap();
    write!(stream, "GET {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n").unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    let (head, body) = answer.split_once("\r\n\r\n").unwrap();
    let status = head.split(' ').nth(1).unwrap().parse().unwrap();
    let kind = head.lines().find_map(|l| l.strip_prefix("content-type: ")).unwrap_or_default();
    (status, kind.to_owned(), body.to_owned())
}

/// The samples of an OpenMetrics text, by name and labels as they are written. Panics where the text breaks the format's rules: each
/// sample belongs to the family named before it, no sample comes twice, buckets only grow, and the text has its end.
fn parse(text: &str) -> BTreeMap<String, f64> {
    let (mut samples, mut families) = (BTreeMap::new(), BTreeSet::new());
    let (mut family, mut kind, mut bucket) = (String::new(), String::new(), 0.0);
    let body = text.strip_suffix("# EOF\n").expect("the text has its end");
    for line in body.lines() {
        if let Some(rest) = line.strip_prefix("# TYPE ") {
            let (name, of) = rest.split_once(' ').unwrap();
            assert!(families.insert(name.to_owned()), "{name} comes twice");
            (family, kind, bucket) = (name.into(), of.into(), 0.0);
        } else if let Some(rest) = line.strip_prefix("# UNIT ") {
            let (name, unit) = rest.split_once(' ').unwrap();
            assert!(name == family && name.ends_with(&format!("_{unit}")), "{line}");
        } else if !line.starts_with("# HELP ") {
            let (name, value) = line.rsplit_once(' ').unwrap_or_else(|| panic!("{line}"));
            let value: f64 = value.parse().unwrap_or_else(|e| panic!("{line}: {e}"));
            let bare = name.split('{').next().unwrap();
            let ending = bare.strip_prefix(family.as_str()).unwrap_or_else(|| panic!("{line} belongs to no family"));
            let allowed: &[&str] = match kind.as_str() {
                "counter" => &["_total"],
                "gauge" => &[""],
                "histogram" => &["_bucket", "_sum", "_count"],
                other => panic!("{family} is {other}"),
            };
            assert!(allowed.contains(&ending) && name.contains("cell=\""), "{line} in a {kind}");
            if ending == "_bucket" {
                assert!(value >= bucket, "{line}: buckets only grow");
                bucket = value;
            }
            assert!(samples.insert(name.to_owned(), value).is_none(), "{line} comes twice");
        }
    }
    samples
}

/// Protects whoever watches a cell from a distance: the page parses, its counters and histograms are those of `status` and grow, results are
/// counted, and a controller that goes away is shown as such by a program that goes on.
#[test]
fn a_cell_is_measured() {
    let mut cell = CellUnderTest::start(|_| {});
    cell.take_weights(&steady_weights(12));
    cell.wait_idle();
    let mut metrics = cell.program("decant");
    metrics.args(["metrics", "--port", "0", "--config"]).arg(cell.config()).stdout(Stdio::piped());
    let mut metrics = metrics.spawn().unwrap();
    let mut line = String::new();
    BufReader::new(metrics.stdout.take().unwrap()).read_line(&mut line).unwrap();
    let address = line.trim().strip_prefix("http://").and_then(|a| a.strip_suffix("/metrics")).unwrap().to_owned();
    let look = || {
        let (status, kind, body) = get(&address, "/metrics", &address);
        assert_eq!((status, kind.as_str()), (200, "application/openmetrics-text; version=1.0.0; charset=utf-8"));
        parse(&body)
    };
    let value = |samples: &BTreeMap<String, f64>, name: &str, label: &str| {
        let found = samples.iter().find(|(n, _)| n.split('{').next() == Some(name) && n.contains(label));
        found.map(|(_, v)| *v)
    };
    // The first pour ends before anybody has asked.
    assert!(cell.command("rt-controller", &["pour", "20"]).status.code().is_some_and(|c| c == 0 || c == 4));
    std::thread::sleep(Duration::from_secs(1));
    let ended = |samples: &BTreeMap<String, f64>| -> BTreeMap<String, f64> {
        samples.iter().filter(|(n, _)| n.starts_with("decant_ended_total{")).map(|(n, v)| (n.clone(), *v)).collect()
    };
    let first = look();
    let reasons = ended(&first);
    assert_eq!(reasons.values().sum::<f64>(), 1.0, "{reasons:?}");
    assert_eq!(reasons.len(), EndReason::all().count(), "what first appears with 1 has not grown, for Prometheus: {reasons:?}");
    assert_eq!(value(&first, "decant_up", ""), Some(1.0));
    assert_eq!(value(&first, "decant_phase", "phase=\"idle\""), Some(1.0));
    assert_eq!(value(&first, "decant_phase", "phase=\"pouring\""), Some(0.0));
    assert!(value(&first, "decant_free_bytes", "of=\"episodes\"").unwrap() > 0.0);
    assert_ne!(value(&first, "decant_free_files", "of=\"episodes\""), Some(0.0), "none are told where their number is not bounded");

    assert!(cell.command("rt-controller", &["pour", "20"]).status.code().is_some_and(|c| c == 0 || c == 4));
    std::thread::sleep(Duration::from_secs(1));
    let (second, status) = (look(), cell.status().unwrap());
    for (name, key) in [("decant_ticks_total", "ticks"), ("decant_features_total", "features")] {
        let (before, after) = (value(&first, name, "").unwrap(), value(&second, name, "").unwrap());
        assert!(before < after && after <= status[key].as_f64().unwrap(), "{name}: {before}, {after}");
    }
    assert_eq!(ended(&second).values().sum::<f64>(), 2.0, "another pour ended");
    for name in ["decant_wakeup_lateness_seconds", "decant_tick_execution_seconds", "decant_feature_age_seconds"] {
        let count = value(&second, &format!("{name}_count"), "").unwrap();
        assert!(count > 0.0, "{name}");
        assert_eq!(value(&second, &format!("{name}_bucket"), "le=\"+Inf\""), Some(count), "{name}: every value is in a bucket");
        let mean_s = value(&second, &format!("{name}_sum"), "").unwrap() / count;
        assert!(mean_s > 0.0 && mean_s < 0.5, "{name}: a mean of {mean_s} s");
    }

    // The dashboard asks for nothing that is not served.
    let dashboard = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../packaging/grafana-dashboard.json")).unwrap();
    let dashboard: serde_json::Value = serde_json::from_str(&dashboard).unwrap();
    for panel in dashboard["panels"].as_array().unwrap() {
        for target in panel["targets"].as_array().unwrap() {
            let asked = target["expr"].as_str().unwrap().split(|c: char| !(c.is_ascii_alphanumeric() || c == '_'));
            for name in asked.filter(|word| word.starts_with("decant_")) {
                let served = second.keys().any(|n| n.split('{').next() == Some(name));
                let later = ["decant_newest_weighed_error_ml", "decant_weights_age_seconds"].contains(&name);
                assert!(served || later, "{}: {name} is not served", panel["title"]);
            }
        }
    }

    let host = get(&address, "/metrics", "evil.example").0;
    assert_eq!((host, get(&address, "/", &address).0), (421, 404), "another name's page, and another page");

    cell.stop("rt-controller");
    std::thread::sleep(Duration::from_secs(1));
    let last = look();
    assert_eq!((value(&last, "decant_up", ""), value(&last, "decant_ticks_total", "")), (Some(0.0), None));
    rustix::process::kill_process(rustix::process::Pid::from_child(&metrics), rustix::process::Signal::TERM).unwrap();
    assert!(metrics.wait().unwrap().success(), "it ends at once when it is asked to");
}
