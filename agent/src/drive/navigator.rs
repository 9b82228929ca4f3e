//! A robot that drives autonomously along the server's paths, around the obstacles that the server
//! reports and its own sensor sees, at its own rate.

use core::cell::Cell;

use heapless::Vec;
use ubimap_protocol::{
    message::{EventCode, MAX_OBSTACLES, MAX_PEERS, Obstacle, ObstacleClass, Peer, Waypoint},
    tile::{Row, TILE_SIDE, TileId},
    time::{Duration, Instant},
    units::{Millimetres, Pose},
};

use super::{
    choice::{Drive, Drives, Surroundings},
    driver::{Driver, Inputs, Task},
    driving::Driving,
    follow::DriveCommand,
    near::{NearPoints, Seen},
    planning_window::{GroundRow, Mover},
    reason::Reason,
    safety::Health,
    search::Workspace,
    stops::Stops,
};
use crate::{
    map::OwnTile,
    timing::{DOUBTS_OWN, OBSTACLE_LOST},
};

/// Distance at which an intermediate point counts as passed, in millimetres.
const PASSED: i32 = 150;

type Movers = Vec<Mover, { MAX_PEERS + MAX_OBSTACLES }>;

impl Drive for Driving {
    type Memory = Workspace;
    const EMPTY: Workspace = Workspace::EMPTY;
    type State<'b> = Navigator<'b>;

    fn begin(self, resolution: Millimetres, memory: &mut Workspace) -> Navigator<'_> {
        Navigator::new(self, resolution, memory)
    }
}

/// Drives along the server's paths, point by point, and explores without a server if configured.
/// Size: 2.5 kB, and 7.6 kB of [`Workspace`].
#[derive(Debug)]
pub struct Navigator<'b> {
    driver: Driver<'b>,
    near: NearPoints,
    /// The robot's radius, in millimetres.
    radius: i32,
    /// Time between steps.
    interval: Duration,
    /// When the next step is due.
    next_step: Instant,
    command: DriveCommand,
    /// The sequence number of the current path.
    path: Option<u32>,
    /// The index of the point that the robot drives to.
    point: usize,
    /// The state of a robot that stops for each scan; `None` if it maps on the move.
    stops: Option<Stops>,
    /// The task until the first session; `None` to stand.
    alone: Option<Task>,
    /// When it last had no way.
    shut_in: Option<Instant>,
}

impl<'b> Navigator<'b> {
    /// Stands until the server sends a path.
    fn new(config: Driving, resolution: Millimetres, workspace: &'b mut Workspace) -> Self {
        Self {
            near: NearPoints::default(),
            radius: config.motion.radius.into(),
            // With an interval of 0, a step would always be due.
            interval: config.interval.max(Duration::from_millis(1)),
            next_step: Instant(0),
            command: DriveCommand::STAND,
            path: None,
            point: 0,
            stops: config.stop_and_wait.then(Stops::default),
            alone: config.alone.map(|home| Task::Explore(Some(home))),
            shut_in: None,
            driver: Driver::new(config, resolution, workspace),
        }
    }

    /// The driver: task, state and planning window.
    pub fn driver(&self) -> &Driver<'b> {
        &self.driver
    }

    /// Adopts the current path and drives to its next point. Returns whether that is the last.
    fn follow(&mut self, surroundings: &Surroundings<'_, '_>) -> bool {
        let Some(path) = surroundings.commands.path() else {
            // A path belongs to the server that sent it. If another server has taken over, its
            // commands contain no path, and the robot stops.
            let task = self.alone.filter(|_| surroundings.heard.is_none()).unwrap_or(Task::Stand);
            if self.path.take().is_some() || self.driver.task() != task {
                self.driver.set_task(task);
            }
            return true;
        };
        if self.path != Some(path.number) {
            (self.path, self.point) = (Some(path.number), 0);
            match path.waypoints.first() {
                None => self.driver.set_task(Task::Stand),
                Some(&first) => self.head_for(first),
            }
        }
        while let (Some(at), Some(&after)) =
            (path.waypoints.get(self.point), path.waypoints.get(self.point + 1))
        {
            let is_near = |(pose, _): (Pose, f32)| {
                squared_distance(pose, at.x, at.y) < i64::from(PASSED).pow(2)
            };
            if !surroundings.pose.is_some_and(is_near) && self.driver.reason() != Reason::Arrived {
                break;
            }
            self.point += 1;
            self.driver.go_to_next(after);
        }
        self.point + 1 >= path.waypoints.len()
    }

    /// Drives to a point. A new path to the same point changes nothing.
    fn head_for(&mut self, point: Waypoint) {
        let heads_there = self.driver.task() == Task::Go(point);
        if !heads_there || self.driver.reason() == Reason::Arrived {
            self.driver.go_to_next(point);
        }
    }

    fn health(&mut self, surroundings: &Surroundings<'_, '_>) -> Health {
        let &Surroundings { now, pose, odometry, heard, gate, .. } = surroundings;
        let is_alone = self.alone.is_some() && heard.is_none();
        let waits = self.stops.as_mut().is_some_and(|stops| stops.must_stand(gate, odometry, now));
        Health {
            now,
            heard: if is_alone { Some(now) } else { heard.filter(|_| surroundings.is_connected) },
            must_stop: surroundings.commands.must_stop() || surroundings.is_halted || waits,
            pose,
            odometry,
            scan: self.near.taken(),
        }
    }
}

