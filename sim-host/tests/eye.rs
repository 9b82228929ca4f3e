//! The perception of one camera in a room of boxes, from depth images with the noise of a D435.

use std::collections::BTreeMap;

use ubimap_protocol::{
    link::Terms,
    message::{ObstacleClass, Posture},
    tile::{Cell, TileId},
    time::Instant,
    units::{Millimetres, Pose},
};

use ubimap_sim_host::{
    camera::{Calibration, DepthImage, DepthNoise, Frame, Intrinsics, Lens, Observation, Picture},
    mapping::CameraLayer,
    perception::{Detection, Detector, Eye, Footprint, FrameError, Survey, Tracks},
    server::Server,
};

#[path = "../src/perception/testing/boxes.rs"]
mod boxes;

use boxes::{Cuboid, lens, noisy, render};

const WALL: Cuboid = [[2.975, -9.0, 0.0], [3.2, 12.0, 2.5]];
const BOX: Cuboid = [[1.0, 0.5, 0.0], [1.5, 1.0, 0.3]];
/// The top of a table, higher than the robots.
const TABLE: Cuboid = [[1.0, 1.6, 0.70], [1.8, 2.2, 0.74]];

/// A camera under the ceiling, and the contents of its room.
struct Studio {
    eye: Eye,
    lens: Lens,
    room: Vec<Cuboid>,
    floor_m: f64,
    /// The noise of its images.
    noise: DepthNoise,
    millis: u64,
}

impl Studio {
    fn new(room: &[Cuboid]) -> Self {
        Self::with_noise(DepthNoise::D435, DepthNoise::D435, room)
    }

    /// A camera with this noise; its calibration may state a different one.
    fn with_noise(noise: DepthNoise, stated: DepthNoise, room: &[Cuboid]) -> Self {
        let lens = lens(320, 240, [0.0, 0.0, 2.6], [1.6, 1.2, 0.0]);
        let calibration =
            Calibration { depth: Some(lens), depth_noise: stated, ..Calibration::default() };
        let eye = Eye::new(0, &calibration, Survey::default()).unwrap();
        Self { eye, lens, room: room.to_vec(), floor_m: 0.0, noise, millis: 0 }
    }

    /// A camera that has learnt its empty room.
    fn learnt(room: &[Cuboid]) -> Self {
        let mut studio = Self::new(room);
        while !studio.eye.has_learnt() {
            studio.look(&[]);
        }
        studio
    }

    /// The next frame, with these visitors in the room; 5 Hz.
    fn frame(&mut self, visitors: &[Cuboid]) -> Frame {
        self.millis += 200;
        let image = render(&self.lens, self.floor_m, &[&self.room, visitors].concat());
        let depth = Some(noisy(&image, &self.noise, self.millis, 980));
        Frame { camera: 0, captured: Instant(self.millis * 1_000), depth, picture: None }
    }

    fn look_beside(&mut self, visitors: &[Cuboid], robots: &[(Footprint, Pose)]) -> Observation {
        let frame = self.frame(visitors);
        self.eye.look(&frame, frame.captured, robots).unwrap()
    }

    fn look(&mut self, visitors: &[Cuboid]) -> Observation {
        self.look_beside(visitors, &[])
    }
}

/// A person or thing of this height.
fn at(x: f64, y: f64, height: f64) -> Cuboid {
    [[x - 0.2, y - 0.2, 0.0], [x + 0.2, y + 0.2, height]]
}

fn codes(observation: &Observation) -> BTreeMap<(i32, i32), Cell> {
    observation.cells.iter().copied().collect()
}

fn cell(x: f64, y: f64) -> (i32, i32) {
    ((x / 0.05).floor() as i32, (y / 0.05).floor() as i32)
}

