//! The camera server: a session for each robot, and who drives where.

mod aligning;
mod alignments;
mod budget;
mod command;
mod coordinating;
pub mod coordination;
mod events;
mod inbox;
mod inflow;
mod news;
mod port;
mod ports;
mod publishing;
mod scene;
#[expect(clippy::module_inception, reason = "the server itself, beside its sessions")]
mod server;
mod session;
mod shared_map;
mod surroundings;
mod unsaved;

pub use crate::perception::Footprint;
pub use command::Command;
pub use events::{Began, EventLog, PersonEvent, RobotEvent, described};
pub use ports::{CommandError, NoSuchPort};
pub use server::Server;
