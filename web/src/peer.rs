//! As which user the other side of a connection on this machine runs, from the kernel's own table of connections.
//!
//! It runs in the server's thread, once a connection, allocates, and reads `/proc`. What the table does not tell is `None`: then the other
//! side counts as a stranger.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};

/// The columns of `/proc/net/tcp` that hold state, user and inode. Source: proc_net_tcp of the kernel's documentation.
const COLUMNS: [usize; 3] = [3, 7, 9];
/// The state of an established connection in that table (net/tcp_states.h of the kernel).
const ESTABLISHED: &str = "01";

/// The user of the process at `peer` that has connected to `own`; `None` if it is not on this machine, or the kernel does not tell.
pub fn uid(peer: SocketAddr, own: SocketAddr) -> Option<u32> {
    if !peer.ip().to_canonical().is_loopback() && peer.ip() != own.ip() {
        return None;
    }
    ["/proc/net/tcp", "/proc/net/tcp6"]
        .iter()
        .filter_map(|table| std::fs::read_to_string(table).ok())
        .find_map(|table| uid_in(&table, peer, own))
}

/// The user in one table.
fn uid_in(table: &str, peer: SocketAddr, own: SocketAddr) -> Option<u32> {
    let same = |text: &str, wanted: SocketAddr| {
        address(text).is_some_and(|(ip, port)| ip.to_canonical() == wanted.ip().to_canonical() && port == wanted.port())
    };
    table.lines().skip(1).find_map(|line| {
        let columns: Vec<&str> = line.split_whitespace().collect();
        let (from, to) = (columns.get(1)?, columns.get(2)?);
        let [state, uid, inode] = COLUMNS.map(|k| columns.get(k).copied().unwrap_or_default());
        // A closed connection belongs to nobody any more, and the kernel shows it as root's.
        let alive = state == ESTABLISHED && inode != "0";
        if same(from, peer) && same(to, own) && alive { uid.parse().ok() } else { None }
    })
}

/// An address as the kernel writes it: words of 32 bits in the machine's byte order, a colon, and the port.
fn address(text: &str) -> Option<(IpAddr, u16)> {
    let (ip, port) = text.split_once(':')?;
    let port = u16::from_str_radix(port, 16).ok()?;
    let words: Option<Vec<u8>> = (0..ip.len() / 8)
        .map(|k| ip.get(k * 8..k * 8 + 8).and_then(|w| u32::from_str_radix(w, 16).ok()))
        .try_fold(Vec::new(), |mut all, word| {
            all.extend(word?.to_ne_bytes());
            Some(all)
        });
    match words?.as_slice() {
        four if four.len() == 4 => Some((IpAddr::V4(Ipv4Addr::from(<[u8; 4]>::try_from(four).ok()?)), port)),
        sixteen if sixteen.len() == 16 => Some((IpAddr::V6(Ipv6Addr::from(<[u8; 16]>::try_from(sixteen).ok()?)), port)),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use std::net::{TcpListener, TcpStream};

    use super::*;

    /// Protects a shared machine: the user of a connection is known, over IPv4 and IPv6, and that of a connection that is not there is not.
    #[test]
    fn the_kernel_says_who_connects() {
        for place in ["127.0.0.1:0", "[::1]:0"] {
            let Ok(listener) = TcpListener::bind(place) else { continue };
            let own = listener.local_addr().unwrap();
            let client = TcpStream::connect(own).unwrap();
            let peer = client.local_addr().unwrap();
            assert_eq!(uid(peer, own), Some(shared::runtime_dir::own_uid()));
            assert_eq!(uid(SocketAddr::new(peer.ip(), 1), own), None);
            // A client that has closed is nobody, and not root, although the kernel shows the user number 0 for it.
            let (_accepted, _) = listener.accept().unwrap();
            drop(client);
            let closed = std::time::Instant::now();
            while closed.elapsed() < std::time::Duration::from_millis(200) {
                let seen = uid(peer, own);
                assert!(seen.is_none() || seen == Some(shared::runtime_dir::own_uid()), "{seen:?}");
            }
            assert_eq!(uid(peer, own), None);
        }
        assert_eq!(uid("192.0.2.7:5000".parse().unwrap(), "192.0.2.8:80".parse().unwrap()), None);
    }
}
