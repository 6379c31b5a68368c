//! The whole cell in virtual time, in one thread, from a seed: the controller's own code, the robot's own program, and everything that goes
//! wrong. docs/SWARM.md says what it shows and what it does not.

pub mod bound;
pub mod camera;
pub mod check;
pub mod commanded;
pub mod costs;
pub mod endings;
pub mod evidence;
pub mod eye;
pub mod faults;
pub mod many;
pub mod noticing;
pub mod pipe;
pub mod plan;
pub mod plot;
pub mod records;
pub mod run;
pub mod site;
pub mod standing;
pub mod trained;
pub mod undisturbed;
pub mod unshown;
pub mod vessels;
pub mod waits;
pub mod weight_set;
pub mod what;
pub mod world;
