//! The results of a run: `report.json`, and a table for humans.

use std::fmt;

use serde::{Serialize, Serializer};

use super::{
    baselines::{BaselineSummary, ChangeSummary},
    cameras::CameraMove,
    comparison::Comparison,
    graph::GraphSummary,
    link::LinkSummary,
    people::{RisingSummary, TrackedPerson},
    points::{ExposureSummary, PointsSummary},
    unexplored_ground::UnexploredGround,
    vision::VisionSummary,
};

/// Results of one run.
///
/// In the JSON, `schema` and `version` identify the format: within a version names keep their
/// meaning, and new ones may be added. The same inputs and seed give the same report except for
/// `elapsed_s`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    /// Always "ubimap-report".
    pub schema: &'static str,
    /// Version of the schema.
    pub version: u32,
    /// Seed of the run's random numbers.
    pub seed: u64,
    /// Each robot, ordered by id.
    pub robots: Vec<RobotSummary>,
    /// The fused map at the end.
    pub map: MapSummary,
    /// Size of the same updates in other formats, for comparison with the sum of the robots'
    /// `bytes_up_map`.
    pub comparison: Comparison,
    /// Duration of the run in seconds of the wall clock.
    pub elapsed_s: f64,
    /// Duration of the run in seconds of simulated or recorded time.
    pub simulated_s: f64,
    /// The map against the true room; only for simulations.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub truth: Option<TruthScores>,
    /// Errors of the robots' poses; only for simulations.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pose: Option<PoseErrors>,
    /// Mapping of blind ground and collisions; only for simulations.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub driving: Option<DrivingSummary>,
    /// Errors of the poses of driving robots as measured by cameras; only for simulated rooms.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sighted: Option<PoseErrors>,
    /// Errors of the cameras' poses; only if the run has calibrated them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub calibration: Option<CalibrationErrors>,
    /// The graph that the map was drawn from; only for logs with odometry alone.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub graph: Option<GraphSummary>,
    /// The exposure of recorded depths; left out without a rule.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub exposure: Option<ExposureSummary>,
    /// The pointset of the robots' scans; only for simulations with range sensors.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub points: Option<PointsSummary>,
    /// How well grey cameras saw; only for simulations with them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub vision: Option<VisionSummary>,
    /// Occupied cells in and around the robots that stand, which should have none; only for simulations
    /// with such robots.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub drawn_on_standing: Option<u64>,
    /// Maximum delay of the simulation behind real time in seconds; only for a robot outside, whose wheels and
    /// sensor were as late.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub late_s: Option<f64>,
    /// What the robots would know without the cameras; only for simulations that ask for it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub baselines: Option<BaselineSummary>,
    /// How soon the map showed changes of the room; left out if there were none.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub changes: Vec<ChangeSummary>,
    /// How soon people who had sat or lain there from the beginning were found when they rose; left out
    /// if nobody did.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub risings: Vec<RisingSummary>,
    /// Each person that robots are told of at the end; only for simulations.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub people: Vec<TrackedPerson>,
    /// The movements of cameras that were noticed, in order of time; left out if there are none.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub camera_moves: Vec<CameraMove>,
    /// What is left to explore, the largest ground first; left out if nothing is, or if nobody leads the robots.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub unexplored: Vec<UnexploredGround>,
}

/// Results of one robot.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct RobotSummary {
    /// The robot's id.
    pub id: u16,
    /// Scans passed to the robot.
    pub scans: u64,
    /// Scans drawn into its map.
    pub mapped: u64,
    /// What became of the readings of its scans.
    pub pixels: Pixels,
    /// Bytes on the wire sent by the robot.
    pub bytes_up: u64,
    /// The part of `bytes_up` that tile updates cause, including framing and retransmissions.
    pub bytes_up_map: u64,
    /// Bytes on the wire sent to the robot.
    pub bytes_down: u64,
    /// `bytes_up_map` per mapped scan; 0 if none was mapped.
    pub bytes_per_mapped: f64,
    /// Frames sent again, in both directions.
    pub retransmissions: u64,
    /// Frames lost or damaged, in both directions.
    pub frames_lost: u64,
    /// Tiles in the robot's pool at the end.
    pub tiles: u64,
    /// Tiles evicted from the pool to free memory.
    pub tiles_evicted: u64,
    /// Cells not drawn because no tile could be evicted.
    pub cells_refused: u64,
    /// Counters of the robot's end of its link.
    pub link: LinkSummary,
    /// Counters of the server's end.
    pub server_link: LinkSummary,
    /// Events that the robot reported.
    pub events: u64,
    /// Peers and obstacles left out of its frames for lack of space.
    pub news_left_out: u64,
    /// Digest of the tiles that it published, as stored on the server.
    pub digest: HexDigest,
}

