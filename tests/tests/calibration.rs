//! `ubimap calibrate` against the true poses of rooms whose cameras see landmarks with noise.
//!
//! This command prints the table of `tests/README.md`, and fails if a figure exceeds its bound:
//!
//! ```sh
//! cargo test --release -p ubimap-tests --test calibration -- --nocapture --test-threads 1 --include-ignored
//! ```
//!
//! `tests/calibration` holds the first instance of each kind; `UBIMAP_WRITE_INSTANCES=1` writes
//! them again.

use std::{fs, path::Path};

use instances::{Instance, Ring, grid};
use nalgebra::Isometry3;
use ubimap_sim_host::{
    calibration::{
        calibrating::{CalibrateError, Calibrated, Options, calibrate},
        observations::Observations,
        refine::Weighting,
    },
    camera::{CamerasFile, MountedCamera},
};

#[path = "calibration/instances.rs"]
mod instances;

/// Position in metres and angle in degrees.
type Pair = [f64; 2];

/// Errors of the poses against the truth.
#[derive(Default)]
struct Errors {
    position_m: Vec<f64>,
    angle_deg: Vec<f64>,
}

impl Errors {
    /// Adds every camera except the reference, whose pose is known.
    fn add<'a>(
        &mut self,
        poses: impl Iterator<Item = Option<&'a Isometry3<f64>>>,
        truth: &[Isometry3<f64>],
    ) {
        for (pose, truth) in poses.zip(truth).skip(1) {
            let pose = pose.expect("a pose for every camera");
            self.position_m.push((pose.translation.vector - truth.translation.vector).norm());
            self.angle_deg.push(pose.rotation.angle_to(&truth.rotation).to_degrees());
        }
        self.position_m.sort_by(f64::total_cmp);
        self.angle_deg.sort_by(f64::total_cmp);
    }

    fn median(&self) -> Pair {
        [&self.position_m, &self.angle_deg].map(|it| it[it.len() / 2])
    }

    fn greatest(&self) -> Pair {
        [&self.position_m, &self.angle_deg].map(|it| it[it.len() - 1])
    }
}

fn solve(instance: &Instance, weighting: Weighting) -> Result<Calibrated, CalibrateError> {
    let reference_pose = Some(instance.truth[0]);
    let options = Options { reference_pose, weighting, ..Options::default() };
    calibrate(&instance.observations, &options)
}

/// Errors after and before the global optimisation.
fn errors(instances: &[Instance], weighting: Weighting) -> [Errors; 2] {
    let mut errors = [Errors::default(), Errors::default()];
    for instance in instances {
        let calibrated = solve(instance, weighting).unwrap();
        let cameras = || calibrated.cameras.iter();
        errors[0].add(cameras().map(|it| it.pose.as_ref()), &instance.truth);
        errors[1].add(cameras().map(|it| it.propagated.as_ref()), &instance.truth);
    }
    errors
}

/// Prints a row: median and maximum, and the median before the global optimisation.
fn print(what: &str, [refined, propagated]: &[Errors; 2]) {
    let show = |[metres, degrees]: Pair| format!("{:.1} mm, {degrees:.3} degrees", 1000.0 * metres);
    let [median, greatest] = [refined.median(), refined.greatest()].map(show);
    println!("| {what} | {median} | {greatest} | {} |", show(propagated.median()));
}

/// Fails if a position or an angle exceeds its bound.
fn hold(what: &str, measured: Pair, bound: Pair) {
    let is_within = measured[0] <= bound[0] && measured[1] <= bound[1];
    assert!(is_within, "{what}: {measured:?} exceeds {bound:?}");
}

fn rings(ring: Ring) -> Vec<Instance> {
    (1..=20).map(|seed| ring.draw(seed)).collect()
}

#[test]
fn a_ring_is_calibrated_to_millimetres() {
    let ring = Ring::averaged();
    for (what, ring, median, greatest) in [
        ("ring of 8", ring, [0.005, 0.1], [0.010, 0.2]),
        ("the same, 20 % wrong", Ring { wrong: 0.2, ..ring }, [0.010, 0.2], [0.020, 0.4]),
    ] {
        let instances = rings(ring);
        let weighted = errors(&instances, Weighting::Covariance);
        print(what, &weighted);
        hold(what, weighted[0].median(), median);
        hold(what, weighted[0].greatest(), greatest);
        hold(what, weighted[0].median(), weighted[1].median().map(|it| 0.5 * it));
        print(&format!("{what}, unweighted"), &errors(&instances, Weighting::Unweighted));
    }
    // Without floors the landmarks alone give tilt and height.
    let bare = errors(&rings(Ring { floors: false, ..ring }), Weighting::Covariance);
    print("ring of 8 without floors", &bare);
    hold("without floors", bare[0].median(), bare[1].median().map(|it| 0.5 * it));
}

