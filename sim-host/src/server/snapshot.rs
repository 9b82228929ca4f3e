//! The part of the server's state that all robots share, at one time.

use ubimap_protocol::tile::{Epoch, Layer};

use super::surroundings::Surroundings;
use crate::mapping::ServedLayer;

/// The layers and surroundings from which sessions fill their messages.
#[derive(Clone, Copy)]
pub(super) struct Snapshot<'s> {
    /// The epoch of the server's layers.
    pub(super) epoch: Epoch,
    pub(super) fused: &'s ServedLayer,
    pub(super) coverage: &'s ServedLayer,
    pub(super) surroundings: &'s Surroundings,
}

impl<'s> Snapshot<'s> {
    /// One of the server's layers.
    pub(super) fn layer(&self, layer: Layer) -> &'s ServedLayer {
        if layer == Layer::Coverage { self.coverage } else { self.fused }
    }
}
