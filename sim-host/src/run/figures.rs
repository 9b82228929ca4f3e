//! The figures of a run, taken from its fleet.

use ubimap_protocol::tile::{Digest, Stamp, tile_hash};

use super::{fleet::Fleet, member::Member};
use crate::{
    grid::OccupancyGrid,
    report::{Comparison, HexDigest, MapSummary, Pixels, Report, RobotSummary},
    server::EventLog,
};

/// The report of a run, without the figures that only the command knows.
pub(super) fn report(
    fleet: &Fleet<'_>,
    map: &OccupancyGrid,
    seed: u64,
    converged: bool,
    tiles: usize,
) -> Report {
    let robots: Vec<RobotSummary> =
        fleet.robots().iter().map(|robot| summary(fleet, robot, tiles)).collect();
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

fn summary(fleet: &Fleet<'_>, robot: &Member<'_>, tiles: usize) -> RobotSummary {
    let server = fleet.server();
    let port = fleet.deployment().port(robot.port());
    let counted = robot.robot().statistics();
    let mut digest = Digest::default();
    if let Some(layer) = server.layer(robot.id()) {
        let tiles = layer.tiles();
        tiles.for_each(|(id, seen)| digest.add(id, Stamp::default(), tile_hash(&seen.tile)));
    }
    let pixels = counted.pixels;
    RobotSummary {
        id: robot.id().0,
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
        bytes_down: port.map_or(0, |port| port.bytes_sent),
        retransmissions: robot.robot().link_counters().retransmissions.into(),
        frames_lost: robot.frames_lost(),
        tiles: tiles as u64,
        tiles_evicted: robot.robot().own_tiles().evicted().into(),
        cells_refused: counted.cells_refused.into(),
        events: server.events(robot.id()).map_or(0, EventLog::count),
        news_left_out: server.left_out(robot.id()),
        digest: HexDigest(digest.0),
        ..RobotSummary::default()
    }
}
