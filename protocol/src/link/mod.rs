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
mod replay_window;
mod round_trip;
mod sealed_handshake;
mod security;
mod timing;

pub use clock::ClockSync;
pub use endpoint::{Counters, Endpoint, Fill, Received, Transmit, Verdict};
pub use fault::FrameFault;
pub use handshake::{Answer, Knocking, Terms, answer, answer_sealed, is_same_boot};
pub use sealed_handshake::{Opened, SealedHandshake, write_answer, write_hello};
pub use security::is_of_session;