/// Readings of a sensor: pixels of a depth row, or beams.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Pixels {
    /// All readings.
    pub seen: u64,
    /// Drawn into the map.
    pub kept: u64,
    /// Skipped because the map already had them.
    pub omitted: u64,
    /// Readings without a usable value.
    pub invalid: u64,
}

/// Errors of calibrated cameras against their true poses.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct CalibrationErrors {
    /// Number of pairs of a landmark in two cameras.
    pub landmarks: u64,
    /// Maximum error of a position, in metres.
    pub position_m: f64,
    /// Maximum error of an orientation, in degrees.
    pub angle_deg: f64,
    /// The errors of the position and of the orientation of each camera but the reference, in their stated
    /// standard deviations.
    pub in_sigmas: Vec<[f64; 2]>,
}

/// Results for the fused map.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct MapSummary {
    /// Side length of a cell in metres.
    pub resolution_m: f64,
    /// Cells that are free or occupied. If the map was drawn from a graph, these are its cells; the
    /// digest is always that of the map that robots get.
    pub known: u64,
    /// Cells that are free.
    pub free: u64,
    /// Cells that are occupied, fixed or movable.
    pub occupied: u64,
    /// Map traffic of all robots to the server, in bits per known cell; 0 if none is known.
    pub bits_per_known: f64,
    /// Digest of the fused tiles.
    pub digest: HexDigest,
    /// Whether the server has the newest version of every tile published by a robot, and every
    /// fused tile on a robot equals the server's newest, by hash.
    pub converged: bool,
}

/// The map against the true room.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct TruthScores {
    /// F1 of the fixed occupied cells, from 0 to 1, with a tolerance of one cell. Only ground
    /// counts that a camera can see, or that was within 3 m of a robot and in its sensor's line of
    /// sight.
    pub f1_occupied: f64,
    /// Known fraction of the ground that robots passed and that no camera can see, from 0 to 1; 1
    /// if there is no such ground.
    pub passed_known: f64,
    /// Fraction of the cells known both on the map and in the room that agree, from 0 to 1.
    pub agreement_known: f64,
    /// Known fraction of the cells that can be known, from 0 to 1.
    pub coverage: f64,
}

/// Errors of poses against the true ones.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct PoseErrors {
    /// Number of poses.
    pub count: u64,
    /// Root mean square position error in metres.
    pub rmse_m: f64,
    /// Root mean square heading error in degrees.
    pub rmse_deg: f64,
}

/// Results of driving, for robots that steer themselves and for those that follow the
/// collision-free routes of a scenario.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct DrivingSummary {
    /// Collisions of a robot with a wall, furniture or another robot.
    pub collisions: u64,
    /// Collisions of a robot with a person.
    pub touches: u64,
    /// Ground that no camera sees and a robot can stand on, in square metres.
    pub blind_m2: f64,
    /// Mapped fraction of the blind ground, from 0 to 1.
    pub blind_mapped: f64,
    /// Time in seconds at which 99 % of the blind ground were mapped; `None` if never.
    pub mapped_s: Option<f64>,
    /// The longest time in seconds that a robot stayed within 0.15 m before that, or before the end, be it that it turned or
    /// had nothing left to do.
    pub stood_s: f64,
}

/// A digest, formatted as 16 hexadecimal digits.
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
    /// The value of [`Report::schema`].
    pub const SCHEMA: &'static str = "ubimap-report";
    /// The version written by this program.
    pub const VERSION: u32 = 1;

    /// Creates a report from robots and a map, and computes their ratios. Times are zero and scores
    /// `None`.
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
            calibration: None,
            graph: None,
            exposure: None,
            points: None,
            vision: None,
            drawn_on_standing: None,
            late_s: None,
            baselines: None,
            changes: Vec::new(),
            risings: Vec::new(),
            people: Vec::new(),
            camera_moves: Vec::new(),
            unexplored: Vec::new(),
        }
    }

    /// Whether any robot has mapped a scan.
    pub fn has_mapped(&self) -> bool {
        self.robots.iter().any(|robot| robot.mapped > 0)
    }
}

