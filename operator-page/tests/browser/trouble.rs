//! What may go wrong beside a page: another browser, another site, a lost server, a lost robot, a dark camera; and a phone.

use std::io::{Read as _, Write as _};
use std::net::TcpListener;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use rustix::process::Signal;
use tests::attack::attack;
use tests::browser::Browser;
use tests::{CellUnderTest, steady_weights};

use super::{LIVE, LOST, Page, SOON, TILT_OUT, picture, says};

/// Another site: a page that sends to the operator's page whatever a browser lets it send.
fn other_site(target: &str) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
    let address = listener.local_addr().expect("an address");
    let body = format!(
        "<script>(async () => {{ const u = 'http://{target}'; const all = [];
        const pour = JSON.stringify({{ id: 'evil', name: 'evil', goal_ml: 50 }});
        for (const type of ['application/json', 'text/plain', 'application/x-www-form-urlencoded'])
          for (const path of ['/api/pour', '/api/stop', '/api/say'])
            for (const mode of ['cors', 'no-cors'])
              all.push(fetch(u + path, {{ method: 'POST', mode, headers: {{ 'Content-Type': type }}, body: pour }}).then(r => r.type === 'opaque' ? 'sent' : 'READ', () => 'refused'));
        all.push(fetch(u + '/api/about').then(() => 'READ', () => 'refused'));
        const done = await Promise.all(all);
        const shown = await new Promise(end => {{ const i = new Image(); i.onload = () => end('SHOWN'); i.onerror = () => end('refused'); i.src = u + '/picture.jpg'; }});
        document.title = [...done, shown].join(' ');
        }})()</script><iframe src='http://{target}/'></iframe>"
    );
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            let Ok(mut stream) = stream else { return };
            let _ = stream.read(&mut [0; 4096]);
            let _ = write!(
                stream,
                "HTTP/1.1 200 OK\r\nContent-Type: text/html\r\nContent-Length: {}\r\nConnection: close\r\n\r\n{body}",
                body.len()
            );
        }
    });
    format!("http://{address}/")
}

/// Starts the simulator anew, in a room without light.
fn darken(cell: &mut CellUnderTest) {
    assert_eq!(cell.stop("simulator"), Some(0));
    let text = std::fs::read_to_string(cell.config()).expect("there");
    let mut config: toml::Table = text.parse().expect("TOML");
    let simulator = config["simulator"].as_table_mut().expect("a table");
    let view = simulator.entry("view").or_insert_with(|| toml::Table::new().into()).as_table_mut().expect("a table");
    view.insert("light".into(), toml::Value::Float(0.05));
    std::fs::write(cell.config(), config.to_string()).expect("writable");
    cell.spawn("simulator");
}

