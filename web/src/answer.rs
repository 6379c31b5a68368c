//! What is answered: text, bytes, a file, or a stream of events.
//!
//! Made in the caller's threads, sent in the server's runtime; it allocates. A file is read in parts while it is sent, and a stream of events
//! always sends the newest event alone, so neither grows with a slow reader. A file that cannot be read to its end cuts the answer short.

use std::fs::File;
use std::future::Future;
use std::io::Read as _;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use hyper::body::{Body, Bytes, Frame, SizeHint};
use tokio::sync::watch;

use crate::connections::Busy;

/// How much of a file is sent at once, bytes. Chosen by hand: a part is read within a millisecond.
const PART: usize = 64 * 1024;

/// An answer.
pub struct Answer {
    /// The HTTP status.
    pub(crate) status: u16,
    /// The content type.
    pub(crate) kind: &'static str,
    /// Headers beside those that every answer has.
    pub(crate) headers: Vec<(&'static str, String)>,
    pub(crate) content: Content,
}

pub(crate) enum Content {
    Bytes(Vec<u8>),
    /// A file and its length.
    File(File, u64),
    Events(watch::Receiver<Arc<str>>),
}

impl Answer {
    fn new(status: u16, kind: &'static str, content: Content) -> Self {
        Self { status, kind, headers: Vec::new(), content }
    }

    /// Bytes of this content type.
    pub fn bytes(kind: &'static str, bytes: impl Into<Vec<u8>>) -> Self {
        Self::new(200, kind, Content::Bytes(bytes.into()))
    }

    /// A page in HTML.
    pub fn html(text: &str) -> Self {
        Self::bytes("text/html; charset=utf-8", text)
    }

    /// Plain text.
    pub fn text(text: impl Into<String>) -> Self {
        Self::bytes("text/plain; charset=utf-8", text.into())
    }

    /// JSON.
    pub fn json(value: &serde_json::Value) -> Self {
        Self::bytes("application/json", value.to_string())
    }

    /// A picture.
    pub fn jpeg(bytes: Vec<u8>) -> Self {
        Self::bytes("image/jpeg", bytes)
    }

    /// A file for the reader's disk, under `name`.
    pub fn file(file: File, name: &str) -> Self {
        let bytes = file.metadata().map_or(0, |m| m.len());
        Self::new(200, "application/octet-stream", Content::File(file, bytes)).saved_as(name)
    }

    /// The answer as a file for the reader's disk, under `name`.
    pub fn saved_as(mut self, name: &str) -> Self {
        let safe: String = name.chars().map(|c| if c.is_ascii_alphanumeric() || "-_.".contains(c) { c } else { '_' }).collect();
        self.headers.push(("content-disposition", format!("attachment; filename=\"{safe}\"")));
        self
    }

    /// A refusal or failure: its HTTP status, and one line that says what to do.
    pub fn fault(status: u16, line: impl Into<String>) -> Self {
        let body = serde_json::json!({ "error": line.into() });
        Self::new(status, "application/json", Content::Bytes(body.to_string().into()))
    }

    /// There is no such page.
    pub fn not_here() -> Self {
        Self::fault(404, "there is no such page")
    }

    /// The answer with another header. Line ends in `value` are dropped.
    pub fn header(mut self, name: &'static str, value: &str) -> Self {
        self.headers.push((name, value.chars().filter(|c| !c.is_control()).collect()));
        self
    }
}

/// Events for all who listen. Each listener gets the newest one as soon as it has taken the one before.
pub struct Broadcast(watch::Sender<Arc<str>>);

impl Default for Broadcast {
    fn default() -> Self {
        Self(watch::Sender::new("".into()))
    }
}

impl Broadcast {
    /// Sends `event`, one line of text, to all who listen.
    pub fn send(&self, event: &str) {
        self.0.send_replace(event.into());
    }

    /// Number of listeners.
    pub fn listeners(&self) -> usize {
        self.0.receiver_count()
    }

