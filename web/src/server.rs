//! Listens, keeps connections within bounds, and hands whole requests to the caller's threads through bounded queues.
//!
//! One thread of its own runs all connections. Requests whose path is in [`Settings::urgent`] have a queue of their own, so that nothing that
//! takes long holds them up. Allocates. What a client does wrong ends its own connection, with a line where it can read one; a full queue is
//! answered "busy". The server ends when it is dropped.

use std::convert::Infallible;
use std::future::Future as _;
use std::net::{IpAddr, SocketAddr, TcpListener};
use std::pin::pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::task::Poll;
use std::thread::JoinHandle;
use std::time::Duration;

use crossbeam::channel::{Receiver, Sender, TrySendError, bounded};
use http_body_util::{BodyExt as _, LengthLimitError, Limited};
use hyper::body::{Body as _, Incoming};
use hyper::header::{self, HeaderValue};
use hyper::http::request::Parts;
use hyper::service::service_fn;
use hyper::{Method, Response, StatusCode};
use hyper_util::rt::{TokioIo, TokioTimer};
use shared::exit::{self, Failure, failure};
use tokio::sync::{Notify, Semaphore, oneshot};
use tokio::time::timeout;

use crate::answer::{Answer, Content, Sending};
use crate::connections::{Connections, Place};
use crate::gate::{self, Ends, Refusal, Rules};
use crate::patient::Patient;

/// Longest time for a request's headers, and of an idle connection. Chosen by hand: a browser sends them at once.
const HEADERS: Duration = Duration::from_secs(5);
/// Longest time for a request's body. Chosen by hand: bodies are short.
const BODY: Duration = Duration::from_secs(5);
/// Longest wait for an answer of the caller. Chosen by hand: longer than anything that a page asks for.
const ANSWER: Duration = Duration::from_secs(60);
/// Largest body, bytes. Chosen by hand: the longest one is a list of episodes.
const BODY_MAX: usize = 64 * 1024;
/// Largest head of a request, bytes. Chosen by hand: browsers send below 2 KiB.
const HEAD_MAX: usize = 16 * 1024;
/// Most headers of a request. Chosen by hand: browsers send below 30.
const HEADERS_MAX: usize = 64;
/// Requests that wait for the caller. Chosen by hand: some for each page that is open.
const WAITING: usize = 64;
/// How long one wait for a request lasts. Chosen by hand: a request to stop is noticed within a tenth of a second.
const WAIT: Duration = Duration::from_millis(100);
/// How long a server that ends lets its last answers leave. Chosen by hand: they are short, and most browsers are near.
const LAST_ANSWERS: Duration = Duration::from_millis(100);
/// How long a browser need not ask again whether it may send the token to another port, s. Source: Chromium takes no more than 2 hours.
const ASKED_BEFORE_S: &str = "7200";
/// Pause after a connection that could not be taken, as when no more files may be opened.
const PAUSE: Duration = Duration::from_millis(50);

/// What a server goes by.
#[derive(Debug, Clone)]
pub struct Settings {
    /// Who is answered.
    pub rules: Rules,
    /// Most connections.
    pub connections: usize,
    /// Most streams of events.
    pub listeners: usize,
    /// Paths with a queue of their own.
    pub urgent: &'static [&'static str],
    /// A second port of this host that the pages may ask.
    pub second_port: Option<u16>,
    /// What everybody gets who asks under a good name: the path, the content type, and the text, in which nothing is of the cell. A browser that
    /// loads a page cannot send the token yet.
    pub open: &'static [(&'static str, &'static str, &'static str)],
}

impl Default for Settings {
    fn default() -> Self {
        let rules = Rules { content_type: "application/json", ..Rules::default() };
        Self { rules, connections: 64, listeners: 16, urgent: &[], second_port: None, open: &[] }
    }
}

/// One request, whole and admitted.
#[derive(Debug)]
pub struct Request {
    /// Whether it may change something.
    pub post: bool,
    /// The path, such as `/state.json`.
    pub path: String,
    /// What follows the question mark.
    pub query: String,
    /// The body.
    pub body: Vec<u8>,
    /// From where it comes.
    pub peer: SocketAddr,
}

