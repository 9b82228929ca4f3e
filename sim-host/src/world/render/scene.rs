//! The scene to be rendered.

use std::sync::Arc;

use super::paint::Paint;
use crate::world::{room::Room, shapes::Prism};

/// A painted prism.
#[derive(Clone, Debug)]
pub(in super::super) struct Part {
    pub(in super::super) prism: Prism,
    pub(in super::super) paint: Paint,
}

/// Everything that cameras can see at one time: the room and its moving parts.
pub(in super::super) struct Scene {
    pub(in super::super) room: Arc<Room>,
    pub(in super::super) moving: Vec<Part>,
}
