//! The addresses under which browsers can ask for this machine, for a page that listens on all of them (`0.0.0.0` or `::`), which is no
//! address that anybody can open.
//!
//! Read once at the start, on the main thread, from the kernel's tables in `/proc`; it allocates. A table that cannot be read gives nothing:
//! then the loopback address alone is known.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr};

/// The kernel's routes of IPv4, which name its own addresses. Source: fib_trie of the kernel's documentation.
const ROUTES: &str = "/proc/net/fib_trie";
/// The kernel's own addresses of IPv6 (same source).
const OWN_V6: &str = "/proc/net/if_inet6";
/// The scope of an address that is good beyond its own cable, in that table (net/ipv6.h of the kernel).
const GLOBAL: &str = "00";

/// What browsers can open when a server listens on `address`: that one, or each of this machine's own if it listens on all.
pub fn to_open(address: IpAddr) -> Vec<IpAddr> {
    if !address.is_unspecified() {
        return vec![address];
    }
    let read = |table: &str| std::fs::read_to_string(table).unwrap_or_default();
    let mut all: Vec<IpAddr> = vec![Ipv4Addr::LOCALHOST.into()];
    all.extend(own_v4(&read(ROUTES)).into_iter().map(IpAddr::V4));
    if address.is_ipv6() {
        all.extend(own_v6(&read(OWN_V6)).into_iter().map(IpAddr::V6));
    }
    // The one for other machines is named first.
    all.rotate_left(1);
    all
}

/// This machine's own addresses in the table of routes, without the loopback's.
fn own_v4(table: &str) -> Vec<Ipv4Addr> {
    let mut found = Vec::new();
    let mut last = None;
    for line in table.lines().map(str::trim) {
        if let Some(address) = line.strip_prefix("|-- ") {
            last = address.parse::<Ipv4Addr>().ok();
        } else if let (true, Some(address)) = (line == "/32 host LOCAL", last)
            && !address.is_loopback()
            && !found.contains(&address)
        {
            found.push(address);
        }
    }
    found
}

/// This machine's own addresses in the table of IPv6 that are good beyond their cable.
fn own_v6(table: &str) -> Vec<Ipv6Addr> {
    let of = |line: &str| {
        let columns: Vec<&str> = line.split_whitespace().collect();
        let number = u128::from_str_radix(columns.first()?, 16).ok()?;
        (*columns.get(3)? == GLOBAL).then(|| Ipv6Addr::from(number))
    };
    table.lines().filter_map(of).filter(|a| !a.is_loopback()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects whoever opens the address that is printed: it is one that the page answers under, and never `0.0.0.0`.
    #[test]
    fn what_is_printed_can_be_opened() {
        let table = "Main:\n  +-- 0.0.0.0/0 3 0 5\n     |-- 0.0.0.0\n        /0 universe UNICAST\n        |-- 192.168.1.20\n           /32 host LOCAL\n\
                     \x20       |-- 192.168.1.255\n           /32 link BROADCAST\nLocal:\n        |-- 127.0.0.1\n           /32 host LOCAL\n\
                     \x20       |-- 192.168.1.20\n           /32 host LOCAL\n";
        assert_eq!(own_v4(table), [Ipv4Addr::new(192, 168, 1, 20)]);
        let table = "fe800000000000000000000000000001 02 40 20 80 eth0\n20010db8000000000000000000000005 02 40 00 80 eth0\n\
                     00000000000000000000000000000001 01 80 10 80 lo\nnonsense\n";
        assert_eq!(own_v6(table), ["2001:db8::5".parse::<Ipv6Addr>().unwrap()]);
        let one: IpAddr = [10, 0, 0, 7].into();
        assert_eq!(to_open(one), [one]);
        for all in [IpAddr::from([0, 0, 0, 0]), Ipv6Addr::UNSPECIFIED.into()] {
            let found = to_open(all);
            assert!(found.contains(&Ipv4Addr::LOCALHOST.into()) && found.iter().all(|a| !a.is_unspecified()), "{found:?}");
        }
    }
}
