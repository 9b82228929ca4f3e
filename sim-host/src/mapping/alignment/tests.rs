use core::f64::consts::TAU;
use std::collections::BTreeMap;

use super::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ubimap_protocol::{
    message::DistanceVector,
    tile::{TILE_SIDE, Tile, TileId},
    time::Instant,
};

const RESOLUTION: Millimetres = Millimetres(50);

/// Walls as line segments, in metres. The map is drawn by stepping along them, but views are
/// computed by intersecting rays, so that they do not depend on the map.
struct WalledRoom {
    walls: Vec<[[f64; 2]; 2]>,
    tiles: BTreeMap<TileId, Tile>,
}

impl WalledRoom {
    fn new(walls: Vec<[[f64; 2]; 2]>, inside: [[f64; 2]; 2]) -> Self {
        let mut room = Self { walls, tiles: BTreeMap::new() };
        let cell = |metres: f64| (metres / 0.05).floor() as i32;
        for y in cell(inside[0][1])..=cell(inside[1][1]) {
            for x in cell(inside[0][0])..=cell(inside[1][0]) {
                room.set((x, y), Cell::Free);
            }
        }
        for [from, to] in room.walls.clone() {
            for step in 0..=1_000 {
                let part = f64::from(step) / 1_000.0;
                let at = |axis: usize| from[axis] + (to[axis] - from[axis]) * part;
                room.set((cell(at(0)), cell(at(1))), Cell::Occupied);
            }
        }
        room
    }

    fn set(&mut self, (x, y): (i32, i32), cell: Cell) {
        let within = |cell: i32| cell.rem_euclid(TILE_SIDE as i32) as usize;
        let tile = self.tiles.entry(TileId::of_cell(x, y).unwrap()).or_default();
        tile.set(within(x), within(y), cell);
    }

    /// A distance vector of 64 columns of four beams each, over 90 degrees, with a range of 4 m.
    fn look(&self, pose: Pose) -> DistanceVector {
        let step = 256;
        let column = |column: i32| {
            let beams = (0..4).map(|beam| column * step - 8_192 + (2 * beam + 1) * step / 8);
            let ranges = beams.filter_map(|beam| {
                let angle = pose.heading.radians() + f64::from(beam) * TAU / 65_536.0;
                self.range(pose, angle).filter(|range| *range < 4.0)
            });
            let nearest = ranges.reduce(f64::min);
            nearest.map_or(0, |metres| (metres * 50.0).round() as u8)
        };
        DistanceVector {
            time: Instant(0),
            pose,
            first: Angle((-8_192 + step / 2) as u16),
            step: step as i16,
            distances: (0..64).map(column).collect(),
            odometry: None,
        }
    }

    fn range(&self, pose: Pose, angle: f64) -> Option<f64> {
        let (dx, dy) = (angle.cos(), angle.sin());
        let ranges = self.walls.iter().filter_map(|[from, to]| {
            let (wx, wy) = (to[0] - from[0], to[1] - from[1]);
            let (ox, oy) = (from[0] - pose.x.metres(), from[1] - pose.y.metres());
            let cross = dx * wy - dy * wx;
            let (range, part) = ((ox * wy - oy * wx) / cross, (ox * dy - oy * dx) / cross);
            ((0.0..=1.0).contains(&part) && range > 0.0).then_some(range)
        });
        ranges.reduce(f64::min)
    }

    fn find(&self, seen_from: Pose, predicted: Pose, search: Search) -> Option<Match> {
        self.surfaces(predicted).find(&points(&self.look(seen_from)), predicted, search)
    }

    fn surfaces(&self, about: Pose) -> Surfaces {
        let tile = |id| self.tiles.get(&id).copied().unwrap_or_default();
        Surfaces::about(about, Millimetres(5_000), RESOLUTION, tile, &Trail::default())
    }
}

const WIDE: Search =
    Search { position: Millimetres(500), turn: Angle(2_730), prior: Prior::Nothing };

/// 6 x 4 m with a slanted cupboard and a pillar.
fn furnished() -> WalledRoom {
    let walls = vec![
        [[0.02, 0.03], [6.01, 0.03]],
        [[6.01, 0.03], [6.01, 4.04]],
        [[6.01, 4.04], [0.02, 4.04]],
        [[0.02, 4.04], [0.02, 0.03]],
        [[2.0, 3.2], [3.5, 3.7]],
        [[4.5, 1.0], [4.8, 1.0]],
        [[4.5, 1.0], [4.5, 1.3]],
    ];
    WalledRoom::new(walls, [[0.05, 0.05], [6.0, 4.0]])
}

