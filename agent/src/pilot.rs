//! An agent and a driver on one robot: what the agent hears and maps is what the driver drives by.

use heapless::Vec;
use ubimap_protocol::{
    message::{EventCode, MAX_OBSTACLES, MAX_PEERS, Obstacle, ObstacleClass, Peer, Waypoint},
    tile::{TILE_SIDE, TileId},
    time::Instant,
    units::{Millimetres, Pose},
};

use crate::{
    Agent,
    drive::{
        Config, DriveCommand, Driver, GroundRow, Health, Inputs, Mover, NearPoints, Reason, Stops,
        Task,
    },
    timing::OBSTACLE_LOST,
};

/// A point on the way is passed from this near, in millimetres.
const PASSED: i32 = 150;

type Movers = Vec<Mover, { MAX_PEERS + MAX_OBSTACLES }>;

/// Drives the robot of an agent along the paths that the server sends, a point after the other, and
/// explores without a server if it may. It takes about 12 kB.
#[derive(Debug)]
pub struct Pilot {
    driver: Driver,
    near: NearPoints,
    /// The robot's radius, in millimetres.
    radius: i32,
    /// The number of the path, and which of its points is next.
    path: Option<u32>,
    next: usize,
    /// Of a robot that stops for each scan.
    stops: Option<Stops>,
    /// What it does as long as it has never heard a server.
    alone: Option<Task>,
}

impl Pilot {
    /// A pilot that stands until the server sends a path.
    pub fn new(config: Config) -> Self {
        let radius = config.motion.radius.into();
        let near = NearPoints::default();
        Self {
            driver: Driver::new(config),
            near,
            radius,
            path: None,
            next: 0,
            stops: None,
            alone: None,
        }
    }

    /// Lets it stop for each scan that is mapped: see [`Pilot::takes_scan`].
    pub fn stop_for_scans(&mut self, stops: Stops) {
        self.stops = Some(stops);
    }

    /// Lets it explore by its own map and odometry, and then come home, as long as it has never
    /// heard a server; its agent's [`PoseSource`](crate::locate::PoseSource) must be odometry.
    pub fn explore_alone(&mut self, home: Waypoint) {
        self.alone = Some(Task::Explore(Some(home)));
    }

    /// What it drives by.
    pub fn driver(&self) -> &Driver {
        &self.driver
    }

    /// Whether the agent is to be given a scan that was taken at `taken`: always, unless the robot
    /// stops for scans and does not stand where it has been localised.
    pub fn takes_scan(&mut self, agent: &Agent<'_>, taken: Instant) -> bool {
        self.stops.as_mut().is_none_or(|stops| stops.takes(taken, agent.newest_fix()))
    }

    /// Takes a scan, whether the agent was given it or not: its readings, and when it was taken.
    pub fn scan(&mut self, agent: &Agent<'_>, readings: &[u16], taken: Instant) {
        self.near = NearPoints::of_scan(agent.beams(), readings, agent.config().mounting, taken);
    }

    /// What the wheels shall do until the next step. Steps should come at 10 Hz or more, each after
    /// a reading of the odometry. All times are the robot's clock.
    pub fn step(&mut self, agent: &mut Agent<'_>, now: Instant) -> DriveCommand {
        let pose = agent.pose_at(now);
        let last = self.follow(agent, pose.map(|(pose, _)| pose));
        let movers = pose.map(|(pose, _)| self.movers(agent, pose, now)).unwrap_or_default();
        let odometry = agent.newest_odometry();
        let heard = agent.heard().filter(|_| agent.is_connected());
        let stops = self.stops.as_mut().is_some_and(|stops| stops.must_stand(odometry, now));
        let health = Health {
            now,
            heard: if self.is_alone(agent) { Some(now) } else { heard },
            must_stop: agent.commands().must_stop() || stops,
            pose,
            odometry,
            scan: self.near.taken(),
        };
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
            let task = self.alone.filter(|_| self.is_alone(agent)).unwrap_or(Task::Stand);
            if self.path.take().is_some() || self.driver.task() != task {
                self.driver.set_task(task);
            }
            return true;
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

    /// Whether it may do without a server, and has never heard one.
    fn is_alone(&self, agent: &Agent<'_>) -> bool {
        self.alone.is_some() && agent.heard().is_none()
    }

    /// A path that goes on to the same point is no news.
    fn head_for(&mut self, point: Waypoint) {
        let heads_there = self.driver.task() == Task::Go(point);
        if !heads_there || self.driver.reason() == Reason::Arrived {
            self.driver.go_to_next(point);
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
        if age > OBSTACLE_LOST {
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
