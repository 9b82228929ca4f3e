//! Scores a simulated run against the ground truth.

use std::collections::{BTreeMap, BTreeSet};

use image::RgbImage;
use ubimap_protocol::{
    tile::{Cell, TILE_SIDE, Tile, TileId},
    time::{Duration, Instant},
    units::{Angle, Millimetres, Pose},
};

use super::{RunError, fleet::Fleet};
use crate::{
    camera::FrameSource,
    grid::{self, OccupancyGrid},
    report::{self, Against, Caption, PoseErrors, TruthScores},
    world::{SimRobot, World},
};

/// Interval between two entries of a robot's true track.
pub(super) const TRACK_INTERVAL: Duration = Duration::from_millis(50);
/// Time from which pose errors are counted: robots boot at time zero and first need a session with
/// the server.
const SETTLED: Duration = Duration::from_secs(5);
/// Minimum speed of a robot that counts as driving, in m/s, and minimum turn rate in deg/s.
const DRIVES_M_S: f64 = 0.05;
const DRIVES_DEG_S: f64 = 5.0;
/// A robot that has not left a place by this distance stands there, in metres.
const STANDS_M: f64 = 0.15;
/// Distance by which the tracked position of a walking person may lag, in metres: about half a
/// second.
const TRAIL_M: f64 = 0.6;

/// Errors of the robots' own pose estimates.
pub fn pose_errors(fleet: &Fleet<'_>, tracks: &[Vec<Pose>]) -> PoseErrors {
    errors(paths(fleet).zip(tracks).flat_map(|(path, track)| {
        let path = path.iter();
        path.filter_map(|&(moment, pose)| {
            Some((pose, true_pose(track, moment).filter(|_| moment.0 >= SETTLED.0)?))
        })
    }))
}

/// Times and position errors of the robots' own pose estimates, in metres.
pub(super) fn position_errors(fleet: &Fleet<'_>, tracks: &[Vec<Pose>]) -> Vec<(Instant, f64)> {
    let errors = paths(fleet).zip(tracks).flat_map(|(path, track)| {
        path.iter().filter_map(|&(moment, pose)| {
            let truth = true_pose(track, moment)?;
            Some((moment, (pose.x - truth.x).metres().hypot((pose.y - truth.y).metres())))
        })
    });
    errors.collect()
}

/// What each robot believed, including the one outside.
fn paths<'f>(fleet: &'f Fleet<'_>) -> impl Iterator<Item = &'f [(Instant, Pose)]> {
    let outside = fleet.outside().map(|robot| robot.path());
    fleet.robots().iter().map(|robot| robot.path()).chain(outside)
}

/// The longest time before `until` for which a robot that drives stayed within [`STANDS_M`] of one place.
pub(super) fn longest_stand(
    tracks: &[Vec<Pose>],
    robots: &[SimRobot],
    until: Duration,
) -> Duration {
    let end = (until.micros() / TRACK_INTERVAL.micros()) as usize;
    let driving = tracks.iter().zip(robots).filter(|(_, robot)| robot.drives());
    let longest = driving.map(|(track, _)| {
        let (mut from, mut longest) = (0, 0);
        for (now, pose) in track.iter().enumerate().take(end) {
            let (dx, dy) = (pose.x - track[from].x, pose.y - track[from].y);
            if dx.metres().hypot(dy.metres()) > STANDS_M {
                from = now;
            }
            longest = longest.max(now - from);
        }
        longest
    });
    Duration(longest.max().unwrap_or(0) as u64 * TRACK_INTERVAL.micros())
}

/// Errors of the cameras' sightings of driving robots.
pub fn sighting_errors(fleet: &Fleet<'_>, tracks: &[Vec<Pose>]) -> PoseErrors {
    let tracks: BTreeMap<_, _> =
        fleet.robots().iter().map(|robot| robot.id()).zip(tracks).collect();
    errors(fleet.deployment().sightings().iter().filter_map(|&(captured, sighting)| {
        let track = tracks.get(&sighting.robot)?;
        Some((sighting.pose, true_pose(track, captured).filter(|_| drives(track, captured))?))
    }))
}

