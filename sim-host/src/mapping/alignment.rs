//! What a robot saw against the map: the pose from which the points of a distance vector lie best
//! on the surfaces of the map, and how sure that is.
//!
//! First every pose about the predicted one is tried, in steps of a cell and 1.4 degrees, with
//! looked-up integer scores: so a better place is found wherever it is, and a second place that is
//! nearly as good is noticed. Then the best is refined by least squares of the distances between
//! points and lines along the surfaces (Censi's PL-ICP, ICRA 2008). Their normal equations tell
//! what the surfaces say of x, y and heading: in a corridor nothing of the way along it.
//!
//! Where the map says nothing, what the robot has seen from its last places stands for it: so each
//! place is found from those before it, and errors grow with the surfaces that come into view, not
//! with the way of the wheels.

mod points;
mod trail;

use core::f64::consts::FRAC_PI_2;

use libm::{atan2, cos, sin};
use nalgebra::{Matrix3, Vector2, Vector3};
use ubimap_protocol::{
    tile::{Cell, TILE_SIDE, Tile, TileId, cell_of},
    units::{Angle, Millimetres, Pose},
};

pub use {points::points, trail::Trail};

/// A surface farther from a point than so many cells is not what the point shows.
const REACH: i32 = 8;
/// One that was seen on the way reaches so far, and is not told from one that is drawn so near.
const TRAIL_REACH: i32 = 4;
const BESIDE: i32 = 2;
/// A line is fitted to the surfaces within so many cells, if there are so many of them, and none is
/// off it by more than a tenth of its length.
const LINE_REACH: i32 = 4;
const LINE_CELLS: usize = 5;
const LINE_WIDTH: f64 = 0.1;
/// The step of headings that are tried, in binary angle units: 1.4 degrees, a cell and a half at
/// 4 m.
const TURN_STEP: i32 = 256;
/// Another place is as good as the best one with so many hundredths of its score, and another one
/// if it is so many cells or steps of heading away.
const RIVAL_SCORE: i32 = 88;
const RIVAL_CELLS: i32 = 4;
const RIVAL_TURNS: i32 = 4;
/// Places that are looked at, the best one included.
const MOST_PLACES: usize = 8;
/// Two places are not one if they are so far from each other: the square of the distance in
/// standard deviations, as chi-squared with three degrees of freedom has it in one of 10,000 cases.
const ELSEWHERE: f64 = 21.1;
/// What a candidate's score loses for the square of its distance from the predicted pose in
/// standard deviations: half of what a point on a surface is worth.
const DEVIATION_SCORE: f64 = 128.0;
/// Points farther from their surface than this do not count, in millimetres: at first, and once the
/// pose is nearly right.
const FIRST_REACH_MM: f64 = 250.0;
const LAST_REACH_MM: f64 = 100.0;
/// Rounds of refinement; so many of them with the first reach.
const ROUNDS: usize = 14;
const FIRST_ROUNDS: usize = 6;
/// A match stands on so many points at least, and so many hundredths of those in known ground.
const LEAST_POINTS: usize = 14;
const LEAST_SHARE: usize = 60;
/// A match whose heading is less sure than this is none: 2 degrees.
const HEADING_LIMIT: f64 = 0.035;
/// What a surface is at odds with the cells that stand for it, in millimetres and radians: it does
/// not average out over the points.
const CELL_DEVIATION_MM: f64 = 15.0;
const CELL_DEVIATION: f64 = 0.004;
/// A point stands for less than a measurement of its own, for its neighbours hit the same cells.
const CORRELATION: f64 = 2.0;

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

/// What holds a match to the predicted pose.
#[derive(Clone, Copy, Debug)]
struct Hold {
    at: Vector2<f64>,
    heading: f64,
    /// Of x, y and heading, for deviations of a millimetre.
    information: Vector3<f64>,
    /// Whether it is part of the result's certainty.
    counts: bool,
}

/// From where the points were seen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Match {
    /// `base_link` in `map`.
    pub pose: Pose,
    /// Of x, y (mm) and heading (rad) in `map`. Where the surfaces say nothing of a direction, it
    /// is huge.
    pub covariance: Matrix3<f64>,
}