impl Request {
    /// The value of `name` in the query.
    pub fn parameter(&self, name: &str) -> Option<String> {
        self.query.split('&').filter_map(|p| p.split_once('=')).find(|(n, _)| *n == name).map(|(_, value)| plain(value))
    }

    /// The body as JSON.
    pub fn json<T: serde::de::DeserializeOwned>(&self) -> Result<T, String> {
        serde_json::from_slice(&self.body).map_err(|e| format!("the page sent what cannot be read ({e}): load it again"))
    }
}

/// A value of a query without its escapes; what is no escape stays.
fn plain(value: &str) -> String {
    let mut bytes = Vec::new();
    let mut rest = value;
    while let Some(at) = rest.find('%') {
        bytes.extend(rest[..at].bytes());
        let code = rest.get(at + 1..at + 3).and_then(|c| u8::from_str_radix(c, 16).ok());
        bytes.push(code.unwrap_or(b'%'));
        rest = &rest[at + if code.is_some() { 3 } else { 1 }..];
    }
    bytes.extend(rest.bytes());
    String::from_utf8_lossy(&bytes).into_owned()
}

/// A request that waits for its answer.
pub struct Pending {
    /// The request.
    pub request: Request,
    reply: oneshot::Sender<Answer>,
}

impl Pending {
    /// Answers. A browser that has gone away is no error.
    pub fn answer(self, answer: Answer) {
        let _ = self.reply.send(answer);
    }
}

/// Everything that a connection needs.
struct Shared {
    settings: Settings,
    connections: Connections,
    listeners: Arc<Semaphore>,
    queues: [Sender<Pending>; 2],
}

/// A server that runs.
pub struct Server {
    address: SocketAddr,
    ordinary: Receiver<Pending>,
    urgent: Receiver<Pending>,
    end: Arc<Notify>,
    thread: Option<JoinHandle<()>>,
}

impl Server {
    /// Listens on `port` of `address`; with 0, any free port is taken. A port that is in use is an error that says so.
    pub fn open(address: IpAddr, port: u16, settings: Settings) -> Result<Self, Failure> {
        Self::on(Self::bind(address, port)?, settings)
    }

    /// Takes a port without serving on it yet.
    pub fn bind(address: IpAddr, port: u16) -> Result<TcpListener, Failure> {
        TcpListener::bind((address, port)).map_err(|e| failure(exit::FAILED, format!("port {port} on {address}: {e}; give another --port")))
    }

