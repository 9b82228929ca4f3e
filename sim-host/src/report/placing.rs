//! The result of `ubimap place`, as it is printed and in `report.json`.

use std::fmt;

use serde::Serialize;

/// The figures of a placement.
///
/// In the JSON, `schema` and `version` identify the format: within a version, names keep their
/// meaning, and new ones may be added.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PlaceReport {
    /// Always "ubimap-place".
    pub schema: &'static str,
    /// The version of the schema.
    pub version: u32,
    /// The room: a file or the name of a scenario.
    pub room: String,
    /// "true" or "paper": which floor a camera sees.
    pub model: &'static str,
    /// The goal of the optimisation, in words.
    pub goal: &'static str,
    /// Minimum number of cameras that must see a cell for it to count as covered: UbiSLAM's `m`.
    pub min_overlap: u16,
    /// Maximum number of cameras that may see a cell: UbiSLAM's `k`.
    pub max_overlap: Option<u16>,
    /// The floor.
    pub floor: FloorSummary,
    /// The placement.
    pub placement: PlacementSummary,
    /// Each camera.
    pub cameras: Vec<PlacedCamera>,
    /// Whether Ctrl-C ended the search.
    pub was_interrupted: bool,
    /// Time in seconds until the integer programme was solved, or its search ended.
    pub solved_s: f64,
    /// Duration of the run in seconds of the wall clock.
    pub elapsed_s: f64,
}

/// The floor to be covered: UbiSLAM's `S`.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct FloorSummary {
    /// The side of a cell in metres.
    pub cell_m: f64,
    /// Number of cells.
    pub cells: u64,
    /// Number of cells that no candidate sees.
    pub blind: u64,
    /// Number of cells that fewer candidates see than the required number of cameras. For such a
    /// cell, all candidates that see it are required.
    pub lowered: u64,
    /// Number of cells left out because they belong to a small piece of floor.
    pub left_out: u64,
}

/// A placement and its quality.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct PlacementSummary {
    /// Number of candidates (possible poses of cameras): UbiSLAM's `C`.
    pub candidates: u64,
    /// Distance between adjacent places for cameras, in metres.
    pub spacing_m: f64,
    /// Number of cameras.
    pub cameras: u64,
    /// Number of cameras added to connect the views.
    pub added: u64,
    /// Number of cells that at least `min_overlap` cameras see.
    pub covered: u64,
    /// The fraction of all cells that are covered.
    pub coverage: f64,
    /// Number of cells that no camera sees, one camera, two, and so on.
    pub by_overlap: Vec<u64>,
    /// The value of the goal: the number of cameras, except those added, or the weight of the
    /// covered cells.
    pub value: u64,
    /// A proved bound: no placement has a better value.
    pub bound: u64,
    /// Maximum gap to the optimum: the difference between value and bound, relative to the greater
    /// of the two.
    pub gap: f64,
    /// Whether the value is proved to be optimal.
    pub is_optimal: bool,
    /// Number of connected components of the graph of cameras with overlapping views. If it is one,
    /// every camera can be calibrated against every other.
    pub pieces: u64,
    /// The minimum possible number of connected components.
    pub fewest_pieces: u64,
}

/// A camera of the placement.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct PlacedCamera {
    /// The camera's name.
    pub name: String,
    /// The optical centre in `map`, in metres.
    pub position_m: [f64; 3],
    /// Direction in which it faces, counter-clockwise from x, in degrees.
    pub heading_deg: f64,
    /// Downward tilt in degrees: 0 is level, 90 straight down.
    pub tilt_deg: f64,
}

impl PlaceReport {
    /// The value of [`PlaceReport::schema`].
    pub const SCHEMA: &'static str = "ubimap-place";
    /// The version written by this program.
    pub const VERSION: u32 = 1;

    /// Whether the cameras are as connected as the room allows.
    pub fn is_connected(&self) -> bool {
        self.placement.pieces <= self.placement.fewest_pieces
    }
}

