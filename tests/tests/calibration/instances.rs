//! Rooms with cameras of known poses that see landmarks with the noise of a D435.

use nalgebra::{Isometry3, Matrix3, Point3, Translation3, UnitQuaternion, Vector3};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ubimap_sim_host::{
    calibration::{
        observations::{CameraObservations, Floor, Landmark, Observations},
        point_noise::PointNoise,
    },
    camera::{DepthNoise, Orientation},
};

/// Half of the field of view of a D435's depth sensor, as tangents.
const VIEW: [f64; 2] = [0.949, 0.554];
/// Range of the depth, in metres.
const RANGE_M: [f64; 2] = [0.3, 6.0];
/// Standard deviations of a floor's plane, which is fitted to thousands of pixels.
const FLOOR_SIGMA_DEG: f64 = 0.1;
const FLOOR_SIGMA_M: f64 = 0.005;
/// Radius of the ring, in metres: neighbours are 2.4 m apart, and their views are 5.3 m wide.
const RADIUS_M: f64 = 3.2;
/// Random numbers never used: a bound on the attempts to place a landmark.
const ATTEMPTS: usize = 1_000_000;

/// Observations and the poses that they come from.
pub(crate) struct Instance {
    pub(crate) observations: Observations,
    pub(crate) truth: Vec<Isometry3<f64>>,
}

impl Instance {
    /// The observations, to hundredths of a millimetre.
    pub(crate) fn rounded(&self) -> Observations {
        let mut rounded = self.observations.clone();
        for landmark in rounded.cameras.iter_mut().flat_map(|it| &mut it.landmarks) {
            landmark.position.iter_mut().for_each(|it| *it = (*it * 1e5).round() / 1e5);
        }
        rounded
    }
}

/// How a ring of eight cameras is seen.
#[derive(Clone, Copy)]
pub(crate) struct Ring {
    pub(crate) noise: Option<PointNoise>,
    pub(crate) floors: bool,
    pub(crate) is_labelled: bool,
    /// The fraction of wrong pairs.
    pub(crate) wrong: f64,
    pub(crate) per_overlap: usize,
}

impl Ring {
    /// A D435 whose landmarks are averaged over 100 frames; six in each overlap.
    pub(crate) fn averaged() -> Self {
        Self {
            noise: Some(PointNoise::D435.averaged(100)),
            floors: true,
            is_labelled: true,
            wrong: 0.0,
            per_overlap: 6,
        }
    }

    /// Eight cameras at 2.8 m on a circle, looking down within a few degrees. Every landmark is in
    /// the overlap of two neighbours.
    pub(crate) fn draw(&self, seed: u64) -> Instance {
        let mut dice = ChaCha8Rng::seed_from_u64(seed);
        let truth: Vec<Isometry3<f64>> = (0..8)
            .map(|index| {
                let angle = f64::from(index) * std::f64::consts::FRAC_PI_4;
                // The wide side of the image is along the circle.
                pose(&mut dice, [RADIUS_M * angle.cos(), RADIUS_M * angle.sin(), 2.8], angle, 0.08)
            })
            .collect();
        let mut landmarks = Vec::new();
        for first in 0..8 {
            let second = (first + 1) % 8;
            let mut found = 0;
            for _ in 0..ATTEMPTS {
                let at = [6.0, 6.0, 0.5].map(|it| dice.random_range(-it..it));
                let point = Point3::new(at[0], at[1], at[2] + 0.5);
                let both = [first, second].iter().all(|&it| sees(&truth[it], &point))
                    && truth.iter().filter(|it| sees(it, &point)).count() == 2;
                let is_clear = landmarks.iter().all(|it| nalgebra::distance(it, &point) > 0.2);
                if both && is_clear {
                    landmarks.push(point);
                    found += 1;
                    if found == self.per_overlap {
                        break;
                    }
                }
            }
        }
        let mut instance = film(&mut dice, truth, &landmarks, self.noise);
        // Ten of 48 pairs are wrong: two in every overlap that is hit.
        let hit = (self.wrong * 8.0 * self.per_overlap as f64 / 2.0).round() as usize;
        for overlap in 0..hit {
            let labels = [0, 1].map(|it| (overlap * self.per_overlap + it).to_string());
            swap(&mut instance, overlap, labels);
        }
        if self.floors {
            add_floors(&mut dice, &mut instance);
        }
        if !self.is_labelled {
            remove_labels(&mut dice, &mut instance);
        }
        instance
    }
}

