//! A camera that is knocked, and what only looks like it.

use nalgebra::{Matrix3, Point3, Vector6};
use ubimap_protocol::{time::Instant, units::RobotId};

use super::{
    Change, Standing, Steadiness, Witness,
    motion::{lengths, motion, transform},
};
use crate::{
    camera::{Calibration, DepthImage, DepthNoise, Lens},
    perception::{
        markers::{Identifier, Marker, Mount, Placement},
        testing::{Cuboid, lens, noisy, render},
    },
};

/// Two walls, a carton and a cupboard.
const ROOM: [Cuboid; 4] = [
    [[4.0, -9.0, 0.0], [4.2, 9.0, 3.0]],
    [[-9.0, 3.5, 0.0], [9.0, 3.7, 3.0]],
    [[1.5, 0.2, 0.0], [2.1, 0.8, 0.6]],
    [[0.3, 2.2, 0.0], [1.3, 2.8, 1.4]],
];

/// A watch over a camera, which looks five times a second.
struct Scene {
    watch: Steadiness,
    stated: Lens,
    frames: u64,
}

impl Scene {
    fn new() -> Self {
        let stated = lens(320, 240, [0.0, 0.0, 2.8], [1.6, 1.3, 0.0]);
        let watch = Steadiness::new(stated.intrinsics(), DepthNoise::D435, *stated.pose());
        Self { watch, stated, frames: 0 }
    }

    /// The camera after a motion.
    fn moved(&self, motion: &Vector6<f64>) -> Lens {
        let pose = self.stated.pose() * transform(motion);
        Lens::new(*self.stated.intrinsics(), pose).unwrap()
    }

    /// Looks at an image with fresh noise; returns the change and its time in seconds.
    fn look(&mut self, exact: &DepthImage, is_accused: bool) -> Option<(f64, Change)> {
        self.frames += 1;
        let image = noisy(exact, &DepthNoise::D435, self.frames, 980);
        let change = self.watch.look(&image, self.now(), &[], is_accused)?;
        Some((self.frames as f64 / 5.0, change))
    }

    fn now(&self) -> Instant {
        Instant(self.frames * 200_000)
    }

    /// Looks for some seconds, and asserts that nothing is noticed.
    #[track_caller]
    fn assert_steady(&mut self, exact: &DepthImage, seconds: u64) {
        for _ in 0..5 * seconds {
            assert_eq!(self.look(exact, false), None, "frame {}", self.frames);
            assert_eq!(self.watch.standing(), Standing::Steady);
        }
    }
}

#[test]
fn knocks_in_all_directions_are_noticed_and_measured() {
    let mut learnt = Scene::new();
    let room = render(&learnt.stated, 0.0, &ROOM);
    learnt.assert_steady(&room, 12);
    for axis in 0..6 {
        let mut knock = Vector6::zeros();
        knock[axis] = if axis < 3 { 0.03 } else { -2.0_f64.to_radians() };
        let mut scene =
            Scene { watch: learnt.watch.clone(), stated: learnt.stated, frames: learnt.frames };
        let room = render(&scene.moved(&knock), 0.0, &ROOM);
        let changes: Vec<_> = (0..60).filter_map(|_| scene.look(&room, false)).collect();
        let [(noticed, Change::Knocked { since, .. }), (returned, Change::Returned(pose))] =
            changes[..]
        else {
            panic!("axis {axis}: {changes:?}")
        };
        // One image more may pass where the view tells a direction badly.
        let knocked = learnt.now().0;
        assert!((knocked - 2_000_000..=knocked + 200_000).contains(&since.0), "{since:?}");
        assert!(noticed < 12.0 + 5.0 && returned < 12.0 + 10.0, "{noticed}, {returned}");
        let error = motion(&scene.moved(&knock).pose().inv_mul(&pose));
        let [metres, radians] = lengths(&error);
        assert!(metres < 0.005 && radians < 0.002_5, "axis {axis}: {error}");
    }
}

