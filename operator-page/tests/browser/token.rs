//! The token: who needs it, where a browser keeps it, to whom it sends it, and who is shown it.

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpListener;
use std::process::{Command, Stdio};
use std::sync::mpsc::{Receiver, channel};

use rustix::process::{Pid, Signal, kill_process};
use tests::browser::Browser;
use tests::{CellUnderTest, steady_weights, terminal};

use super::{LIVE, Page, SOON, TILT_OUT, says};

/// A user of this machine who is neither this one nor root.
const STRANGER: u32 = 65_534;

/// The file in which the page's token lies.
fn token_file(cell: &CellUnderTest) -> std::path::PathBuf {
    cell.weights().with_file_name(format!("operator-page-{}.token", cell.name))
}

/// The token, once the page has made it.
fn token(cell: &CellUnderTest) -> String {
    std::fs::read_to_string(token_file(cell)).expect("the page has made it").trim().into()
}

/// Another user's server on another port of this host: its address, and the heads of the requests that it gets.
fn neighbour() -> (String, Receiver<String>) {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
    let address = listener.local_addr().expect("an address");
    let (sender, heads) = channel();
    std::thread::spawn(move || {
        for mut stream in listener.incoming().flatten() {
            let mut head = vec![0; 4096];
            let got = stream.read(&mut head).unwrap_or(0);
            let _ = sender.send(String::from_utf8_lossy(&head[..got]).into_owned());
            let _ = stream.write_all(b"HTTP/1.1 200 OK\r\nContent-Type: text/html\r\nContent-Length: 0\r\nConnection: close\r\n\r\n");
        }
    });
    (format!("http://{address}/"), heads)
}

/// Protects a cell on a shared machine: another user's browser needs the token, takes it from the address, shows everything and stops with it by both
/// ports, keeps it, and sends it to no other port of the host.
#[test]
fn another_users_browser_sends_the_token_to_this_page_alone() {
    let home = tempfile::tempdir().expect("a directory");
    let Some(browser) = Browser::open_as(STRANGER, home.path()) else { return };
    let cell = CellUnderTest::start(|_| {});
    cell.take_weights(&steady_weights(TILT_OUT));
    cell.json("simulator", &["operator", "fill", "300", "--json"]);
    cell.wait_idle();
    let page = Page::open(&cell);
    browser.go(&page.url());
    browser.wait("that the token is missing", SOON, "return $('said').textContent.includes('has no token')");
    assert_eq!(browser.run("return ask('/picture.jpg').then(answer => answer.status)"), 401);

    // In a window that has the page already, this is only a jump within it.
    browser.go(&format!("{}#token={}", page.url(), token(&cell)));
    browser.wait("the live picture", SOON, LIVE);
    assert_eq!(browser.run("return location.href"), page.url(), "the token stands in the address no more");
    says(&browser, "Ready to pour");
    browser.fill("#goal", "100");
    browser.click("#foresee");
    browser.wait("what is foreseen", SOON, "return !document.getElementById('confirm').hidden");
    browser.click("#go");
    says(&browser, "Pouring 100 ml");
    // By the second port alone, the first time and with what the browser has asked before.
    let second = "const url = `http://${location.hostname}:${stopPort}/stop`;";
    let ways = format!(
        "{second} const bare = fetch(url, {{ method: 'POST', headers: {{ 'Content-Type': 'text/plain' }}, body: '' }});
         const own = ask(url, {{ method: 'POST', headers: {{ 'Content-Type': 'text/plain' }}, body: '' }});
         return Promise.all([bare, own].map(asked => asked.then(answer => answer.status))).then(all => all.join())"
    );
    assert_eq!(browser.run(&ways), "401,200", "without the token, and with it");
    cell.wait("the end", SOON, |s| s["phase"] == "idle" && s["outcomes"][0]["reason"] == "aborted");
    browser.run("return alive()");
    assert_eq!(browser.run("return $('stop-way').hidden"), true, "Stop's own way is there");

    let (other, heads) = neighbour();
    browser.go(&other);
    let head = heads.recv_timeout(SOON).expect("the browser asks");
    assert!(head.starts_with("GET / ") && !head.contains(&token(&cell)), "{head}");
    assert_eq!(browser.run("return document.cookie + localStorage.length"), "0");
    browser.go(&page.url());
    browser.wait("the live picture, with the token that was kept", SOON, LIVE);
}

