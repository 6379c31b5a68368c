//! A simulated UR5 controller that real clients accept: dashboard, client interfaces, RTDE, and the very programs they upload.
//!
//! | module | what it is | sockets, clock |
//! |---|---|---|
//! | [`variables`], [`registers`] | RTDE's variables with their types and versions, and the registers among them | no |
//! | [`servo`], [`kinematics`] | how the joints move, and where the flange is | no |
//! | [`robot`], [`watchdog`], [`log`] | what a program can see and touch | no |
//! | [`script`] | URScript, interpreted one cycle at a time | no |
//! | [`ur_rtde`] | the register protocol of the ur_rtde library's own program | no |
//! | [`program`] | the life of a program, from its upload to its end | no |
//! | [`power`], [`machine`] | power, safety, and one step of everything in a control cycle | no |
//! | [`outputs`] | the value of every RTDE output | no |
//! | [`rtde`], [`dashboard`], [`client_interface`] | bytes in, bytes out | no |
//! | [`fault`] | what can be made to go wrong | no |
//! | [`InMemory`] | the clients of a controller without sockets | no |
//! | `server` | the sockets, and the one thread around all of it | yes |
//! | [`published`] | what that thread publishes in this process | no |
//! | [`controller`], [`operator_port`] | starting a controller, watching it, and injecting faults | yes |
//!
//! One controller listens on the fixed ports 29999 and 30001 to 30004 of its address, and on [`OPERATOR_PORT`], which no robot
//! has. Several run at once on 127.0.0.1, 127.0.0.2 and so on.

pub mod client_interface;
pub mod controller;
pub mod dashboard;
pub mod fault;
pub mod kinematics;
pub mod log;
pub mod machine;
pub mod operator_port;
pub mod outputs;
pub mod power;
pub mod program;
pub mod published;
pub mod registers;
pub mod robot;
pub mod rtde;
pub mod script;
mod server;
pub mod servo;
pub mod ur_rtde;
pub mod variables;
pub mod watchdog;

pub use controller::{Controller, ControllerOptions, StartError};
pub use fault::Fault;
pub use log::{LogKind, LogLine};
pub use machine::{Machine, SafetyMode};
pub use operator_port::{OPERATOR_PORT, SendError, send_fault};
pub use power::RobotMode;
pub use program::RuntimeState;
pub use published::{ControllerState, Joints, TraceRow};
pub use server::in_memory::InMemory;
pub use variables::{Series, Version};