#[test]
fn people_furniture_and_a_covered_lens_are_no_knock() {
    let mut scene = Scene::new();
    let room = render(&scene.stated, 0.0, &ROOM);
    scene.assert_steady(&room, 8);
    // Somebody who stands close.
    let person = [[0.7, 0.3, 0.0], [1.2, 0.8, 1.8]];
    let busy: Vec<Cuboid> = ROOM.iter().copied().chain([person]).collect();
    scene.assert_steady(&render(&scene.stated, 0.0, &busy), 6);
    // The carton and the cupboard are moved, and stay there.
    let mut changed = ROOM;
    changed[2] = [[2.4, 0.6, 0.0], [3.0, 1.2, 0.6]];
    changed[3] = [[1.3, 2.6, 0.0], [2.3, 3.2, 1.4]];
    let changed = render(&scene.stated, 0.0, &changed);
    scene.assert_steady(&changed, 45);
    scene.assert_steady(&DepthImage::from_pixel(320, 240, image::Luma([300])), 6);
    scene.assert_steady(&DepthImage::new(320, 240), 6);
    scene.assert_steady(&changed, 6);
}

/// As from a camera with half the pixels along each side: robots hardly stand out from its noise.
#[test]
fn neither_noise_nor_robots_that_drive_away_are_a_drift() {
    let noise = DepthNoise::new(0.001, 0.009_5).unwrap();
    let robot = |[x, y]: [f64; 2]| [[x - 0.17, y - 0.17, 0.0], [x + 0.17, y + 0.17, 0.15]];
    let robots = [[0.8, 0.7], [1.3, 1.6], [2.0, 0.9]].map(robot);
    let stated = lens(320, 240, [0.0, 0.0, 2.6], [1.6, 1.3, 0.0]);
    let parked: Vec<Cuboid> = ROOM.into_iter().chain(robots).collect();
    let (parked, away) = (render(&stated, 0.0, &parked), render(&stated, 0.0, &ROOM));
    let mut watch = Steadiness::new(stated.intrinsics(), noise, *stated.pose());
    for frame in 0..700 {
        let image = noisy(if frame < 60 { &parked } else { &away }, &noise, frame, 980);
        let change = watch.look(&image, Instant(frame * 200_000), &[], false);
        assert_eq!(change, None, "frame {frame}");
    }
}

#[test]
fn a_turn_above_a_bare_floor_is_told_by_neighbours() {
    let stated = lens(320, 240, [0.0, 0.0, 2.8], [0.0, 0.0, 0.0]);
    let watch = Steadiness::new(stated.intrinsics(), DepthNoise::D435, *stated.pose());
    let mut scene = Scene { watch, stated, frames: 0 };
    let calibration =
        Calibration { depth: Some(stated), picture: Some(stated), ..Calibration::default() };
    let mount = Mount::centred(RobotId(1), 0.16, 0.3);
    let identifier = Identifier::Tag(1);
    let points = mount.points(identifier);
    // A robot that drives round, as a camera sees it, and its pose by others.
    let witness = |camera: &Lens, frame: u64| {
        let angle = frame as f64 * 0.05;
        let (x, y) = (0.9 * libm::cos(angle), 0.9 * libm::sin(angle));
        let pixel = |&[ahead, left]: &[f64; 2]| {
            camera.project(&Point3::new(x + ahead, y + left, 0.3)).unwrap()
        };
        let marker =
            Marker { identifier, points: points.iter().map(pixel).collect(), noise_px: 0.1 };
        let covariance = Matrix3::identity() * 1e-6;
        let place = Placement { position_m: [x, y], heading_rad: 0.0, covariance };
        vec![Witness { marker, points: points.clone(), height_m: 0.3, place }]
    };
    let play = |scene: &mut Scene, camera: &Lens, frames: u64| {
        let room = render(camera, 0.0, &[]);
        let mut changes = Vec::new();
        for _ in 0..frames {
            let is_accused = scene.watch.is_accused();
            changes.extend(scene.look(&room, is_accused));
            scene.watch.hear(&calibration, &witness(camera, scene.frames), scene.now());
        }
        changes
    };
    assert_eq!(play(&mut scene, &stated, 50), []);
    let turn = Vector6::new(0.0, 0.0, 0.0, 0.0, 0.0, 2.0_f64.to_radians());
    let turned = scene.moved(&turn);
    let changes = play(&mut scene, &turned, 150);
    let [(noticed, Change::Knocked { .. }), (returned, Change::Returned(pose))] = changes[..]
    else {
        panic!("{changes:?}")
    };
    assert!(noticed < 10.0 + 5.0 && returned < 10.0 + 30.0, "{noticed}, {returned}");
    let [metres, radians] = lengths(&motion(&turned.pose().inv_mul(&pose)));
    assert!(metres < 0.01 && radians < 0.003_5, "{metres} m, {radians}");
}
