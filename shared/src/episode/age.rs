//! Which episodes are older.
//!
//! Ordinary threads use it; it allocates, and asks the disk what directories are the same. It cannot fail.

use std::path::{Path, PathBuf};

use super::{Episode, by_number, number_of};

/// What tells an episode's age.
#[derive(Debug, Clone, Copy)]
pub struct Begun<'a, T> {
    /// Its file.
    pub path: &'a Path,
    /// The number that the recorder gave it, as the file says.
    pub number: Option<u64>,
    /// When it began, by the wall clock of its day.
    pub at: T,
}

/// Episodes that were read from files, the oldest first.
pub fn oldest_first(episodes: Vec<Episode>) -> Vec<Episode> {
    oldest_first_of(episodes, |e| (e.name.as_ref(), e))
}

/// The elements of `all`, the oldest first. `file` gives of each its path and what was read from there.
pub fn oldest_first_of<T>(all: Vec<T>, file: impl Fn(&T) -> (&Path, &Episode)) -> Vec<T> {
    let begun = all.iter().map(|one| {
        let (path, Episode { info, .. }) = file(one);
        Begun { path, number: info.number, at: info.started_at_utc.as_str() }
    });
    let order = by_age(&begun.collect::<Vec<_>>());
    let mut all: Vec<_> = all.into_iter().map(Some).collect();
    order.into_iter().filter_map(|i| all[i].take()).collect()
}

/// Places in `found`, the oldest first. Within one directory the recorder's numbers say which is older: they only grow, and a wall clock may go back. So an
/// episode counts as begun no sooner than those of its directory with a smaller number. Of a copy, whose name has another number than the recorder gave,
/// and where there is no number, the time alone counts.
pub fn by_age<T: Ord + Copy>(found: &[Begun<'_, T>]) -> Vec<usize> {
    let directory = |f: &Begun<T>| f.path.parent().map(|d| d.canonicalize().unwrap_or(d.to_path_buf()));
    let own_number = |f: &Begun<T>| number_of(f.path).filter(|number| f.number == Some(*number));
    let mut order: Vec<_> = (0..found.len()).map(|i| (directory(&found[i]), own_number(&found[i]), i)).collect();
    order.sort_by(|a, b| (&a.0, a.1).cmp(&(&b.0, b.1)));
    let mut began: Vec<T> = found.iter().map(|f| f.at).collect();
    let mut before: Option<(&Option<PathBuf>, T)> = None;
    for (directory, number, i) in &order {
        if number.is_some() {
            let latest = before.filter(|(d, _)| *d == directory).map_or(began[*i], |(_, at)| at);
            began[*i] = began[*i].max(latest);
            before = Some((directory, began[*i]));
        }
    }
    let mut oldest_first: Vec<usize> = (0..found.len()).collect();
    oldest_first.sort_by(|i, j| began[*i].cmp(&began[*j]).then_with(|| by_number(found[*i].path, found[*j].path)));
    oldest_first
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects who asks for the newest episodes: the recorder's numbers decide although a clock went wrong, and a copy counts by its time.
    #[test]
    fn numbers_tell_the_age_and_times_that_of_copies() {
        fn order(files: &[(&'static str, Option<u64>, u64)]) -> Vec<&'static str> {
            let begun: Vec<_> = files.iter().map(|(path, number, at)| Begun { path: Path::new(path), number: *number, at: *at }).collect();
            by_age(&begun).into_iter().map(|i| files[i].0).collect()
        }
        let of = |name, number, at| (name, Some(number), at);
        // The clock stood in the future at the second one, and was put right.
        let (one, two, three) = (of("a/episode-0001.mcap", 1, 10), of("a/episode-0002.mcap", 2, 9000), of("a/episode-0003.mcap", 3, 30));
        assert_eq!(order(&[three, one, two]), [one.0, two.0, three.0]);
        let copy = of("a/episode-0009.mcap", 1, 10);
        assert_eq!(order(&[copy, three, two, one]), [one.0, copy.0, two.0, three.0]);
        let elsewhere = of("b/episode-0001.mcap", 1, 20);
        assert_eq!(order(&[two, elsewhere, one]), [one.0, elsewhere.0, two.0]);
        assert_eq!(order(&[("a/x.mcap", None, 40), one]), [one.0, "a/x.mcap"]);
    }
}
