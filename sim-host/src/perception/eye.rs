//! Perception of one camera: from depth images to observations.

use ubimap_protocol::{
    tile::Cell,
    time::Instant,
    units::{Millimetres, Pose},
};

use super::{
    background::Background,
    cells::cells,
    detector::{Detector, label},
    evidence::Evidence,
    footprint::Footprint,
    ray_table::{RayTable, Survey},
    rising::has_risen,
    things::things,
    tracks::Tracks,
};
use crate::{
    camera::{Calibration, DepthImage, Frame, Lens, Observation},
    timing::{CLOCK_TOLERANCE, FRAME_LATE},
};

/// Margin around a robot, for pixels that see its sides and for the error of its pose.
const ROBOT_MARGIN: Millimetres = Millimetres(100);

/// Why a frame is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum FrameError {
    /// The frame comes from another camera.
    #[error("frame of camera {0}, expected one of camera {1}")]
    Camera(usize, usize),
    /// The frame has no depth image.
    #[error("camera {0}: a frame without a depth image")]
    NoDepth(usize),
    /// The depth image's size differs from the calibration.
    #[error("camera {camera}: the depth image has {} x {} pixels, the calibration says {} x {}",
        found.0, found.1, expected.0, expected.1)]
    Size {
        /// The camera.
        camera: usize,
        /// Width and height of the depth image.
        found: (u32, u32),
        /// Width and height in the calibration.
        expected: (u32, u32),
    },
    /// No pixel has a measurement.
    #[error("camera {0}: no pixel of the depth image has a measurement (is the lens covered?)")]
    Blank(usize),
    /// The capture time is in the future.
    #[error("camera {camera}: frame captured {millis} ms in the future; check the camera's clock")]
    Future {
        /// The camera.
        camera: usize,
        /// Time from now to the capture, in milliseconds.
        millis: u64,
    },
    /// The frame is stale.
    #[error(
        "camera {camera}: frame is {millis} ms old; check the camera's clock and the connection"
    )]
    Stale {
        /// The camera.
        camera: usize,
        /// Time from the capture to now, in milliseconds.
        millis: u64,
    },
}

/// One fixed camera with its learnt background of the empty room. Eyes are independent, so each may
/// run in a thread of its own.
#[derive(Debug)]
pub struct Eye {
    camera: usize,
    rays: RayTable,
    background: Background,
    evidence: Evidence,
    /// The last published code of each cell.
    said: Vec<Cell>,
    /// The camera's own tracks; they keep people who have walked out of the background.
    tracks: Tracks,
    /// Capture time of the newest frame.
    newest: Instant,
    detector: Option<(Lens, Box<dyn Detector>)>,
}

impl Eye {
    /// The eye of camera number `camera`; `None` without a depth sensor. Costs as much as
    /// [`RayTable::new`], and 40 bytes per pixel.
    pub fn new(camera: usize, calibration: &Calibration, survey: Survey) -> Option<Self> {
        let rays = RayTable::new(&calibration.depth?, &calibration.depth_noise, survey);
        Some(Self {
            camera,
            background: Background::new(&rays),
            said: vec![Cell::Unknown; rays.cells()],
            rays,
            evidence: Evidence::default(),
            tracks: Tracks::default(),
            newest: Instant::default(),
            detector: None,
        })
    }

    /// Moves the eye to the pose of `calibration`, of the same sensors. If it `relearns`, what it has learnt
    /// of the room was seen from elsewhere, and is forgotten. Costs as much as [`RayTable::new`].
    pub fn stand(&mut self, calibration: &Calibration, relearns: bool) {
        let Some(lens) = &calibration.depth else { return };
        self.rays = RayTable::new(lens, &calibration.depth_noise, self.rays.survey());
        if relearns {
            self.background = Background::new(&self.rays);
        } else {
            self.background.reseat(&self.rays);
        }
        self.evidence = Evidence::default();
        self.said = vec![Cell::Unknown; self.rays.cells()];
    }

    /// Sets a detector that labels objects in the pictures of this camera's sensor `picture`.
    pub fn set_detector(&mut self, picture: Lens, detector: Box<dyn Detector>) {
        self.detector = Some((picture, detector));
    }

