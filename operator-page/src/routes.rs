//! Which request gets which answer.
//!
//! The page's answering threads run it. GET looks, POST changes; whatever starts something needs the say. It allocates; every failure is an
//! answer with one line.

use serde::Deserialize;
use serde_json::{Value, json};
use shared::messages::Doubt;
use shared::os::now_ns;
use web::{Answer, Request};

use crate::orders;
use crate::site::Site;

/// Who sends a request that changes something.
#[derive(Deserialize)]
struct Who {
    id: String,
    #[serde(default)]
    name: String,
}

/// What a page orders; each path takes some of it.
#[derive(Default, Deserialize)]
#[serde(default)]
struct Order {
    goal_ml: f32,
    fill_ml: Option<f64>,
    hold: bool,
    holding: bool,
    lambda_deg: f32,
    gamma_per_s2: f32,
    file: String,
    files: Vec<String>,
    grams: Option<f64>,
    /// The weight that the page shows of the episode; none if it shows none.
    shown_g: Option<f64>,
    /// The section of the configuration that the page shows.
    section: String,
    holds_ml: Option<f64>,
    last: Option<usize>,
    accept: Vec<String>,
    leave_out: Vec<String>,
    what: String,
    /// The weights that the page shows.
    identity: String,
    /// The number of stops in the newest state that the page had when it ordered a motion.
    stops: Option<u64>,
    /// When that state was sent, CLOCK_MONOTONIC ms.
    sent_at_ms: Option<u64>,
    /// What the page showed of a pour before it was confirmed.
    lines: Vec<String>,
    seconds: u64,
    corner: Value,
}

/// An order of a motion by a page whose newest state is older than this came late, ms: states are sent every 75 ms, so it is 26 of them.
const LATE_MS: u64 = 2000;
/// The paths that order a motion.
const MOTIONS: [&str; 3] = ["/api/pour", "/api/record", "/api/resume"];
/// The page itself. It holds nothing of the cell, so it needs no token: what it shows it asks for with the token that it has from its address.
pub const PAGE: &[(&str, &str, &str)] = &[
    ("/", "text/html; charset=utf-8", include_str!("../page/index.html")),
    ("/page.css", "text/css", include_str!("../page/page.css")),
    ("/page.js", "text/javascript", include_str!("../page/page.js")),
    ("/plot.js", "text/javascript", include_str!("../page/plot.js")),
    ("/live.js", "text/javascript", include_str!("../page/live.js")),
    ("/pour.js", "text/javascript", include_str!("../page/pour.js")),
    ("/learn.js", "text/javascript", include_str!("../page/learn.js")),
    ("/calibrate.js", "text/javascript", include_str!("../page/calibrate.js")),
    ("/history.js", "text/javascript", include_str!("../page/history.js")),
    ("/icon.svg", "image/svg+xml", include_str!("../page/icon.svg")),
];
/// The formats of `feature-worker episodes export`.
const FORMATS: [&str; 4] = ["csv", "images", "video", "lerobot"];

/// The answer to `request`.
pub fn answer(site: &Site, request: &Request) -> Answer {
    if request.post { post(site, request) } else { get(site, request) }
}

fn get(site: &Site, request: &Request) -> Answer {
    let file = request.parameter("file").unwrap_or_default();
    match request.path.as_str() {
        "/events" => site.events.stream(),
        "/picture.jpg" => picture(site),
        "/api/about" => Answer::json(&site.about()),
        "/api/minute" => Answer::json(&site.minute()),
        "/api/episodes" => {
            let ends = site.cell.live().ends.clone();
            Answer::json(&site.history.table(&ends))
        }
        "/api/plan" => Answer::json(&site.jobs.plan()),
        "/api/rows" => line(site.history.rows(&file)),
        "/api/frame" => {
            let sequence = request.parameter("sequence").and_then(|n| n.parse().ok()).unwrap_or(0);
            match site.history.picture(&file, sequence) {
                Ok((number, bytes)) => {
                    let kind = if bytes.starts_with(b"\x89PNG") { "image/png" } else { "image/jpeg" };
                    Answer::bytes(kind, bytes).header("x-frame", &json!({ "sequence": number }).to_string())
                }
                Err(e) => Answer::fault(404, e),
            }
        }
        "/api/calibration" => Answer::json(&site.calibration.about()),
        "/api/calibration.jpg" => site.calibration.picture().map_or_else(|e| Answer::fault(404, e), Answer::jpeg),
        "/api/mcap" => site.history.open_file(&file).map_or_else(|e| Answer::fault(404, e), |open| Answer::file(open, &file)),
        "/api/csv" => {
            let name = format!("{}.csv", file.trim_end_matches(".mcap"));
            site.history.csv(&file).map_or_else(|e| Answer::fault(404, e), |text| Answer::bytes("text/csv", text).saved_as(&name))
        }
        _ => Answer::not_here(),
    }
}

