//! The map as it grows: what is kept of a run for a picture of it.

use image::RgbImage;
use ubimap_protocol::time::{Duration, Instant};

use super::{RunError, figures, fleet::Fleet};
use crate::{
    grid::OccupancyGrid,
    report::{self, Marker},
};

/// The frames: each after twice the time of the one before, the last at the end.
pub(super) const FRAMES: u32 = 6;

/// Keeps the map and the robots' ways at some moments of a run.
pub(super) struct TimeLapse {
    duration: Duration,
    frames: Vec<(OccupancyGrid, Vec<Marker>)>,
}

impl TimeLapse {
    /// For a run of this length.
    pub(super) fn new(duration: Duration) -> Self {
        Self { duration, frames: Vec::new() }
    }

    /// Keeps the map if the moment of a frame has come.
    pub(super) fn look(&mut self, fleet: &Fleet<'_>) {
        let taken = self.frames.len() as u32;
        let due = self.duration.micros() >> FRAMES.saturating_sub(taken + 1);
        let now = Instant(0) + fleet.elapsed();
        if taken < FRAMES && now.micros() >= due {
            // A map that can't become a grid is an error at the end.
            self.frames.extend(grid(fleet).ok().map(|grid| (grid, figures::markers(fleet))));
        }
    }

    /// All frames, as large as the map at the end.
    pub(super) fn picture(&self, map: &OccupancyGrid) -> RgbImage {
        report::render_frames(map, &self.frames)
    }
}

/// The fused map as it is now.
pub(super) fn grid(fleet: &Fleet<'_>) -> Result<OccupancyGrid, RunError> {
    let tiles = fleet.server().fused().tiles().map(|(id, _, tile)| (id, tile));
    Ok(OccupancyGrid::from_tiles(tiles, fleet.deployment().resolution())?)
}
