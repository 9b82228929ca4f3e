//! The link: sessions, reliable delivery, and the server's time on the robot.
//!
//! It has no clock, port or thread. The rule for this module and everything built on it: **after
//! every input, drain the outputs until none is left, and call again at `poll_timeout` at the
//! latest.**

mod acknowledgement;
mod clock;
mod endpoint;
mod fault;
mod handshake;
mod round_trip;
mod timing;

pub use clock::ClockSync;
pub use endpoint::{Counters, Endpoint, Fill, Received, Transmit};
pub use fault::FrameFault;
pub use handshake::{Answer, Knocking, Terms, answer, is_same_boot};
