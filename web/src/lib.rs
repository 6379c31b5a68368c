//! The HTTP layer of every page of Decant: of the operator's page, `feature-worker view` and `feature-worker calibrate --page`.
//!
//! A page may start motion or write a configuration, so this layer decides who is answered, and nothing in it grows with what others send:
//! connections, event streams, headers, bodies, waiting requests and times are bounded. It runs in a thread of its own with one asynchronous
//! runtime, allocates, and hands whole requests to the caller's own threads through bounded queues.
//!
//! | file | what it holds |
//! |---|---|
//! | [`server`] | listening, connections, and the queues to the caller |
//! | [`gate`] | who is answered: host, origin, method, content type, user and token |
//! | [`peer`] | as which user the other side of a connection on this machine runs |
//! | [`token`] | the word that another machine needs |
//! | [`answer`] | what is answered: text, bytes, a file, or a stream of events |
//! | [`connections`] | which connections are open, and which one makes room |
//! | [`patient`] | a connection whose reader may not hold it up |
#![forbid(unsafe_code)]

pub mod answer;
pub mod connections;
pub mod gate;
pub mod patient;
pub mod peer;
pub mod server;
pub mod token;

pub use answer::{Answer, Broadcast};
pub use server::{Pending, Request, Server, Settings};