impl Match {
    /// Standard deviations of x, y (mm) and heading (rad).
    pub fn deviations(&self) -> [f64; 3] {
        [0, 1, 2].map(|axis| self.covariance[(axis, axis)].sqrt())
    }
}

/// A cell in which a surface can be seen: occupied, beside a free one.
#[derive(Clone, Copy, Debug)]
struct Surface {
    /// A point of the line along it, in millimetres in `map`.
    middle: Vector2<f64>,
    /// Across the line; `None` if it is the end of something, or something small.
    normal: Option<Vector2<f64>>,
}

/// The surfaces nearest to a cell.
#[derive(Clone, Copy, Debug)]
struct Nearest {
    /// The square of the distance, in cells.
    square: i32,
    surface: usize,
}

/// The surfaces that one can see when one looks into one of four quarters: whoever looks to the
/// north-east sees the west and the south of things. A wall that is known from one side only is
/// not what somebody sees who stands on the other, be it as thin as it may.
#[derive(Clone, Debug, Default)]
struct Facing {
    surfaces: Vec<Surface>,
    /// For each cell the one nearest to it.
    nearest: Vec<Option<Nearest>>,
}

/// The quarter into which one looks along an arm.
fn quarter(arm: Vector2<f64>) -> usize {
    usize::from(arm.x > 0.0) | usize::from(arm.y > 0.0) << 1
}

/// The surfaces of a part of the map.
#[derive(Clone, Debug)]
pub struct Surfaces {
    resolution: f64,
    /// Its south-western cell.
    corner: (i32, i32),
    side: i32,
    codes: Vec<Cell>,
    /// By [`quarter`].
    facing: [Facing; 4],
}

/// A candidate of the search: what it scores, and how far it is from the predicted pose.
#[derive(Clone, Copy, Debug, Default)]
struct Candidate {
    score: i32,
    /// What the score loses for the distance from the predicted pose.
    away: i32,
    turns: i32,
    cells: (i32, i32),
}

/// Where a refinement came to.
struct Refined {
    at: Vector2<f64>,
    heading: f64,
    /// The normal equations, for deviations of a millimetre.
    information: Matrix3<f64>,
    points: usize,
    /// The mean square of the points' distances, in square millimetres.
    square: f64,
}

impl Search {
    /// Standard deviations of x and of y in millimetres, and of the heading in binary angle units,
    /// about the predicted pose: the search goes four of them far.
    fn deviations(&self) -> (f64, f64) {
        let position = match self.prior {
            Prior::Measured(deviation) => deviation.0.into(),
            _ => f64::from(self.position.0) / 4.0,
        };
        (position.max(1.0), (f64::from(self.turn.0) / 4.0).max(1.0))
    }

    /// A pose is never surer than 5 mm and 0.1 degrees.
    fn hold(&self, predicted: Pose) -> Hold {
        let information = |deviation: f64| (CELL_DEVIATION_MM / deviation).powi(2);
        let position = match self.prior {
            Prior::Carried(deviation, _) => f64::from(deviation.0).max(5.0),
            _ => self.deviations().0,
        };
        let heading = match self.prior {
            Prior::Carried(_, deviation) => information(deviation.radians().max(2e-3)),
            _ => 0.0,
        };
        Hold {
            at: self::position(predicted),
            heading: predicted.heading.radians(),
            information: Vector3::new(information(position), information(position), heading),
            counts: matches!(self.prior, Prior::Measured(_)),
        }
    }
}

impl Candidate {
    fn pose(
        &self,
        surfaces: &Surfaces,
        start: Vector2<f64>,
        heading: Angle,
    ) -> (Vector2<f64>, f64) {
        let moved = Vector2::new(f64::from(self.cells.0), f64::from(self.cells.1));
        let turned = heading + Angle((self.turns * TURN_STEP) as u16);
        (start + moved * surfaces.resolution, turned.radians())
    }
}

