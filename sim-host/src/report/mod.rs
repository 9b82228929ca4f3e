//! Reports and pictures of a run.
//!
//! [`Report`] is `report.json` of a run, [`ServeReport`] that of a server, and
//! [`WatchReport`] that of recorded cameras. [`render`] draws `map.png`, and [`OutputFolder`]
//! writes either all files or none.

mod baselines;
mod brief;
mod calibrating;
mod cameras;
mod comparison;
mod graph;
mod link;
mod network;
mod output;
mod output_file;
mod people;
mod picture;
mod placing;
mod points;
mod served_robot;
mod serving;
mod summary;
mod unexplored_ground;
mod vision;
mod watching;

use serde::Serialize;

pub use baselines::{BaselineErrors, BaselineSummary, ChangeSummary};
pub use brief::{Brief, brief};
pub use calibrating::{
    CalibrateReport, CameraResult, EdgeResult, FailedPair, FloorResult, UnseenCamera,
};
pub use cameras::CameraMove;
pub use comparison::{Comparison, Published};
pub use graph::GraphSummary;
pub use link::LinkSummary;
pub use network::{Network, NetworkCamera, NetworkPart, PartKind};
pub use output::{OutputError, OutputFolder};
pub use output_file::OutputFile;
pub use people::{RisingSummary, TrackedPerson, posture_name};
pub use picture::{
    Against, Caption, Marker, MarkerKind, Moment, png, render, render_coverage, render_error,
    render_frames, render_overlap, render_volatility,
};
pub use placing::{FloorSummary, PlaceReport, PlacedCamera, PlacementSummary};
pub use points::{ExposureSummary, PointsSummary};
pub use served_robot::ServedRobot;
pub use serving::{
    EventSummary, FrameDelays, PortSummary, ServeReport, ServedCamera, StateSummary,
};
pub use summary::{
    CalibrationErrors, DrivingSummary, HexDigest, MapSummary, Pixels, PoseErrors, Report,
    RobotSummary, TruthScores,
};
pub use unexplored_ground::UnexploredGround;
pub use vision::{ScaleRow, VisionBand, VisionSummary};
pub use watching::{
    CameraSummary, PassedEvent, SeenFloor, SeenMap, SeenRobot, SeenThing, WatchReport,
};

/// A report as indented JSON with a trailing line break.
pub fn json_pretty(report: &impl Serialize) -> String {
    // Plain structs with string keys: serialising them can't fail.
    serde_json::to_string_pretty(report).unwrap_or_default() + "\n"
}
