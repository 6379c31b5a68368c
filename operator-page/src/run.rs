//! `operator-page run`: serves the page of one cell until it is ended.
//!
//! | thread | what it does |
//! |---|---|
//! | main | starts the others, and waits for a signal |
//! | web (two) | all connections, one thread for each port |
//! | answer | ordinary requests, several at a time |
//! | stop (eight) | Stop alone, from both ports |
//! | link | keeps the link to the cell running, and takes its messages |
//! | publish, weights, history | the state for all browsers; the weight files; the episodes |
//!
//! None of them is in the loop's process, and none touches shared memory: the link does, as a process of its own. A port that is in use, a
//! token that others may read, or a configuration that cannot be read ends the command with one line.

use std::io::IsTerminal as _;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

use shared::config::Config;
use shared::exit::{self, Failure, OrExit as _};
use shared::level::Level;
use shared::os;
use web::gate::Rules;
use web::{Server, Settings, token};

use crate::addresses;
use crate::routes;
use crate::site::Site;

/// Threads that answer ordinary requests. Chosen by hand: some may wait seconds for the controller, and pictures still come.
const ANSWERING: usize = 6;
/// Threads of each port that answer Stop. Chosen by hand: while a controller hangs a Stop takes up to 6 s, and a person presses again each second or
/// two.
const STOPPING: usize = 4;
/// Most connections of the port where only Stop is answered. Chosen by hand: one for each page, and room.
const STOP_CONNECTIONS: usize = 32;
/// How long it may take to end. Chosen by hand: longer than any answer waits for the controller, at most 15 s (`CONNECTED` of orders.rs) and a Stop's 6 s.
const GRACE: Duration = Duration::from_secs(25);

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  operator-page run --config config/sim.toml\n  operator-page run --config config/cell.toml --address 192.168.1.20\n\n\
Open the address that it prints in a browser. Ctrl-C ends it; a pour goes on. On another address than 127.0.0.1 a browser needs the\n\
token, which is made at the first start and stands in a terminal behind the address; see docs/OPERATOR.md."
)]
pub struct Args {
    /// The cell's configuration.
    #[arg(long, env = shared::config::VARIABLE, default_value = shared::config::DEFAULT_FILE)]
    config: PathBuf,
    /// The address to listen on. Others than 127.0.0.1 can be reached from other machines, with a token.
    #[arg(long, default_value_t = IpAddr::V4(Ipv4Addr::LOCALHOST))]
    address: IpAddr,
    /// The port; Stop has the one after it, too. With 0 any free ports are taken.
    #[arg(long, default_value_t = 8643)]
    port: u16,
    /// A name under which browsers may ask for this machine, beside its addresses. It may be given more than once.
    #[arg(long = "name")]
    names: Vec<String>,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let config = Config::read(&args.config).or_exit(exit::BAD_INPUT)?;
    let file = std::path::absolute(&args.config).or_exit(exit::BAD_INPUT)?;
    exit::explain_panics("operator-page");
    let stop = os::stop_at_signals().or_exit(exit::FAILED)?;
    exit::end_within(&stop, GRACE, "operator-page: the disk or the controller does not answer: ended without it");
    let token_file = config.controller.weights.with_file_name(format!("operator-page-{}.token", config.cell.name));
    let (word, made) = token::read_or_make(&token_file).or_exit(exit::FAILED)?;
    let page_port = Server::bind(args.address, args.port)?;
    let port = page_port.local_addr().or_exit(exit::FAILED)?.port();
    let stop_port = Server::bind(args.address, if args.port == 0 { 0 } else { args.port.saturating_add(1) })?;
    let second_port = stop_port.local_addr().or_exit(exit::FAILED)?.port();
    let rules = Rules { names: args.names.clone(), token: Some(word.clone()), pages_port: None, content_type: "application/json" };
    let of_stop = Rules { pages_port: Some(port), content_type: "text/plain", ..rules.clone() };
    let (urgent, open) = (&["/api/stop"], routes::PAGE);
    let page = Server::on(page_port, Settings { rules, urgent, open, second_port: Some(second_port), ..Settings::default() })?;
    let stop_settings = Settings { rules: of_stop, connections: STOP_CONNECTIONS, listeners: 0, ..Settings::default() };
    let stop_page = Server::on(stop_port, stop_settings)?;
    let site = Arc::new(Site::new(config, file, second_port));
    announce(page.address(), &word, (&token_file, made), args.address.is_loopback());
    std::thread::scope(|scope| {
        let (page, stop_page, site, stop) = (&page, &stop_page, &site, &*stop);
        for _ in 0..ANSWERING {
            scope.spawn(|| page.serve(stop, |request| routes::answer(site, request)));
        }
        for _ in 0..STOPPING {
            scope.spawn(move || {
                while !stop.load(Relaxed) {
                    if let Some(pending) = page.next_urgent() {
                        let answer = if pending.request.post { routes::stop(site) } else { web::Answer::not_here() };
                        pending.answer(answer);
                    }
                }
            });
        }
        for _ in 0..STOPPING {
            scope.spawn(move || {
                stop_page.serve(stop, |request| match (request.post, request.path.as_str()) {
                    (true, "/stop") => routes::stop(site),
                    // What the browser has asked for here before, it sends as Stop without asking again.
                    (false, "/stop") => web::Answer::text("alive"),
                    _ => web::Answer::not_here(),
                });
            });
        }
        scope.spawn(|| site.cell.keep(stop));
        scope.spawn(|| site.publish(stop));
        scope.spawn(|| site.look_at_weights(stop));
        scope.spawn(|| site.history.keep(stop));
    });
    site.end();
    Ok(())
}

/// Says where the page is. Only a terminal gets the token: what else takes the output may be a log that others read, and is told the token's file.
fn announce(address: SocketAddr, word: &str, (file, made): (&Path, bool), loopback: bool) {
    let say = |level: Level, text: &str| eprintln!("{}", level.marked(&format!("operator-page: {text}")));
    for ip in addresses::to_open(address.ip()) {
        let address = SocketAddr::new(ip, address.port());
        let whole = format!("http://{address}/#token={word}");
        let hidden = format!("http://{address}/#token=... (it is in {})", file.display());
        let told = if std::io::stderr().is_terminal() { &whole } else { &hidden };
        if loopback || !std::io::stdout().is_terminal() {
            println!("http://{address}");
        } else {
            println!("{whole}");
        }
        if loopback {
            say(Level::Info, &format!("open http://{address} on this machine; another user of it needs {told}"));
        } else {
            say(Level::Info, &format!("open {told}"));
        }
    }
    if !loopback {
        say(Level::Warning, "whoever has the token can move the robot; it is not encrypted, so use a network that you trust");
    }
    if made {
        say(Level::Info, "the token was made now, and stays the same until its file is deleted and the page is started again");
    }
}
