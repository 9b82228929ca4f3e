//! The choice of a robot's drive, at compile time.

use core::fmt::Debug;

use ubimap_protocol::{
    message::EventCode,
    time::Instant,
    units::{Millimetres, Pose},
};

use super::{follow::DriveCommand, near::Seen};
use crate::{
    map::{Gate, Pool},
    share::{Commands, FusedMap},
};

/// A robot's drive: its configuration as a type. [`Driving`](super::Driving) plans, follows paths
/// and stops, all by the map. [`NoDrive`] takes no flash, RAM or stack. With an `Option` of a drive
/// the choice is made at run time.
pub trait Drive {
    /// The drive's working memory, part of the robot's [`Memory`](crate::Memory).
    type Memory;
    /// The initial state of the memory: all zero bits.
    const EMPTY: Self::Memory;
    /// The drive's state at run time.
    type State<'b>: Drives;

    /// Starts the drive of a robot whose map has cells of side `resolution`.
    fn begin(self, resolution: Millimetres, memory: &mut Self::Memory) -> Self::State<'_>;
}

/// A running drive, called by the robot.
pub trait Drives: Debug {
    /// Whether to map a scan taken at `taken`. `fix` is the time of the newest fix.
    fn wants_scan(&mut self, taken: Instant, fix: Option<Instant>) -> bool;

    /// Processes a new scan, whether it is mapped or not.
    fn see(&mut self, scan: &Seen<'_>);

    /// When the next step is due; `None` if there will be none.
    fn poll_timeout(&self) -> Option<Instant>;

    /// Makes a step. Returns the event to report to the server, if any.
    fn step(&mut self, surroundings: &Surroundings<'_, '_>) -> Option<EventCode>;

    /// The wheels' command until the next step.
    fn command(&self) -> DriveCommand;
}

/// The inputs of a drive's step. Times are by the robot's clock unless stated otherwise.
#[derive(Clone, Copy, Debug)]
pub struct Surroundings<'r, 'b> {
    /// The time of the step.
    pub now: Instant,
    /// The time of the step by the server's clock, once the clocks are synchronised.
    pub server_now: Option<Instant>,
    /// `base_link` in `map`, and the standard deviation of the position in millimetres.
    pub pose: Option<(Pose, f32)>,
    /// The newest odometry: `base_link` in `odom`.
    pub odometry: Option<Pose>,
    /// When the last message from the server arrived; `None` until the first session.
    pub heard: Option<Instant>,
    /// Whether there is a session.
    pub is_connected: bool,
    /// Whether the robot's own hardware or its user has stopped it.
    pub is_halted: bool,
    /// How far the robot must move before it maps again.
    pub gate: Gate,
    /// The server's commands, and its reports on other robots and obstacles.
    pub commands: &'r Commands,
    /// Number of cells not mapped so far because the pool of own tiles was full.
    pub cells_refused: u32,
    /// The robot's own tiles.
    pub own: &'r Pool<'b>,
    /// The server's tiles.
    pub fused: &'r FusedMap<'b>,
}

/// No drive: the wheels always stand.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct NoDrive;

impl Drive for NoDrive {
    type Memory = ();
    const EMPTY: Self::Memory = ();
    type State<'b> = Self;

    fn begin(self, _: Millimetres, (): &mut ()) -> Self {
        self
    }
}

impl Drives for NoDrive {
    fn wants_scan(&mut self, _: Instant, _: Option<Instant>) -> bool {
        true
    }

    fn see(&mut self, _: &Seen<'_>) {}

    fn poll_timeout(&self) -> Option<Instant> {
        None
    }

    fn step(&mut self, _: &Surroundings<'_, '_>) -> Option<EventCode> {
        None
    }

    fn command(&self) -> DriveCommand {
        DriveCommand::STAND
    }
}

impl<D: Drive> Drive for Option<D> {
    type Memory = D::Memory;
    const EMPTY: Self::Memory = D::EMPTY;
    type State<'b> = Option<D::State<'b>>;

    fn begin(self, resolution: Millimetres, memory: &mut Self::Memory) -> Self::State<'_> {
        self.map(|drive| drive.begin(resolution, memory))
    }
}

impl<S: Drives> Drives for Option<S> {
    fn wants_scan(&mut self, taken: Instant, fix: Option<Instant>) -> bool {
        self.as_mut().is_none_or(|drive| drive.wants_scan(taken, fix))
    }

    fn see(&mut self, scan: &Seen<'_>) {
        self.iter_mut().for_each(|drive| drive.see(scan));
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.as_ref()?.poll_timeout()
    }

    fn step(&mut self, surroundings: &Surroundings<'_, '_>) -> Option<EventCode> {
        self.as_mut()?.step(surroundings)
    }

    fn command(&self) -> DriveCommand {
        self.as_ref().map_or(DriveCommand::STAND, Drives::command)
    }
}