    /// Whether the background has been learnt. Until then no objects are reported.
    pub fn has_learnt(&self) -> bool {
        self.background.is_learnt()
    }

    /// The observation of a frame that arrived at `now` (server's clock). `robots` are the
    /// footprints and poses of the robots when the frame was captured: they are not reported as
    /// objects, and the cells under them are left out. Late and out-of-order frames also give
    /// observations; the map layers ignore those that are superseded.
    ///
    /// Costs about 3 ns per pixel until the background is learnt, and a fraction of that afterwards.
    ///
    /// # Errors
    /// Every [`FrameError`]; the frame is then ignored.
    pub fn look(
        &mut self,
        frame: &Frame,
        now: Instant,
        robots: &[(Footprint, Pose)],
    ) -> Result<Observation, FrameError> {
        let depths = self.check(frame, now)?;
        self.evidence.fuse(&self.rays, &self.background, depths);

        let side = self.rays.survey().side;
        let mut under = vec![false; self.rays.cells()];
        // A cell is left out if a robot covers any part of it; its corners are 0.7 sides from its
        // centre.
        self.mark(&mut under, robots, Millimetres(side.0 * 7 / 10));
        let mut taken = vec![false; self.rays.cells()];
        self.mark(&mut taken, robots, ROBOT_MARGIN);
        let rays = &self.rays;
        let figures = self.evidence.figures().filter(|(cell, _)| !taken[*cell]);
        let mut things = things(figures.map(|(cell, figure)| (rays.in_map(cell), figure)));
        if let (Some((lens, detector)), Some(picture)) = (&mut self.detector, &frame.picture) {
            label(&mut things, &detector.detect(picture), lens, side.metres());
        }
        let totals = self.background.totals();
        for thing in things.iter_mut().filter(|thing| has_risen(thing, rays, totals)) {
            thing.label.get_or_insert_with(|| "person".to_owned());
        }
        let mut movable = vec![false; rays.cells()];
        for cell in things.iter().flat_map(|thing| &thing.cells) {
            if let Some(index) = rays.index(*cell) {
                movable[index] = true;
            }
        }
        let cells = cells(rays, totals, &self.evidence, &movable, &under, &mut self.said);

        self.tracks.observe(frame.captured, &things, side);
        if frame.captured >= self.newest {
            self.newest = frame.captured;
            for walker in self.tracks.now().filter(|track| track.has_walked) {
                for cell in walker.cells(side).filter_map(|cell| self.rays.index(cell)) {
                    taken[cell] = true;
                }
            }
            self.background.learn(&self.rays, depths, frame.captured, &taken);
        }
        let (camera, captured) = (self.camera, frame.captured);
        Ok(Observation { camera, captured, cells, things, ..Observation::default() })
    }

    fn mark(&self, marked: &mut [bool], robots: &[(Footprint, Pose)], margin: Millimetres) {
        let side = self.rays.survey().side;
        let cells =
            robots.iter().flat_map(|(footprint, pose)| footprint.cells(*pose, margin, side));
        for cell in cells.filter_map(|cell| self.rays.index(cell)) {
            marked[cell] = true;
        }
    }

    /// The depth image of a frame.
    ///
    /// # Errors
    /// Every [`FrameError`].
    pub(super) fn check<'a>(
        &self,
        frame: &'a Frame,
        now: Instant,
    ) -> Result<&'a DepthImage, FrameError> {
        let camera = self.camera;
        if frame.camera != camera {
            return Err(FrameError::Camera(frame.camera, camera));
        }
        let (early, late) = (frame.captured.since(now), now.since(frame.captured));
        if early > CLOCK_TOLERANCE {
            return Err(FrameError::Future { camera, millis: early.micros() / 1_000 });
        }
        if late > FRAME_LATE {
            return Err(FrameError::Stale { camera, millis: late.micros() / 1_000 });
        }
        let depths = frame.depth.as_ref().ok_or(FrameError::NoDepth(camera))?;
        let (found, expected) = (depths.dimensions(), self.rays.size());
        if found != expected {
            return Err(FrameError::Size { camera, found, expected });
        }
        if depths.iter().all(|depth| *depth == 0) {
            return Err(FrameError::Blank(camera));
        }
        Ok(depths)
    }
}
