//! What `ubimap rig` prints at its end.

use std::fmt;

use serde::Serialize;

use crate::report::TruthScores;

/// A room that is behind the clock by more than this, in milliseconds, is not the one that the server sees.
const LATE_MS: u64 = 100;

/// The truth about the room.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RigReport {
    /// Always "ubimap-rig".
    pub schema: &'static str,
    /// Version of the schema.
    pub version: u32,
    /// Each robot's number and true pose at the end: x and y in metres, heading in degrees.
    pub robots: Vec<(u16, [f64; 3])>,
    /// Contacts with walls, furniture and other robots.
    pub collisions: u64,
    /// Contacts with people.
    pub touches: u64,
    /// Frames sent by each camera, and those that were dropped because the server did not take them.
    pub frames: Vec<(u64, u64)>,
    /// Maximum time by which the room was behind the wall clock, in milliseconds.
    pub late_ms: u64,
    /// Scores of the server's map.
    pub truth: Option<TruthScores>,
    /// Duration in seconds.
    pub elapsed_s: f64,
}

/// A line for each robot and camera, and the figures of the room.
impl fmt::Display for RigReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { robots, frames, collisions, touches, late_ms, elapsed_s, .. } = self;
        for (robot, [x, y, heading]) in robots {
            writeln!(f, "robot {robot}: really at {x:.3} m, {y:.3} m, {heading:.1} degrees")?;
        }
        for (camera, (sent, dropped)) in frames.iter().enumerate() {
            writeln!(
                f,
                "camera-{camera:02}: {sent} frames sent, {dropped} dropped while no server took them"
            )?;
        }
        writeln!(f, "robots ran {collisions} times into things, and {touches} times into people")?;
        if let Some(truth) = &self.truth {
            writeln!(
                f,
                "the server's map: occupied cells at F1 {:.3}, {:.0} % of the room known, {:.1} % of that right",
                truth.f1_occupied,
                100.0 * truth.coverage,
                100.0 * truth.agreement_known
            )?;
        }
        if *late_ms > LATE_MS {
            writeln!(f, "the room was up to {late_ms} ms late: this computer was too busy")?;
        }
        writeln!(f, "the room ran for {elapsed_s:.1} s")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_end_is_told_in_words() {
        let report = RigReport {
            schema: "ubimap-rig",
            version: 1,
            robots: vec![(1, [1.0, 2.5, -90.0])],
            collisions: 2,
            touches: 0,
            frames: vec![(100, 7)],
            late_ms: 12,
            truth: None,
            elapsed_s: 20.04,
        };
        assert_eq!(
            report.to_string(),
            "robot 1: really at 1.000 m, 2.500 m, -90.0 degrees\ncamera-00: 100 frames sent, 7 dropped while no \
             server took them\nrobots ran 2 times into things, and 0 times into people\nthe room ran for 20.0 s\n"
        );
        let late = RigReport { late_ms: 800, ..report };
        assert!(late.to_string().contains("up to 800 ms late"));
    }
}
