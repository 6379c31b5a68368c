//! The page for everybody: by keyboard alone, with a screen reader's names, on a phone, at 200 % zoom, in dark and light.

use std::time::Duration;

use tests::browser::Browser;
use tests::{CellUnderTest, steady_weights};

use super::{LIVE, Page, SOON, TILT_OUT, picture, says};

/// Key of the tabulator in WebDriver.
const TAB: &str = "\u{E004}";
/// Key Enter in WebDriver.
const ENTER: &str = "\u{E007}";
/// Arrow to the right in WebDriver.
const RIGHT: &str = "\u{E014}";

/// Controls and pictures without a name for a screen reader, and headings that skip a level; empty if all is well.
const NAMELESS: &str = "
    const name = e => e.getAttribute('aria-label') || (e.labels && [...e.labels].map(l => l.textContent).join('').trim()) || e.alt || e.textContent.trim();
    const bad = [...document.querySelectorAll('button, input, select, a, canvas, img, [role=tabpanel], [role=application]')]
        .filter(e => !name(e) && !e.getAttribute('aria-labelledby')).map(e => e.outerHTML.slice(0, 80));
    const ids = [...document.querySelectorAll('[id]')].map(e => e.id);
    return bad.concat(ids.filter((id, k) => ids.indexOf(id) !== k)).join('; ')";

/// Roles of what a person uses or looks at; each needs a name.
const NAMED: [&str; 12] =
    ["button", "textbox", "combobox", "slider", "image", "img", "tab", "tabpanel", "link", "application", "progressbar", "region"];

/// Marks what is reached by keys alone, from the page's beginning.
const WALK: &str = "document.activeElement.blur(); scrollTo(0, 0); window.reached = new Set();
    window.walked ||= addEventListener('focusin', e => window.reached.add(e.target)) || true;
    return [...document.querySelectorAll('button, input, select, a[href], [tabindex]')].filter(e => e.tabIndex >= 0 && !e.disabled && e.checkVisibility()).length";
/// What was not; empty if all is well.
const UNREACHED: &str = "return [...document.querySelectorAll('button, input, select, a[href], [tabindex]')]
    .filter(e => e.tabIndex >= 0 && !e.disabled && e.checkVisibility() && !window.reached.has(e)).map(e => e.outerHTML.slice(0, 80)).join('; ')";

/// Pairs of text and ground that are closer than the contrast of WCAG 2.2 AA (4.5); empty if all is well.
const FAINT: &str = "
    const paint = v => { const d = document.createElement('i'); d.style.color = `var(${v})`; document.body.append(d);
        const c = getComputedStyle(d).color.match(/[0-9.]+/g).map(Number); d.remove(); return c; };
    const light = c => { const [r, g, b] = c.slice(0, 3).map(v => { v /= 255; return v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4; }); return 0.2126 * r + 0.7152 * g + 0.0722 * b; };
    const ratio = (a, b) => { const [x, y] = [light(paint(a)), light(paint(b))]; return (Math.max(x, y) + 0.05) / (Math.min(x, y) + 0.05); };
    const pairs = ['--ink', '--soft', '--good', '--warn', '--bad'].flatMap(t => [[t, '--paper'], [t, '--card']]).concat([['--on-accent', '--accent'], ['--on-stop', '--stop']]);
    return pairs.map(([t, g]) => [t, g, ratio(t, g)]).filter(p => p[2] < 4.5).map(p => `${p[0]} on ${p[1]}: ${p[2].toFixed(2)}`).join('; ')";

/// Whether nothing is wider than the window, and Stop is in the window.
const FITS: &str = "const s = document.getElementById('stop').getBoundingClientRect();
    return document.documentElement.scrollWidth <= innerWidth && s.bottom <= innerHeight && s.top >= 0 && s.right <= innerWidth";

