//! `ubimap calibrate` against the true poses of rooms with simulated noise.
//!
//! ```sh
//! cargo test --release -p ubimap-tests --test calibration -- --nocapture --test-threads 1
//! ```

use std::f64::consts::PI;

use instances::{Instance, Ring, grid};
use nalgebra::Isometry3;
use ubimap_sim_host::calibration::{
    calibrating::{CalibrateError, Calibrated, Options, calibrate},
    refine::Weighting,
};

#[path = "calibration/instances.rs"]
mod instances;

/// Errors of poses against the truth, sorted: metres and degrees.
#[derive(Default)]
struct Errors {
    position_m: Vec<f64>,
    angle_deg: Vec<f64>,
}

impl Errors {
    /// The reference camera, whose pose is known, doesn't count.
    fn add<'a>(
        &mut self,
        poses: impl Iterator<Item = Option<&'a Isometry3<f64>>>,
        truth: &[Isometry3<f64>],
    ) {
        for (pose, truth) in poses.zip(truth).skip(1) {
            let Some(pose) = pose else {
                println!("untied");
                continue;
            };
            let apart = pose.translation.vector - truth.translation.vector;
            self.position_m.push(apart.norm());
            self.angle_deg.push(pose.rotation.angle_to(&truth.rotation) * 180.0 / PI);
        }
        self.position_m.sort_by(f64::total_cmp);
        self.angle_deg.sort_by(f64::total_cmp);
    }

    /// In metres and degrees.
    fn median(&self) -> [f64; 2] {
        [&self.position_m, &self.angle_deg].map(|it| it[it.len() / 2])
    }

    /// In metres and degrees.
    fn greatest(&self) -> [f64; 2] {
        [&self.position_m, &self.angle_deg].map(|it| it[it.len() - 1])
    }

    fn print(&self, what: &str) {
        let ([median, turn], [most, most_turn]) = (self.median(), self.greatest());
        println!(
            "| {what} | {:.2} mm, {turn:.3} degrees | {:.2} mm, {most_turn:.3} degrees |",
            1000.0 * median,
            1000.0 * most,
        );
    }
}

fn solve(instance: &Instance, weighting: Weighting) -> Result<Calibrated, CalibrateError> {
    let reference_pose = Some(instance.truth[0]);
    calibrate(&instance.observations, &Options { reference_pose, weighting, ..Options::default() })
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

#[test]
fn a_ring_is_calibrated_to_millimetres() {
    let draw = |ring: Ring| (1..=20).map(|seed| ring.draw(seed)).collect::<Vec<_>>();
    let averaged = Ring::averaged();
    for (what, ring) in [
        ("ring, floors", averaged),
        ("ring, no floors", Ring { floors: false, ..averaged }),
        ("ring, floors, 20 % wrong", Ring { wrong: 0.2, ..averaged }),
        ("ring, no floors, 20 % wrong", Ring { wrong: 0.2, floors: false, ..averaged }),
    ] {
        let instances = draw(ring);
        for weighting in [Weighting::Covariance, Weighting::Unweighted] {
            let [refined, propagated] = errors(&instances, weighting);
            refined.print(&format!("{what}, {weighting:?}"));
            propagated.print(&format!("{what}, propagated"));
        }
    }
}

#[test]
fn a_grid_of_cameras_is_calibrated_from_one_frame() {
    for wrong in [0.0, 0.2] {
        let instances: Vec<Instance> = (1..=5).map(|seed| grid(seed, wrong)).collect();
        for weighting in [Weighting::Covariance, Weighting::Unweighted] {
            let [refined, propagated] = errors(&instances, weighting);
            refined.print(&format!("grid, {wrong} wrong, {weighting:?}"));
            propagated.print(&format!("grid, {wrong} wrong, propagated"));
        }
    }
}

#[test]
fn exact_landmarks_give_exact_poses() {
    let exact = Ring { noise: None, floors: false, ..Ring::averaged() };
    for (what, ring) in [("exact", exact), ("exact, 20 % wrong", Ring { wrong: 0.2, ..exact })] {
        for weighting in [Weighting::Covariance, Weighting::Unweighted] {
            let [refined, _] = errors(&[ring.draw(1), ring.draw(2)], weighting);
            println!("{what}: {:?}", refined.greatest());
        }
    }
}

#[test]
fn unlabelled() {
    for (noise, per_overlap) in [(true, 6), (true, 8)] {
        let ring = Ring { is_labelled: false, floors: true, per_overlap, ..Ring::averaged() };
        let ring = if noise { ring } else { Ring { noise: None, ..ring } };
        let (mut right, mut failed, mut wrong) = (0, 0, 0);
        let mut ambiguous = 0;
        for seed in 1..=100 {
            let instance = ring.draw(seed);
            match solve(&instance, Weighting::Covariance) {
                Ok(it) if it.untied().next().is_none() => {
                    let mut errors = Errors::default();
                    errors.add(it.cameras.iter().map(|it| it.pose.as_ref()), &instance.truth);
                    let [m, deg] = errors.greatest();
                    if m < 0.03 && deg < 0.6 {
                        right += 1
                    } else {
                        wrong += 1;
                        println!("seed {seed}: {m} {deg}")
                    }
                    ambiguous += usize::from(it.edges.len() != 8);
                    if it.edges.len() != 8 {
                        println!(
                            "seed {seed} edges {} {:?}",
                            it.edges.len(),
                            it.failures
                                .iter()
                                .filter(|f| f.cameras[1] - f.cameras[0] == 1
                                    || f.cameras[1] - f.cameras[0] == 7)
                                .collect::<Vec<_>>()
                        );
                    }
                }
                Ok(it) => {
                    failed += 1;
                    println!("seed {seed} untied {:?}", it.untied().collect::<Vec<_>>());
                }
                Err(error) => {
                    failed += 1;
                    println!("seed {seed} {error}");
                }
            }
        }
        println!(
            "unlabelled {per_overlap}: right {right} failed {failed} wrong {wrong} edges!=8 {ambiguous}"
        );
    }
}
