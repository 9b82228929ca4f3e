//! What stands out of the empty room.

/// Layers of a height profile, of 128 mm each; the last one has no end.
pub const LAYERS: usize = 16;

/// Something that was not there when the room was learnt, as one frame of one camera shows it.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Thing {
    /// The cells that it takes up, by grid coordinates: at least one, each touching another.
    pub cells: Vec<(i32, i32)>,
    /// How high it is, in millimetres; zero where the source does not know.
    pub top_mm: u16,
    /// Its pixels in each layer of 128 mm above the floor.
    pub layers: [u32; LAYERS],
    /// What a detector calls it.
    pub label: Option<String>,
}
