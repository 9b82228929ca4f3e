//! Figures and pictures of a run.
//!
//! [`Report`] is `report.json`, [`ServeReport`] its like for serial ports, [`render`] draws `map.png`, and [`OutputFolder`] writes files all
//! or none.

mod comparison;
mod output;
mod picture;
mod serving;
mod summary;

pub use comparison::{Comparison, Published};
pub use output::{OutputError, OutputFolder};
pub use picture::{Marker, MarkerKind, png, render, render_coverage, render_error, render_frames};
pub use serving::{EventSummary, PortSummary, ServeReport, StateSummary};
pub use summary::{
    DrivingSummary, HexDigest, MapSummary, Pixels, PoseErrors, Report, RobotSummary, TruthScores,
};
