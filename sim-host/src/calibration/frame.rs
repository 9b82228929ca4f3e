//! The frame `R0` if the reference camera's pose is not known.

use nalgebra::{Isometry3, Matrix6, Translation3, UnitQuaternion, Vector3};

use super::{observations::Floor, refine::Refined};
use crate::camera::Orientation;

/// What fixes `R0`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Frame {
    /// The pose of the reference camera.
    Known,
    /// The floor is z = 0; x, y and heading of the reference camera are zero. The transform from the
    /// frame of [`Frame::level`].
    Floor(Isometry3<f64>),
}

impl Frame {
    /// The pose of a level reference camera at the origin that looks along x.
    pub(super) fn level() -> Isometry3<f64> {
        let rotation = Orientation::default().rotation();
        Isometry3::from_parts(Translation3::identity(), rotation)
    }

    /// The frame of the floor that the reference sees, or else another camera; [`Frame::Known`] if
    /// none does.
    pub(super) fn of_floor(
        poses: &[Option<Isometry3<f64>>],
        floors: &[Option<Floor>],
        reference: usize,
    ) -> Self {
        let first = std::iter::once(reference).chain(0..floors.len());
        let found = first.into_iter().find_map(|it| Some((poses[it]?, floors[it]?)));
        let Some((pose, floor)) = found else { return Self::Known };
        let normal = pose.rotation * floor.normal.into_inner();
        let turn = UnitQuaternion::rotation_between(&normal, &Vector3::z()).unwrap_or_else(|| {
            UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI)
        });
        let turned = turn * pose.translation.vector;
        let shift = Translation3::new(0.0, 0.0, floor.height_m - turned.z);
        Self::Floor(Isometry3::from_parts(shift, turn))
    }

    /// Which rotations and translations of the reference are estimated.
    pub(super) fn free(&self) -> [bool; 6] {
        match self {
            Self::Known => [false; 6],
            Self::Floor(_) => [true, true, false, false, false, true],
        }
    }

    /// Poses in this frame.
    pub(super) fn align(
        &self,
        poses: &[Option<Isometry3<f64>>],
        reference: usize,
    ) -> Vec<Option<Isometry3<f64>>> {
        let (Self::Floor(transform), Some(pose)) = (self, poses[reference]) else {
            return poses.to_vec();
        };
        let transform = centring(&(transform * pose)) * transform;
        poses.iter().map(|pose| pose.map(|it| transform * it)).collect()
    }

    /// Sets x, y and heading of the reference to zero.
    pub(super) fn settle(&self, refined: &mut Refined, reference: usize) {
        if let Self::Known = self {
            return;
        }
        let transform = centring(&refined.poses[reference]);
        let turn = transform.rotation.to_rotation_matrix();
        let mut turns = Matrix6::zeros();
        turns.fixed_view_mut::<3, 3>(0, 0).copy_from(turn.matrix());
        turns.fixed_view_mut::<3, 3>(3, 3).copy_from(turn.matrix());
        refined.poses.iter_mut().for_each(|pose| *pose = transform * *pose);
        for covariance in &mut refined.covariances {
            *covariance = turns * *covariance * turns.transpose();
        }
    }
}

/// The rotation about z and the shift along the floor that bring a camera to x = y = 0 and to
/// heading zero.
fn centring(pose: &Isometry3<f64>) -> Isometry3<f64> {
    let heading = Orientation::of(&pose.rotation).heading_rad;
    let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), -heading);
    let at = turn * pose.translation.vector;
    Isometry3::from_parts(Translation3::new(-at.x, -at.y, 0.0), turn)
}
