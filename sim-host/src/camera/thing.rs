//! An object that was not in the empty room.

/// Number of layers in a height profile, 128 mm each; the last one is open-ended.
pub const LAYERS: usize = 16;

/// An object in one frame of one camera that was not there when the room was learnt.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Thing {
    /// The cells that it covers, by grid coordinates: at least one, all connected.
    pub cells: Vec<(i32, i32)>,
    /// The object's height in millimetres; zero if the source does not know it.
    pub top_mm: u16,
    /// Number of its pixels in each 128 mm layer above the floor.
    pub layers: [u32; LAYERS],
    /// The label that a detector gave it.
    pub label: Option<String>,
}
