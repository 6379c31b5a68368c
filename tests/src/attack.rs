//! What others may do to a page that a real process serves: half-open and idle connections, readers that read nothing, bodies without end, foreign
//! names and origins, methods that are not there, and another user's process.
//!
//! Only tests use it, in their own threads: it allocates and waits, and it panics when the page does not withstand.

use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::process::Command;
use std::time::{Duration, Instant};

/// Connections that are held open: more than any page takes.
const HELD: usize = 200;
/// Most threads that a page's process may start meanwhile, for work of its own: far fewer than it is sent connections.
const THREADS: usize = 4;
/// Most that a page's process may grow by, KiB. Chosen by hand: a hundredth of what is sent to it.
const GROWTH_KIB: usize = 40 * 1024;

/// Sends `head`, in which HOST stands for the page's address.
fn send(address: &str, head: &str) -> TcpStream {
    let mut stream = TcpStream::connect(address).expect("it listens");
    stream.set_read_timeout(Some(Duration::from_secs(20))).expect("a socket");
    stream.set_write_timeout(Some(Duration::from_secs(20))).expect("a socket");
    // A page that has closed already has answered.
    let _ = stream.write_all(head.replace("HOST", address).as_bytes());
    stream
}

/// The status of the answer to `head`; empty if it was only closed.
fn status(address: &str, head: &str) -> String {
    let (mut stream, mut answer, mut byte) = (send(address, head), String::new(), [0]);
    while !answer.ends_with('\n') && stream.read(&mut byte).unwrap_or(0) == 1 {
        answer.push(byte[0].into());
    }
    answer.split(' ').nth(1).unwrap_or("").into()
}

/// A figure of the process, such as `Threads` or `VmRSS` (KiB).
fn figure(pid: u32, name: &str) -> usize {
    let all = std::fs::read_to_string(format!("/proc/{pid}/status")).expect("it runs");
    let line = all.lines().find(|l| l.starts_with(name)).expect("the kernel says it");
    line.split_whitespace().nth(1).and_then(|n| n.parse().ok()).expect("a number")
}

/// What another user of this machine gets; none where this user may not become another one.
fn as_another_user(address: &str, path: &str) -> Option<String> {
    let (host, port) = address.rsplit_once(':').expect("host and port");
    let ask = format!("exec 3<>/dev/tcp/{host}/{port}; printf 'GET {path} HTTP/1.1\\r\\nHost: {address}\\r\\n\\r\\n' >&3; head -n1 <&3");
    let mut command = Command::new("setpriv");
    command.args(["--reuid=65534", "--regid=65534", "--clear-groups", "bash", "-c", &ask]);
    let output = command.output().ok().filter(|o| o.status.success())?;
    Some(String::from_utf8_lossy(&output.stdout).split(' ').nth(1).unwrap_or("").into())
}

/// Attacks the page at `address`, which the process `pid` serves. It must answer `path`, which the program itself answers, to its own user meanwhile,
/// answer it to nobody else, and not grow.
pub fn attack(address: &str, path: &str, pid: u32) {
    let answers = |what: &str| {
        let began = Instant::now();
        assert_eq!(status(address, &format!("GET {path} HTTP/1.1\r\nHost: HOST\r\n\r\n")), "200", "{what}");
        println!("{address}: answered after {:?} {what}", began.elapsed());
    };
    answers("undisturbed");
    let (threads, memory) = (figure(pid, "Threads"), figure(pid, "VmRSS"));

    let post = "POST /api/say HTTP/1.1\r\nHost: HOST\r\n";
    let (own, json) = ("Origin: http://HOST\r\n", "Content-Type: application/json\r\n");
    let port = address.rsplit_once(':').expect("a port").1;
    for (head, refused) in [
        ("GET / HTTP/1.1\r\nHost: evil.example\r\n".to_string(), "421"),
        // A name that was pointed at this machine.
        (format!("GET / HTTP/1.1\r\nHost: evil.example:{port}\r\nOrigin: http://evil.example:{port}\r\n"), "421"),
        ("GET /state.json HTTP/1.1\r\nHost: HOST\r\nOrigin: http://evil.example\r\n".into(), "403"),
        ("GET /state.json HTTP/1.1\r\nHost: HOST\r\nSec-Fetch-Site: cross-site\r\nSec-Fetch-Dest: empty\r\n".into(), "403"),
        (format!("{post}{json}Content-Length: 0\r\n"), "403"),
        (format!("{post}{json}Origin: http://evil.example\r\nContent-Length: 0\r\n"), "403"),
        (format!("{post}{json}Origin: null\r\nContent-Length: 0\r\n"), "403"),
        (format!("{post}{own}Content-Type: text/plain\r\nContent-Length: 0\r\n"), "415"),
        ("GET / HTTP/1.1\r\n".into(), "400"),
        ("GET / HTTP/1.1\r\nHost: HOST\r\nHost: HOST\r\n".into(), "400"),
        ("DELETE / HTTP/1.1\r\nHost: HOST\r\n".into(), "405"),
        ("OPTIONS / HTTP/1.1\r\nHost: HOST\r\n".into(), "405"),
        ("TRACE / HTTP/1.1\r\nHost: HOST\r\n".into(), "405"),
        ("GET /../../etc/passwd HTTP/1.1\r\nHost: HOST\r\n".into(), "404"),
        // 1 GiB is announced.
        (format!("{post}{own}{json}Content-Length: 1073741824\r\n"), "413"),
    ] {
        assert_eq!(status(address, &format!("{head}\r\n")), refused, "{head}");
    }
    assert_ne!(status(address, &format!("GET / HTTP/1.1\r\nHost: HOST\r\nA: {}\r\n\r\n", "x".repeat(1 << 20))), "200");
    let mut endless = send(address, &format!("{post}{own}{json}Transfer-Encoding: chunked\r\n\r\n"));
    let chunk = format!("10000\r\n{}\r\n", "x".repeat(0x10000));
    let taken = (0..2000).take_while(|_| endless.write_all(chunk.as_bytes()).is_ok()).count();
    assert!(taken < 400, "{taken} chunks of 64 KiB of one request were taken");
    answers("after bodies without end");

    let half_open: Vec<TcpStream> = (0..HELD).map(|_| send(address, "GET / HTTP/1.1\r\nHost: ")).collect();
    answers("beside half-open connections");
    let idle: Vec<TcpStream> = (0..HELD).map(|_| send(address, "")).collect();
    answers("beside idle connections");
    drop((half_open, idle));
    let slow: Vec<TcpStream> = (0..20).map(|_| send(address, &"GET /picture.jpg HTTP/1.1\r\nHost: HOST\r\n\r\n".repeat(50))).collect();
    for _ in 0..20 {
        answers("beside readers that read nothing");
    }
    let (threads_now, memory_now) = (figure(pid, "Threads"), figure(pid, "VmRSS"));
    println!("{address}: threads {threads} to {threads_now}, resident memory {memory} KiB to {memory_now} KiB");
    assert!(threads_now <= threads + THREADS, "{threads} threads to {threads_now}");
    assert!(memory_now < memory + GROWTH_KIB, "{memory} KiB to {memory_now} KiB");
    drop(slow);
    match as_another_user(address, path) {
        Some(got) => assert!(["401", "403"].contains(&got.as_str()), "another user's process got {got}"),
        None => println!("not run: this user may not become another one (it takes root, setpriv and bash)"),
    }
    answers("afterwards");
}
