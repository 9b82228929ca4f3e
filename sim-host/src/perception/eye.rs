//! From the depth images of one camera to observations.

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
    things::things,
    tracks::Tracks,
};
use crate::{
    camera::{Calibration, DepthImage, Frame, Lens, Observation},
    timing::{CLOCK_TOLERANCE, FRAME_LATE},
};

/// About a robot, where its sides and the error of its pose may put pixels.
const ROBOT_MARGIN: Millimetres = Millimetres(100);

/// Why a frame says nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum FrameError {
    /// It comes from another camera.
    #[error("a frame of camera {0} where one of camera {1} is expected")]
    Camera(usize, usize),
    /// It has no depth image.
    #[error("camera {0}: a frame without a depth image")]
    NoDepth(usize),
    /// Its depth image is not as large as calibration says.
    #[error("camera {camera}: a depth image of {} x {} pixels where calibration has {} x {}",
        found.0, found.1, expected.0, expected.1)]
    Size {
        /// The camera.
        camera: usize,
        /// Width and height of the image.
        found: (u32, u32),
        /// What they should be.
        expected: (u32, u32),
    },
    /// No pixel has measured anything.
    #[error("camera {0}: a depth image without a depth (is the lens covered?)")]
    Blank(usize),
    /// It says that it was captured later than now.
    #[error("camera {camera}: captured {millis} ms from now; its clock is wrong")]
    Future {
        /// The camera.
        camera: usize,
        /// How much later.
        millis: u64,
    },
    /// It was captured too long ago.
    #[error(
        "camera {camera}: captured {millis} ms ago; its clock is wrong, or the frame was held up"
    )]
    Stale {
        /// The camera.
        camera: usize,
        /// How long ago.
        millis: u64,
    },
}

/// One fixed camera, and what it has learnt of the empty room. Cameras know nothing of each other:
/// each may have a thread of its own.
#[derive(Debug)]
pub struct Eye {
    camera: usize,
    rays: RayTable,
    background: Background,
    evidence: Evidence,
    /// What was said of each cell last.
    said: Vec<Cell>,
    /// What it follows itself, so that nobody who has walked is learnt.
    tracks: Tracks,
    /// When the newest frame was captured.
    newest: Instant,
    detector: Option<(Lens, Box<dyn Detector>)>,
}

impl Eye {
    /// The camera of a number; `None` if it has no depth sensor. Costs as [`RayTable::new`] does, and
    /// 40 bytes for each pixel.
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

    /// Lets a detector label things in the pictures that a sensor of this camera takes.
    pub fn set_detector(&mut self, picture: Lens, detector: Box<dyn Detector>) {
        self.detector = Some((picture, detector));
    }

    /// Whether the empty room is known. Until then nothing stands out of it.
    pub fn has_learnt(&self) -> bool {
        self.background.is_learnt()
    }

    /// What a frame says that has arrived `now`, in the server's clock. `robots` are those that
    /// were localised, where they were when the frame was captured: they are no things, and their
    /// cells are left out. A frame that comes late or out of order is told as any other; the
    /// layers pass over what they know better.
    ///
    /// Costs some 3 ns for each pixel until the room is learnt, then a fraction of that.
    ///
    /// # Errors
    /// Every [`FrameError`]; nothing of the frame is then taken.
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
        // A cell is under a robot if any of it is: its corner is 0.7 sides from its middle.
        self.mark(&mut under, robots, Millimetres(side.0 * 7 / 10));
        let mut taken = vec![false; self.rays.cells()];
        self.mark(&mut taken, robots, ROBOT_MARGIN);
        let rays = &self.rays;
        let figures = self.evidence.figures().filter(|(cell, _)| !taken[*cell]);
        let mut things = things(figures.map(|(cell, figure)| (rays.in_map(cell), figure)));
        if let (Some((lens, detector)), Some(picture)) = (&mut self.detector, &frame.picture) {
            label(&mut things, &detector.detect(picture), lens, side.metres());
        }
        let mut movable = vec![false; rays.cells()];
        for cell in things.iter().flat_map(|thing| &thing.cells) {
            if let Some(index) = rays.index(*cell) {
                movable[index] = true;
            }
        }
        let cells =
            cells(rays, self.background.totals(), &self.evidence, &movable, &under, &mut self.said);

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

    fn check<'a>(&self, frame: &'a Frame, now: Instant) -> Result<&'a DepthImage, FrameError> {
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