/// The cells under a box.
fn under([low, high]: Cuboid) -> Vec<(i32, i32)> {
    let (from, to) = (cell(low[0] + 1e-6, low[1] + 1e-6), cell(high[0] - 1e-6, high[1] - 1e-6));
    (from.1..=to.1).flat_map(|y| (from.0..=to.0).map(move |x| (x, y))).collect()
}

#[test]
fn walls_and_boxes_are_occupied_where_they_stand_and_tables_hide_without_blocking() {
    let mut studio = Studio::learnt(&[WALL, BOX, TABLE]);
    let seen = codes(&studio.look(&[]));
    let occupied: Vec<_> =
        seen.iter().filter(|it| *it.1 == Cell::Occupied).map(|it| *it.0).collect();
    let solid = [under(WALL), under(BOX)].concat();
    let near = |a: &(i32, i32), b: &(i32, i32)| (a.0 - b.0).abs() + (a.1 - b.1).abs() <= 1;
    let right = occupied.iter().filter(|it| solid.iter().any(|solid| near(it, solid))).count();
    assert!(right * 100 >= occupied.len() * 97, "{right} of {}", occupied.len());
    // The face of the wall in view, and the box.
    let face = (cell(0.0, 0.0).1..=cell(0.0, 2.0).1).map(|y| (cell(2.976, 0.0).0, y));
    let expected: Vec<_> = face.chain(under(BOX)).collect();
    let found = expected.iter().filter(|it| occupied.iter().any(|seen| near(seen, it))).count();
    assert!(found * 100 >= expected.len() * 97, "{found} of {}", expected.len());

    // Visible floor is free, cells behind the wall are unknown, and the table casts a shadow.
    assert_eq!(seen.get(&cell(0.9, 1.5)), Some(&Cell::Free));
    let behind: Vec<_> = seen.iter().filter(|it| it.0.0 > cell(3.05, 0.0).0).collect();
    assert_eq!(behind, [], "behind the wall");
    let eye = studio.lens.centre();
    let stretch = eye.z / (eye.z - 0.74);
    assert_eq!(seen.get(&cell(1.4 * stretch, 1.9 * stretch)), None, "the shadow of the table");
    assert_eq!(seen.get(&cell(1.1, 1.7)), Some(&Cell::Free), "seen below its edge");
}

/// Three times the noise of a D435.
fn noisy_sensor() -> DepthNoise {
    let usual = DepthNoise::D435;
    DepthNoise::new(3.0 * usual.constant_m(), 3.0 * usual.quadratic_per_m()).unwrap()
}

/// The cells that a sensor with three times the noise of a D435 reports in twenty seconds of an
/// unchanging room, if its calibration states the noise `stated`: the number of free cells, and the
/// number of false ones, which are movable, or occupied more than a cell away from anything solid.
fn free_and_false_cells(stated: DepthNoise) -> [usize; 2] {
    let mut studio = Studio::with_noise(noisy_sensor(), stated, &[WALL, BOX]);
    let solid = [under(WALL), under(BOX)].concat();
    let is_near = |cell: (i32, i32)| {
        solid.iter().any(|it| (it.0 - cell.0).abs().max((it.1 - cell.1).abs()) <= 1)
    };
    let mut counts = [0; 2];
    for _ in 0..100 {
        for (cell, code) in studio.look(&[]).cells {
            counts[0] += usize::from(code == Cell::Free);
            let is_false = match code {
                Cell::Movable => true,
                Cell::Occupied => !is_near(cell),
                _ => false,
            };
            counts[1] += usize::from(is_false);
        }
    }
    counts
}

#[test]
fn a_noisy_sensor_draws_no_false_cells_if_its_calibration_states_the_noise() {
    let [free, wrong] = free_and_false_cells(noisy_sensor());
    assert!(free > 150_000 && wrong == 0, "{free} free, {wrong} false");
    let [free, wrong] = free_and_false_cells(DepthNoise::D435);
    assert!(wrong > 1_000, "{free} free, {wrong} false: the test would pass with any figure");
}

