//! Scores all poses around the predicted one.

use nalgebra::Vector2;
use ubimap_protocol::units::{Angle, Millimetres, Pose};

use super::{
    geometry::{position, quarter, rotated, square},
    surfaces::Surfaces,
};

/// Step of the tried headings in binary angle units: 1.4 degrees, which is 1.5 cells at 4 m.
const TURN_STEP: i32 = 256;
/// Number of these steps in a full turn.
const FULL_TURN: i32 = 65_536 / TURN_STEP;
/// Minimum score of a rival, in per cent of the best score.
pub(super) const RIVAL_SCORE: i32 = 88;
/// Candidates at most this many cells apart, along x and y, count as the same place.
const RIVAL_CELLS: i32 = 4;
/// Candidates at most this many heading steps apart count as the same place.
const RIVAL_TURNS: i32 = 4;
/// Maximum number of places that are compared, including the best one.
const MAX_PLACES: usize = 8;
/// Penalty on a candidate's score per squared standard deviation from the predicted pose: half the
/// score of a point on a surface.
const DEVIATION_SCORE: f64 = 128.0;

/// The search range around the predicted pose.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Search {
    /// Maximum offset along x and along y, in both directions.
    pub position: Millimetres,
    /// Maximum turn in both directions.
    pub turn: Angle,
    /// The certainty of the predicted pose.
    pub prior: Prior,
}

/// The certainty of a predicted pose, as standard deviations.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Prior {
    /// Unknown: the pose is only the centre of the search.
    Nothing,
    /// Deviation of x and y. The prediction is an independent measurement that adds to the match's
    /// certainty.
    Measured(Millimetres),
    /// Deviation of x and y, and of the heading, of an independent measurement that adds to the match's
    /// certainty.
    Remembered(Millimetres, Angle),
    /// Deviation of x and y, and of the heading. Whoever uses the match already knows this
    /// information, so it does not add to the match's certainty.
    Carried(Millimetres, Angle),
}

/// A candidate pose of the search.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Candidate {
    pub(super) score: i32,
    /// Penalty for the distance from the predicted pose.
    pub(super) away: i32,
    turns: i32,
    cells: (i32, i32),
}

impl Search {
    /// Standard deviations of the predicted pose by which candidates are penalised: of x and y in
    /// millimetres (those of a measurement, otherwise a quarter of the search range), and of the
    /// heading in binary angle units (always a quarter of the range).
    pub(super) fn deviations(&self) -> (f64, f64) {
        let position = match self.prior {
            Prior::Measured(deviation) | Prior::Remembered(deviation, _) => deviation.0.into(),
            _ => f64::from(self.position.0) / 4.0,
        };
        (position.max(1.0), (f64::from(self.turn.0) / 4.0).max(1.0))
    }

    /// Whether the pose `at`, `heading` is at most one step outside the search range. `step` is the
    /// length of a cell in millimetres. A refinement that ends farther away has diverged.
    pub(super) fn covers(
        &self,
        step: f64,
        predicted: Pose,
        at: Vector2<f64>,
        heading: f64,
    ) -> bool {
        let off = at - position(predicted);
        let turn = Angle::from_radians(heading - predicted.heading.radians());
        let turned = i32::from(turn.0 as i16).abs();
        off.amax() <= f64::from(self.position.0) + step
            && turned <= i32::from(self.turn.0) + TURN_STEP
    }
}

impl Candidate {
    /// Position and heading of the candidate, for a search around `start` and `heading`.
    pub(super) fn pose(
        &self,
        surfaces: &Surfaces,
        start: Vector2<f64>,
        heading: Angle,
    ) -> (Vector2<f64>, f64) {
        let moved = Vector2::new(f64::from(self.cells.0), f64::from(self.cells.1));
        let turned = heading + Angle((self.turns * TURN_STEP) as u16);
        (start + moved * surfaces.resolution(), turned.radians())
    }
}

/// Scores all poses of the search, around the position `start` and `heading`.
pub(super) fn candidates(
    surfaces: &Surfaces,
    points: &[Vector2<f64>],
    start: Vector2<f64>,
    heading: Angle,
    search: Search,
) -> Vec<Candidate> {
    let turns = (i32::from(search.turn.0) / TURN_STEP).clamp(0, FULL_TURN / 2);
    let cells = libm::ceil(f64::from(search.position.0) / surfaces.resolution()) as i32;
    let cells = cells.clamp(0, 20);
    let (far, wide) = search.deviations();
    let (far, wide) = (far / surfaces.resolution(), wide / f64::from(TURN_STEP));
    let mut all = Vec::new();
    for turn in -turns..=turns {
        let turned = (heading + Angle((turn * TURN_STEP) as u16)).radians();
        let arms = points.iter().map(|point| rotated(*point, turned));
        let seen: Vec<(usize, (i32, i32))> =
            arms.map(|arm| (quarter(arm), surfaces.cell(arm + start))).collect();
        for (dx, dy) in square(cells) {
            let squares = seen.iter().filter_map(|&(quarter, (x, y))| {
                surfaces.nearest_square(quarter, (x + dx, y + dy))
            });
            // The score of a point is 256 on a surface, 230 one cell away, 92 at two cells and 8 at
            // four.
            let score = squares.map(|square| 2_304 / (9 + square * square)).sum();
            let off =
                f64::from(dx * dx + dy * dy) / (far * far) + f64::from(turn * turn) / (wide * wide);
            let away = (DEVIATION_SCORE * off) as i32;
            all.push(Candidate { score, away, turns: turn, cells: (dx, dy) });
        }
    }
    all
}

/// The candidates that score nearly as well as `best` at another place: the best one of each place,
/// best first.
pub(super) fn rivals(candidates: &[Candidate], best: &Candidate) -> Vec<Candidate> {
    let good = candidates.iter().filter(|it| it.score * 100 >= best.score * RIVAL_SCORE);
    let mut good: Vec<Candidate> = good.copied().collect();
    good.sort_by_key(|it| core::cmp::Reverse(it.score));
    let mut places = vec![*best];
    for candidate in good {
        let same = |place: &Candidate| {
            let (dx, dy) = (candidate.cells.0 - place.cells.0, candidate.cells.1 - place.cells.1);
            let turned = (candidate.turns - place.turns).rem_euclid(FULL_TURN);
            turned.min(FULL_TURN - turned) <= RIVAL_TURNS && dx.abs().max(dy.abs()) <= RIVAL_CELLS
        };
        if places.len() < MAX_PLACES && !places.iter().any(same) {
            places.push(candidate);
        }
    }
    places.split_off(1)
}
