//! The simulated controller without its sockets, taken in by path: a fuzz build needs neither OpenCV nor iceoryx2.

#[path = "../../../simulator/src/ur/client_interface.rs"]
pub mod client_interface;
#[path = "../../../simulator/src/ur/dashboard.rs"]
pub mod dashboard;
#[path = "../../../simulator/src/ur/fault.rs"]
pub mod fault;
#[path = "../../../simulator/src/ur/kinematics.rs"]
pub mod kinematics;
#[path = "../../../simulator/src/ur/machine.rs"]
pub mod machine;
#[path = "../../../simulator/src/ur/rtde.rs"]
pub mod rtde;
#[path = "../../../simulator/src/ur/script/mod.rs"]
pub mod script;
#[path = "../../../simulator/src/ur/servo.rs"]
pub mod servo;
#[path = "../../../simulator/src/ur/ur_rtde.rs"]
pub mod ur_rtde;
#[path = "../../../simulator/src/ur/variables.rs"]
pub mod variables;

pub use fault::Fault;
pub use variables::Series;