impl Refined {
    /// Whether it is another place than `best`, whose covariance is given, and explains what was
    /// seen nearly as well.
    fn is_elsewhere_and_as_good(&self, best: &Self, covariance: &Matrix3<f64>) -> bool {
        let (dx, dy) = (self.at.x - best.at.x, self.at.y - best.at.y);
        let off = Vector3::new(dx, dy, self.heading - best.heading);
        // Along a direction of which the surfaces say nothing, all places are one.
        let distance = covariance.try_inverse().map_or(0.0, |inverse| off.dot(&(inverse * off)));
        let as_good = 100 * self.points >= RIVAL_SCORE as usize * best.points
            && self.square <= 2.0 * best.square.max(CELL_DEVIATION_MM * CELL_DEVIATION_MM);
        as_good && distance > ELSEWHERE
    }
}

impl Surfaces {
    /// Those within `reach` of a pose along x and along y; `tile` is what the map says of a tile,
    /// and `trail` is for where it says nothing. About a millisecond for 5 m of 5 cm cells.
    pub fn about(
        pose: Pose,
        reach: Millimetres,
        resolution: Millimetres,
        mut tile: impl FnMut(TileId) -> Tile,
        trail: &Trail,
    ) -> Self {
        let half = (reach.0 / resolution.0.max(1)).clamp(1, 1_000);
        let corner = (cell_of(pose.x, resolution) - half, cell_of(pose.y, resolution) - half);
        let side = 2 * half + 1;
        let mut all = Self {
            resolution: f64::from(resolution.0),
            corner,
            side,
            codes: vec![Cell::Unknown; (side * side) as usize],
            facing: Default::default(),
        };
        let step = TILE_SIDE as i32;
        let tiles = |from: i32| from.div_euclid(step)..=(from + side - 1).div_euclid(step);
        for (tile_x, tile_y) in
            tiles(corner.1).flat_map(|y| tiles(corner.0).map(move |x| (x * step, y * step)))
        {
            let Some(id) = TileId::of_cell(tile_x, tile_y) else { continue };
            let tile = tile(id);
            for (y, x) in (0..TILE_SIDE).flat_map(|y| (0..TILE_SIDE).map(move |x| (y, x))) {
                if let Some(index) = all.index((tile_x + x as i32, tile_y + y as i32)) {
                    all.codes[index] = tile.cell(x, y);
                }
            }
        }
        all.facing = core::array::from_fn(|quarter| all.facing(quarter, trail));
        all
    }

    fn index(&self, (x, y): (i32, i32)) -> Option<usize> {
        let (x, y) = (x.checked_sub(self.corner.0)?, y.checked_sub(self.corner.1)?);
        let within = (0..self.side).contains(&x) && (0..self.side).contains(&y);
        within.then_some((y * self.side + x) as usize)
    }

    fn code(&self, cell: (i32, i32)) -> Cell {
        self.index(cell).map_or(Cell::Unknown, |index| self.codes[index])
    }

    fn cell(&self, point: Vector2<f64>) -> (i32, i32) {
        cell_at(point, self.resolution)
    }

    /// The surfaces that are seen by looking into a quarter.
    fn facing(&self, quarter: usize, trail: &Trail) -> Facing {
        let (west, south) = self.corner;
        // From where one looks at a cell.
        let (aside, below) = (1 - 2 * (quarter as i32 & 1), 1 - 2 * (quarter as i32 >> 1));
        let cells =
            (south..south + self.side).flat_map(|y| (west..west + self.side).map(move |x| (x, y)));
        let cells: Vec<(i32, i32)> = cells
            .filter(|&(x, y)| {
                self.code((x, y)) == Cell::Occupied
                    && [(x + aside, y), (x, y + below)]
                        .into_iter()
                        .any(|beside| self.code(beside) == Cell::Free)
            })
            .collect();
        let mut is_surface = vec![false; self.codes.len()];
        for &cell in &cells {
            if let Some(index) = self.index(cell) {
                is_surface[index] = true;
            }
        }
        let mut facing = Facing { nearest: vec![None; self.codes.len()], surfaces: Vec::new() };
        for &(x, y) in &cells {
            let beside = square(LINE_REACH).map(|(dx, dy)| (x + dx, y + dy));
            let near: Vec<(i32, i32)> = beside
                .filter(|&cell| self.index(cell).is_some_and(|index| is_surface[index]))
                .collect();
            let found = self.surface((x, y), &near);
            if found.normal.is_none() && self.is_where_knowledge_ends((x, y)) {
                continue;
            }
            self.place(&mut facing, (x, y), found, REACH);
        }
        for ((x, y), middle, normal) in trail.seen(quarter) {
            let is_drawn =
                |(dx, dy)| self.index((x + dx, y + dy)).is_some_and(|index| is_surface[index]);
            if !square(BESIDE).any(is_drawn) {
                let seen = Surface { middle, normal: Some(normal) };
                self.place(&mut facing, (x, y), seen, TRAIL_REACH);
            }
        }
        facing
    }

