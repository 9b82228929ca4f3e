//! The figures of a run: `report.json`, and the same as a table for people.

use std::fmt;

use serde::{Serialize, Serializer};

use super::comparison::Comparison;

/// The figures of one run.
///
/// As JSON, `schema` and `version` tell a reader what to expect: within a version names keep their
/// meaning, and new ones may be added. The same inputs and the same seed give the same report but
/// for `elapsed_s`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    /// Always "ubimap-report".
    pub schema: &'static str,
    /// The version of the schema.
    pub version: u32,
    /// What the random numbers of the run were drawn from.
    pub seed: u64,
    /// Each robot, in the order of their ids.
    pub robots: Vec<RobotSummary>,
    /// The fused map at the end.
    pub map: MapSummary,
    /// What telling the server of the same would have cost in other formats, beside the sum of the
    /// robots' `bytes_up_map`.
    pub comparison: Comparison,
    /// How long the run took, in seconds of the wall clock.
    pub elapsed_s: f64,
    /// How long it lasted in the robots' world, in seconds.
    pub simulated_s: f64,
    /// How the map compares with the true room; of a simulation only.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub truth: Option<TruthScores>,
    /// How far the robots were wrong about where they are; of a simulation only.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pose: Option<PoseErrors>,
    /// How the blind ground was mapped, and what robots that drove themselves ran into; of a
    /// simulation only.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub driving: Option<DrivingSummary>,
    /// What the cameras said of robots that drove, against the truth; in a simulated room only.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sighted: Option<PoseErrors>,
}

/// The figures of one robot.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct RobotSummary {
    /// Its number.
    pub id: u16,
    /// Scans that it was given.
    pub scans: u64,
    /// Scans that it drew into its map.
    pub mapped: u64,
    /// What became of the readings of its scans.
    pub pixels: Pixels,
    /// Everything that it sent, in bytes on the wire.
    pub bytes_up: u64,
    /// Of those, tile updates, with their framing and retransmissions.
    pub bytes_up_map: u64,
    /// Everything that was sent to it, in bytes on the wire.
    pub bytes_down: u64,
    /// `bytes_up_map` for each mapped scan; 0 if none was mapped.
    pub bytes_per_mapped: f64,
    /// Frames sent again, both ways.
    pub retransmissions: u64,
    /// Frames that did not arrive whole, both ways.
    pub frames_lost: u64,
    /// The tiles that its pool holds.
    pub tiles: u64,
    /// Tiles that had to leave its pool to make room.
    pub tiles_evicted: u64,
    /// Cells that it could not draw because no tile could leave.
    pub cells_refused: u64,
    /// Events that it told of.
    pub events: u64,
    /// Peers and obstacles that it was not told of for want of room in its frames.
    pub news_left_out: u64,
    /// Of the tiles that it published, as the server holds them.
    pub digest: HexDigest,
}

/// Readings of a sensor: pixels of a depth row, or beams.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Pixels {
    /// All of them.
    pub seen: u64,
    /// Drawn into the map.
    pub kept: u64,
    /// Left out because the map already said so.
    pub omitted: u64,
    /// Without a usable reading.
    pub invalid: u64,
}

/// The figures of the fused map.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct MapSummary {
    /// The side of a cell in metres.
    pub resolution_m: f64,
    /// Cells that are free or occupied.
    pub known: u64,
    /// Cells that are free.
    pub free: u64,
    /// Cells that are occupied, fixed or movable.
    pub occupied: u64,
    /// Map traffic up of all robots, in bits for each known cell; 0 if none is known.
    pub bits_per_known: f64,
    /// Of the fused tiles.
    pub digest: HexDigest,
    /// Whether the server holds the newest version of every tile that a robot published, and every
    /// fused tile that a robot holds is the server's newest, hash for hash.
    pub converged: bool,
}

/// The map against the true room.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct TruthScores {
    /// F1 of occupied cells, without movable ones, within one cell of the true surfaces, 0 to 1, on ground that a camera
    /// can see or a robot has passed within three metres and in its sensor's line of sight.
    pub f1_occupied: f64,
    /// The share of the ground that no camera can see and a robot has passed so which is known, 0
    /// to 1; 1 if there is none.
    pub passed_known: f64,
    /// The share of cells known in both that agree, 0 to 1.
    pub agreement_known: f64,
    /// The share of the cells that can be known which are, 0 to 1.
    pub coverage: f64,
}