#[test]
fn a_floor_one_centimetre_off_or_a_door_sill_is_not_occupied() {
    let threshold = [[1.0, -1.0, 0.0], [1.06, 3.0, 0.02]];
    let mut studio = Studio::new(&[threshold]);
    studio.floor_m = 0.01;
    let mut wrong = 0;
    while !studio.eye.has_learnt() {
        let seen = studio.look(&[]);
        wrong += seen.cells.iter().filter(|it| it.1 != Cell::Free).count();
    }
    assert!(wrong <= 5, "{wrong} cells in the first seconds");
    for _ in 0..10 {
        let seen = studio.look(&[]);
        assert!(seen.cells.len() > 1_000);
        assert_eq!(seen.cells.iter().find(|it| it.1 != Cell::Free), None);
        assert_eq!(seen.things, []);
    }
}

#[test]
fn a_walking_person_is_tracked_and_leaves_no_cells_behind() {
    let mut studio = Studio::learnt(&[WALL, BOX]);
    let (mut layer, mut tracks) = (CameraLayer::default(), Tracks::default());
    let empty = codes(&studio.look(&[]));
    let walks = |step: u32| at(0.5 + 0.08 * f64::from(step), 1.6, 1.75);
    for step in 0..20 {
        let seen = studio.look(&[walks(step)]);
        layer.observe(&seen);
        tracks.observe(seen.captured, &seen.things, Millimetres(50));
        assert_eq!(seen.things.len(), 1, "{step}");
        let codes = codes(&seen);
        // Cells that were free before the person came, and are visible again, are free.
        for cell in (0..step.saturating_sub(6)).flat_map(|step| under(walks(step))) {
            if empty.get(&cell) == Some(&Cell::Free) && codes.contains_key(&cell) {
                let id = TileId::of_cell(cell.0, cell.1).unwrap();
                let (x, y) = (cell.0.rem_euclid(32) as usize, cell.1.rem_euclid(32) as usize);
                assert_eq!(layer.tile(id).cell(x, y), Cell::Free, "{cell:?} in step {step}");
            }
        }
    }
    let [track] = &tracks.now().collect::<Vec<_>>()[..] else { panic!("one of them") };
    assert_eq!((track.class(), track.posture()), (ObstacleClass::Person, Posture::Standing));
    assert!((track.position_m[0] - 2.02).abs() < 0.2, "{track:?}");
    assert!((track.position_m[1] - 1.6).abs() < 0.2, "{track:?}");
    assert!((track.velocity_m_s[0] - 0.4).abs() < 0.1, "{track:?}");
    assert!((1_650..=1_850).contains(&track.top_mm), "{track:?}");
    // The person has left.
    let seen = studio.look(&[]);
    layer.observe(&seen);
    assert_eq!(seen.things, []);
    assert!(!seen.cells.iter().any(|it| it.1 == Cell::Movable));
}

#[test]
fn a_thing_put_down_becomes_background_and_its_ground_is_free_after_removal() {
    let mut studio = Studio::learnt(&[WALL]);
    let crate_ = at(1.2, 1.4, 0.6);
    let mut tracks = Tracks::default();
    let middle = cell(1.2, 1.4);
    let seen = studio.look(&[crate_]);
    assert_eq!(codes(&seen).get(&middle), Some(&Cell::Movable));
    for _ in 0..200 {
        let seen = studio.look(&[crate_]);
        tracks.observe(seen.captured, &seen.things, Millimetres(50));
        assert!(tracks.now().all(|it| it.class() != ObstacleClass::Person));
    }
    let seen = studio.look(&[crate_]);
    assert_eq!(codes(&seen).get(&middle), Some(&Cell::Occupied), "although higher than robots");
    assert_eq!(seen.things, []);
    let seen = studio.look(&[]);
    assert_eq!(codes(&seen).get(&middle), Some(&Cell::Free));
    let left = under(crate_).into_iter().filter(|it| codes(&seen).get(it) == Some(&Cell::Occupied));
    assert_eq!(left.count(), 0);
}