fn errors(pairs: impl Iterator<Item = (Pose, Pose)>) -> PoseErrors {
    let (mut squares, mut count) = ((0.0, 0.0), 0);
    for (pose, truth) in pairs {
        let (dx, dy) = (pose.x - truth.x, pose.y - truth.y);
        squares.0 += dx.metres().powi(2) + dy.metres().powi(2);
        squares.1 += (pose.heading - truth.heading).degrees().powi(2);
        count += 1;
    }
    let root = |sum: f64| if count > 0 { (sum / count as f64).sqrt() } else { 0.0 };
    PoseErrors { count, rmse_m: root(squares.0), rmse_deg: root(squares.1) }
}

fn drives(track: &[Pose], moment: Instant) -> bool {
    let index = (moment.micros() / TRACK_INTERVAL.micros()) as usize;
    let (Some(from), Some(to)) = (track.get(index), track.get(index + 1)) else { return false };
    let seconds = TRACK_INTERVAL.micros() as f64 / 1e6;
    let way = (to.x - from.x).metres().hypot((to.y - from.y).metres());
    way >= DRIVES_M_S * seconds
        || (to.heading - from.heading).degrees().abs() >= DRIVES_DEG_S * seconds
}

/// A robot's true pose, interpolated in its track.
fn true_pose(track: &[Pose], moment: Instant) -> Option<Pose> {
    let interval = TRACK_INTERVAL.micros();
    let index = (moment.micros() / interval) as usize;
    let (from, to) = (*track.get(index)?, *track.get(index + 1)?);
    let part = (moment.micros() % interval) as f64 / interval as f64;
    let mix = |from: Millimetres, to: Millimetres| {
        Millimetres::from_metres(from.metres() + (to - from).metres() * part)
    };
    let turn = Angle::from_radians((to.heading - from.heading).radians() * part);
    Some(Pose { x: mix(from.x, to.x), y: mix(from.y, to.y), heading: from.heading + turn })
}

/// The ground truth of a finished run.
struct Ground {
    covered: BTreeSet<(i32, i32)>,
    passed: BTreeSet<(i32, i32)>,
    /// A perfect map.
    whole: OccupancyGrid,
    /// The same, but only with the surfaces that a camera can see or that a robot has passed.
    seen: OccupancyGrid,
}

impl Ground {
    /// The ground truth in cells of this side.
    fn of(world: &World, side: Millimetres) -> Result<Self, RunError> {
        let truth = world.truth();
        let cameras = 0..FrameSource::cameras(world).len();
        let covered: BTreeSet<_> = cameras.flat_map(|camera| world.covered(camera)).collect();
        let passed: BTreeSet<_> = world.passed().collect();
        // A surface counts as passed if a cell next to it has been passed.
        let is_seen = |&(x, y): &(i32, i32)| {
            let mut about = (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (x + dx, y + dy)));
            covered.contains(&(x, y)) || about.any(|cell| passed.contains(&cell))
        };
        let surfaces = || truth.surfaces.iter().copied();
        let free = || truth.free.iter().map(|&cell| (cell, Cell::Free));
        let occupied = |cell| (cell, Cell::Occupied);
        let whole = of_cells(surfaces().map(occupied).chain(free()), side)?;
        let seen = of_cells(surfaces().filter(is_seen).map(occupied).chain(free()), side)?;
        Ok(Self { covered, passed, whole, seen })
    }
}

/// Scores a map against the ground truth of a finished run.
pub fn score(map: &OccupancyGrid, world: &World) -> Result<TruthScores, RunError> {
    let Ground { covered, passed, whole, seen } = Ground::of(world, side_of(map))?;
    let map = &without_bodies(map, world);
    // Precision counts all surfaces; recall only those that could have been seen.
    let scores = grid::compare(map, &whole, None);
    let (precision, recall) = (scores.precision, grid::compare(map, &seen, None).recall);
    let truth = world.truth();
    let known = known(map);
    let share = |cells: &mut dyn Iterator<Item = &(i32, i32)>| {
        let (mut count, mut found) = (0, 0);
        for cell in cells {
            count += 1;
            found += usize::from(known.contains(cell));
        }
        if count > 0 { found as f64 / f64::from(count) } else { 1.0 }
    };
    let is_blind = |cell: &&(i32, i32)| passed.contains(*cell) && !covered.contains(*cell);
    Ok(TruthScores {
        f1_occupied: 2.0 * precision * recall / (precision + recall).max(f64::EPSILON),
        passed_known: share(&mut truth.free.iter().filter(is_blind)),
        agreement_known: scores.agreement_known,
        coverage: share(&mut truth.free.iter().chain(&truth.surfaces)),
    })
}

