//! Which faults a pour or recording has had: those that began in it or shortly before, and those that still stand from long before.
//!
//! Pure; allocates; cannot fail.

/// How long before a run a fault that is over still counts as one of its own, s: its last drops and its way upright are over by then.
const LATELY_S: f64 = 6.0;

/// A fault.
#[derive(Debug, Clone, Copy)]
struct Stood {
    name: &'static str,
    until_s: f64,
    is_of_weights: bool,
}

/// The faults of a cell so far.
#[derive(Debug, Default)]
pub struct Standing(Vec<Stood>);

impl Standing {
    /// A fault begins that somebody sets right at `until_s`.
    pub fn begins(&mut self, name: &'static str, until_s: f64) {
        self.0.push(Stood { name, until_s, is_of_weights: false });
    }

    /// The controller gets weights at `at_s`, which replace those before; `wrong` names what is wrong with them, if anything is.
    pub fn weights(&mut self, wrong: Option<&'static str>, at_s: f64) {
        self.0.iter_mut().filter(|stood| stood.is_of_weights).for_each(|stood| stood.until_s = stood.until_s.min(at_s));
        self.0.extend(wrong.map(|name| Stood { name, until_s: f64::INFINITY, is_of_weights: true }));
    }

    /// The names of the faults that a run which began at `began_s` has had.
    pub fn of_run(&self, began_s: f64) -> impl Iterator<Item = &'static str> {
        self.0.iter().filter(move |stood| stood.until_s >= began_s - LATELY_S).map(|stood| stood.name)
    }
}
