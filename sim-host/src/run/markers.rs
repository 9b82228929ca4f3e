//! The markers on the pictures of a run: robots, people and cameras.

use nalgebra::Vector3;
use ubimap_protocol::{
    message::{Obstacle, ObstacleClass, Posture},
    time::{Duration, Instant},
    units::{Millimetres, Pose, RobotId},
};

use super::fleet::Fleet;
use crate::{
    camera::{Calibration, Lens},
    deployment::Deployment,
    report::{Marker, MarkerKind, TrackedPerson},
    server::Footprint,
};

/// Maximum age of a detection of a person or thing that is drawn.
const RECENT: Duration = Duration::from_secs(1);
/// Maximum distance along the floor at which the edge of a view is drawn, in metres.
const VIEW_M: f64 = 6.0;
/// Number of points of that edge per side of the image.
const POINTS: u32 = 16;
/// A camera whose axis is within this angle of straight down has no heading; as a cosine.
const DOWN: f64 = 0.999;

/// The robots of a fleet at their estimated poses, with the paths driven.
pub(super) fn robots(fleet: &Fleet<'_>) -> Vec<Marker> {
    let robots = fleet.robots().iter().filter_map(|robot| {
        let (_, pose) = robot.robot().pose()?;
        Some((robot.id(), pose, robot.path()))
    });
    let outside = fleet.outside().and_then(|robot| {
        let (_, pose) = robot.path().last()?;
        Some((robot.id(), *pose, robot.path()))
    });
    let markers = robots.chain(outside).map(|(id, pose, path)| {
        let place = |pose: &Pose| [pose.x, pose.y].map(Millimetres::metres);
        Marker {
            radius_m: radius_m(fleet.deployment(), id),
            label: id.0.to_string(),
            path: path.iter().map(|(_, pose)| place(pose)).collect(),
            ..Marker::new(MarkerKind::Robot, place(&pose), pose.heading.radians())
        }
    });
    markers.collect()
}

/// Half the longer side of a robot.
pub(super) fn radius_m(deployment: &Deployment, robot: RobotId) -> f64 {
    let Footprint { half_length, half_width, .. } = deployment.server().footprint(robot);
    f64::from(half_length.max(half_width)) / 1000.0
}

/// The people and things that a deployment tracks at `now`, and the posture of each.
pub(super) fn followed(deployment: &Deployment, now: Instant) -> Vec<(Obstacle, Posture)> {
    let (moment, obstacles) = deployment.server().obstacles();
    let is_recent = deployment.server_time(now).since(moment) <= RECENT;
    if is_recent { obstacles } else { Vec::new() }
}

/// The people that robots are told of at `now`.
pub(super) fn tracked_people(deployment: &Deployment, now: Instant) -> Vec<TrackedPerson> {
    followed(deployment, now).into_iter().filter_map(TrackedPerson::of).collect()
}

/// The people that a deployment tracks at `now`.
pub(super) fn people(deployment: &Deployment, now: Instant) -> Vec<Marker> {
    let people = followed(deployment, now).into_iter();
    let people = people.filter(|(it, _)| it.class == ObstacleClass::Person).map(|(person, _)| {
        let place = [person.x, person.y].map(Millimetres::metres);
        let heading = f64::from(person.velocity_y).atan2(person.velocity_x.into());
        let radius_m = f64::from(person.radius) / 1000.0;
        Marker { radius_m, ..Marker::new(MarkerKind::Person, place, heading) }
    });
    people.collect()
}

/// Cameras, with their view of an empty floor, and whether each is in use. One that isn't sees nothing that
/// counts.
pub(super) fn cameras<'c>(
    cameras: impl IntoIterator<Item = (&'c Calibration, bool)>,
) -> Vec<Marker> {
    let lenses = cameras
        .into_iter()
        .filter_map(|(camera, is_in_use)| Some((camera.depth.or(camera.picture)?, is_in_use)));
    let marker = |(lens, is_in_use): (Lens, bool)| match camera(&lens) {
        marker if is_in_use => marker,
        marker => Marker { kind: MarkerKind::CameraOut, view: Vec::new(), ..marker },
    };
    lenses.map(marker).collect()
}

fn camera(lens: &Lens) -> Marker {
    let axis = lens.pose().rotation * Vector3::z();
    let kind = if -axis.z > DOWN { MarkerKind::CameraDown } else { MarkerKind::Camera };
    let centre = lens.centre();
    Marker { view: view(lens), ..Marker::new(kind, [centre.x, centre.y], axis.y.atan2(axis.x)) }
}

/// The outline of the visible floor, cut off at [`VIEW_M`].
fn view(lens: &Lens) -> Vec<[f64; 2]> {
    let intrinsics = lens.intrinsics();
    let [right, lower] = [intrinsics.width, intrinsics.height].map(|it| f64::from(it) - 1.0);
    let corners = [[0.0, 0.0], [right, 0.0], [right, lower], [0.0, lower], [0.0, 0.0]];
    let pixels = corners.windows(2).flat_map(|side| {
        let [from, to] = [side[0], side[1]];
        (0..POINTS).map(move |step| {
            let part = f64::from(step) / f64::from(POINTS);
            [0, 1].map(|axis| from[axis] + part * (to[axis] - from[axis]))
        })
    });
    let centre = lens.centre();
    let floor = pixels.map(|pixel| {
        let direction = lens.direction(pixel);
        let along = direction.xy().norm();
        // Distance to the floor; a ray that does not point down never reaches it.
        let depth = if direction.z < 0.0 { centre.z / -direction.z } else { f64::INFINITY };
        let depth = depth.min(VIEW_M / along);
        [centre.x + depth * direction.x, centre.y + depth * direction.y]
    });
    floor.collect()
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, PI};

    use nalgebra::{Isometry3, Translation3, UnitQuaternion};

    use super::*;
    use crate::camera::Intrinsics;

    /// A camera 2 m above (1, 1) m, with a field of view of 90 degrees both ways.
    fn lens(rotation: UnitQuaternion<f64>) -> Lens {
        let pose = Isometry3::from_parts(Translation3::new(1.0, 1.0, 2.0), rotation);
        Lens::new(Intrinsics::pinhole(200, 200, FRAC_PI_2), pose).unwrap()
    }

    #[test]
    fn a_camera_looking_down_sees_a_square() {
        let down = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), PI);
        let marker = camera(&lens(down));
        assert_eq!(marker.kind, MarkerKind::CameraDown);
        for [x, y] in marker.view {
            // Half the side equals the height, to within half a pixel.
            let away = (x - 1.0).abs().max((y - 1.0).abs());
            assert!((away - 2.0).abs() < 0.03, "({x}, {y})");
        }
    }

    #[test]
    fn a_level_camera_sees_from_two_metres_to_the_maximum_distance() {
        // Along x: the image's right is -y, its down is -z.
        let level = UnitQuaternion::from_euler_angles(-FRAC_PI_2, 0.0, -FRAC_PI_2);
        let marker = camera(&lens(level));
        assert_eq!(marker.kind, MarkerKind::Camera);
        assert!(marker.heading_rad.abs() < 1e-9, "{}", marker.heading_rad);
        let ahead = |[x, y]: &[f64; 2]| (x - 1.0).hypot(y - 1.0);
        let nearest = marker.view.iter().map(ahead).fold(f64::INFINITY, f64::min);
        let farthest = marker.view.iter().map(ahead).fold(0.0, f64::max);
        assert!((nearest - 2.0).abs() < 0.03 && (farthest - VIEW_M).abs() < 1e-9);
    }
}