    /// Lets a surface in a cell be the nearest to all cells that it is the nearest to.
    fn place(&self, facing: &mut Facing, (x, y): (i32, i32), it: Surface, reach: i32) {
        let surface = facing.surfaces.len();
        facing.surfaces.push(it);
        for (dx, dy) in square(reach) {
            let square = dx * dx + dy * dy;
            let Some(index) = self.index((x + dx, y + dy)) else { continue };
            let nearest = &mut facing.nearest[index];
            if square <= reach * reach && nearest.is_none_or(|it| square < it.square) {
                *nearest = Some(Nearest { square, surface });
            }
        }
    }

    /// Whether something may go on from a cell where nobody has seen: beside it is an unknown cell
    /// in front of which is the free. Its end then says nothing of the way along it.
    fn is_where_knowledge_ends(&self, (x, y): (i32, i32)) -> bool {
        let is = |cell: (i32, i32), code| self.code(cell) == code;
        square(1).map(|(dx, dy)| (x + dx, y + dy)).any(|(x, y)| {
            is((x, y), Cell::Unknown)
                && [(x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1)]
                    .into_iter()
                    .any(|cell| is(cell, Cell::Free))
        })
    }

    /// The surface in a cell, by those near it.
    fn surface(&self, cell: (i32, i32), near: &[(i32, i32)]) -> Surface {
        let middle = |(x, y): (i32, i32)| {
            Vector2::new(f64::from(x) + 0.5, f64::from(y) + 0.5) * self.resolution
        };
        let near: Vec<Vector2<f64>> = near.iter().map(|&cell| middle(cell)).collect();
        match line(&near) {
            Some((middle, normal)) if near.len() >= LINE_CELLS => {
                Surface { middle, normal: Some(normal) }
            }
            _ => Surface { middle: middle(cell), normal: None },
        }
    }

    /// The pose about the predicted one from which the points (as of [`points`]) were seen. `None`
    /// if too little of them lies on surfaces, or if there are two such poses or more, or if they
    /// say too little of the heading. A search of half a metre and 15 degrees takes about two
    /// milliseconds.
    pub fn find(&self, points: &[[f64; 2]], predicted: Pose, search: Search) -> Option<Match> {
        let points: Vec<Vector2<f64>> = points.iter().map(|&[x, y]| Vector2::new(x, y)).collect();
        let start = position(predicted);
        let candidates = self.candidates(&points, start, predicted.heading, search);
        let best = *candidates.iter().max_by_key(|it| it.score - it.away)?;
        let hold = search.hold(predicted);
        let (at, heading) = best.pose(self, start, predicted.heading);
        let refined = self.refine(&points, at, heading, hold)?;

        let known = points.iter().filter(|point| {
            let arm = rotated(**point, refined.heading);
            let seen = refined.at + arm;
            self.code(self.cell(seen)) == Cell::Free || self.seen_along(arm, seen).is_some()
        });
        if refined.points < LEAST_POINTS || 100 * refined.points < LEAST_SHARE * known.count() {
            return None;
        }
        let deviation = refined.square.max(CELL_DEVIATION_MM * CELL_DEVIATION_MM) * CORRELATION;
        // A metre and more of the position must not count for a radian.
        let inverse = (refined.information + Matrix3::identity() * 1e-9).try_inverse()?;
        let floor = Vector3::new(CELL_DEVIATION_MM, CELL_DEVIATION_MM, CELL_DEVIATION);
        let covariance = inverse * deviation + Matrix3::from_diagonal(&floor.component_mul(&floor));
        if covariance[(2, 2)] > HEADING_LIMIT * HEADING_LIMIT {
            return None;
        }
        let rivals = self.rivals(&candidates, &best);
        let ambiguous = rivals.iter().any(|rival| {
            let (at, heading) = rival.pose(self, start, predicted.heading);
            let other = self.refine(&points, at, heading, hold);
            other.is_some_and(|other| other.is_elsewhere_and_as_good(&refined, &covariance))
        });
        if ambiguous {
            return None;
        }
        let pose = Pose {
            x: Millimetres(libm::round(refined.at.x) as i32),
            y: Millimetres(libm::round(refined.at.y) as i32),
            heading: Angle::from_radians(refined.heading),
        };
        Some(Match { pose, covariance })
    }