#[test]
fn a_grid_of_cameras_is_calibrated_from_one_frame() {
    for (what, wrong, bound) in
        [("grid of 16", 0.0, [0.065, 0.88]), ("grid of 16, 20 % wrong", 0.2, [0.130, 1.76])]
    {
        let instances: Vec<Instance> = (1..=5).map(|seed| grid(seed, wrong)).collect();
        for weighting in [Weighting::Covariance, Weighting::Unweighted] {
            let found = errors(&instances, weighting);
            print(&format!("{what}, {weighting:?}"), &found);
            hold(what, found[0].median(), bound);
        }
    }
}

#[test]
fn exact_landmarks_give_exact_poses() {
    let exact = Ring { noise: None, floors: false, ..Ring::averaged() };
    for (what, ring) in [("exact", exact), ("exact, 20 % wrong", Ring { wrong: 0.2, ..exact })] {
        for weighting in [Weighting::Covariance, Weighting::Unweighted] {
            let found = errors(&rings(ring), weighting);
            let [metres, degrees] = found[0].greatest();
            println!("| {what}, {weighting:?} | | {metres:.0e} m, {degrees:.0e} degrees | |");
            hold(what, [metres, degrees], [1e-9; 2]);
        }
    }
}

/// The standard deviations that a calibration states are those of its errors.
#[test]
fn errors_are_as_large_as_stated() {
    for (what, instances) in [
        ("ring", rings(Ring { floors: false, ..Ring::averaged() })),
        ("grid", (1..=5).map(|seed| grid(seed, 0.0)).collect()),
    ] {
        for weighting in [Weighting::Covariance, Weighting::Unweighted] {
            let (mut sum, mut count) = ([0.0; 2], 0.0);
            for instance in &instances {
                let calibrated = solve(instance, weighting).unwrap();
                for (camera, truth) in calibrated.cameras.iter().zip(&instance.truth).skip(1) {
                    let pose = camera.pose.unwrap();
                    let apart = pose.translation.vector - truth.translation.vector;
                    sum[0] += (apart.norm() / camera.position_sigma_m()).powi(2);
                    let angle = pose.rotation.angle_to(&truth.rotation);
                    sum[1] += (angle / camera.angle_sigma_rad()).powi(2);
                    count += 1.0;
                }
            }
            let ratios = sum.map(|it| f64::sqrt(it / count));
            println!("{what}, {weighting:?}: errors are {ratios:.2?} times the stated sigmas");
            assert!(ratios.iter().all(|it| (0.7..1.4).contains(it)), "{what}: {ratios:?}");
        }
    }
}

/// How calibrations of unlabelled landmarks ended.
#[derive(Debug, Default, PartialEq)]
struct Outcomes {
    right: usize,
    /// Reported: an error, or cameras without a pose.
    failed: usize,
    /// A pose that is wrong.
    wrong: usize,
}

fn unlabelled(ring: Ring) -> Outcomes {
    let mut outcomes = Outcomes::default();
    for seed in 1..=100 {
        let instance = Ring { is_labelled: false, ..ring }.draw(seed);
        let Ok(calibrated) = solve(&instance, Weighting::Covariance) else {
            outcomes.failed += 1;
            continue;
        };
        let found = calibrated.cameras.iter().zip(&instance.truth).filter_map(|(camera, truth)| {
            let pose = camera.pose?;
            let metres = (pose.translation.vector - truth.translation.vector).norm();
            let degrees = pose.rotation.angle_to(&truth.rotation).to_degrees();
            Some(metres < 0.02 && degrees < 0.4)
        });
        let found: Vec<bool> = found.collect();
        match found {
            _ if found.contains(&false) => outcomes.wrong += 1,
            _ if found.len() < instance.truth.len() => outcomes.failed += 1,
            _ => outcomes.right += 1,
        }
    }
    outcomes
}

#[test]
fn unlabelled_landmarks_are_matched_or_reported() {
    let outcomes = unlabelled(Ring::averaged());
    println!("| 6 unlabelled landmarks an overlap, 100 seeds | {outcomes:?} | | |");
    assert!(outcomes.right >= 99 && outcomes.wrong == 0, "{outcomes:?}");
}

#[test]
#[ignore = "takes a minute"]
fn many_or_few_unlabelled_landmarks_are_matched_or_reported() {
    for (per_overlap, least) in [(5, 90), (8, 99), (12, 99)] {
        let outcomes = unlabelled(Ring { per_overlap, ..Ring::averaged() });
        println!("| {per_overlap} unlabelled landmarks an overlap, 100 seeds | {outcomes:?} | | |");
        assert!(outcomes.right >= least && outcomes.wrong == 0, "{outcomes:?}");
    }
}