/// If too little is in view, there may be no match. The errors of 99 % of the matches must be
/// within three of their stated standard deviations.
#[test]
fn matches_are_within_their_claimed_deviations() {
    let room = furnished();
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let (mut found, mut claimed, mut farthest, mut most_turned) = (0, 0, 0.0f64, 0.0f64);
    for _ in 0..1_000 {
        let truth = Pose::from_metres(
            rng.random_range(1.0..3.5),
            rng.random_range(1.0..2.6),
            rng.random_range(-3.1..3.1),
        );
        let predicted = Pose {
            x: truth.x + Millimetres(rng.random_range(-450..450)),
            y: truth.y + Millimetres(rng.random_range(-450..450)),
            heading: truth.heading + Angle(rng.random_range(-2_500i16..2_500) as u16),
        };
        let Some(match_) = room.find(truth, predicted, WIDE) else { continue };
        let [sx, sy, sh] = match_.deviations();
        let off = [match_.pose.x - truth.x, match_.pose.y - truth.y];
        let off = off.map(|it| f64::from(it.0).abs());
        let turned = (match_.pose.heading - truth.heading).radians().abs();
        found += 1;
        claimed += u32::from(off[0] < 3.0 * sx && off[1] < 3.0 * sy && turned < 3.0 * sh);
        farthest = off.into_iter().fold(farthest, f64::max);
        most_turned = most_turned.max(turned.to_degrees());
    }
    println!(
        "{found} of 1000 found, {claimed} within three deviations; at most {farthest:.0} mm and \
         {most_turned:.2} degrees off"
    );
    assert!(found >= 900, "{found}");
    assert!(100 * claimed >= 99 * found, "{claimed} of {found}");
}

/// Without any heading to begin with, one scan is found wrongly in 3 of 100 matches.
#[test]
fn a_robot_in_any_heading_is_hardly_ever_found_wrongly() {
    let room = furnished();
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let (mut found, mut wrong) = (0, 0);
    for _ in 0..300 {
        let mut pose = |x: f64, y: f64, within: f64| {
            let [x, y] = [x, y].map(|it| it + rng.random_range(-within..within));
            Pose::from_metres(x, y, rng.random_range(-3.1..3.1))
        };
        let truth = pose(2.5, 2.0, 0.7);
        let predicted = pose(truth.x.metres(), truth.y.metres(), 0.6);
        let seen = points(&room.look(truth));
        let match_ = room.surfaces(predicted).find_in_any_heading(&seen, predicted);
        let Some(match_) = match_ else { continue };
        found += 1;
        let off = [match_.pose.x - truth.x, match_.pose.y - truth.y];
        let turned = (match_.pose.heading - truth.heading).degrees().abs();
        wrong += u32::from(turned > 3.0 || off.iter().any(|off| off.0.abs() > 100));
    }
    println!("{found} of 300 found, {wrong} wrong");
    assert!(found >= 120 && 100 * wrong <= 5 * found, "{found} found, {wrong} wrong");
}

/// A robot that has booted where it stood is found in most views; one that was carried away hardly ever is, in
/// a view that fits the old place.
#[test]
fn a_robot_is_found_where_it_stood() {
    let room = furnished();
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let (mut found, mut wrong, mut deceived, mut in_any_heading) = (0, 0, 0, 0);
    for _ in 0..300 {
        let mut pose = |x: f64, y: f64, heading: f64, within: [f64; 2]| {
            let [x, y] = [x, y].map(|it| it + rng.random_range(-within[0]..within[0]));
            Pose::from_metres(x, y, heading + rng.random_range(-within[1]..within[1]))
        };
        let stood = pose(2.5, 2.0, 0.0, [0.7, 3.1]);
        let [x, y] = [stood.x.metres(), stood.y.metres()];
        let rolled = pose(x, y, stood.heading.radians(), [0.02, 0.03]);
        let carried = pose(x, y, 0.0, [0.8, 3.1]);
        let surfaces = room.surfaces(stood);
        let seen = |pose| points(&room.look(pose));
        if let Some(match_) = surfaces.find_where_it_stood(&seen(rolled), stood) {
            found += 1;
            let off = [match_.pose.x - rolled.x, match_.pose.y - rolled.y];
            let turned = (match_.pose.heading - rolled.heading).degrees().abs();
            wrong += u32::from(turned > 3.0 || off.iter().any(|off| off.0.abs() > 100));
        }
        let any = surfaces.find_in_any_heading(&seen(rolled), stood);
        in_any_heading += u32::from(any.is_some());
        deceived += u32::from(surfaces.find_where_it_stood(&seen(carried), stood).is_some());
    }
    println!(
        "{found} of 300 found, {wrong} wrong, {in_any_heading} in any heading; {deceived} carried"
    );
    assert!(found >= 240 && wrong <= 3, "{found} found, {wrong} wrong");
    assert!(in_any_heading < found && deceived <= 3, "{deceived} were carried away");
}

