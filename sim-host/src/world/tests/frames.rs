//! Frames agree with the scene and the calibration, and have the specified noise.

use nalgebra::Point3;
use parry2d_f64::glamx::{DVec2, DVec3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{built_in, seconds, small_room, world};
use crate::{
    camera::{Frame, FrameSource, Picture},
    world::{
        Scenario, World,
        render::{FrameCamera, Scene},
        scene, tag,
    },
};

fn scene_of(world: &World) -> Scene {
    scene(&world.room, &world.robots, &world.people)
}

fn dice(seed: u64) -> ChaCha8Rng {
    ChaCha8Rng::seed_from_u64(seed)
}

fn camera(scenario: &Scenario, index: usize) -> FrameCamera {
    FrameCamera::new(&scenario.cameras[index], false, dice(1)).unwrap()
}

/// Reduces the images, for tests that need many.
fn shrunk(mut scenario: Scenario) -> Scenario {
    for camera in &mut scenario.cameras {
        (camera.depth.width, camera.depth.height) = (160, 120);
        (camera.picture.width, camera.picture.height) = (320, 180);
    }
    scenario
}

/// Distance of a ray's first hit, computed the slow way in double precision.
fn cast(scene: &Scene, eye: DVec3, way: DVec3) -> f64 {
    let plane = if way.z < 0.0 { 0.0 } else { scene.room.height() };
    let nearest = (plane - eye.z) / way.z;
    let moving = scene.moving.iter().filter_map(|part| part.prism.first_hit(eye, way, nearest));
    let standing = scene.room.first_hit(eye, way, nearest).map(|(_, at)| at);
    moving.chain(standing).fold(nearest, f64::min)
}

#[test]
fn depths_agree_with_ray_casting() {
    let scenario = Scenario::built_in().unwrap();
    let mut world = built_in(1);
    world.advance(seconds(7.0));
    let scene = scene_of(&world);
    let mut throw = dice(5);
    for index in 0..scenario.cameras.len() {
        let mut camera = camera(&scenario, index);
        let depth = camera.exact_depth(&scene);
        let lens = camera.calibration().depth.unwrap();
        let eye = DVec3::from(scenario.cameras[index].position_m);
        for _ in 0..5_000 {
            let (column, row) = (throw.random_range(0..640), throw.random_range(0..480));
            let found = f64::from(depth[row * 640 + column]);
            // At an outline, rounding decides what a ray hits: the depth of a ray a fiftieth of a
            // pixel beside it is accepted, too.
            let beside = [(0.0, 0.0), (-0.02, 0.0), (0.02, 0.0), (0.0, -0.02), (0.0, 0.02)];
            let mut near = beside.iter().map(|&(right, down)| {
                let way = lens.direction([column as f64 + right, row as f64 + down]);
                cast(&scene, eye, DVec3::new(way.x, way.y, way.z))
            });
            assert!(
                near.any(|expected| (found - expected).abs() < 1e-4 * expected),
                "camera {index}, pixel ({column}, {row}): {found} m"
            );
        }
    }
}

/// A camera 2.5 m above the floor that looks straight down.
const ABOVE: &str = "
    [[cameras]]
    position_m = [2.0, 1.5, 2.5]
    heading_deg = 90.0
    tilt_deg = 90.0
    horizontal_fov_deg = 60.0
    vertical_fov_deg = 45.0
";

#[test]
fn depth_noise_is_that_of_a_stereo_camera_with_this_baseline() {
    let scenario = small_room(ABOVE);
    let scene = scene_of(&world(&scenario, 1));
    let (image, _) = camera(&scenario, 0).take(&scene, &mut dice(9)).unwrap();
    // The noise is uniform in disparity: 0.08 pixels, plus steps of 1/32.
    let focal = 320.0 / 30_f64.to_radians().tan();
    let expected = focal * 0.05 / 2.5;
    let (mut count, mut sum, mut squares) = (0.0, 0.0, 0.0);
    for pixel in image.pixels().filter(|pixel| pixel.0[0] > 0) {
        let error = focal * 0.05 / (f64::from(pixel.0[0]) / 1000.0) - expected;
        (count, sum, squares) = (count + 1.0, sum + error, squares + error * error);
    }
    let deviation = (0.08_f64.powi(2) + (1.0_f64 / 32.0).powi(2) / 12.0).sqrt();
    assert!((sum / count).abs() < 0.002, "off by {} px", sum / count);
    let found = (squares / count).sqrt();
    assert!((found / deviation - 1.0).abs() < 0.02, "{found} px, not {deviation}");
    let lost = 1.0 - count / (640.0 * 480.0);
    assert!((lost / 0.005 - 1.0).abs() < 0.15, "{lost} lost");
}

#[test]
fn the_calibration_states_the_noise_of_the_depths() {
    for (baseline_m, noise_px) in [(0.05, 0.08), (0.05, 0.24), (0.095, 0.04)] {
        let mut scenario = small_room(ABOVE);
        let depth = &mut scenario.cameras[0].depth;
        (depth.baseline_m, depth.noise_px) = (baseline_m, noise_px);
        let mut camera = camera(&scenario, 0);
        let (image, _) = camera.take(&scene_of(&world(&scenario, 1)), &mut dice(9)).unwrap();
        let measured = image.pixels().filter(|pixel| pixel.0[0] > 0);
        let squares: Vec<f64> =
            measured.map(|pixel| (f64::from(pixel.0[0]) / 1000.0 - 2.5).powi(2)).collect();
        let found = (squares.iter().sum::<f64>() / squares.len() as f64).sqrt();
        let stated = camera.calibration().depth_noise.sigma_m(2.5);
        // The stated constant of one millimetre exceeds the actual rounding.
        assert!((0.0..0.001).contains(&(stated - found)), "{stated} m stated, {found} m found");
    }
}

#[test]
fn objects_cast_a_shadow_without_depth_to_their_left() {
    let mut scenario = small_room(&format!(
        "[[furniture]]
        footprint.box = {{ centre_m = [2.0, 1.5], size_m = [0.6, 0.6] }}
        top_m = 1.2
        {ABOVE}"
    ));
    scenario.cameras[0].depth.noise_px = 0.0;
    scenario.cameras[0].depth.dropout = 0.0;
    let scene = scene_of(&world(&scenario, 1));
    let (image, _) = camera(&scenario, 0).take(&scene, &mut dice(9)).unwrap();
    let row: Vec<u16> = (0..640).map(|column| image.get_pixel(column, 240).0[0]).collect();
    let focal = 320.0 / 30_f64.to_radians().tan();
    // The width of the shadow in columns, for the floor at 2.5 m and the box's top at 1.3 m.
    let shadow = focal * 0.05 * (1.0 / 1.3 - 1.0 / 2.5);
    let (left, right) = (319.5 - focal * 0.3 / 1.3, 319.5 + focal * 0.3 / 1.3);
    for (column, &millimetres) in row.iter().enumerate() {
        let column = column as f64;
        let expected = match column {
            _ if column < left - shadow - 1.0 || column > right + 1.0 => Some(2500),
            _ if column > left + 1.0 && column < right - 1.0 => Some(1300),
            _ if column > left - shadow + 1.0 && column < left - 1.0 => Some(0),
            _ => None,
        };
        if let Some(expected) = expected {
            // Within one disparity step of 1/32 pixel.
            assert!(millimetres.abs_diff(expected) <= 8, "column {column}: {millimetres} mm");
        }
    }
}

#[test]
fn a_tag_lies_where_the_calibration_says_and_shows_its_number() {
    let mut scenario = small_room(
        "[[robots]]
        id = 23
        start = { x_m = 2.2, y_m = 1.4, heading_deg = 37.0 }
        identifier_askew_deg = 5.0
        [[cameras]]
        position_m = [1.4, 0.5, 2.4]
        look_at_m = [2.1, 1.4, 0.0]",
    );
    scenario.cameras[0].picture.noise = 0.0;
    let scene = scene_of(&world(&scenario, 1));
    let mut camera = camera(&scenario, 0);
    let (_, picture) = camera.take(&scene, &mut dice(3)).unwrap();
    let Picture::Grey(picture) = picture else { panic!("expected a grey picture") };
    let lens = camera.calibration().picture.unwrap();
    let turn = DVec2::from_angle(42_f64.to_radians());
    // A position on the tag, in modules ahead and to the left of its centre.
    let pixel = |ahead: f64, left: f64| {
        let at = DVec2::new(2.2, 1.4) + turn.rotate(DVec2::new(ahead, left) * 0.1 / 8.0);
        DVec2::from(lens.project(&Point3::new(at.x, at.y, 0.3)).unwrap())
    };
    let brightness = |at: DVec2| {
        let (column, row) = (at.x.floor(), at.y.floor());
        let part = at - DVec2::new(column, row);
        let get = |dx: u32, dy: u32| {
            f64::from(picture.get_pixel(column as u32 + dx, row as u32 + dy).0[0])
        };
        let upper = get(0, 0) * (1.0 - part.x) + get(1, 0) * part.x;
        let lower = get(0, 1) * (1.0 - part.x) + get(1, 1) * part.x;
        upper * (1.0 - part.y) + lower * part.y
    };
    let white = tag::pattern(23).unwrap();
    for (row, line) in white.iter().enumerate() {
        for (column, &is_white) in line.iter().enumerate() {
            let found = brightness(pixel(4.5 - row as f64, 4.5 - column as f64));
            assert_eq!(found > 100.0, is_white, "module ({column}, {row}): {found}");
        }
    }
    // At each edge of the black square, brightness crosses half way at the edge, on average.
    for (side, name) in [DVec2::X, DVec2::Y, -DVec2::X, -DVec2::Y]
        .into_iter()
        .zip(["ahead", "left", "behind", "right"])
    {
        let mut offsets = Vec::new();
        for step in -30..=30 {
            let edge = side * 4.0 + side.perp() * f64::from(step) / 10.0;
            let at = |out: f64| pixel((edge + side * out).x, (edge + side * out).y);
            let (dark, light) = (brightness(at(-0.5)), brightness(at(0.5)));
            let middle = (dark + light) / 2.0;
            let crossing = (-50..50)
                .map(|part| f64::from(part) / 100.0)
                .find(|&out| brightness(at(out)) >= middle);
            let scale = at(0.5).distance(at(-0.5));
            offsets.push(crossing.unwrap() * scale);
        }
        let mean = offsets.iter().sum::<f64>() / offsets.len() as f64;
        assert!(mean.abs() < 0.1, "the edge {name} is {mean} pixels off");
    }
}

#[test]
fn moving_parts_leave_nothing_behind() {
    let scenario = shrunk(Scenario::built_in().unwrap());
    let mut world = built_in(1);
    let mut camera = camera(&scenario, 0);
    let empty = || Scene { room: world.room.clone(), moving: Vec::new() };
    let before = camera.take(&empty(), &mut dice(2)).unwrap();
    let (room, people) = (world.room.clone(), world.people.len());
    assert!(people > 0);
    for step in 0..20 {
        world.advance(seconds(f64::from(step)));
        let with = camera.take(&scene_of(&world), &mut dice(2)).unwrap();
        assert!(with != before, "nothing in view has moved after {step} s");
    }
    assert!(camera.take(&Scene { room, moving: Vec::new() }, &mut dice(2)).unwrap() == before);
}

#[test]
fn a_changed_room_looks_like_one_built_that_way() {
    let scenario = shrunk(small_room(&format!(
        "[[furniture]]
        footprint.box = {{ centre_m = [1.5, 1.0], size_m = [0.6, 0.4] }}
        top_m = 0.8
        moved = [{{ at_s = 1.0, centre_m = [2.5, 2.0], heading_deg = 30.0 }}]
        [[furniture]]
        footprint.disc = {{ centre_m = [2.0, 1.4], radius_m = 0.3 }}
        bottom_m = 0.4
        top_m = 0.6
        {ABOVE}"
    )));
    let mut world = world(&scenario, 1);
    let (mut seen, mut fresh) = (camera(&scenario, 0), camera(&scenario, 0));
    let before = seen.take(&scene_of(&world), &mut dice(1)).unwrap();
    world.advance(seconds(1.0));
    let after = seen.take(&scene_of(&world), &mut dice(1)).unwrap();
    assert!(before != after);
    assert!(after == fresh.take(&scene_of(&world), &mut dice(1)).unwrap());
}

/// The frames that arrive until a time, polled at an interval (seconds), each with its arrival.
fn frames(world: &mut World, until: f64, interval: f64) -> Vec<(f64, Frame)> {
    let mut frames = Vec::new();
    let mut time = 0.0;
    while time < until {
        time = (time + interval).min(until);
        let arrived = std::iter::from_fn(|| FrameSource::poll(world, seconds(time)));
        frames.extend(arrived.map(|frame| (time, frame)));
    }
    frames
}

#[test]
fn skipped_frames_are_gone_and_the_others_are_as_they_were() {
    let scenario = shrunk(Scenario::built_in().unwrap());
    let all = frames(&mut world(&scenario, 3), 1.0, 1.0);
    let mut world = world(&scenario, 3);
    world.advance(seconds(0.5));
    world.skip_frames(seconds(0.5));
    let left = frames(&mut world, 1.0, 1.0);
    assert!(left.len() > 10 && left.len() < all.len());
    let captured = |it: &(f64, Frame)| (it.1.captured, it.1.camera);
    assert!(left.iter().map(captured).eq(all[all.len() - left.len()..].iter().map(captured)));
}

#[test]
fn frames_depend_on_the_seed_and_not_on_polling() {
    let scenario = shrunk(Scenario::built_in().unwrap());
    let film = |seed: u64, interval: f64| -> Vec<Frame> {
        let frames = frames(&mut world(&scenario, seed), 1.0, interval);
        frames.into_iter().map(|(_, frame)| frame).collect()
    };
    let once = film(3, 1.0);
    assert!(once.len() > 20);
    assert!(once == film(3, 0.0137));
    assert!(once != film(4, 1.0));
}

#[test]
fn frames_arrive_late_out_of_order_or_not_at_all() {
    let mut scenario = small_room(ABOVE);
    let camera = &mut scenario.cameras[0];
    (camera.depth.width, camera.depth.height) = (8, 6);
    (camera.picture.width, camera.picture.height) = (16, 9);
    (camera.lost_frames, camera.latency_jitter_ms) = (0.1, 30.0);
    camera.fails_at_s = Some(90.0);
    let frames = frames(&mut world(&scenario, 1), 100.0, 0.01);
    let captured: Vec<f64> =
        frames.iter().map(|(_, frame)| frame.captured.micros() as f64 / 1e6).collect();
    // Of 1350 frames a tenth is lost; three standard deviations are 33.
    assert!((1350 - captured.len()).abs_diff(135) < 33, "{} arrived", captured.len());
    assert!(captured.iter().all(|&moment| moment < 90.0));
    assert!(captured.windows(2).any(|pair| pair[1] < pair[0]), "all in order");
    let delays = frames.iter().zip(&captured).map(|((arrived, _), captured)| arrived - captured);
    let delays: Vec<f64> = delays.collect();
    assert!(delays.iter().all(|&delay| delay > 0.0599));
    // The sum of latency, mean jitter and half a polling interval.
    let mean = delays.iter().sum::<f64>() / delays.len() as f64;
    assert!((mean - 0.095).abs() < 0.004, "late by {mean} s on average");
}

#[test]
fn postures_have_the_right_heights() {
    for (posture, expected) in [("standing", 1.75), ("sitting", 1.36), ("lying", 0.24)] {
        let scenario = shrunk(small_room(&format!(
            "[[people]]
            waypoints_m = [[2.0, 1.5]]
            posture = \"{posture}\"
            {ABOVE}"
        )));
        let depth = camera(&scenario, 0).exact_depth(&scene_of(&world(&scenario, 1)));
        let nearest = depth.iter().copied().fold(f32::INFINITY, f32::min);
        assert!((2.5 - f64::from(nearest) - expected).abs() < 0.01, "{posture}: {nearest}");
    }
}
