//! Peers of the conformance runner in the same process, under virtual time, and spoiled ones.

mod gate;
mod peers;
mod spoiled;
mod virtual_bench;

pub use gate::{Gate, Leak};
pub use peers::{KEY, RobotPeer, ServerPeer};
pub use spoiled::{Context, Hooks, Reaction, Spoiled, edit, without};
pub use virtual_bench::{Peer, VirtualBench};