/// Protects people who do not use a mouse, do not see, or hold a phone: every control has a name and enough contrast, nothing leaves the window at a
/// phone's size or at 200 % zoom, Stop is always in it, and a pour is ordered and stopped by keys alone.
#[test]
fn everybody_can_use_it() {
    let Some(browser) = Browser::open(1280, 1000) else { return };
    let cell = CellUnderTest::start(|_| {});
    cell.take_weights(&steady_weights(TILT_OUT));
    cell.json("simulator", &["operator", "fill", "300", "--json"]);
    cell.wait_idle();
    let page = Page::open(&cell);
    browser.go(&page.url());
    browser.wait("the live picture", SOON, LIVE);
    says(&browser, "Ready to pour");

    // A phone, a phone held across, and what 200 % zoom leaves of 1280 x 1000 px.
    for (width, height) in [(390, 844), (844, 390), (640, 500), (1280, 1000)] {
        browser.resize(width, height);
        for tab in ["learn", "history", "calibrate", "pour"] {
            browser.run(&format!("document.getElementById('tab-{tab}').click(); scrollTo(0, 0)"));
            for theme in ["light", "dark"] {
                browser.run(&format!("document.getElementById('theme').value = '{theme}'; theme()"));
                assert_eq!(browser.run(FAINT), "", "{theme}");
                if theme == "dark" || width == 1280 {
                    browser.screenshot(&picture(&format!("{tab}-{width}-{theme}")));
                }
            }
            assert_eq!(browser.run(FITS), true, "{tab} at {width} x {height}");
            assert_eq!(browser.run(NAMELESS), "", "{tab}");
            if width == 1280 {
                // What the browser itself tells a screen reader.
                let all = browser.accessible();
                let nameless: Vec<_> = all.iter().filter(|(role, name)| NAMED.contains(&role.as_str()) && name.is_empty()).collect();
                let stop = all.iter().any(|(role, name)| role == "button" && name.starts_with("Stop"));
                assert!(nameless.is_empty() && stop, "{tab}: {nameless:?} of {all:?}");
                // What scrolls is a step too.
                let steps = browser.run(WALK).as_u64().expect("a number") as usize + 8;
                browser.press(&vec![TAB; steps]);
                assert_eq!(browser.run(UNREACHED), "", "{tab}: by {steps} steps");
                // Letters of twice the size, without a larger window.
                browser.run("document.documentElement.style.fontSize = '200%'; scrollTo(0, 0)");
                assert_eq!(browser.run(FITS), true, "{tab} with large letters");
                browser.screenshot(&picture(&format!("{tab}-large-letters")));
                browser.run("document.documentElement.style.fontSize = ''");
            }
        }
    }

    // From the first tab to the goal by the tabulator, then by Enter alone.
    browser.run("document.getElementById('tab-pour').focus()");
    browser.press(&[RIGHT]);
    assert_eq!(browser.run("return document.activeElement.id"), "tab-learn");
    browser.run("document.getElementById('tab-pour').click(); document.getElementById('tab-pour').focus()");
    for _ in 0..4 {
        if browser.run("return document.activeElement.id") == "goal" {
            break;
        }
        browser.press(&[TAB]);
    }
    assert_eq!(browser.run("return document.activeElement.id"), "goal");
    browser.press(&["1", "0", "0", ENTER]);
    browser.wait("the focus on the button that pours", SOON, "return document.activeElement.id === 'go'");
    // The space bar does not press the button that has the focus: nothing starts.
    browser.press(&[" "]);
    browser.wait("the answer", SOON, "return document.getElementById('stop-said').textContent.startsWith('Stop: ')");
    assert_eq!(cell.status().expect("running")["outcomes"].as_array().map(Vec::len), Some(0));
    browser.press(&[ENTER]);
    says(&browser, "Pouring 100 ml");
    browser.press(&[" "]);
    cell.wait("the end", SOON, |s| s["phase"] == "idle" && s["outcomes"][0]["reason"] == "aborted");

    // Hold to pour: it goes on while the button or Enter is held, and ends when it is let go of, or when the page is lost.
    browser.run("document.getElementById('hold').click()");
    for key in [None, Some(ENTER)] {
        let held = (0..TRIES).any(|_| is_held_for_a_second(&browser, &cell, key));
        assert!(held, "it goes on while it is held");
        let before = outcomes(&cell);
        if key.is_none() {
            browser.screenshot(&picture("held"));
            browser.let_go();
        } else {
            browser.go("about:blank");
        }
        cell.wait("the end", SOON, |s| s["phase"] == "idle" && s["outcomes"][before]["reason"] == "aborted");
    }
}

/// A browser that stands still for longer than the page's time to let go ends what it holds, as it shall. A busy machine does that to it now and then,
/// but not each time.
const TRIES: usize = 5;

fn outcomes(cell: &CellUnderTest) -> usize {
    cell.status().expect("running")["outcomes"].as_array().map_or(0, Vec::len)
}

/// Orders 90 ml, holds the button with the mouse or a key, and tells whether the pour goes on for a second. If not, all is let go of and at rest.
fn is_held_for_a_second(browser: &Browser, cell: &CellUnderTest, key: Option<&str>) -> bool {
    let before = outcomes(cell);
    says(browser, "Ready to pour");
    browser.fill("#goal", "90");
    browser.click("#foresee");
    browser.wait("the focus on the button that pours", SOON, "return document.activeElement.id === 'go'");
    browser.hold("#go", key);
    let pours = || cell.status().expect("running")["phase"] == "pouring";
    let has_ended = || outcomes(cell) > before;
    cell.wait("a pour or its end", SOON, |s| s["phase"] == "pouring" || s["outcomes"].as_array().is_some_and(|o| o.len() > before));
    std::thread::sleep(Duration::from_secs(1));
    if pours() && !has_ended() {
        says(browser, "Pouring 90 ml");
        return true;
    }
    browser.let_go();
    cell.wait("the end", SOON, |s| s["phase"] == "idle" && s["outcomes"][before]["reason"] == "aborted");
    false
}
