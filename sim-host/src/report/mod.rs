//! Reports and pictures of a run.
//!
//! [`Report`] is `report.json`, [`ServeReport`] the same for serial ports and [`WatchReport`] for
//! recorded cameras; [`render`] draws `map.png`, and [`OutputFolder`] writes all files or none.

mod brief;
mod comparison;
mod output;
mod picture;
mod placing;
mod serving;
mod summary;
mod watching;

use serde::Serialize;

pub use brief::{Brief, brief};
pub use comparison::{Comparison, Published};
pub use output::{OutputError, OutputFolder};
pub use picture::{
    Caption, Marker, MarkerKind, Moment, png, render, render_coverage, render_error, render_frames,
    render_overlap,
};
pub use placing::{FloorSummary, PlaceReport, PlacedCamera, PlacementSummary};
pub use serving::{EventSummary, PortSummary, ServeReport, StateSummary};
pub use summary::{
    DrivingSummary, HexDigest, MapSummary, Pixels, PoseErrors, Report, RobotSummary, TruthScores,
};
pub use watching::{CameraSummary, PassedEvent, SeenMap, SeenRobot, SeenThing, WatchReport};

/// A report as indented JSON with a trailing line break.
pub fn json_pretty(report: &impl Serialize) -> String {
    // Plain structs with string keys: serialising them can't fail.
    serde_json::to_string_pretty(report).unwrap_or_default() + "\n"
}
