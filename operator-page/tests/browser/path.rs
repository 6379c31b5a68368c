//! The whole path of a new cell: fill, record, weigh, learn, pour, weigh, learn again, and back to the weights from before.

use std::time::{Duration, Instant};

use tests::CellUnderTest;
use tests::browser::Browser;

use super::{LIVE, Page, SOON, picture, says, worker_pages};

/// A training takes some seconds alone, and much longer beside others.
const TRAINED: Duration = Duration::from_secs(240);
/// Only a calibration that hangs takes longer. It has the least priority.
const CALIBRATED: Duration = Duration::from_secs(240);

/// Types the scale's reading into the result, and gives it.
fn weigh(cell: &CellUnderTest, browser: &Browser) -> f64 {
    browser.wait(
        "the result",
        Duration::from_secs(60),
        "return !!document.querySelector('#result-body .grams') && !document.getElementById('result').hidden",
    );
    let grams = cell.json("simulator", &["operator", "scale", "--json"])["weight_g"].as_f64().expect("a weight");
    browser.fill("#result-body .grams", &grams.to_string());
    browser.click("#result-body button[type=submit]");
    browser.wait("the weight", SOON, "return document.getElementById('result-body').textContent.includes('Weighed')");
    grams
}

/// Begins to learn.
fn begin_to_learn(browser: &Browser) {
    browser.click("#tab-learn");
    browser.wait("the button", SOON, "return !document.getElementById('start-learning').disabled");
    browser.click("#start-learning");
    browser.wait("the training", SOON, "return !!document.querySelector('#job progress')");
    browser.screenshot(&picture("learning"));
}

/// Waits for the offer, and takes it into use.
fn take_the_offer(browser: &Browser) {
    browser.click("#tab-learn");
    let over = "return !!document.querySelector('#compare .accept') || /failed|judge/.test(document.getElementById('job').textContent)";
    browser.wait("the offer", TRAINED, over);
    if browser.text("#job").contains("judge") {
        browser.run("document.querySelectorAll('#doubts input[value=use]').forEach(b => b.click())");
        browser.click("#learn-judged");
        browser.wait("the offer", TRAINED, "return !!document.querySelector('#compare .accept')");
    }
    browser.screenshot(&picture("offered"));
    browser.click("#compare .accept");
    browser.wait("the new weights", SOON, "return document.getElementById('said').textContent.includes('in use')");
    browser.run("scrollTo(0, 0)");
}

/// Waits until the calibration under way has come so far that `script` gives true. It runs behind everything else, so however long it takes, only
/// its own end is too early.
fn wait_for_calibration(browser: &Browser, what: &str, script: &str) {
    let ended = "return !!document.querySelector('#calibrate-lines .good, #calibrate-lines .bad')";
    let until = Instant::now() + CALIBRATED;
    while browser.run(script) != true {
        // It may have come so far and ended since the look before.
        let over = browser.run(ended) == true || Instant::now() > until;
        assert!(!over || browser.run(script) == true, "{what} did not happen; the page says:\n{}", browser.text("body"));
        std::thread::sleep(Duration::from_millis(100));
    }
}

/// Corrects what was found while the second curve was recorded, by keys and by a click, and writes it.
fn calibrate(cell: &CellUnderTest, browser: &Browser) {
    let image = || cell.config().display().to_string();
    let read = || shared::config::Config::read(&cell.config()).unwrap_or_else(|e| panic!("{}: {e}", image())).image;
    let before = read();
    browser.click("#tab-calibrate");
    wait_for_calibration(browser, "what was found", "return !document.getElementById('calibrate-write').hidden");
    wait_for_calibration(browser, "its picture", "return document.getElementById('spot-picture').naturalWidth === 640");
    browser.screenshot(&picture("calibrated"));
    // By keys: the lip 2 px to the left and back by 1.
    browser.run("document.getElementById('spot').focus()");
    browser.press(&["\u{E012}", "\u{E012}", "\u{E014}"]);
    // What was measured with the dots elsewhere is not written.
    assert_eq!(browser.run("return document.getElementById('calibrate-write').hidden"), true);
    browser.click("#measure");
    wait_for_calibration(browser, "the new measurement", "return document.getElementById('said').textContent.includes('measured again')");
    wait_for_calibration(browser, "the picture with it", "return found !== null");
    browser.run("document.getElementById('write-title').scrollIntoView({ block: 'center' })");
    browser.click("#calibrate-write");
    wait_for_calibration(browser, "that it is written", "return document.getElementById('said').textContent.includes('written to')");
    wait_for_calibration(
        browser,
        "the child's end",
        "return document.getElementById('calibrate-lines').textContent.includes('It is written')",
    );
    browser.run("scrollTo(0, 0)");
    browser.screenshot(&picture("calibration-written"));
    let after = read();
    assert_ne!(after, before, "the configuration has what was found");
    let lip = [after.x_axis_px[0], after.x_axis_px[1]];
    assert!((lip[0] - before.x_axis_px[0]).abs() < 6.0 && (lip[1] - before.x_axis_px[1]).abs() < 6.0, "{lip:?}");
}

