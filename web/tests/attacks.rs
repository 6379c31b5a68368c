//! What others may send to a page: half-open connections, endless bodies, slow readers, foreign pages. None of it grows the server or keeps its
//! own pages waiting.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use web::{Answer, Broadcast, Server, Settings};

/// A server that answers a path with itself, `/large` with 64 MiB, and `/events` with events.
struct Running {
    address: SocketAddr,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Running {
    fn start() -> Self {
        let server = Server::open([127, 0, 0, 1].into(), 0, Settings { connections: 20, listeners: 3, ..Settings::default() }).unwrap();
        let stop = Arc::new(AtomicBool::new(false));
        let (address, told) = (server.address(), Arc::clone(&stop));
        let thread = std::thread::spawn(move || {
            let events = Broadcast::default();
            server.serve(&told, |request| {
                events.send("event");
                match request.path.as_str() {
                    "/large" => Answer::bytes("text/plain", vec![b'x'; 64 << 20]),
                    "/events" => events.stream(),
                    path => Answer::text(path),
                }
            });
        });
        Self { address, stop, thread: Some(thread) }
    }

    /// Sends `head` with a host and gives the connection.
    fn send(&self, head: &str) -> TcpStream {
        let mut stream = TcpStream::connect(self.address).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
        let _ = stream.write_all(head.replace("HOST", &self.address.to_string()).as_bytes());
        stream
    }

    /// The status of the answer to `head`, and the connection, from which nothing more is read.
    fn ask(&self, head: &str) -> (String, TcpStream) {
        let mut answer = String::new();
        let mut stream = self.send(head);
        let mut byte = [0];
        while !answer.ends_with('\n') && stream.read(&mut byte).unwrap_or(0) == 1 {
            answer.push(byte[0].into());
        }
        (answer.split(' ').nth(1).unwrap_or("").into(), stream)
    }

    fn status(&self, head: &str) -> String {
        self.ask(head).0
    }

    fn answers(&self) -> bool {
        let begin = std::time::Instant::now();
        let good = self.status("GET /a HTTP/1.1\r\nHost: HOST\r\n\r\n") == "200";
        println!("answered after {:?}", begin.elapsed());
        good
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.take().map(JoinHandle::join);
    }
}

/// A figure of this process from `/proc/self/status`, such as `Threads` or `VmRSS` (KiB).
fn own(figure: &str) -> usize {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find(|l| l.starts_with(figure)).unwrap();
    line.split_whitespace().nth(1).unwrap().parse().unwrap()
}

/// Protects whoever wants to stop a robot: 300 half-open connections, 300 idle ones, bodies without end, and readers that read nothing neither
/// take threads nor memory, and the page's own requests are answered meanwhile.
#[test]
fn nothing_that_is_sent_grows_the_server_or_blocks_it() {
    let page = Running::start();
    assert!(page.answers());
    let (threads, memory) = (own("Threads"), own("VmRSS"));
    let half_open: Vec<TcpStream> = (0..300).map(|_| page.send("GET / HTTP/1.1\r\nHost: ")).collect();
    assert!(page.answers(), "beside half-open connections");
    let idle: Vec<TcpStream> = (0..300).map(|_| page.send("")).collect();
    assert!(page.answers(), "beside idle connections");

    let post = "POST /a HTTP/1.1\r\nHost: HOST\r\nOrigin: http://HOST\r\nContent-Type: application/json\r\n";
    assert_eq!(page.status(&format!("{post}Content-Length: 1610612736\r\n\r\n")), "413", "1.5 GiB are announced");
    let mut endless = page.send(&format!("{post}Transfer-Encoding: chunked\r\n\r\n"));
    let chunk = format!("10000\r\n{}\r\n", "x".repeat(0x10000));
    let written = (0..2000).take_while(|_| endless.write_all(chunk.as_bytes()).is_ok()).count();
    assert!(written < 200, "{written} chunks of 64 KiB were taken");
    let heads = "x".repeat(1 << 20);
    assert_ne!(page.status(&format!("GET / HTTP/1.1\r\nHost: HOST\r\nA: {heads}\r\n\r\n")), "200");
    assert!(page.answers(), "beside long requests");
    drop((half_open, idle));

    // Each is answered before the next one asks: who comes first is not decided by the order of the connections.
    let (answers, events): (Vec<String>, Vec<TcpStream>) = (0..4).map(|_| page.ask("GET /events HTTP/1.1\r\nHost: HOST\r\n\r\n")).unzip();
    assert_eq!(answers, ["200", "200", "200", "503"], "a fourth listener");
    for _ in 0..200 {
        assert!(page.answers(), "beside listeners that read nothing");
    }
    let (threads_now, memory_now) = (own("Threads"), own("VmRSS"));
    println!("threads {threads} to {threads_now}, resident memory {memory} KiB to {memory_now} KiB");
    assert!(threads_now <= threads, "{threads} threads to {threads_now}");
    assert!(memory_now < memory + 20 * 1024, "{memory} KiB to {memory_now} KiB");
    drop(events);
}

/// Protects the robot from other sites: what their pages can send is refused before it reaches the program.
#[test]
fn what_foreign_pages_send_is_refused() {
    let page = Running::start();
    let post = |more: &str| page.status(&format!("POST /a HTTP/1.1\r\n{more}Content-Length: 2\r\n\r\n{{}}"));
    let (host, origin, kind) = ("Host: HOST\r\n", "Origin: http://HOST\r\n", "Content-Type: application/json\r\n");
    assert_eq!(post(&format!("{host}{origin}{kind}")), "200");
    assert_eq!(post(&format!("{host}{kind}")), "403");
    assert_eq!(post(&format!("{host}{kind}Origin: http://evil.example\r\n")), "403");
    assert_eq!(post(&format!("{host}{origin}Content-Type: text/plain\r\n")), "415");
    assert_eq!(post(&format!("Host: evil.example:{}\r\n{origin}{kind}", page.address.port())), "421");
    let chunks = |body: &str| page.status(&format!("POST /a HTTP/1.1\r\n{host}{origin}{kind}Transfer-Encoding: chunked\r\n\r\n{body}"));
    assert_eq!(
        (chunks("2\r\n{}\r\n0\r\n\r\n"), chunks("no length\r\n")),
        ("200".into(), "400".into()),
        "a body that is none is not too large"
    );
    assert_eq!(page.status("DELETE /a HTTP/1.1\r\nHost: HOST\r\n\r\n"), "405");
    // An absolute address in the first line counts as the host does, whatever the host says beside it (RFC 9112, 3.2.2).
    let absolute = |target: &str| page.status(&format!("GET {target} HTTP/1.1\r\nHost: HOST\r\n\r\n"));
    assert_eq!(absolute("http://HOST/a"), "200", "its own");
    let port = page.address.port();
    for target in ["http://evil.example/a", &format!("http://evil.example:{port}/a"), "http://me@HOST/a", "https://HOST/a", "ftp://HOST/a"]
    {
        assert_eq!(absolute(target), "421", "{target}");
    }
    assert_eq!(page.status("GET /a HTTP/1.0\r\n\r\n"), "400");
    assert_eq!(page.status("GET /a HTTP/1.1\r\nHost: HOST\r\nHost: HOST\r\n\r\n"), "400");
}
