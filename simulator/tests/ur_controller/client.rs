//! Clients for the tests: one that speaks RTDE packets, and one for the dashboard.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{IpAddr, TcpStream};

use crate::connect;

/// A client that speaks RTDE packets.
pub struct RtdeClient {
    pub stream: TcpStream,
    buffer: Vec<u8>,
    /// Sizes of the pieces in which the bytes arrived.
    pub pieces: Vec<usize>,
}

impl RtdeClient {
    pub fn new(address: IpAddr) -> Self {
        Self { stream: connect(address, 30004), buffer: Vec::new(), pieces: Vec::new() }
    }

    pub fn send(&mut self, kind: u8, payload: &[u8]) {
        let mut packet = ((payload.len() + 3) as u16).to_be_bytes().to_vec();
        packet.push(kind);
        packet.extend(payload);
        self.stream.write_all(&packet).unwrap();
    }

    /// The next packet with its header. None when the controller closed the connection, an error when it aborted it.
    pub fn packet(&mut self) -> std::io::Result<Option<Vec<u8>>> {
        loop {
            if let Some(size) = self.buffer.first_chunk().map(|s| usize::from(u16::from_be_bytes(*s)))
                && self.buffer.len() >= size
            {
                return Ok(Some(self.buffer.drain(..size).collect()));
            }
            let mut piece = [0; 65536];
            let n = self.stream.read(&mut piece)?;
            if n == 0 {
                return Ok(None);
            }
            self.pieces.push(n);
            self.buffer.extend(&piece[..n]);
        }
    }

    /// The next packet of type `kind`. Data and text before it are passed over.
    pub fn answer(&mut self, kind: u8) -> Vec<u8> {
        loop {
            let packet = self.packet().unwrap().expect("closed");
            if packet[2] == kind {
                return packet;
            }
        }
    }

    pub fn ask(&mut self, kind: u8, payload: &[u8]) -> Vec<u8> {
        self.send(kind, payload);
        self.answer(kind)
    }

    pub fn outputs(&mut self, frequency: f64, names: &str) -> String {
        let packet = self.ask(b'O', &[&frequency.to_be_bytes(), names.as_bytes()].concat());
        format!("{}:{}", packet[3], String::from_utf8_lossy(&packet[4..]))
    }

    pub fn inputs(&mut self, names: &str) -> String {
        let packet = self.ask(b'I', names.as_bytes());
        format!("{}:{}", packet[3], String::from_utf8_lossy(&packet[4..]))
    }

    /// The values of the next data packet.
    pub fn data(&mut self) -> Vec<u8> {
        self.answer(b'U').split_off(4)
    }

    /// A client that has negotiated version 2 and reads `names` at full rate.
    pub fn started(address: IpAddr, names: &str) -> Self {
        let mut client = Self::new(address);
        assert_eq!(client.ask(b'V', &[0, 2]), hex("00045601"));
        let types = client.outputs(500.0, names);
        assert!(types.starts_with("1:"), "{types}");
        assert_eq!(client.ask(b'S', &[]), hex("00045301"));
        client
    }
}

pub fn hex(text: &str) -> Vec<u8> {
    let digits: Vec<u32> = text.chars().filter_map(|c| c.to_digit(16)).collect();
    digits.chunks(2).map(|d| (d[0] * 16 + d[1]) as u8).collect()
}

pub fn double(data: &[u8], at: usize) -> f64 {
    f64::from_be_bytes(*data[at..].first_chunk().unwrap())
}

pub fn int(data: &[u8], at: usize) -> i32 {
    i32::from_be_bytes(*data[at..].first_chunk().unwrap())
}

/// A dashboard client that has read the greeting.
pub struct DashboardClient(BufReader<TcpStream>);

impl DashboardClient {
    pub fn new(address: IpAddr) -> Self {
        let mut dashboard = Self(BufReader::new(connect(address, 29999)));
        assert_eq!(dashboard.line(), "Connected: Universal Robots Dashboard Server");
        dashboard
    }

    pub fn line(&mut self) -> String {
        let mut line = String::new();
        self.0.read_line(&mut line).unwrap();
        line.trim_end().to_owned()
    }

    pub fn ask(&mut self, command: &str) -> String {
        self.0.get_mut().write_all(format!("{command}\n").as_bytes()).unwrap();
        self.line()
    }
}
