//! Who is answered. A page may start motion or write a configuration, so each request is judged before it reaches anything else.
//!
//! Pure functions of a request's headers and its connection; they allocate, never wait, and a refusal is a [`Refusal`] with one line.
//!
//! 1. `Host` is an address of this connection, or a name that the user has given. A foreign name that was pointed at this machine (DNS
//!    rebinding) is refused. So is a request line with a whole address of another place, whatever its `Host` says: the line comes first (RFC
//!    9112, 3.2.2).
//! 2. What another site's page asks is refused: by `Origin`, by `Sec-Fetch-Site`, and because JSON cannot be sent from a form. Only looking
//!    up the address itself by a link is left.
//! 3. GET changes nothing; POST needs an `Origin` of its own and a content type.
//! 4. On this machine the kernel says as which user the browser runs. This page's own user and root need no token, all others do.

use std::net::{IpAddr, SocketAddr};
use std::sync::OnceLock;

use hyper::header::{self, HeaderMap};
use hyper::{Method, StatusCode, Uri};
use shared::runtime_dir::own_uid;

use crate::{peer, token};

/// The header in which a browser says from where a request comes. Source: Fetch Metadata Request Headers (W3C).
const FETCH_SITE: &str = "sec-fetch-site";
/// What the result of a request is for (same source): `document` is a page of its own.
const FETCH_DEST: &str = "sec-fetch-dest";

/// What the gate goes by.
#[derive(Debug, Clone, Default)]
pub struct Rules {
    /// Names under which this server may be asked, beside its addresses.
    pub names: Vec<String>,
    /// The token that strangers need; without it, strangers are refused.
    pub token: Option<String>,
    /// The port whose pages may send their POST here, instead of this server's own port.
    pub pages_port: Option<u16>,
    /// The content type of a POST.
    pub content_type: &'static str,
}

/// Why a request is refused.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Refusal {
    /// The HTTP status.
    pub status: StatusCode,
    /// What to do about it.
    pub line: String,
}

fn refused(status: StatusCode, line: impl Into<String>) -> Refusal {
    Refusal { status, line: line.into() }
}

/// Both ends of a connection, and whether the other one is trusted, which is found out when it is first asked for: the kernel's table takes
/// milliseconds to read, and whoever only opens connections is not worth them.
#[derive(Debug)]
pub struct Ends {
    /// This side.
    pub own: SocketAddr,
    /// The other side.
    pub peer: SocketAddr,
    trusted: OnceLock<bool>,
}

impl Ends {
    /// The ends of a new connection.
    pub fn new(own: SocketAddr, peer: SocketAddr) -> Self {
        Self { own, peer, trusted: OnceLock::new() }
    }

    /// Whether the other side runs on this machine as this process's user or as root.
    fn trusted(&self) -> bool {
        *self.trusted.get_or_init(|| peer::uid(self.peer, self.own).is_some_and(|uid| uid == own_uid() || uid == 0))
    }
}

/// The text of a header; none if it is missing, doubled or no text.
fn text(headers: &HeaderMap, name: impl header::AsHeaderName) -> Option<&str> {
    let mut all = headers.get_all(name).iter();
    let first = all.next()?;
    if all.next().is_some() { None } else { first.to_str().ok() }
}

/// The host of a request without its port, if it may be asked for under it.
fn host<'a>(uri: &Uri, headers: &'a HeaderMap, ends: &Ends, rules: &Rules) -> Result<&'a str, Refusal> {
    let missing = || refused(StatusCode::BAD_REQUEST, "the request names no host");
    let name = known(text(headers, header::HOST).ok_or_else(missing)?, ends, rules)?;
    if uri.scheme_str().is_some_and(|scheme| scheme != "http") {
        return Err(misdirected());
    }
    if let Some(authority) = uri.authority() {
        known(authority.as_str(), ends, rules)?;
    }
    Ok(name)
}

/// What is not asked here.
fn misdirected() -> Refusal {
    refused(
        StatusCode::MISDIRECTED_REQUEST,
        "this page is not known under that name: open the address that its program printed, or start it with --name",
    )
}

/// `full`, a name or address with or without a port, without its port, if this server may be asked for under it.
fn known<'a>(full: &'a str, ends: &Ends, rules: &Rules) -> Result<&'a str, Refusal> {
    let (name, port) = match full.rsplit_once(':').filter(|(_, port)| port.bytes().all(|b| b.is_ascii_digit())) {
        Some((name, port)) => (name, port.parse().unwrap_or(0)),
        None => (full, 80),
    };
    let literal: Option<IpAddr> = name.trim_start_matches('[').trim_end_matches(']').parse().ok();
    let own = ends.own.ip().to_canonical();
    let known = literal.is_some_and(|ip| ip.to_canonical() == own)
        || (own.is_loopback() && name.eq_ignore_ascii_case("localhost"))
        || rules.names.iter().any(|n| n.eq_ignore_ascii_case(name));
    if known && port == ends.own.port() { Ok(name) } else { Err(misdirected()) }
}

