//! Who has the say: one page at a time may start something; all of them may stop.
//!
//! Plain state, behind the caller's lock; it allocates and does not fail, a refusal is a line. A page that has not been heard of for a while
//! has left, and the say is free. A pour that is held ends when the page that holds it is not heard of, or lets go.

use std::time::{Duration, Instant};

/// A page that was not heard of for this long has left. Chosen by hand: a page says every second that it is there.
const GONE: Duration = Duration::from_secs(6);
/// A held pour ends when its page was not heard of for this long. Chosen by hand: the page speaks five times a second, and a phone's network
/// may swallow two words.
const LET_GO: Duration = Duration::from_millis(700);
/// Longest name of a person, characters. Chosen by hand; no measurement is recorded.
const NAME_MAX: usize = 40;

/// The page that has the say.
#[derive(Debug, Clone)]
pub struct Holder {
    /// What the page calls itself, at random; only the page and this program know it.
    id: String,
    /// What people see.
    pub name: String,
    seen: Instant,
}

/// The say, and a pour that is held.
#[derive(Debug, Default)]
pub struct Say {
    holder: Option<Holder>,
    /// When the page that holds a pour last said that it does.
    held_at: Option<Instant>,
}

/// A name as it is shown: one short line.
fn tidy(name: &str, from: &str) -> String {
    let name: String = name.chars().filter(|c| !c.is_control()).take(NAME_MAX).collect();
    let name = name.trim();
    if name.is_empty() { format!("a page at {from}") } else { format!("{name} ({from})") }
}

impl Say {
    /// Who has the say, if anybody has.
    pub fn holder(&self) -> Option<&Holder> {
        self.holder.as_ref().filter(|h| h.seen.elapsed() < GONE)
    }

    /// Whether the page `id` has the say.
    pub fn is(&self, id: &str) -> bool {
        self.holder().is_some_and(|h| h.id == id)
    }

    /// Gives the say to a page. Nobody is asked: the page shows who had it. A pour that another page holds is let go of in a moment, because
    /// nobody says any more that it is held.
    pub fn take(&mut self, id: &str, name: &str, from: &str) {
        self.holder = Some(Holder { id: id.into(), name: tidy(name, from), seen: Instant::now() });
    }

    /// Gives the say back.
    pub fn leave(&mut self, id: &str) {
        if self.is(id) {
            self.holder = None;
        }
    }

    /// Lets a page act: it has the say, or nobody has it and it gets it now.
    pub fn act(&mut self, id: &str, name: &str, from: &str) -> Result<(), String> {
        if id.is_empty() {
            return Err("the page does not say who it is: load it again".into());
        }
        match self.holder() {
            Some(holder) if holder.id != id => Err(format!("{} has the say: take it first", holder.name)),
            _ => {
                self.take(id, name, from);
                Ok(())
            }
        }
    }

    /// The page `id` is there, and `holding` a pour or not.
    pub fn here(&mut self, id: &str, holding: bool) {
        if let Some(holder) = self.holder.as_mut().filter(|h| h.id == id) {
            holder.seen = Instant::now();
            if holding && self.held_at.is_some() {
                self.held_at = Some(Instant::now());
            }
        }
    }

    /// From now on a pour is held, or none is.
    pub fn hold(&mut self, held: bool) {
        self.held_at = held.then(Instant::now);
    }

    /// Whether a pour is held.
    pub fn is_held(&self) -> bool {
        self.held_at.is_some()
    }

    /// Whether a pour was held and is no longer.
    pub fn let_go(&self) -> bool {
        self.held_at.is_some_and(|at| at.elapsed() > LET_GO)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects people beside the robot: while one page has the say, another starts nothing; it can take the say, and then the first starts
    /// nothing.
    #[test]
    fn one_page_has_the_say() {
        let mut say = Say::default();
        assert!(say.holder().is_none());
        assert_eq!(say.act("a", "Anna\n", "10.0.0.1"), Ok(()));
        assert_eq!(say.holder().unwrap().name, "Anna (10.0.0.1)");
        assert!(say.act("b", "", "10.0.0.2").unwrap_err().contains("Anna"));
        say.take("b", "", "10.0.0.2");
        assert!(say.is("b") && say.act("a", "Anna", "10.0.0.1").unwrap_err().contains("10.0.0.2"));
        say.leave("a");
        assert!(say.is("b"));
        say.leave("b");
        assert!(say.holder().is_none() && say.act("", "", "x").is_err());
    }

    /// Protects whoever holds a pour: it is let go of when the page is not heard of, and only the page with the say can hold it.
    #[test]
    fn a_held_pour_is_let_go() {
        let mut say = Say::default();
        say.take("a", "", "x");
        say.hold(true);
        std::thread::sleep(LET_GO / 2);
        say.here("a", true);
        assert!(!say.let_go());
        std::thread::sleep(LET_GO + Duration::from_millis(50));
        say.here("b", true);
        assert!(say.let_go(), "another page does not hold it");
        say.hold(true);
        say.take("b", "", "y");
        say.here("a", true);
        say.here("b", false);
        std::thread::sleep(LET_GO + Duration::from_millis(50));
        assert!(say.is_held() && say.let_go(), "who takes the say does not hold what another one held");
    }
}
