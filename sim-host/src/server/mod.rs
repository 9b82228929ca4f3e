//! The camera server: a session for each robot.

#[expect(clippy::module_inception, reason = "the server itself, beside its sessions")]
mod server;
mod session;

pub use server::{NoSuchPort, Server};