fn line(result: Result<Value, String>) -> Answer {
    result.map_or_else(|e| Answer::fault(409, e), |value| Answer::json(&value))
}

/// The newest picture, with what the worker measured in it as a header.
fn picture(site: &Site) -> Answer {
    match site.cell.look() {
        Err(e) => Answer::fault(503, e),
        Ok(picture) => {
            let about = json!({
                "sequence": picture.sequence, "size_px": [picture.size_px.0, picture.size_px.1],
                "measured": picture.measured.map(|m| json!({ "area_px2": m.area_px2, "confidence": m.confidence,
                    "doubt": Doubt::from_code(m.doubt).words(), "triangle_px": m.triangle_px })),
            });
            Answer::jpeg(picture.jpeg.clone()).header("x-frame", &about.to_string())
        }
    }
}

fn post(site: &Site, request: &Request) -> Answer {
    let path = request.path.as_str();
    if path == "/api/stop" {
        return stop(site);
    }
    let (who, order) = match request.json::<Who>().and_then(|who| request.json::<Order>().map(|order| (who, order))) {
        Ok(both) => both,
        Err(e) => return Answer::fault(400, e),
    };
    let from = request.peer.ip().to_canonical().to_string();
    match path {
        "/api/here" => {
            let mut say = site.say();
            say.here(&who.id, order.holding);
            return Answer::json(&json!({ "mine": say.is(&who.id) }));
        }
        "/api/say" => {
            // What the page before ordered, and has not begun, does not begin under another's say.
            site.stopped();
            site.say().take(&who.id, &who.name, &from);
            return Answer::json(&json!({ "mine": true, "stops": site.stops() }));
        }
        "/api/leave" => {
            site.say().leave(&who.id);
            return Answer::json(&json!({ "mine": false }));
        }
        "/api/foresee" => return Answer::json(&orders::foresee(site, order.goal_ml, order.fill_ml).json()),
        _ => {}
    }
    let stops = site.stops();
    if MOTIONS.contains(&path)
        && let Err(e) = still_meant(&order, stops, now_ns() / 1_000_000)
    {
        return Answer::fault(409, e);
    }
    if let Err(e) = site.say().act(&who.id, &who.name, &from) {
        return Answer::fault(409, e);
    }
    line(act(site, stops, path, order))
}

/// Stops the motion. Whoever asks needs no say.
pub fn stop(site: &Site) -> Answer {
    site.stopped();
    line(site.stopper.stop().map(|words| json!({ "words": words, "stops": site.stops() })))
}

/// Whether an order of a motion is still meant: nobody has stopped since the state that its page saw, and that state is not old. Otherwise a Stop
/// that overtook the order, or a network that held it up, would let the robot begin after the person has turned away.
fn still_meant(order: &Order, stops: u64, now_ms: u64) -> Result<(), String> {
    let (Some(seen), Some(sent_at_ms)) = (order.stops, order.sent_at_ms) else {
        return Err("the page does not say what it has seen: load it again".into());
    };
    if seen != stops {
        return Err("it was stopped before it began".into());
    }
    // One from the future was sent before this machine was started.
    if now_ms.abs_diff(sent_at_ms) > LATE_MS {
        return Err("the order came late, so nothing began: look at the robot, and order it again".into());
    }
    Ok(())
}