#[test]
fn a_person_who_sits_down_does_not_become_background() {
    let mut studio = Studio::learnt(&[WALL]);
    for step in 0..20 {
        studio.look(&[at(0.4 + 0.06 * f64::from(step), 1.4, 1.75)]);
    }
    for _ in 0..200 {
        let sitting = at(1.6, 1.4, 1.25);
        let seen = codes(&studio.look(&[sitting]));
        let body = under(sitting);
        let movable = body.iter().filter(|it| seen.get(it) == Some(&Cell::Movable)).count();
        assert!(movable * 100 >= body.len() * 85, "{movable} of {}", body.len());
    }
}

/// A person who sits when the camera begins, and the chair, which the body hides.
const SEATED: Cuboid = [[1.2, 1.2, 0.0], [1.6, 1.6, 1.3]];
const CHAIR: Cuboid = [[1.3, 1.3, 0.0], [1.6, 1.6, 0.45]];

#[test]
fn a_person_who_sat_there_from_the_beginning_is_found_on_rising_and_leaves_the_chair() {
    for room in [&[WALL][..], &[WALL, CHAIR]] {
        let mut studio = Studio::new(room);
        let (mut layer, mut tracks) = (CameraLayer::default(), Tracks::default());
        let mut observe = |studio: &mut Studio, visitors: &[Cuboid]| {
            let seen = studio.look(visitors);
            layer.observe(&seen);
            tracks.observe(seen.captured, &seen.things, Millimetres(50));
            // The cells that were under the person, by code.
            let drawn = under(SEATED).into_iter().map(|(x, y)| {
                let tile = layer.tile(TileId::of_cell(x, y).unwrap());
                let code = tile.cell(x.rem_euclid(32) as usize, y.rem_euclid(32) as usize);
                ((x, y), code)
            });
            (drawn.collect::<BTreeMap<_, _>>(), tracks.now().collect::<Vec<_>>())
        };
        let count =
            |cells: &BTreeMap<_, Cell>, code| cells.values().filter(|it| **it == code).count();
        for _ in 0..100 {
            observe(&mut studio, &[SEATED]);
        }
        let (cells, found) = observe(&mut studio, &[SEATED]);
        assert!(found.is_empty(), "furniture so far: {found:?}");
        assert!(count(&cells, Cell::Occupied) >= 8 && count(&cells, Cell::Free) == 0, "{cells:?}");

        // Stands for a second, then walks away at 1 m/s; 5 Hz.
        let mut told = None;
        let mut drawn = BTreeMap::new();
        for step in 0..40 {
            let at_x = 1.4 + 0.2 * f64::from((step - 4).max(0));
            let person = at(at_x, 1.4, 1.75);
            let visitors: &[Cuboid] = if at_x < 2.6 { &[person] } else { &[] };
            let (cells, found) = observe(&mut studio, visitors);
            let mut people = found.iter().filter(|it| it.class() == ObstacleClass::Person);
            if let (Some(person), [_]) = (people.next(), visitors) {
                told.get_or_insert(step);
                let [x, y] = person.position_m;
                let is_known = person.posture() == Posture::Standing;
                let is_there = (x - at_x).hypot(y - 1.4) < 0.4;
                assert!(is_known && is_there, "{person:?} in step {step}");
            }
            drawn = cells;
        }
        // Within two frames from rising, before the first step.
        assert!(told.is_some_and(|step| step < 2), "{told:?}");
        let chair = if room.contains(&CHAIR) { under(CHAIR) } else { Vec::new() };
        let is_chair = |(x, y): &(i32, i32)| {
            chair.iter().any(|it| (it.0 - x).abs().max((it.1 - y).abs()) <= 1)
        };
        let wrong = drawn.iter().filter(|(cell, code)| !is_chair(cell) && **code != Cell::Free);
        assert_eq!(wrong.count(), 0, "{drawn:?}");
        // The sides of the chair that face the camera.
        let faces =
            chair.iter().filter(|(x, y)| *x == cell(1.31, 0.0).0 || *y == cell(0.0, 1.31).1);
        let (mut right, mut all) = (0, 0);
        for face in faces {
            all += 1;
            right += usize::from(drawn.get(face) == Some(&Cell::Occupied));
        }
        assert!(10 * right >= 8 * all, "{right} of {all}: {drawn:?}");
    }
}

