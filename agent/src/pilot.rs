//! An agent and a driver on one robot: what the agent hears and maps is what the driver drives by.

use heapless::Vec;
use ubimap_protocol::{
    message::{EventCode, MAX_OBSTACLES, MAX_PEERS, Obstacle, ObstacleClass, Peer, Waypoint},
    tile::{TILE_SIDE, TileId},
    time::{Duration, Instant},
    units::{Millimetres, Pose},
};

use crate::{
    Agent,
    drive::{
        Config, DriveCommand, Driver, GroundRow, Health, Inputs, Mover, NearPoints, Reason, Task,
    },
};

/// Obstacles are known for so long after they were seen.
const SEEN: Duration = Duration::from_secs(2);
/// How long the link and the sensor may be silent while a robot seeks to be seen.
const LINKED: Duration = Duration::from_secs(3);
const SCANNED: Duration = Duration::from_millis(500);
/// A point on the way is passed from this near, in millimetres.
const PASSED: i32 = 150;

type Movers = Vec<Mover, { MAX_PEERS + MAX_OBSTACLES }>;

/// Drives the robot of an agent along the paths that the server sends, a point after the other. One
/// that does not know where it is seeks to be seen. It takes about 12 kB.
#[derive(Debug)]
pub struct Pilot {
    driver: Driver,
    near: NearPoints,
    /// The robot's radius, in millimetres.
    radius: i32,
    /// The number of the path, and which of its points is next.
    path: Option<u32>,
    next: usize,
}

impl Pilot {
    /// A pilot that stands until the server sends a path.
    pub fn new(config: Config) -> Self {
        let radius = config.motion.radius.into();
        let near = NearPoints::default();
        Self { driver: Driver::new(config), near, radius, path: None, next: 0 }
    }

    /// What it drives by.
    pub fn driver(&self) -> &Driver {
        &self.driver
    }

    /// Takes the scan that the agent was given: its readings, and when it was taken.
    pub fn scan(&mut self, agent: &Agent<'_>, readings: &[u16], taken: Instant) {
        self.near = NearPoints::of_scan(agent.beams(), readings, agent.config().mounting, taken);
    }

    /// What the wheels shall do until the next step. Steps should come at 10 Hz or more, each after
    /// a reading of the odometry. All times are the robot's clock.
    pub fn step(&mut self, agent: &mut Agent<'_>, now: Instant) -> DriveCommand {
        let pose = agent.pose_at(now);
        let last = self.follow(agent, pose.map(|(pose, _)| pose));
        let movers = pose.map(|(pose, _)| self.movers(agent, pose, now)).unwrap_or_default();
        let health = Health {
            now,
            heard: agent.heard().filter(|_| agent.is_connected()),
            must_stop: agent.commands().must_stop(),
            pose,
            odometry: agent.newest_odometry(),
            scan: self.near.taken(),
        };
        if pose.is_none() && self.may_seek(&health) {
            return self.seek();
        }
        let inputs = Inputs { health, near: &self.near, movers: &movers };
        let command = self.driver.step(&inputs, |column, row| ground(agent, now, column, row));
        let code = self.driver.poll_event().and_then(Reason::event_code);
        // A point on the way is no end.
        if let Some(code) = code.filter(|&code| last || code != EventCode::PathDone) {
            agent.raise(code, now);
        }
        command
    }

    /// Takes the path that holds, and goes on to the next of its points. Whether that is the last.
    fn follow(&mut self, agent: &Agent<'_>, pose: Option<Pose>) -> bool {
        let Some(path) = agent.commands().path() else {
            // Another server knows nothing of the path.
            if self.path.take().is_some() {
                self.driver.set_task(Task::Stand);
            }
            return false;
        };
        if self.path != Some(path.number) {
            (self.path, self.next) = (Some(path.number), 0);
            match path.waypoints.first() {
                None => self.driver.set_task(Task::Stand),
                Some(&first) => self.head_for(first),
            }
        }
        while let (Some(at), Some(&after)) =
            (path.waypoints.get(self.next), path.waypoints.get(self.next + 1))
        {
            let is_near = |pose: Pose| square(pose, at.x, at.y) < i64::from(PASSED).pow(2);
            if !pose.is_some_and(is_near) && self.driver.reason() != Reason::Arrived {
                break;
            }
            self.next += 1;
            self.driver.go_to_next(after);
        }
        self.next + 1 >= path.waypoints.len()
    }