/// The origin whose pages may ask here.
pub fn own_origin(name: &str, ends: &Ends, rules: &Rules) -> String {
    format!("http://{name}:{}", rules.pages_port.unwrap_or(ends.own.port()))
}

/// Judges a request by its method, the address in its first line, and its headers. Gives the host under which it was asked.
pub fn judge<'a>(method: &Method, uri: &Uri, headers: &'a HeaderMap, ends: &Ends, rules: &Rules) -> Result<&'a str, Refusal> {
    let name = host(uri, headers, ends, rules)?;
    let own = own_origin(name, ends, rules);
    let same =
        |origin: &str| origin.eq_ignore_ascii_case(&own) || (own.ends_with(":80") && own[..own.len() - 3].eq_ignore_ascii_case(origin));
    let foreign = || refused(StatusCode::FORBIDDEN, "another site's page may ask for nothing here");
    if headers.contains_key(header::ORIGIN) && !text(headers, header::ORIGIN).is_some_and(same) {
        return Err(foreign());
    }
    let looks_up = *method == Method::GET && text(headers, FETCH_DEST) == Some("document");
    let own_sites: &[&str] = if rules.pages_port.is_some() { &["same-origin", "same-site", "none"] } else { &["same-origin", "none"] };
    if headers.contains_key(FETCH_SITE) && !looks_up && !text(headers, FETCH_SITE).is_some_and(|site| own_sites.contains(&site)) {
        return Err(foreign());
    }
    match *method {
        Method::GET => Ok(name),
        // A browser asks beforehand whether a page may send the token to another port (Fetch Standard, "CORS-preflight fetch").
        Method::OPTIONS if rules.pages_port.is_some() && headers.contains_key(header::ORIGIN) => Ok(name),
        Method::POST => {
            if !headers.contains_key(header::ORIGIN) {
                return Err(refused(StatusCode::FORBIDDEN, "a request that changes something must say from which page it comes (Origin)"));
            }
            let kind = text(headers, header::CONTENT_TYPE).unwrap_or("").split(';').next().unwrap_or("").trim();
            if !kind.eq_ignore_ascii_case(rules.content_type) {
                let line = format!("a request that changes something must be {}", rules.content_type);
                return Err(refused(StatusCode::UNSUPPORTED_MEDIA_TYPE, line));
            }
            Ok(name)
        }
        _ => Err(refused(StatusCode::METHOD_NOT_ALLOWED, "only GET and POST are answered")),
    }
}

