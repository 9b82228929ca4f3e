//! The camera server: a session for each robot.

mod command;
#[expect(clippy::module_inception, reason = "the server itself, beside its sessions")]
mod server;
mod session;

pub use command::Command;
pub use server::{CommandError, NoSuchPort, Server};