/// The committed instances are those of the generator, to the digits that they have.
#[test]
fn committed_instances_are_those_of_the_generator() {
    let ring = Ring::averaged();
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("calibration");
    for (name, instance) in [
        ("ring-8", ring.draw(1)),
        ("ring-8-wrong", Ring { wrong: 0.2, ..ring }.draw(1)),
        ("ring-8-unlabelled", Ring { is_labelled: false, ..ring }.draw(1)),
        ("grid-16", grid(1, 0.0)),
        ("grid-16-wrong", grid(1, 0.2)),
    ] {
        let [path, truth] = ["", "-truth"].map(|it| folder.join(format!("{name}{it}.toml")));
        if std::env::var_os("UBIMAP_WRITE_INSTANCES").is_some() {
            fs::create_dir_all(&folder).unwrap();
            fs::write(&path, instance.rounded().to_toml()).unwrap();
            fs::write(&truth, cameras_file(&instance).to_toml()).unwrap();
        }
        let read = Observations::parse(&fs::read_to_string(path).unwrap()).unwrap();
        for (read, drawn) in read.cameras.iter().zip(&instance.observations.cameras) {
            assert_eq!(read.landmarks.len(), drawn.landmarks.len());
            for (read, drawn) in read.landmarks.iter().zip(&drawn.landmarks) {
                assert_eq!(read.label, drawn.label);
                assert!((read.position - drawn.position).norm() < 1e-4);
            }
        }
        let truth = CamerasFile::parse(&fs::read_to_string(truth).unwrap()).unwrap();
        for (camera, pose) in truth.cameras.iter().zip(&instance.truth) {
            let read = camera.pose().unwrap();
            assert!((read.to_homogeneous() - pose.to_homogeneous()).norm() < 1e-6);
        }
    }
}

fn cameras_file(instance: &Instance) -> CamerasFile {
    let named = instance.observations.cameras.iter().zip(&instance.truth);
    let cameras = named.map(|(seen, pose)| {
        let mut camera = MountedCamera { name: seen.name.clone(), ..MountedCamera::default() };
        camera.set_pose(pose);
        camera
    });
    CamerasFile { cameras: cameras.collect() }
}

/// The squared errors of the positions and of the angles of all cameras, in their stated variances, in
/// order.
fn squared_sigmas(instances: &[Instance]) -> [Vec<f64>; 2] {
    let mut squared = [Vec::new(), Vec::new()];
    for Instance { observations, truth } in instances {
        let options = Options { reference_pose: Some(truth[0]), ..Options::default() };
        let found = calibrate(observations, &options).unwrap();
        for (camera, truth) in found.cameras.iter().zip(truth).skip(1) {
            let pose = camera.pose.unwrap();
            let metres = (pose.translation.vector - truth.translation.vector).norm();
            let radians = pose.rotation.angle_to(&truth.rotation);
            squared[0].push((metres / camera.position_sigma_m()).powi(2));
            squared[1].push((radians / camera.angle_sigma_rad()).powi(2));
        }
    }
    squared.iter_mut().for_each(|it| it.sort_by(f64::total_cmp));
    squared
}

/// Landmarks that were placed by a floor have its error in common, which the stated standard deviations
/// cover. If these counted the landmarks as independent, the angles would be off by more.
#[test]
fn stated_deviations_cover_the_common_error_of_a_floor() {
    let mut instances: Vec<Instance> = (0..40).map(instances::placed_by_floors).collect();
    let summary = |squared: &[Vec<f64>; 2]| {
        let median = squared.each_ref().map(|it| it[it.len() / 2]);
        let mean = squared.each_ref().map(|it| it.iter().sum::<f64>() / it.len() as f64);
        (median, mean)
    };
    let (median, mean) = summary(&squared_sigmas(&instances));
    println!("squared errors in variances: median {median:.2?}, mean {mean:.2?}");
    assert!(median.iter().all(|it| (0.5..2.0).contains(it)), "{median:?}");
    assert!(mean.iter().all(|it| (0.7..1.4).contains(it)), "{mean:?}");
    for camera in instances.iter_mut().flat_map(|it| &mut it.observations.cameras) {
        camera.floor.as_mut().unwrap().placing = None;
    }
    let (as_independent, _) = summary(&squared_sigmas(&instances));
    println!("as independent: median {as_independent:.2?}");
    assert!(as_independent[0] > 2.0 * median[0], "{as_independent:?}");
}
