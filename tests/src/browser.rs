//! A real browser for tests: headless Chromium, by chromedriver and the WebDriver protocol (W3C).
//!
//! Only tests use it, in their own threads: it allocates and waits, and it panics when the browser does not do what it is told. Without
//! chromedriver there is no browser, and a test says so.

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::{Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

use serde_json::{Value, json};

/// The key under which WebDriver passes elements. Source: WebDriver, section "Elements".
const ELEMENT: &str = "element-6066-11e4-a52e-4f735466cecf";

/// How many browsers of this process are open. A browser keeps a core busy, so there are never more than cores (and two): what a page does to
/// a running pour would come too late.
static OPEN: Mutex<usize> = Mutex::new(0);
/// Woken when one of them closes.
static CLOSED: Condvar = Condvar::new();

/// One of the browsers that may be open at once.
struct Place;

impl Place {
    /// Waits until there is a place.
    fn take() -> Self {
        // At least two: a test that watches one page from another opens both.
        let places = std::thread::available_parallelism().map_or(1, std::num::NonZero::get).max(2);
        let open = OPEN.lock().unwrap_or_else(PoisonError::into_inner);
        *CLOSED.wait_while(open, |open| *open >= places).unwrap_or_else(PoisonError::into_inner) += 1;
        Self
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        *OPEN.lock().unwrap_or_else(PoisonError::into_inner) -= 1;
        CLOSED.notify_one();
    }
}

/// A browser with one window.
pub struct Browser {
    _place: Place,
    driver: Child,
    port: u16,
    session: String,
}

impl Browser {
    /// Opens a window of `width` by `height` px; `None`, with a printed line, where there is no chromedriver.
    pub fn open(width: u32, height: u32) -> Option<Self> {
        Self::begin(Command::new("chromedriver"), (width, height))
    }

    /// Opens a window of another user of this machine, with the number `user`, who keeps everything in `home`; `None`, with a printed line, where that is
    /// not possible.
    pub fn open_as(user: u32, home: &Path) -> Option<Self> {
        if !rustix::process::geteuid().is_root() || std::os::unix::fs::chown(home, Some(user), Some(user)).is_err() {
            println!("not run: it takes root to act as another user");
            return None;
        }
        let mut command = Command::new("setpriv");
        command.arg(format!("--reuid={user}")).arg(format!("--regid={user}")).args(["--clear-groups", "chromedriver"]);
        command.current_dir(home).env("HOME", home).env("TMPDIR", home).env_remove("XDG_RUNTIME_DIR");
        Self::begin(command, (1280, 1000))
    }

    fn begin(mut command: Command, (width, height): (u32, u32)) -> Option<Self> {
        command.arg("--port=0").stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null());
        let place = Place::take();
        let begun = Command::new("chromedriver").arg("--version").stdout(Stdio::null()).status().and_then(|_| command.spawn());
        let Ok(mut driver) = begun else {
            println!("not run: there is no chromedriver (scripts/install chromium-driver)");
            return None;
        };
        let mut lines = BufReader::new(driver.stdout.take().expect("piped")).lines();
        let said = |line: String| line.split_once("successfully on port ")?.1.trim_end_matches('.').parse().ok();
        let port = lines.by_ref().map_while(Result::ok).find_map(said);
        // What it says more is not wanted, and must not hold it up.
        std::thread::spawn(move || lines.map_while(Result::ok).for_each(drop));
        let mut this = Self { _place: place, driver, port: port.expect("chromedriver says its port"), session: String::new() };
        let arguments = [
            "--headless=new".into(),
            "--no-sandbox".into(),
            "--disable-gpu".into(),
            "--disable-dev-shm-usage".into(),
            format!("--window-size={width},{height}"),
        ];
        let wanted = json!({ "browserName": "chrome", "goog:chromeOptions": { "args": arguments } });
        let session = this.call("POST", "/session", &json!({ "capabilities": { "alwaysMatch": wanted } }));
        this.session = session["sessionId"].as_str().expect("a session").into();
        Some(this)
    }

    /// One request to chromedriver. Gives its value, or panics with its error.
    fn call(&self, method: &str, path: &str, body: &Value) -> Value {
        let mut stream = TcpStream::connect(("127.0.0.1", self.port)).expect("chromedriver listens");
        stream.set_read_timeout(Some(Duration::from_secs(60))).expect("a socket");
        let body = if method == "POST" { body.to_string() } else { String::new() };
        write!(
            stream,
            "{method} {path} HTTP/1.1\r\nHost: 127.0.0.1:{}\r\nContent-Type: application/json\r\nContent-Length: {}\r\nConnection: close\r\n\r\n{body}",
            self.port,
            body.len()
        )
        .expect("it reads");
        // Chromedriver keeps the connection open: the answer's length says where it ends.
        let mut answer = BufReader::new(stream);
        let (mut line, mut length) = (String::new(), 0);
        while line != "\r\n" {
            line.clear();
            assert!(answer.read_line(&mut line).expect("an answer") > 0, "{method} {path}: chromedriver has gone");
            if let Some((_, value)) = line.to_lowercase().split_once("content-length:") {
                length = value.trim().parse().expect("a length");
            }
        }
        let mut text = vec![0; length];
        answer.read_exact(&mut text).expect("the answer");
        let value: Value = serde_json::from_slice(&text).expect("JSON");
        assert!(value["value"]["error"].is_null(), "{method} {path}: {}", value["value"]["message"]);
        value["value"].clone()
    }

    fn post(&self, path: &str, body: &Value) -> Value {
        self.call("POST", &format!("/session/{}{path}", self.session), body)
    }

    /// Opens an address.
    pub fn go(&self, url: &str) {
        self.post("/url", &json!({ "url": url }));
    }

    /// The window in which everything happens, and a new one.
    pub fn windows(&self) -> [String; 2] {
        let own = self.call("GET", &format!("/session/{}/window", self.session), &Value::Null);
        let new = self.post("/window/new", &json!({ "type": "tab" }));
        [&own, &new["handle"]].map(|handle| handle.as_str().expect("a handle").into())
    }

    /// From now on everything happens in this window.
    pub fn enter(&self, window: &str) {
        self.post("/window", &json!({ "handle": window }));
    }

    /// Closes the window; another one must be entered.
    pub fn close(&self) {
        self.call("DELETE", &format!("/session/{}/window", self.session), &Value::Null);
    }

    /// Runs a script in the page and gives what it returns; promises are waited for.
    pub fn run(&self, script: &str) -> Value {
        self.post("/execute/sync", &json!({ "script": script, "args": [] }))
    }

    /// Waits until a script returns true, and panics with the page's text if it does not.
    pub fn wait(&self, what: &str, within: Duration, script: &str) {
        let until = Instant::now() + within;
        while Instant::now() < until {
            if self.run(script) == Value::Bool(true) {
                return;
            }
            std::thread::sleep(Duration::from_millis(50));
        }
        panic!("{what} did not happen; the page says:\n{}", self.run("return document.body.innerText"));
    }

    /// The text of an element.
    pub fn text(&self, css: &str) -> String {
        self.run(&format!("return document.querySelector({css:?})?.innerText ?? ''")).as_str().unwrap_or_default().into()
    }

    fn find(&self, css: &str) -> String {
        let found = self.post("/element", &json!({ "using": "css selector", "value": css }));
        found[ELEMENT].as_str().expect("an element").into()
    }

    /// Clicks an element as a person does: it must be there, visible, and not covered.
    pub fn click(&self, css: &str) {
        self.post(&format!("/element/{}/click", self.find(css)), &json!({}));
    }

    /// Empties a field and types into it.
    pub fn fill(&self, css: &str, text: &str) {
        let field = self.find(css);
        self.post(&format!("/element/{field}/clear"), &json!({}));
        self.post(&format!("/element/{field}/value"), &json!({ "text": text }));
    }

    /// Presses and lets go of keys, one after the other, wherever the focus is.
    pub fn press(&self, keys: &[&str]) {
        let actions: Vec<Value> =
            keys.iter().flat_map(|k| [json!({ "type": "keyDown", "value": k }), json!({ "type": "keyUp", "value": k })]).collect();
        self.post("/actions", &json!({ "actions": [{ "type": "key", "id": "keyboard", "actions": actions }] }));
    }

    /// Presses the pointer's button on an element, or a key, until [`Browser::let_go`].
    pub fn hold(&self, css: &str, key: Option<&str>) {
        let pointer = || {
            let origin = json!({ ELEMENT: self.find(css) });
            let to = json!({ "type": "pointerMove", "duration": 0, "origin": origin, "x": 0, "y": 0 });
            json!({ "type": "pointer", "id": "mouse", "actions": [to, { "type": "pointerDown", "button": 0 }] })
        };
        let keyboard = |key| json!({ "type": "key", "id": "keyboard", "actions": [{ "type": "keyDown", "value": key }] });
        self.post("/actions", &json!({ "actions": [key.map_or_else(pointer, keyboard)] }));
    }

    /// Lets go of all that is held.
    pub fn let_go(&self) {
        self.call("DELETE", &format!("/session/{}/actions", self.session), &Value::Null);
    }

    /// Role and name of everything that the browser shows to a screen reader.
    pub fn accessible(&self) -> Vec<(String, String)> {
        let tree = self.post("/goog/cdp/execute", &json!({ "cmd": "Accessibility.getFullAXTree", "params": {} }));
        let text = |value: &Value| value["value"].as_str().unwrap_or_default().trim().to_string();
        let shown = tree["nodes"].as_array().expect("a tree").iter().filter(|n| n["ignored"] != true);
        shown.map(|n| (text(&n["role"]), text(&n["name"]))).collect()
    }

    /// From now on this window refuses what its pages would keep or look up, as where its user has forbidden that.
    pub fn forbid_storage(&self) {
        let refused = "get() { throw new DOMException('', 'SecurityError'); }";
        let source = format!("for (const name of ['localStorage', 'sessionStorage']) Object.defineProperty(window, name, {{ {refused} }})");
        self.run(&source);
        let command = json!({ "cmd": "Page.addScriptToEvaluateOnNewDocument", "params": { "source": source } });
        self.post("/goog/cdp/execute", &command);
    }

    /// Sets the window's size, px.
    pub fn resize(&self, width: u32, height: u32) {
        self.post("/window/rect", &json!({ "width": width, "height": height }));
    }

    /// Writes a picture of the window.
    pub fn screenshot(&self, file: &Path) {
        let text = self.call("GET", &format!("/session/{}/screenshot", self.session), &Value::Null);
        std::fs::create_dir_all(file.parent().expect("a directory")).expect("writable");
        std::fs::write(file, decoded(text.as_str().expect("text"))).expect("writable");
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        if !self.session.is_empty() && !std::thread::panicking() {
            self.call("DELETE", &format!("/session/{}", self.session), &Value::Null);
        }
        // Chromedriver ends its browser when it is asked to end.
        let pid = rustix::process::Pid::from_child(&self.driver);
        let _ = rustix::process::kill_process(pid, rustix::process::Signal::TERM);
        let _ = self.driver.wait();
    }
}

/// The bytes of a text in base 64 (RFC 4648).
fn decoded(text: &str) -> Vec<u8> {
    const LETTERS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let (mut bytes, mut held, mut bits) = (Vec::new(), 0u32, 0);
    for letter in text.bytes().filter(|b| *b != b'=') {
        let value = LETTERS.iter().position(|l| *l == letter).expect("base 64");
        held = held << 6 | value as u32;
        bits += 6;
        if bits >= 8 {
            bits -= 8;
            bytes.push((held >> bits) as u8);
            held &= (1 << bits) - 1;
        }
    }
    bytes
}