/// Protects the robot from other people's pages, and people from a page that is old: what a second origin sends moves nothing, one page at a time
/// has the say, a picture that is too dark is doubted, and a page says within a second that it has lost its server.
#[test]
fn others_move_nothing_and_losses_are_said() {
    let Some(browser) = Browser::open(1280, 1000) else { return };
    let mut cell = CellUnderTest::start(|_| {});
    cell.take_weights(&steady_weights(TILT_OUT));
    cell.json("simulator", &["operator", "fill", "300", "--json"]);
    cell.wait_idle();
    let page = Page::open(&cell);
    attack(&page.address, "/api/about", page.process.id());

    browser.go(&other_site(&page.address));
    browser.wait("the other site's requests", SOON, "return document.title !== '' && !document.title.startsWith('http')");
    let got = browser.run("return document.title").as_str().expect("text").to_string();
    println!("another site got: {got}");
    assert!(!got.contains("READ") && !got.contains("SHOWN"), "{got}");
    let status = cell.status().expect("running");
    assert_eq!((&status["phase"], status["outcomes"].as_array().map(Vec::len)), (&"idle".into(), Some(0)));
    for line in [
        "POST /api/pour HTTP/1.1\r\nHost: evil.example\r\nOrigin: http://evil.example\r\nContent-Type: application/json\r\n",
        "GET /api/about HTTP/1.1\r\nHost: evil.example\r\n",
    ] {
        let mut stream = std::net::TcpStream::connect(&page.address).expect("it listens");
        write!(stream, "{line}Connection: close\r\n\r\n").expect("it reads");
        let mut answer = String::new();
        stream.read_to_string(&mut answer).expect("text");
        assert!(answer.starts_with("HTTP/1.1 421"), "{answer}");
    }

    browser.go(&page.url());
    browser.wait("the live picture", SOON, LIVE);
    let other = Browser::open(420, 850).expect("there was one before");
    other.go(&page.url());
    other.wait("the live picture", SOON, LIVE);
    other.run("own.name = '<b>Bea</b>'");
    other.click("#take");
    browser.wait("the other's name, as text", SOON, "return document.getElementById('who').textContent.includes('<b>Bea</b>')");
    browser.fill("#goal", "60");
    browser.click("#foresee");
    browser.wait("what is foreseen", SOON, "return !document.getElementById('confirm').hidden");
    browser.click("#go");
    browser.wait("the refusal", SOON, "return document.getElementById('said').textContent.includes('has the say')");
    browser.screenshot(&picture("another-has-the-say"));
    browser.click("#take");
    // A tab that is duplicated gets a copy of the storage, but not the say; one that is loaded again keeps it.
    let copy = browser.run("return JSON.stringify(sessionStorage)").as_str().expect("text").to_string();
    let [first, twin] = browser.windows();
    let holds = "return document.getElementById('who').textContent.includes('you have')";
    browser.enter(&twin);
    browser.go(&format!("{}icon.svg", page.url()));
    browser.run(&format!("for (const [name, value] of Object.entries({copy})) sessionStorage.setItem(name, value)"));
    browser.go(&page.url());
    browser.wait("the live picture", SOON, LIVE);
    assert_eq!(browser.run(holds), false, "the twin has not the say");
    browser.click("#take");
    browser.wait("the say is the twin's", SOON, holds);
    browser.close();
    browser.enter(&first);
    browser.wait("the say is not this page's", SOON, "return !document.getElementById('who').textContent.includes('you have')");
    browser.click("#take");
    browser.wait("the say", SOON, "return document.getElementById('who').textContent.includes('you have')");
    browser.go(&page.url());
    browser.wait("the live picture", SOON, LIVE);
    browser.wait("the say", SOON, "return document.getElementById('who').textContent.includes('you have')");
    browser.fill("#goal", "60");
    browser.click("#foresee");
    browser.wait("what is foreseen", SOON, "return !document.getElementById('confirm').hidden");
    browser.click("#go");
    says(&browser, "Pouring 60 ml");
    says(&other, "Pouring 60 ml");
    other.screenshot(&picture("phone-pouring"));
    let fits = "return document.documentElement.scrollWidth <= innerWidth && document.getElementById('stop').getBoundingClientRect().bottom <= innerHeight";
    assert_eq!(other.run(fits), true, "Stop is in reach on a phone, and nothing is wider than it");
    // The page that has not the say may stop all the same.
    other.click("#stop");
    other.wait("the answer", SOON, "return document.getElementById('stop-said').textContent.startsWith('Stop: ')");
    cell.wait("the end", SOON, |s| s["phase"] == "idle" && s["outcomes"][0]["reason"] == "aborted");

    cell.signal("feature-worker", Signal::STOP);
    browser.wait("the missing measurement", SOON, "return document.getElementById('frame-words').textContent.includes('not measured')");
    browser.screenshot(&picture("worker-hangs"));
    cell.signal("feature-worker", Signal::CONT);
    assert!(cell.command("simulator", &["operator", "fault", "protective-stop"]).status.success());
    says(&browser, "The robot may not move");
    assert!(browser.text("#remedy").len() > 20, "{}", browser.text("#remedy"));
    browser.screenshot(&picture("robot-stopped"));
    darken(&mut cell);
    browser.wait("the doubt", SOON, "return document.getElementById('frame-words').textContent.includes('DOUBT: too dark')");
    browser.screenshot(&picture("camera-dark"));
    cell.signal("simulator", Signal::STOP);
    browser.wait("no picture", SOON, "return document.getElementById('frame-words').textContent.includes('No picture')");
    says(&browser, "The robot may not move");
    browser.screenshot(&picture("camera-and-robot-lost"));
    cell.signal("simulator", Signal::CONT);
    cell.signal("rt-controller", Signal::KILL);
    says(&browser, "The controller does not answer");
    browser.screenshot(&picture("controller-lost"));

    // Once the server only hangs, and once it is killed.
    browser.run(
        "window.lostAt = 0; new MutationObserver(() => { if (document.body.classList.contains('lost')) window.lostAt ||= Date.now(); })
         .observe(document.body, { attributes: true })",
    );
    let pid = rustix::process::Pid::from_child(&page.process);
    for (signal, what) in [(Signal::STOP, "hung"), (Signal::KILL, "was killed")] {
        rustix::process::kill_process(pid, signal).expect("it is ours");
        let at_ms = SystemTime::now().duration_since(UNIX_EPOCH).expect("after 1970").as_secs_f64() * 1e3;
        browser.wait("the loss", Duration::from_secs(5), LOST);
        let lost_ms = browser.run("return window.lostAt").as_f64().expect("a time");
        println!("the page was grey {:.0} ms after its server {what}", lost_ms - at_ms);
        if signal == Signal::STOP {
            rustix::process::kill_process(pid, Signal::CONT).expect("it is ours");
            browser.wait("the server is back", SOON, "return !document.body.classList.contains('lost')");
            browser.run("window.lostAt = 0");
        }
    }
    browser.screenshot(&picture("server-lost"));
    browser.click("#stop");
    browser.wait("that Stop failed", SOON, "return document.getElementById('stop-said').textContent.includes('robot\\'s own stop')");
}