/// Poses against the true ones.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct PoseErrors {
    /// How many poses.
    pub count: u64,
    /// Root mean square distance in metres.
    pub rmse_m: f64,
    /// Root mean square turn in degrees.
    pub rmse_deg: f64,
}

/// What came of driving: of robots that drove themselves, or along the routes of a scenario, which
/// run into nothing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct DrivingSummary {
    /// How often one ran into a wall, furniture or another robot.
    pub collisions: u64,
    /// How often one ran into a person.
    pub touches: u64,
    /// The ground that no camera sees and a robot can stand on, in square metres.
    pub blind_m2: f64,
    /// The share of it that is mapped, 0 to 1.
    pub blind_mapped: f64,
    /// After how many seconds 99 % of it were mapped, if they were.
    pub mapped_s: Option<f64>,
}

/// A digest as it stands in a report: 16 hexadecimal digits.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct HexDigest(pub u64);

impl fmt::Display for HexDigest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:016x}", self.0)
    }
}

impl Serialize for HexDigest {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl Report {
    /// What [`Report::schema`] says.
    pub const SCHEMA: &'static str = "ubimap-report";
    /// The version that is written.
    pub const VERSION: u32 = 1;

    /// A report of robots and a map; the ratios in them are worked out here. Times are zero, and
    /// there are no scores yet.
    pub fn new(
        seed: u64,
        mut robots: Vec<RobotSummary>,
        mut map: MapSummary,
        comparison: Comparison,
    ) -> Self {
        for robot in &mut robots {
            robot.bytes_per_mapped = ratio(robot.bytes_up_map as f64, robot.mapped);
        }
        let bytes_up_map: u64 = robots.iter().map(|robot| robot.bytes_up_map).sum();
        map.bits_per_known = ratio(8.0 * bytes_up_map as f64, map.known);
        Self {
            schema: Self::SCHEMA,
            version: Self::VERSION,
            seed,
            robots,
            map,
            comparison,
            elapsed_s: 0.0,
            simulated_s: 0.0,
            truth: None,
            pose: None,
            driving: None,
            sighted: None,
        }
    }
}

/// 0 of nothing.
fn ratio(part: f64, whole: u64) -> f64 {
    if whole > 0 { part / whole as f64 } else { 0.0 }
}

/// A table of the robots, and a line for each of the other figures.
impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.write_robots(f)?;
        self.write_map(f)?;
        self.write_scores(f)?;
        let verdict = if self.map.converged { "all hold the same map" } else { "NOT converged" };
        writeln!(
            f,
            "{verdict}, digest {}; {:.1} s simulated in {:.1} s",
            self.map.digest, self.simulated_s, self.elapsed_s
        )
    }
}

