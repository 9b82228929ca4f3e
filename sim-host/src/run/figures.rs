//! The figures of a run, taken from its fleet.

use ubimap_protocol::{
    tile::{Digest, Stamp, tile_hash},
    units::RobotId,
};

use super::{fleet::Fleet, member::Member};
use crate::{
    camera::Orientation,
    deployment::{CameraEventKind, Deployment, PortId},
    grid::OccupancyGrid,
    report::{
        CameraMove, Comparison, HexDigest, LinkSummary, MapSummary, Pixels, Report, RobotSummary,
        UnexploredGround,
    },
    server::{
        EventLog, MessageCounters,
        coordination::{Unexplored, WhyUnexplored},
    },
};

/// The report of a run, without the figures that only the command knows.
pub(super) fn report(
    fleet: &Fleet<'_>,
    map: &OccupancyGrid,
    seed: u64,
    converged: bool,
    tiles: usize,
) -> Report {
    let outside = fleet.outside().map(|robot| known_to_the_server(fleet, robot.id(), robot.port()));
    let robots = fleet.robots().iter().map(|robot| summary(fleet, robot, tiles)).chain(outside);
    let robots: Vec<RobotSummary> = robots.collect();
    for robot in robots.iter().filter(|robot| robot.cells_refused > 0) {
        log::warn!(
            "robot {} dropped {} cells because its {tiles} tiles were full; increase --tiles",
            robot.id,
            robot.cells_refused,
        );
    }
    let counts = map.counts();
    let map = MapSummary {
        resolution_m: map.resolution_m(),
        known: counts.known as u64,
        free: counts.free as u64,
        occupied: counts.occupied as u64,
        digest: HexDigest(fleet.server().fused().digest().0),
        // Empty maps are equal, but agree on nothing.
        converged: converged && counts.known > 0,
        ..MapSummary::default()
    };
    let mut comparison = Comparison::default();
    fleet.robots().iter().for_each(|robot| comparison.add(&robot.comparison()));
    Report::new(seed, robots, map, comparison)
}

/// What is left to explore, the largest ground first, and what was looked at in vain last.
pub(super) fn unexplored(deployment: &Deployment) -> Vec<UnexploredGround> {
    let mut left = deployment.server().unexplored();
    let is_vain = |it: &Unexplored| it.why == WhyUnexplored::SeenInVain;
    left.sort_by(|a, b| is_vain(a).cmp(&is_vain(b)).then(b.area_m2.total_cmp(&a.area_m2)));
    let ground = left.into_iter().map(|it| UnexploredGround {
        place: it.place_m,
        area_m2: it.area_m2,
        why: it.why.to_string(),
    });
    ground.collect()
}

/// The movements of cameras that a deployment has noticed.
pub(super) fn camera_moves(deployment: &Deployment) -> Vec<CameraMove> {
    let moves = deployment.camera_events().map(|(moment, event)| CameraMove {
        camera: event.camera,
        what: match event.kind {
            CameraEventKind::Knocked => "knocked",
            CameraEventKind::Returned => "returned",
            CameraEventKind::Drifted => "drifted",
            CameraEventKind::Disputed => "disputed",
        },
        at_s: moment.micros() as f64 / 1e6,
        shift_m: event.way.map(|[metres, _]| metres),
        turn_deg: event.way.map(|[_, radians]| radians.to_degrees()),
        pose: event.pose.map(|pose| {
            let at = pose.translation.vector;
            let angles = Orientation::of(&pose.rotation);
            let angles = [angles.heading_rad, angles.tilt_rad, angles.roll_rad];
            let [heading, tilt, roll] = angles.map(f64::to_degrees);
            [at.x, at.y, at.z, heading, tilt, roll]
        }),
    });
    moves.collect()
}

fn summary(fleet: &Fleet<'_>, robot: &Member<'_>, tiles: usize) -> RobotSummary {
    let counted = robot.robot().statistics();
    let pixels = counted.pixels;
    RobotSummary {
        scans: counted.scans.into(),
        mapped: counted.mapped.into(),
        pixels: Pixels {
            seen: pixels.seen.into(),
            kept: pixels.kept.into(),
            omitted: pixels.omitted.into(),
            invalid: pixels.invalid.into(),
        },
        bytes_up: counted.bytes_sent,
        bytes_up_map: counted.bytes_sent_map,
        retransmissions: robot.robot().link_counters().retransmissions.into(),
        link: LinkSummary::new(
            robot.robot().link_counters(),
            MessageCounters {
                unknown: counted.unknown_messages,
                malformed: counted.malformed_messages,
                late: 0,
            },
        ),
        frames_lost: robot.frames_lost(),
        tiles: tiles as u64,
        tiles_evicted: robot.robot().own_tiles().evicted().into(),
        cells_refused: counted.cells_refused.into(),
        ..known_to_the_server(fleet, robot.id(), robot.port())
    }
}

/// What the server alone can say about a robot.
fn known_to_the_server(fleet: &Fleet<'_>, robot: RobotId, port: PortId) -> RobotSummary {
    let server = fleet.server();
    let port = fleet.deployment().port(port);
    let mut digest = Digest::default();
    if let Some(layer) = server.layer(robot) {
        let tiles = layer.tiles();
        tiles.for_each(|(id, seen)| digest.add(id, Stamp::default(), tile_hash(&seen.tile)));
    }
    RobotSummary {
        id: robot.0,
        bytes_down: port.map_or(0, |port| port.bytes_sent),
        server_link: port
            .map(|port| LinkSummary::new(port.link, port.messages))
            .unwrap_or_default(),
        events: server.events(robot).map_or(0, EventLog::count),
        news_left_out: server.left_out(robot),
        digest: HexDigest(digest.0),
        ..RobotSummary::default()
    }
}