    /// Serves on a port that was taken.
    pub fn on(listener: TcpListener, settings: Settings) -> Result<Self, Failure> {
        let fail = |e: std::io::Error| failure(exit::FAILED, format!("web server: {e}"));
        listener.set_nonblocking(true).map_err(fail)?;
        let address = listener.local_addr().map_err(fail)?;
        let runtime = tokio::runtime::Builder::new_current_thread().enable_io().enable_time().build().map_err(fail)?;
        let (ordinary_sender, ordinary) = bounded(WAITING);
        let (urgent_sender, urgent) = bounded(WAITING);
        let shared = Arc::new(Shared {
            connections: Connections::new(settings.connections),
            listeners: Arc::new(Semaphore::new(settings.listeners)),
            queues: [ordinary_sender, urgent_sender],
            settings,
        });
        let end = Arc::new(Notify::new());
        let ended = Arc::clone(&end);
        let serve = move || {
            runtime.block_on(async {
                let accepting = pin!(accept(listener, shared));
                let ended = pin!(ended.notified());
                let (mut accepting, mut ended) = (accepting, ended);
                std::future::poll_fn(|context| {
                    if ended.as_mut().poll(context).is_ready() {
                        return Poll::Ready(());
                    }
                    accepting.as_mut().poll(context)
                })
                .await;
                // What was answered last, perhaps the request that ended the server, still leaves.
                tokio::time::sleep(LAST_ANSWERS).await;
            });
        };
        let thread = std::thread::Builder::new().name("web".into()).spawn(serve).map_err(fail)?;
        Ok(Self { address, ordinary, urgent, end, thread: Some(thread) })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// The next ordinary request, if one comes within a tenth of a second. Several threads may ask at the same time.
    pub fn next(&self) -> Option<Pending> {
        self.ordinary.recv_timeout(WAIT).ok()
    }

    /// The next urgent request, if one comes within a tenth of a second.
    pub fn next_urgent(&self) -> Option<Pending> {
        self.urgent.recv_timeout(WAIT).ok()
    }

    /// Answers ordinary requests, one after the other, until `stop` is set.
    pub fn serve(&self, stop: &AtomicBool, mut answer: impl FnMut(&Request) -> Answer) {
        while !stop.load(Relaxed) {
            if let Some(pending) = self.next() {
                let answer = answer(&pending.request);
                pending.answer(answer);
            }
        }
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.end.notify_one();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Takes connections for ever.
async fn accept(listener: TcpListener, shared: Arc<Shared>) {
    let Ok(listener) = tokio::net::TcpListener::from_std(listener) else { return };
    loop {
        let Ok((stream, peer)) = listener.accept().await else {
            tokio::time::sleep(PAUSE).await;
            continue;
        };
        let (Ok(own), Some(place)) = (stream.local_addr(), shared.connections.enter()) else { continue };
        let _ = stream.set_nodelay(true);
        tokio::spawn(connection(Patient::new(stream), own, peer, place, Arc::clone(&shared)));
        // What it has sent already is read before others come, so that it is not closed as an idle one where many connect at once.
        tokio::task::yield_now().await;
    }
}

/// Answers one connection to its end.
async fn connection(stream: Patient, own: SocketAddr, peer: SocketAddr, place: Arc<Place>, shared: Arc<Shared>) {
    let ends = Arc::new(Ends::new(own, peer));
    let service = service_fn(|request| {
        let (shared, place, ends) = (Arc::clone(&shared), Arc::clone(&place), Arc::clone(&ends));
        async move { Ok::<_, Infallible>(respond(request, &ends, &place, &shared).await) }
    });
    let mut connection = pin!(
        hyper::server::conn::http1::Builder::new()
            .timer(TokioTimer::new())
            .header_read_timeout(HEADERS)
            .max_headers(HEADERS_MAX)
            .max_buf_size(HEAD_MAX)
            .serve_connection(TokioIo::new(stream), service)
    );
    let mut close = pin!(place.close.notified());
    std::future::poll_fn(|context| {
        if close.as_mut().poll(context).is_ready() {
            return Poll::Ready(());
        }
        connection.as_mut().poll(context).map(drop)
    })
    .await;
    shared.connections.leave(&place);
}

/// The answer to one request, with the headers that all answers have.
async fn respond(request: hyper::Request<Incoming>, ends: &Ends, place: &Arc<Place>, shared: &Shared) -> Response<Sending> {
    let busy = place.busy();
    let rules = &shared.settings.rules;
    let (head, body) = request.into_parts();
    let judged = gate::judge(&head.method, &head.uri, &head.headers, ends, rules);
    let host = judged.as_ref().map(|name| (*name).to_string()).ok();
    let answered = match judged {
        Ok(_) => let_in(head, body, ends, shared).await,
        Err(refusal) => Err(refusal),
    };
    let mut answer = answered.unwrap_or_else(|refusal| Answer::fault(refusal.status.as_u16(), refusal.line));
    let mut listener = None;
    if matches!(answer.content, Content::Events(_)) {
        listener = Arc::clone(&shared.listeners).try_acquire_owned().ok();
        if listener.is_none() {
            answer = Answer::fault(503, "too many pages are open: close one");
        }
    }
    let mut response = Response::new(Sending::new(answer.content, busy, listener));
    *response.status_mut() = StatusCode::from_u16(answer.status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
    let headers = response.headers_mut();
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(answer.kind));
    for (name, value) in answer.headers {
        if let Ok(value) = HeaderValue::from_str(&value) {
            headers.insert(name, value);
        }
    }
    protect(headers, host.as_deref(), ends, &shared.settings);
    response
}

/// The answer to a request that may be asked: at once to what is open to everybody, and to what a browser asks before it sends the token to another
/// port; otherwise only to who is admitted.
async fn let_in(head: Parts, body: Incoming, ends: &Ends, shared: &Shared) -> Result<Answer, Refusal> {
    if head.method == Method::OPTIONS {
        return Ok(Answer::text(""));
    }
    let open = shared.settings.open.iter().find(|(path, ..)| head.method == Method::GET && *path == head.uri.path());
    if let Some((path, kind, text)) = open {
        let answer = Answer::bytes(kind, *text);
        // Browsers that were here while the token was in a cookie would send it for a year to every port of this host: they drop it.
        let port = ends.own.port();
        return Ok(if *path == "/" { answer.header("set-cookie", &format!("decant-{port}=; Max-Age=0; Path=/")) } else { answer });
    }
    gate::admitted(&head.headers, ends, &shared.settings.rules)?;
    hand_over(head, body, ends.peer, shared).await
}

/// Reads the body, hands the request to the caller, and waits for the answer.
async fn hand_over(head: Parts, body: Incoming, peer: SocketAddr, shared: &Shared) -> Result<Answer, Refusal> {
    let refused = |status, line: &str| Refusal { status, line: line.into() };
    let too_large = || refused(StatusCode::PAYLOAD_TOO_LARGE, "the request is too large");
    if body.size_hint().lower() > BODY_MAX as u64 {
        return Err(too_large());
    }
    let body = timeout(BODY, Limited::new(body, BODY_MAX).collect()).await;
    let body = body.map_err(|_| refused(StatusCode::REQUEST_TIMEOUT, "the request came too slowly"))?;
    let unreadable = || refused(StatusCode::BAD_REQUEST, "the request's body cannot be read: its length or its chunks are wrong");
    let body = body.map_err(|e| if e.is::<LengthLimitError>() { too_large() } else { unreadable() })?;
    let request = Request {
        post: head.method == Method::POST,
        path: head.uri.path().into(),
        query: head.uri.query().unwrap_or("").into(),
        body: body.to_bytes().to_vec(),
        peer,
    };
    let urgent = shared.settings.urgent.contains(&request.path.as_str());
    let (reply, answered) = oneshot::channel();
    shared.queues[usize::from(urgent)].try_send(Pending { request, reply }).map_err(|e| match e {
        TrySendError::Full(_) => refused(StatusCode::SERVICE_UNAVAILABLE, "too much is asked at once: try again"),
        TrySendError::Disconnected(_) => refused(StatusCode::SERVICE_UNAVAILABLE, "the page's program is ending"),
    })?;
    match timeout(ANSWER, answered).await {
        Ok(Ok(answer)) => Ok(answer),
        _ => Err(refused(StatusCode::SERVICE_UNAVAILABLE, "no answer came in time: try again")),
    }
}

/// The headers that keep a page to itself: nothing from outside, no script in its text, in no other page's frame, kept in no cache.
fn protect(headers: &mut header::HeaderMap, host: Option<&str>, ends: &Ends, settings: &Settings) {
    let second = match (host, settings.second_port) {
        (Some(host), Some(port)) => format!(" http://{host}:{port}"),
        _ => String::new(),
    };
    let policy = format!(
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'{second}; \
         frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
    );
    if let Ok(policy) = HeaderValue::from_str(&policy) {
        headers.insert(header::CONTENT_SECURITY_POLICY, policy);
    }
    headers.insert(header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    headers.insert(header::X_FRAME_OPTIONS, HeaderValue::from_static("DENY"));
    headers.insert(header::REFERRER_POLICY, HeaderValue::from_static("no-referrer"));
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    match (host, settings.rules.pages_port) {
        // The pages of the other port may send the token here, and read what is answered.
        (Some(host), Some(_)) => {
            if let Ok(origin) = HeaderValue::from_str(&gate::own_origin(host, ends, &settings.rules)) {
                headers.insert(header::ACCESS_CONTROL_ALLOW_ORIGIN, origin);
                headers.insert(header::ACCESS_CONTROL_ALLOW_HEADERS, HeaderValue::from_static("authorization"));
                headers.insert(header::ACCESS_CONTROL_MAX_AGE, HeaderValue::from_static(ASKED_BEFORE_S));
            }
        }
        _ => {
            headers.insert("cross-origin-resource-policy", HeaderValue::from_static("same-origin"));
        }
    }
}