    /// How many of the points, seen from a pose, lie on surfaces, and how many in the free: more
    /// than three cells before or behind anything.
    pub fn agreement(&self, points: &[[f64; 2]], pose: Pose) -> (u32, u32) {
        let at = position(pose);
        let (mut agree, mut contradict) = (0, 0);
        for &[x, y] in points {
            let seen = rotated(Vector2::new(x, y), pose.heading.radians()) + at;
            let cell = self.cell(seen);
            let near =
                |code| square(3).any(|(dx, dy)| self.code((cell.0 + dx, cell.1 + dy)) == code);
            if near(Cell::Movable) {
                continue;
            }
            if near(Cell::Occupied) {
                agree += 1;
            } else if self.code(cell) == Cell::Free && !near(Cell::Unknown) {
                contradict += 1;
            }
        }
        (agree, contradict)
    }

    /// The surface nearest to a point among those that can be seen along an arm.
    fn seen_along(&self, arm: Vector2<f64>, point: Vector2<f64>) -> Option<&Surface> {
        let facing = &self.facing[quarter(arm)];
        let nearest = facing.nearest[self.index(self.cell(point))?]?;
        facing.surfaces.get(nearest.surface)
    }

    /// All poses of the search, scored.
    fn candidates(
        &self,
        points: &[Vector2<f64>],
        start: Vector2<f64>,
        heading: Angle,
        search: Search,
    ) -> Vec<Candidate> {
        let turns = (i32::from(search.turn.0) / TURN_STEP).clamp(0, 32);
        let cells = libm::ceil(f64::from(search.position.0) / self.resolution) as i32;
        let cells = cells.clamp(0, 20);
        let (far, wide) = search.deviations();
        let (far, wide) = (far / self.resolution, wide / f64::from(TURN_STEP));
        let mut all = Vec::new();
        for turn in -turns..=turns {
            let turned = (heading + Angle((turn * TURN_STEP) as u16)).radians();
            let arms = points.iter().map(|point| rotated(*point, turned));
            let seen: Vec<(usize, (i32, i32))> =
                arms.map(|arm| (quarter(arm), self.cell(arm + start))).collect();
            for (dx, dy) in square(cells) {
                let nearest = seen.iter().filter_map(|&(quarter, (x, y))| {
                    self.facing[quarter].nearest[self.index((x + dx, y + dy))?]
                });
                // A cell away 230, two cells 92, four cells 9.
                let score = nearest.map(|it| 2_304 / (9 + it.square * it.square)).sum();
                let off = f64::from(dx * dx + dy * dy) / (far * far)
                    + f64::from(turn * turn) / (wide * wide);
                let away = (DEVIATION_SCORE * off) as i32;
                all.push(Candidate { score, away, turns: turn, cells: (dx, dy) });
            }
        }
        all
    }

    /// The best candidates of other places, one for each.
    fn rivals(&self, candidates: &[Candidate], best: &Candidate) -> Vec<Candidate> {
        let good = candidates.iter().filter(|it| it.score * 100 >= best.score * RIVAL_SCORE);
        let mut good: Vec<Candidate> = good.copied().collect();
        good.sort_by_key(|it| core::cmp::Reverse(it.score));
        let mut places = vec![*best];
        for candidate in good {
            let same = |place: &Candidate| {
                let (dx, dy) =
                    (candidate.cells.0 - place.cells.0, candidate.cells.1 - place.cells.1);
                (candidate.turns - place.turns).abs() <= RIVAL_TURNS
                    && dx.abs().max(dy.abs()) <= RIVAL_CELLS
            };
            if places.len() < MOST_PLACES && !places.iter().any(same) {
                places.push(candidate);
            }
        }
        places.split_off(1)
    }