/// What needs the say. `stops` is the number of stops when it was asked for.
fn act(site: &Site, stops: u64, path: &str, order: Order) -> Result<Value, String> {
    match path {
        "/api/pour" => {
            let episode = orders::pour(site, stops, order.goal_ml, order.fill_ml, (&order.identity, &order.lines))?;
            if order.hold {
                site.hold(episode);
            }
            Ok(json!({ "episode": episode }))
        }
        "/api/record" => orders::record(site, stops, order.lambda_deg, order.gamma_per_s2).map(|episode| json!({ "episode": episode })),
        "/api/resume" => orders::resume(site).map(|()| json!({ "words": "the robot is connected" })),
        "/api/weigh" => orders::weigh(site, &order.file, order.grams.ok_or("give the scale's reading in g")?, order.shown_g),
        "/api/plan" => {
            let (of, weighed) = (site.history.for_plan()?, site.history.weighed(None).len());
            site.jobs.start_plan((&of, weighed), &site.file, order.holds_ml)?;
            Ok(site.jobs.about())
        }
        "/api/learn" => {
            let files = site.history.to_learn(order.last)?;
            let (offer, config) = (site.shelf.offer(), &site.file);
            site.jobs.start_learning(&files, order.accept, order.leave_out, &offer, config)?;
            Ok(site.jobs.about())
        }
        "/api/cancel" => {
            site.jobs.cancel();
            Ok(site.jobs.about())
        }
        "/api/weights" => match order.what.as_str() {
            "accept" => site.shelf.accept(&order.identity).map(|identity| json!({ "identity": identity })),
            "back" => site.shelf.back(&order.identity).map(|identity| json!({ "identity": identity })),
            "decline" => site.shelf.decline(&order.identity).map(|()| json!({})),
            _ => Err("the page asks for what is not known: load it again".into()),
        },
        "/api/calibrate" => calibrate(site, &order),
        "/api/export" => export(site, &order),
        _ => Err("there is no such page".into()),
    }
}

/// One step of a calibration.
fn calibrate(site: &Site, order: &Order) -> Result<Value, String> {
    match order.what.as_str() {
        "colour" | "clear" | "as-configured" => {
            let picture = site.config.controller.weights.with_file_name("calibration.png");
            site.calibration.start((&site.file, &picture), order.seconds, &order.what)?;
            Ok(json!({ "words": "watching" }))
        }
        "corner" => site.calibration.order("/corner", &order.corner.to_string()).map(|words| json!({ "words": words })),
        "write" => {
            site.calibration.order("/write", &json!({ "section": order.section }).to_string()).map(|words| json!({ "words": words }))
        }
        "cancel" => {
            site.calibration.cancel();
            Ok(json!({ "words": "cancelled" }))
        }
        _ => Err("the page asks for what is not known: load it again".into()),
    }
}

/// Exports episodes in the background.
fn export(site: &Site, order: &Order) -> Result<Value, String> {
    let kind = FORMATS.into_iter().find(|f| *f == order.what).ok_or("choose a format")?;
    let files = order.files.iter().map(|name| site.history.path(name)).collect::<Result<Vec<_>, _>>()?;
    let seconds = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).map_or(0, |d| d.as_secs());
    let to = site.history.exports().join(format!("{kind}-{seconds}"));
    site.jobs.start_export(&files, kind, to)?;
    Ok(site.jobs.about())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects whoever has pressed Stop and turned away: an order that the Stop has overtaken, one that was held up on its way, and one of a page that
    /// does not say what it has seen begin nothing.
    #[test]
    fn an_order_from_before_a_stop_is_not_meant_any_more() {
        let order = |stops, sent_at_ms| Order { stops, sent_at_ms, ..Order::default() };
        let judged = |order: Order| still_meant(&order, 7, 100_000);
        assert_eq!(judged(order(Some(7), Some(99_000))), Ok(()));
        assert_eq!(judged(order(Some(6), Some(99_000))), Err("it was stopped before it began".into()));
        assert!(judged(order(Some(7), Some(97_000))).unwrap_err().contains("came late"));
        assert!(judged(order(Some(7), Some(5_000_000))).unwrap_err().contains("came late"), "before the machine was started again");
        assert!(judged(order(None, None)).unwrap_err().contains("load it again"));
    }
}