/// Protects an operator's first hour with a new cell, all of it in the browser: two curves as they are proposed, their weights, a training, a
/// pour that is foreseen, confirmed, watched and weighed, a training from all three, and the way back; and a calibration that watches the second
/// curve, is corrected and written while the first training runs. At the end the worker's own pages are attacked.
#[test]
fn a_new_cell_learns_to_pour_in_the_browser() {
    let Some(browser) = Browser::open(1280, 1000) else { return };
    let cell = CellUnderTest::start(|config| {
        config["container"].as_table_mut().expect("a table").insert("holds_ml".into(), toml::Value::Float(520.0));
    });
    // A file's name is text, and never markup.
    std::fs::create_dir_all(cell.dir.path().join("episodes")).expect("writable");
    std::fs::write(cell.dir.path().join("episodes/<img src=x onerror=alert(1)>.mcap"), "no episode").expect("writable");
    let page = Page::open(&cell);
    browser.go(&page.url());
    browser.wait("the live picture", SOON, LIVE);
    says(&browser, "Ready to record, but not to pour");
    browser.screenshot(&picture("no-weights"));

    let mut weights = Vec::new();
    for curve in 0..2 {
        browser.click("#tab-learn");
        browser.wait("the button", SOON, "return !document.getElementById('make-plan').disabled");
        browser.run("document.getElementById('plan').replaceChildren()");
        browser.click("#make-plan");
        browser.wait("a proposal", Duration::from_secs(60), "return !!document.querySelector('#plan .primary.record')");
        browser.screenshot(&picture(if curve == 0 { "first-proposal" } else { "second-proposal" }));
        let words = browser.text("#plan .proposal b");
        let fill = words.split(' ').nth(2).expect("Fill in N ml").to_string();
        cell.json("simulator", &["operator", "fill", &fill, "--json"]);
        cell.wait_idle();
        if curve == 1 {
            browser.click("#tab-calibrate");
            browser.fill("#watch-seconds", "18");
            browser.click("#watch");
            wait_for_calibration(
                &browser,
                "the camera is watched",
                "return document.getElementById('calibrate-lines').textContent.includes('watching the camera')",
            );
            browser.click("#tab-learn");
        }
        browser.click("#plan .primary.record");
        says(&browser, "Recording a curve");
        weights.push(weigh(&cell, &browser));
    }
    assert!(weights.iter().all(|g| *g > 5.0), "something flowed: {weights:?}");
    begin_to_learn(&browser);
    calibrate(&cell, &browser);
    take_the_offer(&browser);
    cell.wait("the weights", SOON, |s| s["weights"] != "");

    cell.json("simulator", &["operator", "fill", "350", "--json"]);
    cell.wait_idle();
    browser.click("#tab-pour");
    says(&browser, "Ready to pour");
    browser.fill("#goal", "500");
    browser.click("#foresee");
    browser.wait("the refusal", SOON, "return document.getElementById('said').textContent.includes('at most 300')");
    browser.fill("#goal", "75");
    browser.click("#foresee");
    browser.wait("what is foreseen", SOON, "return document.getElementById('foreseen').textContent.includes('one standard deviation')");
    let warned = browser.text("#foreseen");
    assert!(warned.contains("few weighed episodes (2)"), "{warned}");
    browser.screenshot(&picture("foreseen"));
    browser.click("#go");
    says(&browser, "Pouring 75 ml");
    browser.wait("a stream", Duration::from_secs(30), "return points[points.length - 1][POURED] > 25");
    browser.screenshot(&picture("pouring"));
    let grams = weigh(&cell, &browser);
    browser.screenshot(&picture("weighed"));
    println!("goal 75 ml, {grams} g; the page says: {}", browser.text("#result-body").replace('\n', " "));
    assert!(browser.text("#result-body").contains("an error of"));

    let before = cell.status().expect("running")["weights"].clone();
    begin_to_learn(&browser);
    take_the_offer(&browser);
    let after = cell.wait("the new weights", SOON, |s| s["weights"] != before)["weights"].clone();
    browser.wait("the way back", SOON, "return !!document.querySelector('#compare .back')");
    browser.run("document.getElementById('compare-title').scrollIntoView()");
    browser.screenshot(&picture("choose-weights"));
    let beside = "return [...document.querySelectorAll('#compare thead th')].map(h => h.textContent).join() + [...document.querySelectorAll('#compare tbody th')].filter(h => h.textContent.startsWith('Expected error')).length";
    assert_eq!(browser.run(beside), "In use,From before4", "the expected errors stand beside each other");
    browser.click("#compare .back");
    cell.wait("the weights from before", SOON, |s| s["weights"] == before && s["weights"] != after);

    browser.run("scrollTo(0, 0)");
    browser.click("#tab-history");
    browser.wait("three episodes and the file that is none", SOON, "return document.querySelectorAll('#table tbody tr').length === 4");
    assert!(browser.text("#table").contains("<img src=x onerror=alert(1)>.mcap"));
    assert_eq!(browser.run("return document.querySelectorAll('#table img').length"), 0);
    browser.run("document.getElementById('kind').value = 'pour'; document.getElementById('kind').onchange()");
    browser.wait("one pour", SOON, "return document.querySelectorAll('#table tbody tr').length === 1");
    browser.click("#table .look");
    let loaded = "const i = document.getElementById('episode-picture'); return i.complete && i.naturalWidth === 640";
    browser.wait("the episode's picture", SOON, loaded);
    browser.run("document.getElementById('table-title').scrollIntoView()");
    browser.screenshot(&picture("history"));
    browser.run("document.getElementById('episode').scrollIntoView()");
    browser.screenshot(&picture("episode"));
    browser.run("document.getElementById('exports').scrollIntoView({ block: 'center' })");
    for format in ["csv", "lerobot"] {
        browser.click(&format!("#exports [data-format={format}]"));
        let written = format!("return document.getElementById('export-said').textContent.includes('exports/{format}')");
        browser.wait("the export", Duration::from_secs(60), &written);
    }
    worker_pages::stand_attacks(&cell);
}
