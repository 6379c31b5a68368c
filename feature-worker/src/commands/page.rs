//! The local web page of `view` and `calibrate`: a server on 127.0.0.1 that answers one request after the other.
//!
//! Runs on the thread that calls it, and allocates. A browser that goes away is no error.

use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::Duration;

use shared::exit::{self, Failure, failure};
use tiny_http::{Header, Response, Server};

/// How long one wait for a request lasts. Chosen by hand: a request to stop is noticed within a tenth of a second.
const WAIT: Duration = Duration::from_millis(100);

/// A body with its content type. None means that there is no such page.
pub(super) type Answer = Option<(Vec<u8>, &'static str)>;

/// An answer in HTML.
pub(super) fn html(text: &str) -> Answer {
    Some((text.as_bytes().to_vec(), "text/html; charset=utf-8"))
}

/// An answer in plain text.
pub(super) fn text(text: String) -> Answer {
    Some((text.into_bytes(), "text/plain; charset=utf-8"))
}

/// An answer in JSON.
pub(super) fn json(value: &serde_json::Value) -> Answer {
    Some((value.to_string().into_bytes(), "application/json"))
}

/// A picture as answer.
pub(super) fn jpeg(bytes: Vec<u8>) -> Answer {
    Some((bytes, "image/jpeg"))
}

/// A local server of one command.
pub(super) struct Page {
    server: Server,
}

impl Page {
    /// Listens on `port` of 127.0.0.1. With 0 any free port is taken. A port that is in use is an error that says so.
    pub(super) fn open(port: u16) -> Result<Self, Failure> {
        let server = Server::http(("127.0.0.1", port))
            .map_err(|e| failure(exit::FAILED, format!("port {port} on 127.0.0.1: {e}; give another --port")))?;
        Ok(Self { server })
    }

    /// The address to open in a browser.
    pub(super) fn address(&self) -> String {
        format!("http://{}", self.server.server_addr())
    }

    /// Answers until `stop` is set. `answer` gets the path and the body of a request.
    pub(super) fn serve(&self, stop: &AtomicBool, mut answer: impl FnMut(&str, &str) -> Answer) {
        while !stop.load(Relaxed) {
            let Ok(Some(mut request)) = self.server.recv_timeout(WAIT) else { continue };
            let path = request.url().split('?').next().unwrap_or("/").to_string();
            let mut body = String::new();
            // A body that is not text is treated as an empty one.
            if request.as_reader().read_to_string(&mut body).is_err() {
                body.clear();
            }
            // A browser that goes away before the answer is no error.
            let _ = match answer(&path, &body) {
                Some((body, kind)) => request.respond(response(body, kind)),
                None => request.respond(Response::from_data("not here").with_status_code(404)),
            };
        }
    }
}

fn response(body: Vec<u8>, kind: &str) -> Response<std::io::Cursor<Vec<u8>>> {
    let response = Response::from_data(body);
    match Header::from_bytes("Content-Type", kind) {
        Ok(header) => response.with_header(header),
        Err(()) => response,
    }
}
