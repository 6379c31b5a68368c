//! `decant metrics`: the cell's counters, histograms, ages and errors as OpenMetrics, for Prometheus and what reads the same.
//!
//! An ordinary process of its own, off unless somebody starts it: it asks the controller as every client does, twice a second at most however
//! often it is asked itself, so it can neither delay the loop nor be used to. The main thread answers; another one reads the weighed pours.
//! Allocates. A controller that is away is no failure but `decant_up 0`; a port that is in use, or shared memory that does not come back, ends
//! it with one line.

mod ended;
mod page;
mod weighed;

use std::net::{IpAddr, Ipv4Addr};
use std::path::PathBuf;
use std::time::{Duration, Instant};

use rt_controller::client::Client;
use shared::config::Config;
use shared::control::Status;
use shared::disk_space::room;
use shared::exit::{self, Failure, OrExit as _};
use shared::os;
use shared::runtime_dir::Place;
use web::gate::Rules;
use web::{Answer, Server, Settings, token};

use ended::Ended;
use page::Seen;
use weighed::Weighed;

/// Most connections. Chosen by hand: a scraper has one.
const CONNECTIONS: usize = 8;
/// How long an answer of the controller counts as new. Chosen by hand: no scraper asks more often for a reason.
const FRESH: Duration = Duration::from_millis(500);
/// How long it may take to end. Chosen by hand: reading one episode, or one answer of the controller.
const GRACE: Duration = Duration::from_secs(5);
/// Pause before a controller that is away is looked for again. Chosen by hand; no measurement is recorded.
const AGAIN: Duration = Duration::from_secs(2);

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  decant metrics --config config/cell.toml
  curl http://127.0.0.1:8645/metrics

Whoever is neither this user nor root gives the token, which is made at the first start beside the weights, as a header
'Authorization: Bearer TOKEN'. docs/DEPLOYMENT.md has Prometheus's side of it, and a dashboard.")]
pub struct Args {
    /// The cell's configuration.
    #[arg(long, env = shared::config::VARIABLE, default_value = shared::config::DEFAULT_FILE)]
    config: PathBuf,
    /// The address to listen on. Others than 127.0.0.1 can be reached from other machines, with the token.
    #[arg(long, default_value_t = IpAddr::V4(Ipv4Addr::LOCALHOST))]
    address: IpAddr,
    /// The port. With 0 any free one is taken.
    #[arg(long, default_value_t = 8645)]
    port: u16,
    /// A name under which this machine may be asked, beside its addresses. It may be given more than once.
    #[arg(long = "name")]
    names: Vec<String>,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let config = Config::read(&args.config).or_exit(exit::BAD_INPUT)?;
    exit::explain_panics("decant metrics");
    let stop = os::stop_at_signals().or_exit(exit::FAILED)?;
    exit::end_within(&stop, GRACE, "decant metrics: the disk does not answer: ended without it");
    let token_file = config.controller.weights.with_file_name(format!("metrics-{}.token", config.cell.name));
    let (word, _) = token::read_or_make(&token_file).or_exit(exit::FAILED)?;
    let rules = Rules { names: args.names.clone(), token: Some(word), pages_port: None, content_type: "application/json" };
    let settings = Settings { rules, connections: CONNECTIONS, listeners: 0, ..Settings::default() };
    let server = Server::open(args.address, args.port, settings)?;
    println!("http://{}/metrics", server.address());
    let weighed = Weighed::default();
    std::thread::scope(|scope| {
        scope.spawn(|| weighed.keep(&config.recording.directory, &stop));
        let mut cell = Cell::new(&config);
        // What ends before Prometheus first asks counts too.
        cell.look(&weighed);
        server.serve(&stop, |request| match (request.post, request.path.as_str()) {
            (false, "/metrics") => match page::text(cell.look(&weighed)) {
                Ok(text) => Answer::bytes(page::KIND, text),
                Err(e) => Answer::fault(500, format!("metrics cannot be written: {e}")),
            },
            _ => Answer::not_here(),
        });
    });
    Ok(())
}

/// What is known of the controller, and the way to ask it.
struct Cell<'a> {
    config: &'a Config,
    client: Option<Client>,
    /// The newest answer, and when it was asked for.
    status: Option<Box<Status>>,
    asked: Option<Instant>,
    /// When this process began to look.
    since: Instant,
    /// How the pours and recordings ended since then.
    ended: Ended,
}

impl<'a> Cell<'a> {
    fn new(config: &'a Config) -> Self {
        Self { config, client: None, status: None, asked: None, since: Instant::now(), ended: Ended::new() }
    }

    /// Asks the controller, unless it was asked just now.
    fn look(&mut self, weighed: &Weighed) -> Seen {
        let pause = if self.status.is_some() { FRESH } else { AGAIN };
        if self.asked.is_none_or(|at| at.elapsed() >= pause) {
            self.asked = Some(Instant::now());
            self.status = self.ask();
            self.count();
        }
        let recording = self.config.recording.directory.as_path();
        let journal = self.config.controller.journal.as_deref().map(|path| ("journal", path));
        let places = [("episodes", recording)].into_iter().chain(journal);
        Seen {
            cell: self.config.cell.name.clone(),
            status: self.status.clone(),
            ended: self.ended.counts.clone(),
            errors_ml: weighed.errors_ml(),
            room: places.filter_map(|(name, path)| Some((name, room(path)?))).collect(),
        }
    }

    /// The controller's state; `None` if it does not answer. A client whose controller went away is made anew.
    fn ask(&mut self) -> Option<Box<Status>> {
        if self.client.is_none() {
            // Nothing is joined for a controller that does not run: that would make its files in shared memory.
            rt_controller::stop_client::running_at(&Place::from(&self.config.cell)).ok().flatten()?;
            self.client = Client::connect_or_end(&self.config.cell).ok();
        }
        let status = self.client.as_ref()?.status().ok();
        if status.is_none() {
            self.client = None;
        }
        status
    }

    /// Counts the results that were not counted yet. Those from before this process started are not its own; a controller that started later has none.
    fn count(&mut self) {
        let Some(status) = &self.status else { return };
        self.ended.count(&status.outcomes, status.uptime_s < self.since.elapsed().as_secs_f64());
    }
}