/// Protects whoever presses Stop from a link that somebody else has written, and from a browser that keeps nothing: a wrong token takes no good one's
/// place, in no tab and after no new load; a new one is in force in all tabs; and Stop stops where each look into the storage fails.
#[test]
fn stop_keeps_its_token() {
    let home = tempfile::tempdir().expect("a directory");
    let Some(browser) = Browser::open_as(STRANGER, home.path()) else { return };
    let cell = CellUnderTest::start(|_| {});
    let page = Page::open(&cell);
    let with = |word: &str| format!("{}#token={word}", page.url());
    let stops = |how: &str| {
        browser.run("$('stop-said').textContent = ''");
        browser.click("#stop");
        browser.wait(how, SOON, "return $('stop-said').textContent !== ''");
        let said = browser.text("#stop-said");
        assert!(said.starts_with("Stop: ") && said.ends_with(" ms)"), "{how}: {said}");
    };
    browser.go(&page.url());
    browser.wait("that the token is missing", SOON, "return $('said').textContent.includes('has no token')");
    let [first, second] = browser.windows();
    // It was in a cookie, which browsers keep for a year.
    browser.run("document.cookie = `decant-${location.port}=${'0'.repeat(32)}; Path=/; Max-Age=31536000`");
    browser.enter(&second);
    browser.go(&with(&token(&cell)));
    browser.wait("the live picture", SOON, LIVE);
    assert_eq!(browser.run("return document.cookie"), "", "the cookie from before is dropped");
    browser.enter(&first);
    browser.wait("the live picture in the first tab", SOON, LIVE);
    assert_eq!(browser.text("#said"), "", "nothing is missing any more");
    stops("with the token that the other tab has taken");

    for (word, said) in [("AAAA", true), ("", false), ("%41", false)] {
        browser.go(&with(word));
        if said {
            browser.wait("that it is refused", SOON, "return $('said').textContent.includes('refuses the token')");
        }
        browser.wait("that it stands in the address no more", SOON, &format!("return location.href === '{}'", page.url()));
        stops(&format!("after the jump to '{word}'"));
        browser.go("about:blank");
        browser.go(&with(word));
        browser.wait("the live picture", SOON, LIVE);
        assert_eq!(browser.run("return location.href"), page.url(), "'{word}' stands in the address no more");
        stops(&format!("opened with '{word}'"));
        assert_eq!(browser.run("return localStorage.getItem('decant-token')"), token(&cell).as_str(), "after '{word}'");
    }

    browser.forbid_storage();
    stops("in a page whose storage is forbidden");
    browser.go("about:blank");
    browser.go(&with(&token(&cell)));
    browser.wait("the live picture without a storage", SOON, LIVE);
    assert_eq!(browser.run("try { return localStorage.length } catch (error) { return error.name }"), "SecurityError");
    stops("without a storage");
}

/// Protects the browsers that need the token from a part of the page that is shown only without it: each request goes the one way that sends it.
#[test]
fn each_request_of_the_page_sends_the_token() {
    let directory = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("page");
    let scripts: Vec<_> = std::fs::read_dir(directory).expect("there").flatten().map(|e| e.path()).collect();
    let mut asked = 0;
    for path in scripts.iter().filter(|p| p.extension().is_some_and(|e| e == "js")) {
        let text = std::fs::read_to_string(path).expect("text");
        asked += text.matches("fetch(").count();
        for other in ["EventSource(", "XMLHttpRequest", "sendBeacon", "src = `/", "href: `/", "src: `/"] {
            assert!(!text.contains(other), "{}: {other}", path.display());
        }
    }
    assert_eq!(asked, 1, "places that ask the server");
}

/// Protects the token from whoever reads a log: where the output goes to anything but a terminal, the token's file is named, and the token is not.
#[test]
fn only_a_terminal_is_shown_the_token() {
    for address in ["127.0.0.1", "0.0.0.0"] {
        let cell = CellUnderTest::prepare(|_| {});
        let words = ["run", "--port", "0", "--address", address];
        let mut logged = cell.begin("operator-page", &words);
        let mut printed = String::new();
        let mut stdout = BufReader::new(logged.stdout.take().expect("piped"));
        stdout.read_line(&mut printed).expect("it says where");
        kill_process(Pid::from_child(&logged), Signal::TERM).expect("it is ours");
        stdout.read_to_string(&mut printed).expect("text");
        let said = logged.wait_with_output().expect("it ends").stderr;
        printed.push_str(&String::from_utf8_lossy(&said));
        assert!(!printed.contains(&token(&cell)), "{printed}");
        assert!(printed.contains(&format!("it is in {}", token_file(&cell).display())), "{printed}");

        let (person, programs) = terminal();
        let mut command: Command = cell.program("operator-page");
        command.args(words).arg("--config").arg(cell.config()).stdin(Stdio::null());
        let mut shown = command.stdout(programs.try_clone().expect("a copy")).stderr(programs).spawn().expect("it starts");
        // The command holds the program's side too.
        drop(command);
        // It stands in the first two lines, or not at all.
        let lines = BufReader::new(std::fs::File::from(person)).lines().map_while(Result::ok).take(2);
        let whole = lines.into_iter().any(|line| line.contains(&format!("/#token={}", token(&cell))));
        let _ = kill_process(Pid::from_child(&shown), Signal::TERM);
        let _ = shown.wait();
        assert!(whole, "{address}: a terminal gets the whole address");
    }
}