/// Whether the other side may ask at all: its user is trusted, or it sends the token in the header `Authorization`. A cookie does not count: browsers send
/// it to every port of a host, and so to whoever listens there, while no other site's page can send this header.
pub fn admitted(headers: &HeaderMap, ends: &Ends, rules: &Rules) -> Result<(), Refusal> {
    let Some(token) = &rules.token else {
        if ends.trusted() {
            return Ok(());
        }
        return Err(refused(StatusCode::FORBIDDEN, "this page belongs to another user of this machine"));
    };
    let given = text(headers, header::AUTHORIZATION).and_then(|value| value.strip_prefix("Bearer "));
    if given.is_some_and(|word| token::same(word, token)) || ends.trusted() {
        Ok(())
    } else {
        let line = "this browser has no token, or an old one: open the page's address with #token= and the token behind it";
        Err(refused(StatusCode::UNAUTHORIZED, line))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ends() -> Ends {
        ends_of(true)
    }

    fn ends_of(trusted: bool) -> Ends {
        Ends { own: "127.0.0.1:8643".parse().unwrap(), peer: "127.0.0.1:9".parse().unwrap(), trusted: OnceLock::from(trusted) }
    }

    fn rules() -> Rules {
        Rules { names: vec!["cell.lab".into()], token: None, pages_port: None, content_type: "application/json" }
    }

    fn headers(all: &[(&'static str, &str)]) -> HeaderMap {
        all.iter().map(|(name, value)| (header::HeaderName::from_static(name), value.parse().unwrap())).collect()
    }

    fn status(method: &Method, all: &[(&'static str, &str)]) -> u16 {
        judge(method, &Uri::from_static("/"), &headers(all), &ends(), &rules()).map_or_else(|e| e.status.as_u16(), |_| 200)
    }

    /// Protects the robot from other sites' pages and rebound names: only this server's own names, origin and content type pass.
    #[test]
    fn only_its_own_pages_are_answered() {
        let own = [("host", "127.0.0.1:8643"), ("origin", "http://127.0.0.1:8643"), ("content-type", "application/json")];
        assert_eq!(status(&Method::POST, &own), 200);
        let with = |name: &'static str, value: &'static str| {
            own.iter().map(|(n, v)| if *n == name { (*n, value) } else { (*n, *v) }).collect::<Vec<_>>()
        };
        for origin in ["http://evil.example", "null", "http://127.0.0.1:8644", "https://127.0.0.1:8643", "http://localhost:8643"] {
            assert_eq!(status(&Method::POST, &with("origin", origin)), 403, "{origin}");
        }
        for host in ["evil.example:8643", "evil.example", "127.0.0.1", "127.0.0.2:8643", "192.168.1.5:8643", ""] {
            assert_eq!(status(&Method::POST, &with("host", host)), 421, "{host}");
        }
        for kind in ["text/plain", "application/x-www-form-urlencoded", "multipart/form-data", ""] {
            assert_eq!(status(&Method::POST, &with("content-type", kind)), 415, "{kind}");
        }
        assert_eq!(status(&Method::POST, &own[..1]), 403, "without an origin");
        assert_eq!(status(&Method::GET, &[]), 400, "without a host");
        for host in ["127.0.0.1:8643", "localhost:8643", "CELL.lab:8643"] {
            assert_eq!(status(&Method::GET, &[("host", host)]), 200, "{host}");
        }
        for method in [Method::PUT, Method::DELETE, Method::OPTIONS, Method::HEAD] {
            assert_eq!(status(&method, &own), 405, "{method}");
        }
    }

    /// Protects what the camera sees from other sites: their pages cannot show a picture or frame this one; a link to it works.
    #[test]
    fn another_site_may_only_link_here() {
        let get = |site: &'static str, dest: &'static str| {
            status(&Method::GET, &[("host", "localhost:8643"), ("sec-fetch-site", site), ("sec-fetch-dest", dest)])
        };
        assert_eq!((get("same-origin", "empty"), get("none", "document"), get("cross-site", "document")), (200, 200, 200));
        assert_eq!((get("cross-site", "image"), get("same-site", "iframe"), get("cross-site", "empty")), (403, 403, 403));
    }

    /// Protects the way to stop that has a port of its own: the pages of the other port may use it, and nobody else.
    #[test]
    fn the_other_ports_pages_may_ask() {
        let rules = Rules { pages_port: Some(8000), content_type: "text/plain", ..rules() };
        // A browser asks before it sends the token there (OPTIONS).
        for method in [Method::POST, Method::OPTIONS] {
            let judge = |origin: &str| {
                let all = headers(&[
                    ("host", "127.0.0.1:8643"),
                    ("origin", origin),
                    ("content-type", "text/plain"),
                    ("sec-fetch-site", "same-site"),
                ]);
                super::judge(&method, &Uri::from_static("/"), &all, &ends(), &rules).is_ok()
            };
            assert!(judge("http://127.0.0.1:8000"), "{method}");
            assert!(!judge("http://127.0.0.1:8643") && !judge("http://127.0.0.1:8001") && !judge("http://localhost:8000"), "{method}");
        }
        let no_origin = headers(&[("host", "127.0.0.1:8643")]);
        assert!(super::judge(&Method::OPTIONS, &Uri::from_static("/"), &no_origin, &ends(), &rules).is_err());
    }

    /// Protects a cell on a shared machine or a network: a stranger needs the token, in the one header that a browser sends to nobody by itself.
    #[test]
    fn a_stranger_needs_the_token() {
        let rules = Rules { token: Some("secret".into()), ..rules() };
        let stranger = ends_of(false);
        let with = |cookie: &str| admitted(&headers(&[("cookie", cookie)]), &stranger, &rules).map_err(|e| e.status.as_u16());
        assert_eq!(with("decant-8643=secret"), Err(401), "a cookie goes to every port of the host");
        let says = |word: &str| admitted(&headers(&[("authorization", word)]), &stranger, &rules).is_ok();
        assert!(says("Bearer secret") && !says("Bearer wrong") && !says("Bearer ") && !says("secret") && !says("Basic secret"));
        assert_eq!(admitted(&HeaderMap::new(), &ends(), &rules), Ok(()));
        assert_eq!(
            admitted(&HeaderMap::new(), &stranger, &Rules { token: None, ..rules.clone() }).map_err(|e| e.status.as_u16()),
            Err(403)
        );
    }
}
