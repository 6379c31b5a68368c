//! Where the robot's controller is: an address, or a name that the machine's resolver knows.
//!
//! Plain data; looking a name up ([`RobotAddress::resolve`]) allocates and may wait for seconds for a name server, so only ordinary threads do it, and
//! never the loop. A name that cannot be one is refused when the configuration is read; one that is not known is one line.

use std::fmt::{Display, Formatter};
use std::net::{IpAddr, ToSocketAddrs as _};

use serde::{Deserialize, Serialize};

/// Longest name, bytes (RFC 1035, section 2.3.4).
const NAME_MAX: usize = 253;
/// Longest part of a name between dots, bytes (RFC 1035, section 2.3.4).
const LABEL_MAX: usize = 63;

/// An address or a name.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct RobotAddress(String);

impl RobotAddress {
    /// The address, if no name is to be looked up.
    pub fn literal(&self) -> Option<IpAddr> {
        self.0.parse().ok()
    }

    /// The address now. Of a name's addresses it is the only one of IPv4, which is what UR robots have, else the first.
    pub fn resolve(&self) -> Result<IpAddr, String> {
        if let Some(address) = self.literal() {
            return Ok(address);
        }
        one_of((self.0.as_str(), 0).to_socket_addrs().map_err(|e| e.to_string())?.map(|a| a.ip()))
    }
}

/// The address among those of one name. Several of IPv4 may be several robots', and a resolver gives them in turns, so that none is taken: it would be
/// another one each time.
fn one_of(addresses: impl Iterator<Item = IpAddr>) -> Result<IpAddr, String> {
    let (mut v4, others): (Vec<IpAddr>, Vec<IpAddr>) = addresses.partition(IpAddr::is_ipv4);
    v4.sort();
    v4.dedup();
    if v4.len() > 1 {
        let all = v4.iter().map(IpAddr::to_string).collect::<Vec<_>>().join(", ");
        return Err(format!("the name has several addresses ({all}), which may be those of several robots: give the robot's own"));
    }
    v4.first().or(others.first()).copied().ok_or_else(|| "the name has no address".into())
}

impl TryFrom<String> for RobotAddress {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let label = |l: &str| {
            (1..=LABEL_MAX).contains(&l.len())
                && l.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'-' || b == b'_')
                && !l.starts_with('-')
                && !l.ends_with('-')
        };
        let name = text.strip_suffix('.').unwrap_or(&text);
        // What ends in a number is no name (RFC 3696, section 2), but a mistyped address.
        let numeric = name.rsplit('.').next().is_some_and(|last| last.bytes().all(|b| b.is_ascii_digit()));
        if text.parse::<IpAddr>().is_ok() || (name.len() <= NAME_MAX && name.split('.').all(label) && !numeric) {
            Ok(Self(text))
        } else {
            Err(format!("robot.address = \"{text}\": give an address such as 192.168.1.10, or the robot's name in this network"))
        }
    }
}

impl From<RobotAddress> for String {
    fn from(address: RobotAddress) -> Self {
        address.0
    }
}

impl From<IpAddr> for RobotAddress {
    fn from(address: IpAddr) -> Self {
        Self(address.to_string())
    }
}

impl Display for RobotAddress {
    fn fmt(&self, f: &mut Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects whoever stands at one robot from the other one: a name of two robots, which a resolver gives in turns, is refused, and one address told twice is
    /// one.
    #[test]
    fn a_name_of_two_robots_is_refused() {
        let of = |all: &[&str]| one_of(all.iter().map(|a| a.parse().unwrap()));
        let [a, b, six] = ["192.168.1.10", "192.168.1.11", "fe80::1"];
        for all in [&[a, b][..], &[b, six, a]] {
            assert!(of(all).unwrap_err().contains("several addresses (192.168.1.10, 192.168.1.11)"));
        }
        assert_eq!(of(&[six, b, b]), Ok(b.parse().unwrap()));
        assert_eq!(of(&[six, "fe80::2"]), Ok(six.parse().unwrap()));
        assert_eq!(of(&[]), Err("the name has no address".into()));
    }

    /// Protects the operator: an address stays one, a name is looked up, and what is neither is refused with what to write.
    #[test]
    fn addresses_and_names_are_told_apart() {
        let of = |text: &str| RobotAddress::try_from(text.to_owned());
        assert_eq!(of("192.168.1.10").unwrap().literal(), Some([192, 168, 1, 10].into()));
        assert_eq!(of("::1").unwrap().resolve(), Ok("::1".parse().unwrap()));
        let name = of("localhost").unwrap();
        assert_eq!((name.literal(), name.resolve().unwrap().is_loopback()), (None, true));
        assert!(of("no-such-robot.invalid").unwrap().resolve().is_err());
        for bad in ["", "192.168.1", "192.168.1.256", "robot one", "-robot", "robot..lab", "http://robot", "robot:30004", &"a".repeat(64)] {
            assert!(of(bad).unwrap_err().contains("give an address"), "{bad}");
        }
    }
}
