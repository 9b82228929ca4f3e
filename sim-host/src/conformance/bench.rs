//! What the runner needs of the outside: a clock, and a wire to the implementation under test.

use ubimap_protocol::time::{Duration, Instant};

/// A clock, and a wire to the implementation under test. On a real wire time passes by itself; with a
/// peer in the same process it passes only in [`Bench::receive`].
pub trait Bench {
    /// The time since the bench started.
    fn now(&self) -> Instant;

    /// Sends the bytes of one frame.
    ///
    /// # Errors
    /// [`Gone`].
    fn send(&mut self, wire: &[u8]) -> Result<(), Gone>;

    /// The bytes that arrive next; none if none have come by `until`.
    ///
    /// # Errors
    /// [`Gone`].
    fn receive(&mut self, until: Instant) -> Result<Vec<u8>, Gone>;

    /// How late an answer may be because of the wire and the two operating systems.
    fn slack(&self) -> Duration;
}

/// The implementation under test has gone: its wire hung up or its process ended.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct Gone(pub String);