/// A search around a wrong position may find a match there, but never outside the search range.
#[test]
fn matches_are_within_the_search_range() {
    let room = furnished();
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    let prior = Prior::Measured(Millimetres(25));
    let search = Search { position: Millimetres(100), turn: Angle(2_600), prior };
    let mut found = 0;
    for _ in 0..400 {
        let mut pose = || {
            let (x, y) = (rng.random_range(0.5..5.5), rng.random_range(0.5..3.5));
            Pose::from_metres(x, y, rng.random_range(-3.1..3.1))
        };
        let (truth, predicted) = (pose(), pose());
        let Some(match_) = room.find(truth, predicted, search) else { continue };
        found += 1;
        let off = [match_.pose.x - predicted.x, match_.pose.y - predicted.y];
        let turned = (match_.pose.heading - predicted.heading).degrees().abs();
        // Up to one step beyond the range: a cell and 1.4 degrees.
        assert!(off.iter().all(|off| off.0.abs() <= 151) && turned <= 15.8, "{match_:?}");
    }
    assert!(found > 5, "{found}");
}

#[test]
fn most_places_in_a_room_constrain_position_and_heading() {
    let room = furnished();
    let (mut found, mut good) = (0, 0);
    for (x, y) in (2..7).flat_map(|x| (2..6).map(move |y| (f64::from(x) / 2.0, f64::from(y) / 2.0)))
    {
        for turn in 0..12 {
            let truth = Pose::from_metres(x, y, f64::from(turn) * 0.52);
            let Some(found_there) = room.find(truth, truth, WIDE) else { continue };
            found += 1;
            let off = [found_there.pose.x - truth.x, found_there.pose.y - truth.y];
            let off = f64::from(off[0].0).hypot(f64::from(off[1].0));
            let turned = found_there.pose.heading.distance(truth.heading);
            good += u32::from(off < 40.0 && turned < 91);
        }
    }
    println!("{found} of 240 found, {good} within 4 cm and half a degree");
    assert!(found >= 200 && 4 * good >= 3 * found, "{found} {good}");
}

fn corridor(more: &[[[f64; 2]; 2]]) -> WalledRoom {
    let walls = [[[-9.0, 0.02], [9.0, 0.02]], [[-9.0, 2.04], [9.0, 2.04]]];
    let walls = walls.iter().chain(more).copied().collect();
    WalledRoom::new(walls, [[-9.0, 0.05], [9.0, 2.0]])
}

#[test]
fn a_thin_wall_is_not_taken_for_its_other_side() {
    // A wall 20 cm thick closes the corridor; the map knows only its other face.
    let mut room = corridor(&[[[3.04, 0.0], [3.04, 2.04]]]);
    for y in 1..40 {
        (60..63).for_each(|x| room.set((x, y), Cell::Unknown));
        room.set((63, y), Cell::Occupied);
    }
    let truth = Pose::from_metres(0.5, 1.0, 0.0);
    let found = room.find(truth, truth, WIDE).expect("heading and y are known");
    let [x, y, _] = found.deviations();
    assert!(x > 1_000.0 && y < 60.0, "{x} {y}");
    // Now the map also has the face that the robot sees.
    (1..40).for_each(|y| room.set((60, y), Cell::Occupied));
    let found = room.find(truth, truth, WIDE).expect("all three are known");
    assert!((found.pose.x - truth.x).0.abs() < 40, "{found:?}");
}