/// A map without the people and robots present at the end: they are correctly mapped, or were a
/// moment ago, but are no surfaces of the room. Cells next to a surface are kept.
fn without_bodies(map: &OccupancyGrid, world: &World) -> OccupancyGrid {
    let surfaces: BTreeSet<_> = world.truth().surfaces.iter().copied().collect();
    let mut map = map.clone();
    let side_m = map.resolution_m();
    let people = world.people().iter();
    let people = people.map(|person| (person.position_m(), person.radius_m() + TRAIL_M));
    let robots = world.robots().iter().map(|robot| {
        let pose = robot.truth();
        ([pose.x.metres(), pose.y.metres()], robot.radius_m())
    });
    let bodies: Vec<([f64; 2], f64)> = people.chain(robots).collect();
    for index in 0..map.cells().len() {
        let (column, row) = (index % map.width(), index / map.width());
        if !matches!(map.cell(column, row), Cell::Occupied | Cell::Movable) {
            continue;
        }
        let [x, y] = map.to_map([column as f64 + 0.5, row as f64 + 0.5]);
        let is_under = |&([east, north], reach_m): &([f64; 2], f64)| {
            (x - east).hypot(y - north) <= reach_m + side_m
        };
        let cell = [x, y].map(|metres| (metres / side_m).floor() as i32);
        let mut about =
            (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (cell[0] + dx, cell[1] + dy)));
        if bodies.iter().any(is_under) && !about.any(|it| surfaces.contains(&it)) {
            map.set(column, row, Cell::Free);
        }
    }
    map
}

/// Occupied cells within a cell of a robot that stands, other than those at a surface of the room;
/// `None` if all robots drive.
pub(super) fn drawn_on_standing(map: &OccupancyGrid, world: &World) -> Option<u64> {
    let standing: Vec<_> = world.robots().iter().filter(|robot| !robot.drives()).collect();
    let surfaces: BTreeSet<_> = world.truth().surfaces.iter().copied().collect();
    let side_m = map.resolution_m();
    let is_drawn = |&index: &usize| {
        let (column, row) = (index % map.width(), index / map.width());
        let [x, y] = map.to_map([column as f64 + 0.5, row as f64 + 0.5]);
        let cell = [x, y].map(|metres| (metres / side_m).floor() as i32);
        let mut about =
            (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (cell[0] + dx, cell[1] + dy)));
        matches!(map.cell(column, row), Cell::Occupied | Cell::Movable)
            && standing.iter().any(|robot| {
                let pose = robot.truth();
                (x - pose.x.metres()).hypot(y - pose.y.metres()) <= robot.radius_m() + side_m
            })
            && !about.any(|it| surfaces.contains(&it))
    };
    (!standing.is_empty()).then(|| (0..map.cells().len()).filter(is_drawn).count() as u64)
}

/// A picture of the errors of a map.
pub(super) fn error_picture(
    map: &OccupancyGrid,
    world: &World,
    caption: &Caption,
) -> Result<RgbImage, RunError> {
    let ground = Ground::of(world, side_of(map))?;
    let map = &without_bodies(map, world);
    Ok(report::render_error(map, &ground.whole, &ground.seen, Against::Room, caption))
}

/// The known cells of a map.
fn known(map: &OccupancyGrid) -> BTreeSet<(i32, i32)> {
    let first = map.origin_m().map(|it| (it / map.resolution_m()).round() as i32);
    let cells = map.cells().iter().enumerate().filter(|(_, cell)| **cell != Cell::Unknown);
    cells
        .map(|(index, _)| {
            let (column, row) = (index % map.width(), index / map.width());
            (first[0] + column as i32, first[1] + row as i32)
        })
        .collect()
}

/// The side of a map's cells.
fn side_of(map: &OccupancyGrid) -> Millimetres {
    Millimetres::from_metres(map.resolution_m())
}

fn of_cells(
    cells: impl Iterator<Item = ((i32, i32), Cell)>,
    side: Millimetres,
) -> Result<OccupancyGrid, RunError> {
    let mut tiles = BTreeMap::<TileId, Tile>::new();
    for ((x, y), cell) in cells {
        let Some(id) = TileId::of_cell(x, y) else { continue };
        let within = |cell: i32| cell.rem_euclid(TILE_SIDE as i32) as usize;
        tiles.entry(id).or_default().set(within(x), within(y), cell);
    }
    Ok(OccupancyGrid::from_tiles(tiles.iter().map(|(&id, tile)| (id, tile)), side)?)
}
