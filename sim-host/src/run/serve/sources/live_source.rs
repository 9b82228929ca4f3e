//! The trait of live sources of frames.

use ubimap_protocol::time::Instant;

use crate::{
    camera::{Frame, SenderClock},
    run::serve::clock::Clock,
};

/// A source of frames in real time, read by a thread of its own.
pub(in crate::run::serve) trait LiveSource: Send {
    /// Waits for the next frame. A source that fails says so and waits until it is back. `None` if there
    /// will be no more frames.
    fn next(&mut self, clock: &Clock) -> Option<LiveFrame>;
}

/// A frame of a live source.
#[derive(Debug)]
pub(in crate::run::serve) struct LiveFrame {
    /// The frame; its camera is the index in the deployment.
    pub(in crate::run::serve) frame: Frame,
    /// When it arrived.
    pub(in crate::run::serve) at: Instant,
    /// The clock of its sender, if that is another than the server's.
    pub(in crate::run::serve) sender: Option<SenderClock>,
    /// Whether it waits until perception has taken the frame before, instead of replacing it.
    pub(in crate::run::serve) waits: bool,
}