    fn refine(
        &self,
        points: &[Vector2<f64>],
        mut at: Vector2<f64>,
        mut heading: f64,
        hold: Hold,
    ) -> Option<Refined> {
        let mut refined = None;
        for round in 0..ROUNDS {
            let reach = if round < FIRST_ROUNDS { FIRST_REACH_MM } else { LAST_REACH_MM };
            let (mut information, mut gradient) = (Matrix3::zeros(), Vector3::zeros());
            let (mut count, mut squares) = (0, 0.0);
            for point in points {
                let arm = rotated(*point, heading);
                let Some(&Surface { middle, normal }) = self.seen_along(arm, at + arm) else {
                    continue;
                };
                let off = at + arm - middle;
                let (axes, share): ([Option<Vector2<f64>>; 2], f64) = match normal {
                    Some(normal) => ([Some(normal), None], 1.0),
                    None => ([Some(Vector2::x()), Some(Vector2::y())], 0.25),
                };
                let mut counts = true;
                for axis in axes.into_iter().flatten() {
                    let distance = axis.dot(&off);
                    let part = distance / reach;
                    if part.abs() >= 1.0 {
                        counts = false;
                        continue;
                    }
                    let weight = (1.0 - part * part).powi(2) * share;
                    let row = Vector3::new(axis.x, axis.y, axis.dot(&Vector2::new(-arm.y, arm.x)));
                    information += row * row.transpose() * weight;
                    gradient += row * (distance * weight);
                    squares += distance * distance * share;
                }
                count += usize::from(counts);
            }
            // The start holds it where nothing else does.
            let back = hold.at - at;
            let turn = Angle::from_radians(hold.heading - heading).radians();
            let held = information + Matrix3::from_diagonal(&hold.information);
            gradient -= hold.information.component_mul(&Vector3::new(back.x, back.y, turn));
            let regular = held + Matrix3::from_diagonal(&Vector3::z());
            let step = regular.try_inverse()? * gradient;
            let information = if hold.counts { held } else { information };
            at -= Vector2::new(step.x, step.y);
            heading -= step.z;
            let square = squares / f64::from(count.max(1) as u32);
            refined = Some(Refined { at, heading, information, points: count, square });
        }
        refined
    }
}

/// The line through points, if they lie on one: their mean, and the direction across.
fn line(points: &[Vector2<f64>]) -> Option<(Vector2<f64>, Vector2<f64>)> {
    let mean = points.iter().sum::<Vector2<f64>>() / points.len() as f64;
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for point in points {
        let off = point - mean;
        xx += off.x * off.x;
        xy += off.x * off.y;
        yy += off.y * off.y;
    }
    let spread = ((xx - yy) * (xx - yy) + 4.0 * xy * xy).sqrt();
    if xx + yy - spread > LINE_WIDTH * (xx + yy + spread) {
        return None;
    }
    let across = 0.5 * atan2(2.0 * xy, xx - yy) + FRAC_PI_2;
    Some((mean, Vector2::new(cos(across), sin(across))))
}

/// The cell in which a point lies; in millimetres.
fn cell_at(point: Vector2<f64>, resolution: f64) -> (i32, i32) {
    let cell = |millimetres: f64| libm::floor(millimetres / resolution) as i32;
    (cell(point.x), cell(point.y))
}

/// In millimetres.
fn position(pose: Pose) -> Vector2<f64> {
    Vector2::new(f64::from(pose.x.0), f64::from(pose.y.0))
}

/// The cells within so many of one, along x and along y.
fn square(reach: i32) -> impl Iterator<Item = (i32, i32)> + Clone {
    (-reach..=reach).flat_map(move |dy| (-reach..=reach).map(move |dx| (dx, dy)))
}

fn rotated(point: Vector2<f64>, angle: f64) -> Vector2<f64> {
    let (sin, cos) = (sin(angle), cos(angle));
    Vector2::new(cos * point.x - sin * point.y, sin * point.x + cos * point.y)
}

#[cfg(test)]
mod tests;
