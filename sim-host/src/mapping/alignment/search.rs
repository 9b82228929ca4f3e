//! Every pose about the predicted one, scored.

use nalgebra::Vector2;
use ubimap_protocol::units::{Angle, Millimetres, Pose};

use super::{
    geometry::{position, quarter, rotated, square},
    surfaces::Surfaces,
};

/// The step of headings that are tried, in binary angle units: 1.4 degrees, a cell and a half at
/// 4 m.
const TURN_STEP: i32 = 256;
/// Another place is as good as the best one with so many hundredths of its score, and another one
/// if it is so many cells or steps of heading away.
pub(super) const RIVAL_SCORE: i32 = 88;
const RIVAL_CELLS: i32 = 4;
const RIVAL_TURNS: i32 = 4;
/// Places that are looked at, the best one included.
const MOST_PLACES: usize = 8;
/// What a candidate's score loses for the square of its distance from the predicted pose in
/// standard deviations: half of what a point on a surface is worth.
const DEVIATION_SCORE: f64 = 128.0;

/// How far from the predicted pose to look.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Search {
    /// Along x and along y, either way.
    pub position: Millimetres,
    /// Either way round.
    pub turn: Angle,
    /// How sure the predicted pose is.
    pub prior: Prior,
}

/// How sure a predicted pose is: standard deviations.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Prior {
    /// It says no more than where to look.
    Nothing,
    /// Of x and of y. It is a measurement, which counts for how sure the match is.
    Measured(Millimetres),
    /// Of x and of y, and of the heading. What says so is known to whom the match is for, and does
    /// not count.
    Carried(Millimetres, Angle),
}

/// A candidate of the search: what it scores, and how far it is from the predicted pose.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Candidate {
    pub(super) score: i32,
    /// What the score loses for the distance from the predicted pose.
    pub(super) away: i32,
    turns: i32,
    cells: (i32, i32),
}

impl Search {
    /// Standard deviations of x and of y in millimetres, and of the heading in binary angle units,
    /// about the predicted pose: the search goes four of them far.
    pub(super) fn deviations(&self) -> (f64, f64) {
        let position = match self.prior {
            Prior::Measured(deviation) => deviation.0.into(),
            _ => f64::from(self.position.0) / 4.0,
        };
        (position.max(1.0), (f64::from(self.turn.0) / 4.0).max(1.0))
    }

    /// Whether a place was looked at in a search about a predicted pose, or is no farther than a
    /// step from those that were: a refinement that ends anywhere else has run away.
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
    /// Its position and heading, in a search about these.
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

/// All poses of the search, scored.
pub(super) fn candidates(
    surfaces: &Surfaces,
    points: &[Vector2<f64>],
    start: Vector2<f64>,
    heading: Angle,
    search: Search,
) -> Vec<Candidate> {
    let turns = (i32::from(search.turn.0) / TURN_STEP).clamp(0, 32);
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
            // A cell away 230, two cells 92, four cells 9.
            let score = squares.map(|square| 2_304 / (9 + square * square)).sum();
            let off =
                f64::from(dx * dx + dy * dy) / (far * far) + f64::from(turn * turn) / (wide * wide);
            let away = (DEVIATION_SCORE * off) as i32;
            all.push(Candidate { score, away, turns: turn, cells: (dx, dy) });
        }
    }
    all
}

/// The best candidates of other places, one for each.
pub(super) fn rivals(candidates: &[Candidate], best: &Candidate) -> Vec<Candidate> {
    let good = candidates.iter().filter(|it| it.score * 100 >= best.score * RIVAL_SCORE);
    let mut good: Vec<Candidate> = good.copied().collect();
    good.sort_by_key(|it| core::cmp::Reverse(it.score));
    let mut places = vec![*best];
    for candidate in good {
        let same = |place: &Candidate| {
            let (dx, dy) = (candidate.cells.0 - place.cells.0, candidate.cells.1 - place.cells.1);
            (candidate.turns - place.turns).abs() <= RIVAL_TURNS
                && dx.abs().max(dy.abs()) <= RIVAL_CELLS
        };
        if places.len() < MOST_PLACES && !places.iter().any(same) {
            places.push(candidate);
        }
    }
    places.split_off(1)
}
