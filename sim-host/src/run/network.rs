//! The camera network of a simulated room as a drawing.

use nalgebra::Vector3;

use crate::{
    camera::{Calibration, Lens},
    grid::OccupancyGrid,
    report::{Network, NetworkCamera, NetworkPart, PartKind},
    world::{FixedOutline, Scenario, World},
};

/// Length of a view's edge that does not meet the floor, in metres.
const FAR_M: f64 = 5.0;
/// Corners of a drawn circle.
const CORNERS: u32 = 20;

/// The drawing of a room with its map, in SVG.
pub(super) fn svg<'c>(
    map: &OccupancyGrid,
    scenario: &Scenario,
    world: &World,
    cameras: impl Iterator<Item = &'c Calibration>,
) -> String {
    let mut parts: Vec<NetworkPart> = world
        .fixed_parts(scenario)
        .into_iter()
        .map(|part| NetworkPart {
            kind: if part.name.is_some() { PartKind::Obstacle } else { PartKind::Wall },
            name: part.name.unwrap_or_default(),
            outline_m: match part.outline {
                FixedOutline::Disc { centre_m, radius_m } => circle(centre_m, radius_m),
                FixedOutline::Polygon(corners) => corners,
            },
            heights_m: [part.bottom_m, part.top_m],
        })
        .collect();
    parts.extend(world.robots().iter().map(|robot| {
        let pose = robot.truth();
        NetworkPart {
            kind: PartKind::Robot,
            name: format!("R{}", robot.id().0),
            outline_m: circle([pose.x.metres(), pose.y.metres()], robot.radius_m()),
            heights_m: [0.0, robot.height_m()],
        }
    }));
    let lenses = cameras.filter_map(|camera| camera.depth.or(camera.picture)).enumerate();
    let cameras = lenses.map(|(index, lens)| camera(index, &lens)).collect();
    Network { map, parts, cameras }.svg()
}

fn circle([x, y]: [f64; 2], radius: f64) -> Vec<[f64; 2]> {
    let corner = |corner: u32| {
        let (sin, cos) = (f64::from(corner) * std::f64::consts::TAU / f64::from(CORNERS)).sin_cos();
        [x + radius * cos, y + radius * sin]
    };
    (0..CORNERS).map(corner).collect()
}

fn camera(index: usize, lens: &Lens) -> NetworkCamera {
    let centre = lens.centre().coords;
    let intrinsics = lens.intrinsics();
    let [right, lower] = [intrinsics.width, intrinsics.height].map(|it| f64::from(it) - 1.0);
    let corners = [[0.0, 0.0], [right, 0.0], [right, lower], [0.0, lower]];
    let meet = |pixel: [f64; 2]| {
        let way: Vector3<f64> = lens.direction(pixel).normalize();
        let floor = if way.z < 0.0 { -centre.z / way.z } else { f64::INFINITY };
        let end = centre + way * floor.min(FAR_M);
        [end.x, end.y, end.z]
    };
    NetworkCamera {
        name: format!("C{}", index + 1),
        at_m: [centre.x, centre.y, centre.z],
        view_m: corners.map(meet).to_vec(),
    }
}