#[test]
fn what_is_put_on_a_chair_or_stands_on_floor_is_no_person() {
    for thing in [[[1.3, 1.3, 0.0], [1.6, 1.6, 1.1]], at(0.8, 1.8, 1.75)] {
        let mut studio = Studio::learnt(&[WALL, CHAIR]);
        let mut tracks = Tracks::default();
        for _ in 0..30 {
            let seen = studio.look(&[thing]);
            tracks.observe(seen.captured, &seen.things, Millimetres(50));
            let found: Vec<_> = tracks.now().collect();
            assert!(found.len() == 1 && found[0].class() == ObstacleClass::Movable, "{found:?}");
        }
    }
}

#[test]
fn a_fall_is_reported_once() {
    let mut studio = Studio::learnt(&[WALL]);
    let mut tracks = Tracks::default();
    let terms = Terms { resolution: Millimetres(50), frame: 250, server_epoch: 1, stores: false };
    let mut server = Server::new(terms, 0);
    let mut told = Vec::new();
    for step in 0..60 {
        let x = 0.4 + 0.06 * f64::from(step.min(20));
        let (body, posture) = match step {
            0..30 => (at(x, 1.4, 1.75), Posture::Standing),
            30..45 => (at(x, 1.4, 1.2), Posture::Sitting),
            _ => ([[x - 0.3, 0.6, 0.0], [x + 0.2, 2.2, 0.3]], Posture::Lying),
        };
        let seen = studio.look(&[body]);
        tracks.observe(seen.captured, &seen.things, Millimetres(50));
        server.observe(&seen);
        told.extend(std::iter::from_fn(|| tracks.poll_lying()).map(|it| (step, it)));
        // A height counts after one second.
        if matches!(step, 15..30 | 38..45 | 53..) {
            let track = tracks.now().next().unwrap();
            assert_eq!(track.posture(), posture, "{step}: {track:?}");
        }
    }
    let [(step, lying)] = told[..] else { panic!("{told:?}") };
    assert!((50..58).contains(&step), "{step}");
    assert!((lying.position_m[0] - 1.6).abs() < 0.3, "{lying:?}");
    let events: Vec<_> = server.person_events().iter().collect();
    assert_eq!(events, [(lying.into(), 1, lying.moment)]);
}

#[test]
fn a_localised_robot_is_no_thing_and_its_cells_are_not_reported() {
    let mut studio = Studio::learnt(&[WALL]);
    let robot = [[1.0, 1.0, 0.0], [1.4, 1.3, 0.25]];
    let footprint = Footprint { half_length: 200, half_width: 150, is_round: false };
    let pose = Pose::from_metres(1.2, 1.15, 0.0);
    let seen = studio.look_beside(&[robot], &[(footprint, pose)]);
    assert_eq!(seen.things, []);
    assert!(under(robot).iter().all(|cell| !codes(&seen).contains_key(cell)));
    assert!(seen.cells.iter().all(|it| it.1 == Cell::Free || it.0.0 >= cell(2.8, 0.0).0));
    let unknown = studio.look(&[robot]);
    assert_eq!(unknown.things.len(), 1);
    assert_eq!(codes(&unknown).get(&cell(1.2, 1.15)), Some(&Cell::Movable));
}

