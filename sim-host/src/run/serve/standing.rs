//! Where the cameras of a deployment hang now, and which of them can't be used: perception runs in a thread of
//! its own, and tells only changes.

use crate::{
    camera::Calibration, perception::steadiness::Change, run::deployment_file::DeployedCamera,
};

/// Where the cameras hang, in the order of the deployment's file.
#[derive(Clone, Debug, Default)]
pub(super) struct Standings(Vec<Standing>);

#[derive(Clone, Debug)]
struct Standing {
    /// `None` for a camera without a pose.
    placed: Option<Calibration>,
    state: State,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    Steady,
    Knocked,
    Disputed,
}

impl Standings {
    pub(super) fn new(cameras: &[DeployedCamera]) -> Self {
        let standing = |camera: &DeployedCamera| Standing {
            placed: camera.is_placed.then_some(camera.calibration),
            state: State::Steady,
        };
        Self(cameras.iter().map(standing).collect())
    }

    /// Follows a change of a camera.
    pub(super) fn follow(&mut self, camera: usize, change: &Change) {
        let Some(standing) = self.0.get_mut(camera) else { return };
        match change {
            Change::Knocked { .. } => standing.state = State::Knocked,
            Change::Disputed => standing.state = State::Disputed,
            Change::Returned(pose) | Change::Drifted(pose) => {
                standing.state = State::Steady;
                let moved = standing.placed.map(|it| it.at(*pose));
                // Perception has found a finite pose.
                standing.placed = moved.and_then(Result::ok).or(standing.placed);
            }
        }
    }

    /// Whether a camera is out of use after a knock.
    pub(super) fn is_knocked(&self, camera: usize) -> bool {
        self.0.get(camera).is_some_and(|it| it.state == State::Knocked)
    }

    /// Whether a camera contradicts another one.
    pub(super) fn is_disputed(&self, camera: usize) -> bool {
        self.0.get(camera).is_some_and(|it| it.state == State::Disputed)
    }

    /// The cameras with a pose, by number.
    pub(super) fn placed(&self) -> impl Iterator<Item = (usize, &Calibration)> {
        self.0.iter().enumerate().filter_map(|(index, it)| Some((index, it.placed.as_ref()?)))
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Isometry3;
    use ubimap_protocol::time::Instant;

    use super::*;
    use crate::{
        camera::{DepthNoise, Intrinsics, Lens},
        run::deployment_file::CameraSource,
    };

    #[test]
    fn a_knocked_camera_is_out_until_its_new_pose_is_known() {
        let pose = Isometry3::translation(1.0, 2.0, 3.0);
        let depth = Lens::new(Intrinsics::pinhole(20, 10, 1.0), pose).unwrap();
        let calibration =
            Calibration { depth: Some(depth), depth_noise: DepthNoise::default(), picture: None };
        let camera = |is_placed| DeployedCamera {
            name: "a".into(),
            source: CameraSource::UnixStream("a.sock".into()),
            calibration,
            is_placed,
        };
        let mut standings = Standings::new(&[camera(false), camera(true)]);
        assert_eq!(standings.placed().map(|(index, _)| index).collect::<Vec<_>>(), [1]);
        standings.follow(1, &Change::Knocked { since: Instant(0), pose: None });
        assert!(standings.is_knocked(1) && !standings.is_knocked(0));
        let moved = Isometry3::translation(1.5, 2.0, 3.0);
        standings.follow(1, &Change::Returned(moved));
        assert!(!standings.is_knocked(1));
        assert_eq!(standings.placed().next().unwrap().1.pose(), Some(&moved));
        standings.follow(1, &Change::Disputed);
        assert!(standings.is_disputed(1));
        standings.follow(7, &Change::Disputed);
    }
}