#[test]
fn the_end_of_the_known_part_of_a_wall_constrains_nothing() {
    let mut room = corridor(&[]);
    for x in 50..80 {
        (-1..42).for_each(|y| room.set((x, y), Cell::Unknown));
    }
    let truth = Pose::from_metres(0.0, 1.0, 0.0);
    for metres in [-0.3, 0.0, 0.3] {
        let predicted = Pose::from_metres(metres, 1.0, 0.0);
        let found = room.find(truth, predicted, WIDE).expect("heading and y are known");
        let [x, y, _] = found.deviations();
        assert!(x > 1_000.0 && y < 60.0, "{x} {y}");
    }
}

#[test]
fn a_corridor_does_not_constrain_the_position_along_it() {
    let truth = Pose::from_metres(0.0, 1.0, 0.1);
    let predicted = Pose::from_metres(0.3, 1.2, 0.2);
    let found = corridor(&[]).find(truth, predicted, WIDE).expect("heading and y are known");
    let [x, y, heading] = found.deviations();
    assert!(x > 1_000.0 && y < 60.0 && heading.to_degrees() < 1.0, "{x} {y} {heading}");
    assert!((found.pose.y - truth.y).0.abs() < 40, "{found:?}");
    assert!(found.pose.heading.distance(truth.heading) < 91, "{found:?}");
}

#[test]
fn ambiguous_places_do_not_match() {
    // Ribs every 40 cm on both sides of the corridor.
    let ribs: Vec<_> = (-20..=20)
        .flat_map(|rib| {
            let x = f64::from(rib) * 0.4;
            [[[x, 0.02], [x, 0.22]], [[x, 1.84], [x, 2.04]]]
        })
        .collect();
    let truth = Pose::from_metres(0.1, 1.0, 0.0);
    let predicted = Pose::from_metres(0.3, 1.0, 0.0);
    assert_eq!(corridor(&ribs).find(truth, predicted, WIDE), None);
    let near = Search { position: Millimetres(150), turn: Angle(1_000), prior: Prior::Nothing };
    let found = corridor(&ribs).find(truth, Pose::from_metres(0.15, 1.0, 0.0), near);
    let off = found.expect("the others are out of reach").pose.x - truth.x;
    assert!(off.0.abs() < 40, "{off:?}");
}

/// A hall 3.6 m wide.
fn hall(more: &[[[f64; 2]; 2]]) -> WalledRoom {
    let walls = [[[-9.0, -0.78], [19.0, -0.78]], [[-9.0, 2.82], [19.0, 2.82]]];
    let walls = walls.iter().chain(more).copied().collect();
    WalledRoom::new(walls, [[-9.0, -0.75], [19.0, 2.8]])
}

#[test]
fn points_at_the_end_of_the_range_are_on_their_surface() {
    // The walls on both sides extend beyond the range, so the last column on each wall has only one
    // neighbour.
    let room = hall(&[]);
    for degrees in [-3.0f64, 0.0, 3.0] {
        let pose = Pose::from_metres(0.0, 1.0, degrees.to_radians());
        for [x, y] in points(&room.look(pose)) {
            let seen = rotated(Vector2::new(x, y), pose.heading.radians()).y + 1_000.0;
            let off = (seen + 780.0).abs().min((seen - 2_820.0).abs());
            assert!(off <= 20.0, "{off} mm off at {x} {y}");
        }
    }
}

