//! What robots would know without the cameras, and how soon the map shows a change.

use std::fmt;

use serde::Serialize;

/// Position errors of the same robots with the cameras and without; only for simulations that ask for it.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct BaselineSummary {
    /// The errors at several times.
    pub errors: Vec<BaselineErrors>,
    /// Distances between points that the onboard scan matching computed, for each matched scan.
    pub distances_per_scan: f64,
    /// Scans that were matched, of all robots.
    pub matched: u64,
}

/// Mean position errors of all robots in a stretch of time, in metres.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct BaselineErrors {
    /// The end of the stretch in seconds.
    pub until_s: f64,
    /// Robots that get fixes from the cameras.
    pub cameras_m: f64,
    /// Odometry alone.
    pub odometry_m: f64,
    /// Odometry and matching of each scan with those before.
    pub matching_m: f64,
}

/// How soon the map shows a change of the room: furniture that was moved, a door. Only for simulations in
/// which there is one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct ChangeSummary {
    /// The time of the change, in seconds.
    pub at_s: f64,
    /// Cells of surfaces at the new place, and those that are gone from the old one.
    pub cells: [u64; 2],
    /// Seconds from the change until half of the new cells were drawn; `None` if never.
    pub drawn_s: Option<f64>,
    /// Seconds from the change until nine of ten cells at the old place had been removed: were free or
    /// unknown; `None` if never.
    pub removed_s: Option<f64>,
    /// Seconds from the change until half of the cells at the old place were free; `None` if never.
    pub freed_s: Option<f64>,
}

impl fmt::Display for BaselineSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "position errors (m)  with cameras  odometry alone  own scan matching")?;
        for row in &self.errors {
            writeln!(
                f,
                "  until {:>6.0} s {:>16.3} {:>15.3} {:>18.3}",
                row.until_s, row.cameras_m, row.odometry_m, row.matching_m
            )?;
        }
        writeln!(
            f,
            "own scan matching: {} scans, {:.0} distances each",
            self.matched, self.distances_per_scan
        )
    }
}

impl fmt::Display for ChangeSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let after =
            |time: Option<f64>| time.map_or("never".into(), |it| format!("after {it:.1} s"));
        writeln!(
            f,
            "change at {:.0} s: half of {} new cells drawn {}, nine of ten of {} old ones removed {}, half \
             of them free {}",
            self.at_s,
            self.cells[0],
            after(self.drawn_s),
            self.cells[1],
            after(self.removed_s),
            after(self.freed_s)
        )
    }
}
