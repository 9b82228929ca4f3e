//! Snapshots of the growing map, for a time-lapse picture.

use image::RgbImage;
use ubimap_protocol::time::{Duration, Instant};

use super::{RunError, fleet::Fleet, markers};
use crate::{
    grid::OccupancyGrid,
    report::{self, Caption, Moment},
};

/// Number of snapshots. Each is taken at twice the time of the previous one, the last at the end.
pub(super) const FRAMES: u32 = 6;

/// Collects snapshots of the map and the robots' paths during a run.
pub(super) struct TimeLapse {
    duration: Duration,
    frames: Vec<Moment>,
}

impl TimeLapse {
    /// A time-lapse of a run of this duration.
    pub(super) fn new(duration: Duration) -> Self {
        Self { duration, frames: Vec::new() }
    }

    /// Takes a snapshot if one is due.
    pub(super) fn look(&mut self, fleet: &Fleet<'_>) {
        let taken = self.frames.len() as u32;
        let due = self.duration.micros() >> FRAMES.saturating_sub(taken + 1);
        let now = Instant(0) + fleet.elapsed();
        if taken < FRAMES && now.micros() >= due {
            self.take(fleet);
        }
    }

    /// Takes the last snapshot of a run that has ended before its duration was over.
    pub(super) fn end(&mut self, fleet: &Fleet<'_>) {
        if (self.frames.len() as u32) < FRAMES {
            self.take(fleet);
        }
    }

    fn take(&mut self, fleet: &Fleet<'_>) {
        let time_s = fleet.elapsed().micros() as f64 / 1e6;
        let moment = |grid| Moment { time_s, grid, markers: markers::robots(fleet) };
        // A map that can't become a grid is skipped here; it is an error at the end of the run.
        self.frames.extend(grid(fleet).ok().map(moment));
    }

    /// All snapshots, each of the size of the final map.
    pub(super) fn picture(&self, map: &OccupancyGrid, caption: &Caption) -> RgbImage {
        report::render_frames(map, &self.frames, caption)
    }
}

/// The current fused map as a grid.
pub(super) fn grid(fleet: &Fleet<'_>) -> Result<OccupancyGrid, RunError> {
    let tiles = fleet.server().fused().tiles().map(|(id, _, tile)| (id, tile));
    Ok(OccupancyGrid::from_tiles(tiles, fleet.deployment().resolution())?)
}