    /// A path that goes on to the same point is no news.
    fn head_for(&mut self, point: Waypoint) {
        let heads_there = self.driver.task() == Task::Go(point);
        if !heads_there || self.driver.reason() == Reason::Arrived {
            self.driver.go_to_next(point);
        }
    }

    /// Whether a robot that does not know where it is may look for somebody who does: it is linked, and sees.
    fn may_seek(&self, health: &Health) -> bool {
        let is_new =
            |then: Option<Instant>, most| then.is_some_and(|it| health.now.since(it) < most);
        !health.must_stop && is_new(health.heard, LINKED) && is_new(health.scan, SCANNED)
    }

    /// Slowly ahead where its own sensor sees free floor, and on the spot to the left where not.
    fn seek(&self) -> DriveCommand {
        let aside = (self.radius + 100) as f32;
        let before = (self.radius + 400) as f32;
        let stands = |&(x, y): &(f32, f32)| x > 0.0 && x < before && y.abs() < aside;
        if self.near.points().iter().any(stands) {
            DriveCommand { speed: 0, turn: 600 }
        } else {
            DriveCommand { speed: 200, turn: 0 }
        }
    }

    /// The other robots, and what moves about that is none of the robots.
    fn movers(&self, agent: &mut Agent<'_>, pose: Pose, now: Instant) -> Movers {
        let server_now = agent.server_time(now);
        let commands = agent.commands();
        let mut movers = Movers::new();
        let peers = commands.peers().map_or(&[][..], |peers| &peers.peers);
        for peer in peers {
            // There is room for all.
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
        if age > SEEN {
            return movers;
        }
        let millis = (age.micros() / 1_000) as i32;
        let within = |obstacle: &Obstacle, of: Pose, radius: i32| {
            square(of, obstacle.x, obstacle.y) < i64::from(radius).pow(2)
        };
        for obstacle in &obstacles.obstacles {
            // Cameras may take a robot for something that moves.
            let is_robot = within(obstacle, pose, self.radius)
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
            });
        }
        movers
    }
}

/// Of a circle that holds a robot however it turns, in millimetres.
fn radius(peer: &Peer) -> u16 {
    let (length, width) = (f32::from(peer.half_length), f32::from(peer.half_width));
    libm::sqrtf(length * length + width * width) as u16
}

/// The square of the way from a pose to a point.
fn square(from: Pose, x: Millimetres, y: Millimetres) -> i64 {
    let way = |to: Millimetres, from: Millimetres| i64::from(to.0.saturating_sub(from.0));
    way(x, from.x).pow(2) + way(y, from.y).pow(2)
}

/// What is known of 32 cells: what the server says, and of the others what the robot has seen.
fn ground(agent: &Agent<'_>, now: Instant, column: i32, row: i32) -> GroundRow {
    let side = TILE_SIDE as i32;
    let Some(id) = TileId::of_cell(column.saturating_mul(side), row) else {
        return GroundRow::default();
    };
    let y = row.rem_euclid(side) as usize;
    let around = agent.fused_tiles().around(id, now);
    let mut cells = around.merged.map(|tile| tile.row(y)).unwrap_or_default();
    if let Some(own) = agent.own_tiles().find(id) {
        let (own, unknown) = (own.row(y), !(cells.low | cells.high));
        cells.low |= own.low & unknown;
        cells.high |= own.high & unknown;
    }
    let covered = around.covered.and_then(|rows| rows.get(y)).copied().unwrap_or_default();
    GroundRow { cells, covered }
}