/// The ratio, or 0 if the denominator is 0.
fn ratio(part: f64, whole: u64) -> f64 {
    if whole > 0 { part / whole as f64 } else { 0.0 }
}

/// A table of the robots, and a line for each of the other figures.
impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.write_robots(f)?;
        self.write_links(f)?;
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

    fn write_links(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for robot in &self.robots {
            writeln!(f, "robot {}'s end: {}", robot.id, robot.link)?;
            writeln!(f, "the server's, to robot {}: {}", robot.id, robot.server_link)?;
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
            "map traffic up: {:.1} bytes per mapped scan; {:.1} as zlib tiles, {:.1} as MAVLink \
             OBSTACLE_DISTANCE, {:.1} as ROS OccupancyGridUpdate",
            each(bytes_up_map),
            each(self.comparison.zlib_tiles_bytes),
            each(self.comparison.obstacle_distance_bytes),
            each(self.comparison.occupancy_grid_update_bytes),
        )
    }

    /// Writes the results that only some runs have.
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
                "driving: {} collisions, {} touches; {:.1} m2 of reachable blind ground, \
                 {:.1} % mapped, 99 % {mapped}; a robot stood for {:.0} s at most",
                driving.collisions,
                driving.touches,
                driving.blind_m2,
                100.0 * driving.blind_mapped,
                driving.stood_s
            )?;
        }
        if let Some(sighted) = self.sighted {
            writeln!(
                f,
                "cameras: {} poses of driving robots, {:.4} m and {:.2} degrees off (RMS)",
                sighted.count, sighted.rmse_m, sighted.rmse_deg
            )?;
        }
        if let Some(calibration) = &self.calibration {
            writeln!(
                f,
                "calibration: {} landmarks, cameras within {:.4} m and {:.3} degrees of the truth",
                calibration.landmarks, calibration.position_m, calibration.angle_deg
            )?;
        }
        if let Some(late) = self.late_s {
            writeln!(f, "real time: the simulation was {late:.2} s behind it at most")?;
        }
        if let Some(cells) = self.drawn_on_standing {
            writeln!(f, "robots that stand: {cells} cells drawn on them")?;
        }
        if let Some(baselines) = &self.baselines {
            write!(f, "{baselines}")?;
        }
        for change in &self.changes {
            write!(f, "{change}")?;
        }
        for rising in &self.risings {
            writeln!(f, "{rising}")?;
        }
        for person in &self.people {
            writeln!(f, "at the end: {person}")?;
        }
        if let Some(graph) = &self.graph {
            write!(f, "{graph}")?;
        }
        if let Some(exposure) = &self.exposure {
            write!(f, "{exposure}")?;
        }
        if let Some(points) = &self.points {
            write!(f, "{points}")?;
        }
        if let Some(vision) = &self.vision {
            write!(f, "{vision}")?;
        }
        for moved in &self.camera_moves {
            writeln!(f, "{moved}")?;
        }
        for ground in &self.unexplored {
            writeln!(f, "{ground}")?;
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
    fn the_json_has_exactly_the_documented_names() {
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
             frames_lost id link mapped news_left_out pixels retransmissions scans server_link \
             tiles tiles_evicted"
        );
        assert_eq!(
            names(&json["robots"][0]["link"]),
            "bad duplicates forged late malformed received refused replayed retransmissions sent \
             unknown"
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
    fn ratios_of_zero_are_zero() {
        let report = report();
        assert_eq!(report.robots[0].bytes_per_mapped, 75.0);
        assert_eq!(report.robots[1].bytes_per_mapped, 0.0);
        assert_eq!(report.map.bits_per_known, 2.4);
        let text = report.to_string();
        assert!(text.contains("75.0 bytes per mapped scan; 225.0 as zlib tiles"), "{text}");
        assert!(text.contains("NOT converged"));
    }
}