/// Sixteen cameras in a grid of 4 x 4 and 400 landmarks, seen in one frame with 4 mm across the
/// ray and 18 mm along it; a fraction of the pairs is wrong.
pub(crate) fn grid(seed: u64, wrong: f64) -> Instance {
    let mut dice = ChaCha8Rng::seed_from_u64(seed);
    let truth: Vec<Isometry3<f64>> = (0..16)
        .map(|index| {
            let (column, row) = (f64::from(index % 4), f64::from(index / 4));
            pose(&mut dice, [3.6 * column, 2.2 * row, 2.8], std::f64::consts::FRAC_PI_2, 0.08)
        })
        .collect();
    let mut landmarks = Vec::new();
    while landmarks.len() < 400 {
        let at = [dice.random_range(-2.0..12.8), dice.random_range(-1.5..8.1)];
        let point = Point3::new(at[0], at[1], dice.random_range(0.0..1.0));
        if truth.iter().filter(|it| sees(it, &point)).count() >= 2 {
            landmarks.push(point);
        }
    }
    let depth = DepthNoise::new(0.018, 0.0).unwrap();
    let noise = PointNoise::new(0.004, depth).unwrap();
    let mut instance = film(&mut dice, truth, &landmarks, Some(noise));
    // A pair is wrong if either of its sightings is.
    let share = 1.0 - (1.0 - wrong).sqrt();
    for camera in &mut instance.observations.cameras {
        for landmark in &mut camera.landmarks {
            if dice.random_bool(share) {
                let z = dice.random_range(1.8..2.8);
                let [x, y] = VIEW.map(|it| z * dice.random_range(-it..it));
                landmark.position = Point3::new(x, y, z);
            }
        }
    }
    instance
}

/// A camera that looks down; its image's top is towards `heading_rad`.
fn pose(dice: &mut impl Rng, at: [f64; 3], heading_rad: f64, askew_rad: f64) -> Isometry3<f64> {
    let mut askew = || dice.random_range(-askew_rad..askew_rad);
    let orientation = Orientation {
        heading_rad: heading_rad + askew(),
        tilt_rad: std::f64::consts::FRAC_PI_2 + askew(),
        roll_rad: askew(),
    };
    Isometry3::from_parts(Translation3::from(at), orientation.rotation())
}

fn sees(pose: &Isometry3<f64>, point: &Point3<f64>) -> bool {
    let at = pose.inverse_transform_point(point);
    let is_in_view = (at.x / at.z).abs() < VIEW[0] && (at.y / at.z).abs() < VIEW[1];
    is_in_view && (RANGE_M[0]..RANGE_M[1]).contains(&at.z)
}

/// What the cameras see of the landmarks, labelled by their numbers.
fn film(
    dice: &mut impl Rng,
    truth: Vec<Isometry3<f64>>,
    landmarks: &[Point3<f64>],
    noise: Option<PointNoise>,
) -> Instance {
    let cameras = truth.iter().enumerate().map(|(index, pose)| {
        let seen = landmarks.iter().enumerate().filter(|(_, point)| sees(pose, point));
        let seen = seen.map(|(label, point)| {
            let exact = pose.inverse_transform_point(point);
            let position = noise.map_or(exact, |noise| measured(dice, &exact, &noise));
            let noise = noise.unwrap_or_default();
            Landmark { position, label: Some(label.to_string()), noise }
        });
        CameraObservations {
            name: format!("camera-{index:02}"),
            landmarks: seen.collect(),
            floor: None,
        }
    });
    Instance { observations: Observations { cameras: cameras.collect() }, truth }
}

