//! The possible places and orientations of cameras: the paper's `C`.

use super::{
    camera::{CameraModel, Candidate, Footprint, Projection},
    floor_plan::FloorPlan,
};

/// Number of candidates above which the default grid of places is made coarser.
const MANY: usize = 60_000;
/// Maximum number of candidates.
const MAX_CANDIDATES: usize = 400_000;
/// Maximum default spacing of places, in metres.
const COARSEST_M: f64 = 2.0;

/// Parameters of the candidates.
#[derive(Clone, Debug, PartialEq)]
pub struct Choices {
    /// Heights above the floor, in metres.
    pub heights_m: Vec<f64>,
    /// Tilts in degrees: 0 level, 90 straight down. The paper's projection is defined for 90 only.
    pub tilts_deg: Vec<f64>,
    /// Number of headings around the circle, the first along x. If half a turn does not change the
    /// footprint, only half of them are used.
    pub headings: usize,
    /// Distance between adjacent places, in metres. By default the side of a cell, doubled (up to 2
    /// m) until there are at most 60,000 candidates.
    pub spacing_m: Option<f64>,
}

/// Why there are no candidates. The messages do not name the room.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CandidatesError {
    /// The camera would be above the ceiling.
    #[error("a camera at a height of {height_m} m would be above the ceiling ({ceiling_m} m)")]
    AboveCeiling {
        /// Height of the cameras, in metres.
        height_m: f64,
        /// Height of the ceiling, in metres.
        ceiling_m: f64,
    },
    /// Obstacles block every place at this height.
    #[error("there is no place for a camera at a height of {height_m} m")]
    NoPlace {
        /// Height of the cameras, in metres.
        height_m: f64,
    },
    /// The camera's range is smaller than its height.
    #[error(
        "a camera with a range of {range_m} m can't see the floor from a height of {height_m} m"
    )]
    OutOfRange {
        /// Range of the cameras, in metres.
        range_m: f64,
        /// Height of the cameras, in metres.
        height_m: f64,
    },
    /// The camera is too level: no ray meets the floor within the range.
    #[error(
        "a camera tilted by {tilt_deg} degrees can't see the floor from a height of {height_m} m: \
         its lower edge looks {lower_deg:.1} degrees down, and its range is {range_m} m"
    )]
    TooLevel {
        /// Tilt of the cameras, in degrees.
        tilt_deg: f64,
        /// Height of the cameras, in metres.
        height_m: f64,
        /// How far down the lower edge of the image looks, in degrees.
        lower_deg: f64,
        /// Range of the cameras, in metres.
        range_m: f64,
    },
    /// The paper's projection is defined only for cameras that look straight down.
    #[error(
        "the paper's projection is of cameras that look straight down, not by {tilt_deg} degrees"
    )]
    NotDown {
        /// Tilt asked for, in degrees.
        tilt_deg: f64,
    },
    /// There are more candidates than the solver can handle.
    #[error("{count} candidates are too many (at most {MAX_CANDIDATES}); give a larger spacing")]
    TooMany {
        /// Number of candidates.
        count: usize,
    },
}

/// The candidates for a room, grouped by place, and the distance between adjacent places in metres.
///
/// # Errors
/// Every [`CandidatesError`].
pub fn candidates(
    plan: &FloorPlan,
    projection: Projection,
    model: &CameraModel,
    choices: &Choices,
) -> Result<(Vec<Candidate>, f64), CandidatesError> {
    for &height_m in &choices.heights_m {
        let ceiling_m = plan.ceiling_m();
        if height_m > ceiling_m {
            return Err(CandidatesError::AboveCeiling { height_m, ceiling_m });
        }
        for &tilt_deg in &choices.tilts_deg {
            check_view(projection, model, height_m, tilt_deg)?;
        }
    }
    let poses = poses(projection, choices);
    let mut spacing_m = choices.spacing_m.unwrap_or(plan.side_m());
    loop {
        let mounts: Vec<Vec<[f64; 2]>> =
            choices.heights_m.iter().map(|&height| plan.mounts(spacing_m, height)).collect();
        let count = mounts.iter().map(Vec::len).sum::<usize>() * poses.len();
        if choices.spacing_m.is_none() && count > MANY && 2.0 * spacing_m <= COARSEST_M {
            spacing_m *= 2.0;
            continue;
        }
        if count > MAX_CANDIDATES {
            return Err(CandidatesError::TooMany { count });
        }
        let mut candidates = Vec::with_capacity(count);
        for (mounts, &height_m) in mounts.iter().zip(&choices.heights_m) {
            if mounts.is_empty() {
                return Err(CandidatesError::NoPlace { height_m });
            }
            for &[x, y] in mounts {
                candidates.extend(poses.iter().map(|&(heading_deg, tilt_deg)| Candidate {
                    position_m: [x, y, height_m],
                    heading_deg,
                    tilt_deg,
                }));
            }
        }
        return Ok((candidates, spacing_m));
    }
}

/// All combinations of headings and tilts.
fn poses(projection: Projection, choices: &Choices) -> Vec<(f64, f64)> {
    let mut poses: Vec<(f64, f64)> = Vec::new();
    for &tilt in &choices.tilts_deg {
        let is_symmetric = projection == Projection::Paper || tilt == 90.0;
        for number in 0..choices.headings {
            let heading = 360.0 * number as f64 / choices.headings as f64;
            let heading = if is_symmetric { heading % 180.0 } else { heading };
            let is_known = poses
                .iter()
                .any(|&(other, other_tilt)| (other - heading).abs() < 1e-9 && other_tilt == tilt);
            if !is_known {
                poses.push((heading, tilt));
            }
        }
    }
    poses
}

/// Checks that a camera at this height and tilt sees an unlimited empty floor at all.
fn check_view(
    projection: Projection,
    model: &CameraModel,
    height_m: f64,
    tilt_deg: f64,
) -> Result<(), CandidatesError> {
    let range_m = model.range_m;
    if projection == Projection::Paper {
        return if tilt_deg == 90.0 { Ok(()) } else { Err(CandidatesError::NotDown { tilt_deg }) };
    }
    if range_m <= height_m {
        return Err(CandidatesError::OutOfRange { range_m, height_m });
    }
    let candidate = Candidate { position_m: [0.0, 0.0, height_m], heading_deg: 0.0, tilt_deg };
    let footprint = Footprint::new(projection, model, &candidate);
    // Seen from above, the footprint is convex and symmetric about the x axis: a camera that sees
    // no point of the axis sees nothing at all.
    let reach = footprint.reach_m();
    let steps = 10_000;
    let sees = (-steps..=steps)
        .any(|step| footprint.contains([reach * f64::from(step) / f64::from(steps), 0.0]));
    let lower_deg = tilt_deg + model.vertical_fov_deg / 2.0;
    if sees {
        Ok(())
    } else {
        Err(CandidatesError::TooLevel { tilt_deg, height_m, lower_deg, range_m })
    }
}