impl Drives for Navigator<'_> {
    fn wants_scan(&mut self, taken: Instant, fix: Option<Instant>) -> bool {
        self.stops.as_mut().is_none_or(|stops| stops.takes(taken, fix))
    }

    fn see(&mut self, scan: &Seen<'_>) {
        self.near = NearPoints::of_scan(scan);
    }

    fn poll_timeout(&self) -> Option<Instant> {
        Some(self.next_step)
    }

    fn step(&mut self, surroundings: &Surroundings<'_, '_>) -> Option<EventCode> {
        let now = surroundings.now;
        // A late step delays the following ones only if a whole interval was missed.
        let next = self.next_step + self.interval;
        self.next_step = if next > now { next } else { now + self.interval };
        let is_last = self.follow(surroundings);
        let movers = surroundings.pose.map(|(pose, _)| movers(surroundings, pose, self.radius));
        let movers = movers.unwrap_or_default();
        let health = self.health(surroundings);
        let cells_refused = surroundings.cells_refused;
        let inputs = Inputs { health, near: &self.near, movers: &movers, cells_refused };
        if matches!(self.driver.reason(), Reason::NoWay(_)) {
            self.shut_in = Some(now);
        }
        // What it drew before its pose was corrected may stand where nothing is.
        let trusts_own = self.shut_in.is_none_or(|last| now.since(last) >= DOUBTS_OWN);
        let found = Cell::default();
        let ground = |column, row| ground(surroundings, trusts_own, &found, column, row);
        self.command = self.driver.step(&inputs, ground);
        let code = self.driver.poll_event().and_then(Reason::event_code);
        // Only the last point counts as the end of the path.
        code.filter(|&code| is_last || code != EventCode::PathDone)
    }

    fn command(&self) -> DriveCommand {
        self.command
    }
}

/// The other robots, and the moving obstacles that are not robots. `pose` and `own_radius` are this
/// robot's.
fn movers(surroundings: &Surroundings<'_, '_>, pose: Pose, own_radius: i32) -> Movers {
    let &Surroundings { server_now, commands, .. } = surroundings;
    let mut movers = Movers::new();
    let peers = commands.peers().map_or(&[][..], |peers| &peers.peers);
    for peer in peers {
        // The capacity is large enough for all peers and obstacles.
        let _ = movers.push(Mover {
            x: peer.pose.x,
            y: peer.pose.y,
            radius: radius(peer),
            ..Mover::default()
        });
    }
    let Some((obstacles, server_now)) = commands.obstacles().zip(server_now) else {
        return movers;
    };
    let age = server_now.since(obstacles.time);
    if age > OBSTACLE_LOST {
        return movers;
    }
    // At most two seconds: a division of 64 bits costs a microcontroller 1 kB of flash.
    let millis = (age.micros() as u32 / 1_000) as i32;
    let within = |obstacle: &Obstacle, of: Pose, radius: i32| {
        squared_distance(of, obstacle.x, obstacle.y) < i64::from(radius).pow(2)
    };
    for (obstacle, posture) in obstacles.told() {
        // Cameras may report a robot as an obstacle, too.
        let is_robot = within(obstacle, pose, own_radius)
            || peers.iter().any(|peer| within(obstacle, peer.pose, radius(peer).into()));
        if obstacle.class == ObstacleClass::Fixed || is_robot {
            continue;
        }
        let moved = |at: Millimetres, velocity: i16| {
            Millimetres(at.0.saturating_add(i32::from(velocity) * millis / 1_000))
        };
        let _ = movers.push(Mover {
            x: moved(obstacle.x, obstacle.velocity_x),
            y: moved(obstacle.y, obstacle.velocity_y),
            velocity_x: obstacle.velocity_x,
            velocity_y: obstacle.velocity_y,
            radius: obstacle.radius,
            is_person: obstacle.class == ObstacleClass::Person,
            is_at_rest: posture.is_at_rest(),
        });
    }
    movers
}