    /// A stream of the events from now on. What was sent before is not in it: while nobody listens nothing may be sent, so the newest event may
    /// be old.
    pub fn stream(&self) -> Answer {
        Answer::new(200, "text/event-stream", Content::Events(self.0.subscribe()))
    }
}

/// The wait for the next event.
type Next = Pin<Box<dyn Future<Output = Option<(Bytes, watch::Receiver<Arc<str>>)>> + Send>>;

async fn next(mut receiver: watch::Receiver<Arc<str>>) -> Option<(Bytes, watch::Receiver<Arc<str>>)> {
    receiver.changed().await.ok()?;
    let event = Arc::clone(&receiver.borrow_and_update());
    Some((Bytes::from(format!("data: {event}\n\n")), receiver))
}

/// What is still to be sent of an answer.
enum Rest {
    Bytes(Option<Bytes>),
    File(File, u64),
    Events(Next),
}

/// An answer on its way. Its connection counts as busy, and its listener as one of those that are allowed, until it is dropped.
pub(crate) struct Sending {
    rest: Rest,
    _busy: Busy,
    _listener: Option<tokio::sync::OwnedSemaphorePermit>,
}

impl Sending {
    pub(crate) fn new(content: Content, busy: Busy, listener: Option<tokio::sync::OwnedSemaphorePermit>) -> Self {
        let rest = match content {
            Content::Bytes(bytes) => Rest::Bytes(Some(bytes.into())),
            Content::File(file, bytes) => Rest::File(file, bytes),
            Content::Events(receiver) => Rest::Events(Box::pin(next(receiver))),
        };
        Self { rest, _busy: busy, _listener: listener }
    }
}

impl Body for Sending {
    type Data = Bytes;
    type Error = std::io::Error;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, std::io::Error>>> {
        match &mut self.rest {
            Rest::Bytes(bytes) => Poll::Ready(bytes.take().filter(|b| !b.is_empty()).map(|b| Ok(Frame::data(b)))),
            Rest::File(_, 0) => Poll::Ready(None),
            Rest::File(file, left) => {
                let mut part = vec![0; PART.min(usize::try_from(*left).unwrap_or(PART))];
                match file.read(&mut part) {
                    Ok(0) => Poll::Ready(Some(Err(std::io::ErrorKind::UnexpectedEof.into()))),
                    Ok(bytes) => {
                        part.truncate(bytes);
                        *left -= bytes as u64;
                        Poll::Ready(Some(Ok(Frame::data(part.into()))))
                    }
                    Err(e) => Poll::Ready(Some(Err(e))),
                }
            }
            Rest::Events(waiting) => match waiting.as_mut().poll(context) {
                Poll::Pending => Poll::Pending,
                Poll::Ready(None) => Poll::Ready(None),
                Poll::Ready(Some((event, receiver))) => {
                    *waiting = Box::pin(next(receiver));
                    Poll::Ready(Some(Ok(Frame::data(event))))
                }
            },
        }
    }

    fn size_hint(&self) -> SizeHint {
        match &self.rest {
            Rest::Bytes(bytes) => SizeHint::with_exact(bytes.as_ref().map_or(0, |b| b.len() as u64)),
            Rest::File(_, left) => SizeHint::with_exact(*left),
            Rest::Events(_) => SizeHint::default(),
        }
    }

    fn is_end_stream(&self) -> bool {
        match &self.rest {
            Rest::Bytes(bytes) => bytes.as_ref().is_none_or(Bytes::is_empty),
            Rest::File(_, left) => *left == 0,
            Rest::Events(_) => false,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects whoever opens a page from a state of the robot that is minutes old: a stream begins with what is sent after it was asked for.
    #[test]
    fn a_stream_begins_with_what_is_new() {
        let events = Broadcast::default();
        events.send("old");
        let Content::Events(receiver) = events.stream().content else { panic!("a stream") };
        let mut first = Box::pin(next(receiver));
        let mut context = Context::from_waker(std::task::Waker::noop());
        assert!(first.as_mut().poll(&mut context).is_pending());
        events.send("new");
        let Poll::Ready(Some((bytes, _))) = first.as_mut().poll(&mut context) else { panic!("an event") };
        assert_eq!(bytes, "data: new\n\n");
    }
}