#[test]
fn cells_in_a_shadow_are_not_reported() {
    let mut studio = Studio::learnt(&[WALL]);
    let free = codes(&studio.look(&[]));
    let seen = codes(&studio.look(&[at(1.0, 0.8, 1.6)]));
    // The line from the camera over the top of the head to the floor.
    let stretch = 2.6 / (2.6 - 1.6);
    let hidden = [(1.0, 0.8), (1.1, 0.9)].map(|(x, y)| cell(x * 0.8 * stretch, y * 0.8 * stretch));
    for cell in hidden {
        assert_eq!((free.get(&cell), seen.get(&cell)), (Some(&Cell::Free), None), "{cell:?}");
    }
}

#[test]
fn invalid_frames_are_refused_and_change_nothing() {
    let mut studio = Studio::learnt(&[WALL]);
    let good = studio.frame(&[]);
    let now = good.captured;
    let mut other = Studio::learnt(&[WALL]);
    let refused = |change: &dyn Fn(&mut Frame), now: Instant, studio: &mut Studio| {
        let mut frame = good.clone();
        change(&mut frame);
        studio.eye.look(&frame, now, &[]).unwrap_err()
    };
    let of = |width, height| DepthImage::new(width, height);
    let errors = [
        refused(&|it| it.camera = 3, now, &mut studio),
        refused(&|it| it.depth = None, now, &mut studio),
        refused(&|it| it.depth = Some(of(320, 24)), now, &mut studio),
        refused(&|it| it.depth = Some(of(320, 240)), now, &mut studio),
        refused(&|it| it.captured = Instant(now.0 + 3_600_000_000), now, &mut studio),
        refused(&|_| (), Instant(now.0 + 6_000_000), &mut studio),
    ];
    let size = FrameError::Size { camera: 0, found: (320, 24), expected: (320, 240) };
    let future = FrameError::Future { camera: 0, millis: 3_600_000 };
    let stale = FrameError::Stale { camera: 0, millis: 6_000 };
    let blank = FrameError::Blank(0);
    assert_eq!(
        errors,
        [FrameError::Camera(3, 0), FrameError::NoDepth(0), size, blank, future, stale]
    );
    assert!(size.to_string().contains("320 x 24 pixels, the calibration says 320 x 240"));
    assert_eq!(studio.eye.look(&good, now, &[]), other.eye.look(&good, now, &[]));
}

#[derive(Debug)]
struct SeesPeople;

impl Detector for SeesPeople {
    fn detect(&mut self, picture: &Picture) -> Vec<Detection> {
        let Picture::Grey(picture) = picture else { return vec![] };
        let detection = |label: &str, from, to| Detection { label: label.to_owned(), from, to };
        let (width, height) = (f64::from(picture.width()), f64::from(picture.height()));
        vec![
            detection("room", [0.0, 0.0], [width, height]),
            detection("person", [0.0, 0.0], [width / 2.0, height]),
        ]
    }
}

#[test]
fn a_detector_adds_labels() {
    let mut studio = Studio::learnt(&[WALL]);
    studio.eye.set_detector(studio.lens, Box::new(SeesPeople));
    // One thing is on the left and one on the right of the picture.
    let mut frame = studio.frame(&[at(0.8, 1.7, 0.8), at(1.6, 0.4, 0.8)]);
    frame.picture = Some(Picture::Grey(image::GrayImage::new(320, 240)));
    let seen = studio.eye.look(&frame, frame.captured, &[]).unwrap();
    let labels: Vec<_> = seen.things.iter().map(|it| it.label.as_deref()).collect();
    assert_eq!(labels, [Some("person"), Some("room")]);
    let mut tracks = Tracks::default();
    tracks.observe(seen.captured, &seen.things, Millimetres(50));
    let classes: Vec<_> = tracks.now().map(|it| it.class()).collect();
    assert_eq!(classes, [ObstacleClass::Person, ObstacleClass::Movable]);
}
