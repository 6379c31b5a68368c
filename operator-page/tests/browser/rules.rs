//! The page's own rules, in a browser beside a server without a cell: what is sent, what is refused, and what is said of what is not known.

use std::path::Path;
use std::time::UNIX_EPOCH;

use shared::config::Config;
use shared::episode::{EpisodeEnd, EpisodeKind, EpisodeStart, EpisodeWriter, FrameRow, set_weight};
use shared::messages::{Feature, LAYOUT_VERSION, Telemetry};
use tests::CellUnderTest;
use tests::browser::Browser;

use super::{Page, SOON};

/// Counts what is sent, and answers instead of the server where `window.answers` has an answer for the path.
const CATCH: &str = "window.sent = []; window.answers = {}; const real = window.fetch.bind(window);
    window.fetch = (url, options) => { window.sent.push(url);
        const path = Object.keys(window.answers).sort((a, b) => b.length - a.length).find(p => url.includes(p));
        return path ? window.answers[path](url, options) : real(url, options); };
    window.pressed_stops = () => window.sent.filter(url => url === '/api/stop').length";
/// What came of a request: `began`, or the line that refuses it.
const TOLD: &str = "const told = what => what.then(() => 'began', error => error.message);";

/// Writes an episode of three frames, of which the second has no picture. Its goal is no whole number.
fn episode(directory: &Path, number: u64, weight_g: Option<f64>) {
    let config = Config::read(Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../config/sim.toml"))).expect("good");
    let kind = EpisodeKind::Pour { goal_ml: 12.5 };
    let start = EpisodeStart { episode: number, kind, started_at_ns: 1, wall_clock: UNIX_EPOCH, config: &config, weights: "" };
    let mut writer = EpisodeWriter::create(directory, &start).expect("writable");
    for n in 1..=3 {
        let at_ns = n * 33_000_000;
        let tick = Telemetry { version: LAYOUT_VERSION, tick: n, at_ns, episode: number, goal_ml: 12.5, ..Default::default() };
        writer.telemetry(&tick).expect("writable");
        let feature = Feature { version: LAYOUT_VERSION, sequence: n, captured_at_ns: at_ns, ..Default::default() };
        let image = (n != 2).then_some(("jpeg", &b"\xff\xd8 no picture"[..]));
        writer.frame(&FrameRow { feature: &feature, alpha_commanded_deg: 1.0, alpha_measured_deg: 1.0, image }).expect("writable");
    }
    let file = writer.finish(&EpisodeEnd { complete: true, reason: "over", disordered_frames: 0 }).expect("writable");
    if let Some(grams) = weight_g {
        set_weight(&file, grams).expect("writable");
    }
}

/// A page beside a cell of which nothing runs, with these episodes: their numbers and weights.
fn page(browser: &Browser, episodes: &[(u64, Option<f64>)]) -> (CellUnderTest, Page) {
    let cell = CellUnderTest::prepare(|_| {});
    let directory = cell.dir.path().join("episodes");
    std::fs::create_dir_all(&directory).expect("writable");
    episodes.iter().for_each(|(number, weight_g)| episode(&directory, *number, *weight_g));
    let page = Page::open(&cell);
    browser.go(&page.url());
    let there = format!("return !!state && table.episodes.length === {} && !table.unread", episodes.len());
    browser.wait("the states and the table", SOON, &there);
    browser.run(CATCH);
    (cell, page)
}

/// Protects whoever presses Stop: an order that the Stop has overtaken, or that was held up, begins nothing; a Stop follows an order that was under way;
/// each press is sent, also after a finger that slid off and in an old browser; and what is said of it is so.
#[test]
fn stop_is_sent_and_what_it_overtakes_is_refused() {
    let Some(browser) = Browser::open(1280, 1000) else { return };
    let (_cell, _page) = page(&browser, &[]);
    let told = |script: &str| browser.run(&format!("{TOLD} {script}")).as_str().expect("text").to_string();
    let curve = "lambda_deg: 50, gamma_per_s2: 0.3";
    let meant = told(&format!("return told(postMotion('/api/record', {{ {curve} }}))"));
    assert!(!meant.contains("before it began") && !meant.contains("came late"), "{meant}");
    let late = format!("return told(post('/api/record', {{ {curve}, stops: state.stops, sent_at_ms: state.sent_at_ms - 3000 }}))");
    assert!(told(&late).contains("the order came late"));
    let overtaken = format!(
        "const seen = {{ stops: state.stops, sent_at_ms: state.sent_at_ms }};
         return told(stop().then(() => post('/api/record', {{ {curve}, ...seen, sent_at_ms: state.sent_at_ms }})))"
    );
    assert_eq!(told(&overtaken), "it was stopped before it began");

    // From here on the page answers itself.
    browser.run("window.answers['/stop'] = () => new Promise(() => {}); window.answers['/api/record'] = () => new Promise(end => { window.end = end; })");
    let pressed = |script: &str| {
        browser.run(&format!("window.sent = []; {script}"));
        let wait = "return new Promise(end => setTimeout(() => end(window.pressed_stops()), 100))";
        browser.run(wait).as_u64().expect("a number")
    };
    assert_eq!(pressed("postMotion('/api/record').catch(() => {}); stop(); window.end(new Response('{}'))"), 2, "a Stop follows");
    let slid = "$('stop').dispatchEvent(new PointerEvent('pointerdown', { button: 0, bubbles: true }));
        document.body.dispatchEvent(new PointerEvent('pointerup', { bubbles: true }))";
    assert_eq!(pressed(slid), 1);
    assert_eq!(pressed("$('stop').click()"), 1, "a key's or a screen reader's click");
    assert_eq!(pressed("$('stop').dispatchEvent(new MouseEvent('click', { detail: 1 }))"), 1, "a click without a pointer");
    assert_eq!(pressed("AbortSignal.timeout = undefined; stop()"), 1, "an old browser");

    let said = |answers: &str, end: &str| {
        browser.run(&format!("{answers}; stop()"));
        browser.wait(end, SOON, &format!("return $('stop-said').textContent.includes({end:?})"));
    };
    let refusal = "window.answers['/api/stop'] = () => Promise.resolve(new Response('{\"error\":\"no such robot\"}', { status: 409 }))";
    said(refusal, "no such robot");
    let late = "window.answers['/stop'] = window.answers['/api/stop'] = () => Promise.reject(new DOMException('late', 'AbortError'))";
    said(late, "it is still being tried");
    browser.run("window.answers['/stop'] = () => Promise.reject(new TypeError('gone')); alive()");
    browser.wait("the word of the port", SOON, "return !$('stop-way').hidden && $('stop-way').textContent.includes('cannot be reached')");
    browser.run("delete window.answers['/stop']; alive()");
    browser.wait("that it is back", SOON, "return $('stop-way').hidden");

    // A connection that stays open, and from which nothing comes any more.
    let silent = "window.made = 0; window.answers['/events'] = () => { window.made += 1; return new Promise(() => {}); };
        connect(); const now = performance.now.bind(performance); performance.now = () => now() + 10000";
    browser.run(silent);
    browser.wait("a new connection", SOON, "return window.made > 1");
}

/// Protects who reads the page from what is not known and looks known, and who types from a number that is read as another one: goals, volumes,
/// results, weights, pictures, files.
#[test]
fn what_is_shown_and_typed_is_meant() {
    let Some(browser) = Browser::open(1280, 1000) else { return };
    let (_cell, _page) = page(&browser, &[(1, None), (2, Some(74.0))]);
    let json = |script: &str| browser.run(&format!("{TOLD} {script}"));
    let text = |script: &str| json(script).as_str().expect("text").to_string();
    let numbers =
        "return ['7,5', '.5', '75', '1,250', '1.250', '-1,250', '0x10', '1e2', '1250.5', '0,125', ''].map(decimal).map(String).join(' ')";
    assert_eq!(text(numbers), "7.5 0.5 75 NaN NaN NaN NaN NaN 1250.5 0.125 NaN");
    assert_eq!(text("return [7.5, 12.5, 0.4, 75, Math.fround(12.3)].map(goalWords).join(' ')"), "7.5 12.5 0.4 75 12.3");
    browser.wait("what is not known", SOON, "return $('outcomes').textContent.includes('are not known')");
    let deviation = "points = [1, 2].map(k => [k, k, 10, 10, 5, 0, 3, 75, 0, 2, 4, 80]); plots(); return $('plots-words').textContent";
    assert!(text(deviation).contains("75.0 ml poured (how far off that is, is not known)"));

    // A curve has no goal, and nobody counts what it pours. Where liquid may have left unseen, nobody knows what is missing.
    let curve = "points = [1, 2].map(k => [k, k, 10, 10, 5, 0, 3, 0, 0, 2, 4, NaN]); plots(); return $('plots-words').textContent";
    assert!(!text(curve).contains("poured"), "{}", text(curve));
    let off = |poured: f64, unseen: bool| {
        text(&format!("return offGoal({{ poured_ml: {poured}, poured_sd_ml: 1.2, goal_ml: 75, unseen: {unseen} }})"))
    };
    assert!(off(20.0, false).contains("55.0 ± 1.2 ml short of the goal"), "{}", off(20.0, false));
    assert!(off(20.0, true).contains("at most 55.0 ± 1.2 ml are missing"), "{}", off(20.0, true));
    assert!(off(90.0, true).contains("at least 15.0 ± 1.2 ml over"), "{}", off(90.0, true));

    // A weight is not overwritten, and what is far from the estimate is asked for twice.
    let weigh =
        |shown: &str| text(&format!("return told(post('/api/weigh', {{ file: 'episode-0002.mcap', grams: 75, shown_g: {shown} }}))"));
    for shown in ["null", "73"] {
        let refused = weigh(shown);
        assert!(refused.contains("has a weight already, 74 g"), "{refused}");
    }
    assert_eq!(weigh("74"), "began");
    let far = "window.sent = []; const form = scale('episode-0002.mcap', 50, () => {}, 50); form.querySelector('input').value = '5,1'; form.onsubmit(new Event('submit'));
        return form.textContent + window.sent.length";
    assert!(text(far).contains("enter it again") && text(far).ends_with('0'), "{}", text(far));
    let later = "window.sent = []; const row = rowToWeigh({ file: 'episode-0001.mcap', run: { kind: 'pour', goal_ml: 12.5 }, poured_ml: 12 });
        row.querySelector('input').value = '120'; row.querySelector('form').onsubmit(new Event('submit')); return row.textContent + window.sent.length";
    assert!(text(later).contains("enter it again") && text(later).ends_with('0'), "{}", text(later));

    // What is typed stays while another episode comes, and what is not listed is said.
    browser.click("#tab-learn");
    let typed = "const i = document.querySelector('#unweighed input'); i.value = '74'; i.focus();
        const one = table.episodes[0]; const more = n => ({ ...one, file: `other-${n}.mcap` });
        table = { ...table, unread: 7, episodes: [...table.episodes, ...Array.from({ length: 14 }, (_, n) => more(n)), { ...one, file: 'cut.mcap', complete: false, ended: '' }, { ...one, file: 'gap.mcap', complete: false }] };
        unweighed(); return $('unweighed').textContent";
    let listed = text(typed);
    for part in [
        "7 files still to be read",
        "3 older ones are not weighed",
        "1 episode without a weight was cut",
        "1 episode without a weight lacks",
    ] {
        assert!(listed.contains(part), "{part}: {listed}");
    }
    let skip = "[...document.querySelectorAll('#unweighed .skip-weight')].slice(0, 12).forEach(b => b.click());
        const i = [...document.querySelectorAll('#unweighed input')]; return i.map(one => one.value).join()";
    browser.run("table.episodes.splice(3, 11); unweighed(); document.querySelector('#unweighed input').value = '74'; table.episodes.push({ ...table.episodes[0], file: 'new.mcap' }); unweighed()");
    assert!(json("return [...document.querySelectorAll('#unweighed input')].map(i => i.value).includes('74')") == true);
    assert_eq!(text(skip), "");
    assert!(!text("return $('unweighed').textContent").contains("Everything"), "what is skipped is not weighed");
    let judge = "judged.clear(); askDoubts([['/x/odd.mcap', 'odd']]); const r = [...document.querySelectorAll('#doubts input')];
        const before = r.find(one => one.checked).value + judged.get('/x/odd.mcap'); r.find(one => one.value === 'use').click(); return before + judged.get('/x/odd.mcap')";
    assert_eq!(text(judge), "leavefalsetrue");

    // A picture says when it is another frame's; a saved table has the episode's name; and a second page's calibration is shown.
    browser.click("#tab-history");
    let look = |k: usize| {
        text(&format!(
            "chosen = 'episode-0001.mcap'; rows = {{ t_s: [0, 1, 2], sequence: [1, 2, 3] }}; return showPicture({k}).then(() => $('episode-picture-words').textContent)"
        ))
    };
    assert_eq!((look(0).as_str(), look(2).as_str()), ("", ""));
    assert!(look(1).contains("that of frame 1, the nearest before it, is shown"), "{}", look(1));
    let name = text("return fetch('/api/csv?file=episode-0001.mcap').then(r => r.headers.get('content-disposition'))");
    assert!(name.contains("episode-0001.csv"), "{name}");
    let saved = "const made = URL.createObjectURL; showTable();
        return new Promise(end => { URL.createObjectURL = file => { URL.createObjectURL = made; file.text().then(end); return made.call(URL, file); };
            document.querySelector('[aria-label=\"Save episode-0001.mcap as .csv\"]').click(); })";
    assert!(text(saved).lines().count() > 3, "{}", text(saved));
    let many = "const one = table.episodes[0]; table.episodes = Array.from({ length: 700 }, (_, n) => ({ ...one, file: `e-${n}.mcap` })); showTable();
        window.answers['/api/export'] = (url, o) => { window.exported = JSON.parse(o.body).files.length; return Promise.resolve(new Response('{}')); };
        document.querySelector('[data-format=csv]').click(); return $('table-words').textContent + document.querySelectorAll('#table tbody tr').length + ' ' + window.exported";
    let many = text(many);
    assert!(many.contains("700 of 700") && many.contains("The first 500 of them are shown") && many.ends_with("500 500"), "{many}");
    browser.click("#tab-calibrate");
    let two = "const found = section => ({ busy: false, lines: [], ended: null, found: { section, width: 640, height: 480, lip: [1, 1], rim: [2, 2], foot: [3, 3] } });
        const says = section => { window.answers['/api/calibration'] = () => Promise.resolve(new Response(JSON.stringify(found(section)))); return look(); };
        return says('first').then(() => says('second')).then(() => $('calibrate-section').textContent)";
    assert_eq!(text(two), "second");
}