/// A point whose depth is wrong, which moves it along its ray, and whose pixel is wrong.
fn measured(dice: &mut impl Rng, exact: &Point3<f64>, noise: &PointNoise) -> Point3<f64> {
    let depth = exact.z + noise.depth().sigma_m(exact.z) * normal(dice);
    let along = exact.coords * (depth / exact.z);
    let across = Vector3::from_fn(|_, _| noise.lateral_m() * normal(dice));
    let ray = exact.coords.normalize();
    Point3::from(along + across - ray * ray.dot(&across))
}

/// A normally distributed number (Box and Muller).
fn normal(dice: &mut impl Rng) -> f64 {
    let (one, other): (f64, f64) = (dice.random_range(f64::MIN_POSITIVE..1.0), dice.random());
    (-2.0 * one.ln()).sqrt() * (2.0 * std::f64::consts::PI * other).cos()
}

fn add_floors(dice: &mut impl Rng, instance: &mut Instance) {
    for (camera, pose) in instance.observations.cameras.iter_mut().zip(&instance.truth) {
        let sigma = FLOOR_SIGMA_DEG.to_radians();
        let askew = Vector3::new(sigma * normal(dice), sigma * normal(dice), 0.0);
        let up = UnitQuaternion::new(askew) * Vector3::z();
        let height_m = pose.translation.z + FLOOR_SIGMA_M * normal(dice);
        let floor = Floor::new(pose.rotation.inverse() * up, height_m).unwrap();
        camera.floor =
            Some(Floor { normal_sigma_rad: sigma, height_sigma_m: FLOOR_SIGMA_M, ..floor });
    }
}

/// A ring whose landmarks are markers of known heights, placed where their rays meet the floor that the
/// camera sees, as in recordings: the error of a floor is common to the landmarks of its camera.
pub(crate) fn placed_by_floors(seed: u64) -> Instance {
    let mut instance = Ring { noise: None, ..Ring::averaged() }.draw(seed);
    let mut dice = ChaCha8Rng::seed_from_u64(!seed);
    let noise = PointNoise::new(0.002, DepthNoise::new(0.002, 0.0).unwrap()).unwrap();
    for (camera, pose) in instance.observations.cameras.iter_mut().zip(&instance.truth) {
        let floor = camera.floor.as_mut().unwrap();
        let variances = [floor.normal_sigma_rad, floor.normal_sigma_rad, floor.height_sigma_m];
        floor.placing = Some(Matrix3::from_diagonal(&Vector3::from(variances.map(|it| it * it))));
        for landmark in &mut camera.landmarks {
            let height_m = (pose * landmark.position).z;
            let ray = landmark.position.coords;
            let along = (height_m - floor.height_m) / floor.normal.dot(&ray);
            landmark.position = measured(&mut dice, &Point3::from(ray * along), &noise);
            landmark.noise = noise;
        }
    }
    instance
}

/// Exchanges two labels in one camera.
fn swap(instance: &mut Instance, camera: usize, [one, other]: [String; 2]) {
    for landmark in &mut instance.observations.cameras[camera].landmarks {
        let label = landmark.label.as_mut().unwrap();
        if *label == one {
            *label = other.clone();
        } else if *label == other {
            *label = one.clone();
        }
    }
}

/// Removes the labels and mixes the landmarks.
fn remove_labels(dice: &mut impl Rng, instance: &mut Instance) {
    for camera in &mut instance.observations.cameras {
        let landmarks = &mut camera.landmarks;
        landmarks.iter_mut().for_each(|it| it.label = None);
        for index in (1..landmarks.len()).rev() {
            landmarks.swap(index, dice.random_range(0..=index));
        }
    }
}