/// Drives 10 m through an unmapped hall. The odometry turns 20 % too far, with an additional error
/// of up to 1 degree per scan.
#[test]
fn a_trail_bounds_the_drift_in_unmapped_ground() {
    let room = hall(&[
        [[1.0, -0.78], [1.0, -0.1]],
        [[3.3, 2.0], [4.0, 2.2]],
        [[5.5, -0.3], [6.3, -0.3]],
        [[7.0, 2.1], [7.0, 2.82]],
        [[9.5, -0.78], [9.5, 2.82]],
    ]);
    let at = |step: i32| {
        let way = f64::from(step) * 0.4;
        Pose::from_metres(way - 3.0, 1.0 + 0.2 * way.sin(), 0.2 * way.cos())
    };
    for seed in 1..=5 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut trail = Trail::default();
        let (mut believed, mut wheels) = (at(0), at(0));
        for step in 0..=25 {
            let seen = points(&room.look(at(step)));
            if step > 0 {
                let turned = Angle::from_degrees(0.2 + rng.random_range(-1.0..1.0));
                let strayed = [0; 2].map(|_| Millimetres(rng.random_range(-10..=10)));
                let carried = |from: Pose| {
                    let (was, is) = (at(step - 1), at(step));
                    let bend = (from.heading - was.heading).radians();
                    let way = rotated(position(is) - position(was), bend);
                    Pose {
                        x: from.x + Millimetres(way.x as i32) + strayed[0],
                        y: from.y + Millimetres(way.y as i32) + strayed[1],
                        heading: from.heading + (is.heading - was.heading) + turned,
                    }
                };
                wheels = carried(wheels);
                let predicted = carried(believed);
                let prior = Prior::Carried(Millimetres(13), Angle(115));
                let (reach, nothing) = (Millimetres(5_000), |_| Tile::UNKNOWN);
                let surfaces = Surfaces::about(predicted, reach, RESOLUTION, nothing, &trail);
                let found = surfaces.find(&seen, predicted, Search { prior, ..WIDE });
                believed = found.map_or(predicted, |it| it.pose);
            }
            trail.add(believed, &seen, RESOLUTION);
        }
        let off = |pose: Pose| {
            let turned = (pose.heading - at(25).heading).degrees().abs();
            ((position(pose) - position(at(25))).norm(), turned)
        };
        let ((far, turned), (strayed, _)) = (off(believed), off(wheels));
        println!("seed {seed}: {far:.0} mm and {turned:.2} degrees, wheels {strayed:.0} mm");
        assert!(far <= 100.0 && turned <= 2.0 && far < strayed / 3.0, "seed {seed}");
    }
}

/// Two views of 90 degrees, after a turn of 74 degrees: 11 of 64 columns see the same.
#[test]
fn a_robot_is_followed_by_the_few_points_that_two_views_share() {
    let room = furnished();
    let at = |heading: f64| Pose::from_metres(3.0, 1.5, heading);
    let mut trail = Trail::default();
    trail.add(at(0.0), &points(&room.look(at(0.0))), RESOLUTION);
    let truth = at(1.3);
    let reach = Millimetres(5_000);
    let surfaces = Surfaces::about(truth, reach, RESOLUTION, |_| Tile::UNKNOWN, &trail);
    let seen = points(&room.look(truth));
    for off in [-1.5f64, 1.5] {
        let predicted = at(1.3 + off.to_radians());
        let prior = Prior::Carried(Millimetres(10), Angle::from_degrees(1.2));
        let search = Search { position: Millimetres(80), turn: Angle::from_degrees(4.0), prior };
        assert_eq!(surfaces.find(&seen, predicted, search), None, "too few");
        let followed = surfaces.follow(&seen, predicted, search).unwrap();
        let left = (followed.pose.heading - truth.heading).degrees();
        assert!(left.abs() < 0.5, "{off}: {left}");
        // Beyond the search range it is lost.
        let narrow = Search { turn: Angle(0), ..search };
        let far = at(1.3 + 4.0 * off.to_radians());
        assert_eq!(surfaces.follow(&seen, far, narrow), None);
    }
    let nothing = Surfaces::about(truth, reach, RESOLUTION, |_| Tile::UNKNOWN, &Trail::default());
    assert_eq!(nothing.follow(&seen, truth, WIDE), None);
}

#[test]
fn points_in_free_ground_contradict() {
    let room = furnished();
    let pose = Pose::from_metres(2.0, 1.0, -0.5);
    let tile = |id| room.tiles.get(&id).copied().unwrap_or_default();
    let surfaces = Surfaces::about(pose, Millimetres(5_000), RESOLUTION, tile, &Trail::default());
    let seen = points(&room.look(pose));
    assert!(seen.len() > 40);
    assert_eq!(surfaces.agreement(&seen, pose), (seen.len() as u32, 0));
    let before: Vec<[f64; 2]> = seen.iter().map(|point| point.map(|it| it / 2.0)).collect();
    let (agree, contradict) = surfaces.agreement(&before, pose);
    assert!(contradict > 10 * agree && contradict > 30, "{agree} {contradict}");
}

#[test]
fn an_empty_map_and_an_empty_vector_find_nothing() {
    let pose = Pose { x: Millimetres(i32::MAX), y: Millimetres(i32::MIN), heading: Angle(7) };
    let surfaces =
        Surfaces::about(pose, Millimetres(900), RESOLUTION, |_| Tile::UNKNOWN, &Trail::default());
    assert_eq!(surfaces.find(&[[500.0, 0.0]; 40], pose, WIDE), None);
    assert_eq!(surfaces.find(&[], pose, WIDE), None);
}