impl Report {
    fn write_robots(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "robot   scans  mapped  up (map) bytes   down bytes  bytes/mapped  resent  lost  evicted  refused"
        )?;
        for robot in &self.robots {
            let up = format!("{} ({})", robot.bytes_up, robot.bytes_up_map);
            writeln!(
                f,
                "{:>5} {:>7} {:>7} {up:>15} {:>12} {:>13.1} {:>7} {:>5} {:>8} {:>8}",
                robot.id,
                robot.scans,
                robot.mapped,
                robot.bytes_down,
                robot.bytes_per_mapped,
                robot.retransmissions,
                robot.frames_lost,
                robot.tiles_evicted,
                robot.cells_refused,
            )?;
        }
        Ok(())
    }

    fn write_map(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let map = &self.map;
        writeln!(
            f,
            "map: {} cells of {} m known ({} free, {} occupied), {:.2} bits each",
            map.known, map.resolution_m, map.free, map.occupied, map.bits_per_known
        )?;
        let mapped: u64 = self.robots.iter().map(|robot| robot.mapped).sum();
        let bytes_up_map: u64 = self.robots.iter().map(|robot| robot.bytes_up_map).sum();
        let each = |bytes: u64| ratio(bytes as f64, mapped);
        writeln!(
            f,
            "map traffic up: {:.1} bytes a mapped scan; {:.1} as zlib tiles, {:.1} as MAVLink \
             OBSTACLE_DISTANCE, {:.1} as ROS OccupancyGridUpdate",
            each(bytes_up_map),
            each(self.comparison.zlib_tiles_bytes),
            each(self.comparison.obstacle_distance_bytes),
            each(self.comparison.occupancy_grid_update_bytes),
        )
    }

    /// The figures that only some runs have.
    fn write_scores(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(truth) = self.truth {
            writeln!(
                f,
                "truth: F1 of occupied cells {:.3}, {:.1} % of known cells agree; {:.1} % of all cells and \
                 {:.1} % of the blind ones that robots passed are known",
                truth.f1_occupied,
                100.0 * truth.agreement_known,
                100.0 * truth.coverage,
                100.0 * truth.passed_known
            )?;
        }
        if let Some(pose) = self.pose {
            writeln!(f, "poses: {:.3} m and {:.2} degrees off (RMS)", pose.rmse_m, pose.rmse_deg)?;
        }
        if let Some(driving) = self.driving {
            let mapped = driving.mapped_s.map_or("never".into(), |it| format!("after {it:.0} s"));
            writeln!(
                f,
                "driving: {} collisions, {} touches; of {:.1} m2 of blind ground that can be reached \
                 {:.1} % mapped, 99 % {mapped}",
                driving.collisions,
                driving.touches,
                driving.blind_m2,
                100.0 * driving.blind_mapped
            )?;
        }
        if let Some(sighted) = self.sighted {
            writeln!(
                f,
                "cameras: {} poses of driving robots, {:.4} m and {:.2} degrees off (RMS)",
                sighted.count, sighted.rmse_m, sighted.rmse_deg
            )?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::json_pretty;

    fn report() -> Report {
        let robot = RobotSummary {
            id: 3,
            scans: 10,
            mapped: 4,
            bytes_up_map: 300,
            digest: HexDigest(0xAB),
            ..RobotSummary::default()
        };
        let map = MapSummary { known: 1_000, ..MapSummary::default() };
        let comparison = Comparison { zlib_tiles_bytes: 900, ..Comparison::default() };
        Report::new(7, vec![robot, RobotSummary::default()], map, comparison)
    }

    #[test]
    fn the_json_has_the_names_and_only_those() {
        let mut report = report();
        let json: serde_json::Value = serde_json::from_str(&json_pretty(&report)).unwrap();
        let names = |value: &serde_json::Value| {
            let mut names: Vec<_> = value.as_object().unwrap().keys().cloned().collect();
            names.sort();
            names.join(" ")
        };
        assert_eq!(names(&json), "comparison elapsed_s map robots schema seed simulated_s version");
        assert_eq!(
            names(&json["robots"][0]),
            "bytes_down bytes_per_mapped bytes_up bytes_up_map cells_refused digest events \
             frames_lost id mapped news_left_out pixels retransmissions scans tiles tiles_evicted"
        );
        assert_eq!(names(&json["robots"][0]["pixels"]), "invalid kept omitted seen");
        assert_eq!(
            names(&json["map"]),
            "bits_per_known converged digest free known occupied resolution_m"
        );
        assert_eq!(
            names(&json["comparison"]),
            "obstacle_distance_bytes occupancy_grid_update_bytes updates zlib_tiles_bytes"
        );
        assert_eq!(json["schema"], "ubimap-report");
        assert_eq!(json["version"], 1);
        assert_eq!(json["robots"][0]["id"], 3);
        assert_eq!(json["robots"][0]["digest"], "00000000000000ab");

        report.truth = Some(TruthScores::default());
        report.pose = Some(PoseErrors::default());
        let json: serde_json::Value = serde_json::from_str(&json_pretty(&report)).unwrap();
        assert_eq!(names(&json["truth"]), "agreement_known coverage f1_occupied passed_known");
        assert_eq!(names(&json["pose"]), "count rmse_deg rmse_m");
    }

    #[test]
    fn ratios_of_nothing_are_zero() {
        let report = report();
        assert_eq!(report.robots[0].bytes_per_mapped, 75.0);
        assert_eq!(report.robots[1].bytes_per_mapped, 0.0);
        assert_eq!(report.map.bits_per_known, 2.4);
        let text = report.to_string();
        assert!(text.contains("75.0 bytes a mapped scan; 225.0 as zlib tiles"), "{text}");
        assert!(text.contains("NOT converged"));
    }
}
