//! What sessions take their messages from.

use ubimap_protocol::tile::{Epoch, Layer};

use super::surroundings::Surroundings;
use crate::mapping::ServedLayer;

/// What the server has for all robots.
#[derive(Clone, Copy)]
pub(super) struct Scene<'s> {
    pub(super) epoch: Epoch,
    pub(super) fused: &'s ServedLayer,
    pub(super) coverage: &'s ServedLayer,
    pub(super) surroundings: &'s Surroundings,
}

impl<'s> Scene<'s> {
    /// One of the server's layers.
    pub(super) fn layer(&self, layer: Layer) -> &'s ServedLayer {
        if layer == Layer::Coverage { self.coverage } else { self.fused }
    }
}
