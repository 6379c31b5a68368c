//! The worker's own pages, `feature-worker view` and `calibrate --page`, as other people and their pages could attack them: real processes.

use std::io::{BufRead as _, BufReader};
use std::process::Child;

use tests::CellUnderTest;
use tests::attack::attack;

/// A process of the worker that serves a page; killed when it is dropped.
struct Serving(Child);

impl Drop for Serving {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Attacks both pages in a cell that has recorded an episode: each answers its own user meanwhile, nobody else, and does not grow, and nobody
/// writes the configuration.
pub fn stand_attacks(cell: &CellUnderTest) {
    let mut view = Serving(cell.begin("feature-worker", &["view", "--port", "0"]));
    let mut line = String::new();
    BufReader::new(view.0.stdout.take().expect("piped")).read_line(&mut line).expect("it says where");
    attack(line.trim().strip_prefix("http://").expect("an address"), "/state.json", view.0.id());
    drop(view);

    let episodes = std::fs::read_dir(cell.dir.path().join("episodes")).expect("there").flatten().map(|e| e.path());
    let episode = episodes.into_iter().find(|p| p.ends_with("episode-0001.mcap")).expect("an episode");
    let (episode, picture) = (episode.display().to_string(), cell.dir.path().join("corner.png").display().to_string());
    let words = ["calibrate", &episode, "--page", "--port", "0", "--picture", &picture];
    let mut calibrate = Serving(cell.begin("feature-worker", &words));
    let before = std::fs::read(cell.config()).expect("there");
    let mut said = BufReader::new(calibrate.0.stderr.take().expect("piped")).lines().map_while(Result::ok);
    let address = said.find_map(|line| Some(line.split_once("open http://")?.1.split_whitespace().next()?.to_string()));
    attack(&address.expect("it says where"), "/state.json", calibrate.0.id());
    assert_eq!(std::fs::read(cell.config()).expect("there"), before, "nobody has written the configuration");
}