impl Default for PlaceReport {
    fn default() -> Self {
        Self {
            schema: Self::SCHEMA,
            version: Self::VERSION,
            room: String::new(),
            model: "",
            goal: "",
            min_overlap: 0,
            max_overlap: None,
            floor: FloorSummary::default(),
            placement: PlacementSummary::default(),
            cameras: Vec::new(),
            was_interrupted: false,
            solved_s: 0.0,
            elapsed_s: 0.0,
        }
    }
}

impl fmt::Display for PlaceReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.describe_placement())?;
        let stopped = if self.was_interrupted { ", interrupted" } else { "" };
        writeln!(
            f,
            "{:.2} s, {:.2} s of it for the placement{stopped}",
            self.elapsed_s, self.solved_s
        )?;
        for camera in &self.cameras {
            let [x, y, z] = camera.position_m;
            writeln!(
                f,
                "{}: at {x:.2}, {y:.2}, {z:.2} m, heading {:.0}, tilt {:.0} degrees",
                camera.name, camera.heading_deg, camera.tilt_deg
            )?;
        }
        Ok(())
    }
}

impl PlaceReport {
    /// Coverage, overlap, optimality and candidates in words, one line each; without times and the
    /// list of cameras.
    pub fn describe_placement(&self) -> String {
        let PlacementSummary { cameras, covered, coverage, candidates, spacing_m, .. } =
            &self.placement;
        let FloorSummary { cells, cell_m, blind, lowered, left_out } = &self.floor;
        let shares = self.placement.by_overlap.iter().enumerate();
        let shares: Vec<String> = shares
            .map(|(overlap, &count)| format!("{overlap}: {:.1} %", percent(count, *cells)))
            .collect();
        let mut lines = vec![format!(
            "{room}: {cameras} cameras cover {percent:.1} % of the floor, {covered} of {cells} \
             cells of {cell_m} m",
            room = self.room,
            percent = 100.0 * coverage,
        )];
        lines.extend(self.describe_optimality());
        lines.push(format!("cells by the number of cameras that see them: {}", shares.join(", ")));
        lines.push(self.describe_overlap_graph());
        lines.push(format!(
            "{candidates} candidates, a place every {spacing_m} m ({} model)",
            self.model
        ));
        if *blind > 0 {
            lines.push(format!("{blind} cells are blind: no candidate sees them"));
        }
        if *lowered > 0 {
            lines.push(format!("{lowered} cells are seen by fewer candidates than required"));
        }
        if *left_out > 0 {
            lines.push(format!("{left_out} cells in small pieces of floor are left out"));
        }
        lines.iter().map(|line| format!("{line}\n")).collect()
    }

    fn describe_optimality(&self) -> Vec<String> {
        let PlacementSummary { value, bound, gap, is_optimal, added, .. } = self.placement;
        let mut lines = vec![if is_optimal {
            "proved optimal".to_owned()
        } else {
            let side = if value > bound { "least" } else { "most" };
            format!(
                "{value}; the optimum is at {side} {bound}, at most {:.1} % better",
                100.0 * gap
            )
        }];
        if added > 0 {
            lines.push(format!("{added} of the cameras were added to connect the views"));
        }
        lines
    }

    fn describe_overlap_graph(&self) -> String {
        let PlacementSummary { pieces, fewest_pieces, .. } = self.placement;
        match (pieces, fewest_pieces) {
            (0 | 1, _) => "overlapping views connect all cameras".to_owned(),
            (pieces, fewest) if pieces <= fewest => {
                format!(
                    "overlapping views connect the cameras in {pieces} groups; the floor allows no fewer"
                )
            }
            (pieces, fewest) => format!(
                "overlapping views connect the cameras only in {pieces} groups ({fewest} possible), \
                 which can't be calibrated against each other; --connect adds cameras"
            ),
        }
    }
}

fn percent(part: u64, whole: u64) -> f64 {
    100.0 * part as f64 / whole.max(1) as f64
}