/// Radius of the circle around a robot's footprint, in millimetres.
fn radius(peer: &Peer) -> u16 {
    let (length, width) = (f32::from(peer.half_length), f32::from(peer.half_width));
    libm::sqrtf(length * length + width * width) as u16
}

/// The squared distance from a pose to a point, in mm^2.
fn squared_distance(from: Pose, x: Millimetres, y: Millimetres) -> i64 {
    let way = |to: Millimetres, from: Millimetres| i64::from(to.0.saturating_sub(from.0));
    way(x, from.x).pow(2) + way(y, from.y).pow(2)
}

/// A tile of the robot's own that was looked for, and whether there is one.
type Found<'m> = (Option<TileId>, Option<&'m OwnTile>);

/// The states of the 32 cells in a column of tiles and a row of cells. `trusts_own` says whether what only the robot has
/// seen stand is in its way. `found` keeps the last tile: a coarse window reads up to four rows of a tile one after another.
fn ground<'m>(
    surroundings: &Surroundings<'m, '_>,
    trusts_own: bool,
    found: &Cell<Found<'m>>,
    column: i32,
    row: i32,
) -> GroundRow {
    let side = TILE_SIDE as i32;
    let Some(id) = TileId::of_cell(column.saturating_mul(side), row) else {
        return GroundRow::default();
    };
    let y = row.rem_euclid(side) as usize;
    let around = surroundings.fused.around(id, surroundings.now);
    let merged = around.merged.map(|tile| tile.row(y)).unwrap_or_default();
    let covered = around.covered.and_then(|rows| rows.get(y)).copied().unwrap_or_default();
    if found.get().0 != Some(id) {
        found.set((Some(id), surroundings.own.find(id)));
    }
    let cells = match found.get().1 {
        Some(own) => passable(merged, own.row(y), if trusts_own { !covered } else { 0 }),
        None => merged,
    };
    GroundRow { cells, covered }
}

/// The server's cells; the robot's own, which are never movable, where the server's are unknown and, in the `blind`
/// cells, where it has itself seen something stand: if its pose is off, the server's map is right, and what is in the
/// robot's way is where the robot has drawn it. That holds for what the server has as movable, too: it is there now.
fn passable(merged: Row, own: Row, blind: u32) -> Row {
    let unknown = !(merged.low | merged.high);
    let solid = own.high & blind;
    Row {
        low: (merged.low | own.low & unknown) & !solid,
        high: merged.high | own.high & unknown | solid,
    }
}

#[cfg(test)]
mod tests {
    use ubimap_protocol::tile::{Cell, Tile};

    use super::*;

    #[test]
    fn what_the_robot_saw_stand_is_in_its_way_where_no_camera_looks() {
        use Cell::{Free, Movable, Occupied, Unknown};
        let row = |cell| {
            let mut tile = Tile::UNKNOWN;
            tile.set(5, 0, cell);
            tile.row(0)
        };
        for (merged, own) in [Unknown, Free, Occupied, Movable]
            .into_iter()
            .flat_map(|merged| [Unknown, Free, Occupied].map(|own| (merged, own)))
        {
            for is_blind in [false, true] {
                let mut tile = Tile::UNKNOWN;
                tile.set_row(0, passable(row(merged), row(own), u32::from(is_blind) << 5));
                let expected = match (merged, own) {
                    (_, Occupied) if is_blind => Occupied,
                    (Unknown, own) => own,
                    (merged, _) => merged,
                };
                assert_eq!(tile.cell(5, 0), expected, "{merged:?}, {own:?}, {is_blind}");
                assert_eq!(tile.cell(6, 0), Unknown);
            }
        }
    }
}
