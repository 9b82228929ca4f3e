//! A floor with point robots that follow their paths with delays, random speeds and stops.

use std::collections::VecDeque;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ubimap_protocol::{
    message::{EventCode, Obstacle, ObstacleClass},
    tile::{Cell, Tile, TileId},
    time::{Duration, Instant},
    units::{Angle, Millimetres, Pose, RobotId},
};

use super::plan::{Plan, SIDE_M, middle, set};
use crate::{
    mapping::ServedLayer,
    server::{
        Command, Footprint,
        coordination::{
            Coordinator, Notice, Settings, Situation, Whereabouts, ground::Point,
            settings::ExplorationRules,
        },
    },
};

const STEP: Duration = Duration::from_millis(50);
/// Circumscribed radius of robots of 40 cm by 40 cm.
pub(super) const RADIUS_M: f64 = 0.2828;
/// Range of their sensors.
const RANGE_M: f64 = 3.0;

pub(super) struct Body {
    pub(super) place: Point,
    speed: f64,
    path: VecDeque<Point>,
    is_done: bool,
    stands_until: Instant,
    /// When a person or a wall began to block its way.
    blocked_since: Option<Instant>,
    pub(super) obeys: bool,
    /// Paths in flight to the robot, and pose reports in flight from it.
    mail: VecDeque<(Instant, Vec<Point>)>,
    reports: VecDeque<(Instant, Instant, Point)>,
    reported: (Instant, Point),
    pub(super) driven: f64,
}

pub(super) struct Floor {
    pub(super) plan: Plan,
    pub(super) coordinator: Coordinator,
    pub(super) bodies: Vec<Body>,
    /// Positions of people, and their speeds along x.
    pub(super) people: Vec<(Point, f64)>,
    pub(super) fused: ServedLayer,
    pub(super) coverage: ServedLayer,
    /// Whether robots carry tags that cameras detect.
    pub(super) has_tags: bool,
    pub(super) now: Instant,
    pub(super) notices: Vec<(Instant, RobotId, Notice)>,
    /// Number of pairs of robots whose discs overlapped, and of robots in walls, each summed over
    /// all steps.
    pub(super) overlaps: u32,
    pub(super) collisions: u32,
    pub(super) slowest_tick: std::time::Duration,
    pub(super) last_tick: Option<std::time::Duration>,
    pub(super) paths: u32,
    rng: ChaCha8Rng,
}

pub(super) fn id(index: usize) -> RobotId {
    RobotId(index as u16 + 1)
}

impl Body {
    /// Whether a person or a wall blocks its way.
    pub(super) fn is_blocked(&self) -> bool {
        self.blocked_since.is_some()
    }
}

impl Floor {
    /// A floor on which all cells are known except those for which `hides` is true.
    pub(super) fn new(
        plan: Plan,
        starts: &[Point],
        seed: u64,
        hides: impl Fn(Point) -> bool,
    ) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut fused = ServedLayer::default();
        let seen = plan.places().filter(|it| !hides(middle(*it)));
        set(&mut fused, seen.map(|it| (it, plan.cell(middle(it)))));
        let body = |&place: &Point| Body {
            place,
            speed: rng.random_range(0.25..0.6),
            path: VecDeque::new(),
            is_done: true,
            stands_until: Instant(0),
            blocked_since: None,
            obeys: true,
            mail: VecDeque::new(),
            reports: VecDeque::new(),
            reported: (Instant(0), place),
            driven: 0.0,
        };
        let bodies = starts.iter().map(body).collect();
        let settings = Settings {
            view_m: 2.0,
            range_m: RANGE_M,
            look: Duration::from_millis(1_500),
            exploration: ExplorationRules {
                returns_after: Some(Duration::from_secs(4)),
                ..ExplorationRules::default()
            },
            ..Settings::default()
        };
        let mut floor = Self {
            plan,
            coordinator: Coordinator::new(settings),
            bodies,
            people: Vec::new(),
            fused,
            coverage: ServedLayer::default(),
            has_tags: true,
            now: Instant(0),
            notices: Vec::new(),
            overlaps: 0,
            collisions: 0,
            slowest_tick: Default::default(),
            last_tick: None,
            paths: 0,
            rng,
        };
        // After one tick, the coordinator knows all robots.
        floor.tick();
        floor
    }

    pub(super) fn is_blocked(&self) -> bool {
        self.overlaps + self.collisions > 0
    }

    /// Runs until `until` returns true, but at most for `seconds`. Returns whether it did.
    pub(super) fn run(&mut self, seconds: u64, mut until: impl FnMut(&mut Self) -> bool) -> bool {
        let end = self.now + Duration::from_secs(seconds);
        while self.now < end {
            self.step();
            if until(self) {
                return true;
            }
        }
        false
    }

    /// Like [`Self::run`], with robots that look around twice a second.
    pub(super) fn run_looking(
        &mut self,
        seconds: u64,
        mut until: impl FnMut(&mut Self) -> bool,
    ) -> bool {
        let mut looked = 0;
        self.run(seconds, |floor| {
            let half_seconds = floor.now.micros() / 500_000;
            if half_seconds != core::mem::replace(&mut looked, half_seconds) {
                floor.look_around();
            }
            until(floor)
        })
    }

    /// Lets cameras see the ground where `is_seen` holds.
    pub(super) fn cover(&mut self, is_seen: impl Fn(Point) -> bool) {
        let seen: Vec<_> = self.plan.places().filter(|it| is_seen(middle(*it))).collect();
        set(&mut self.coverage, seen.into_iter().map(|it| (it, Cell::Free)));
    }

    pub(super) fn count(&self, which: Notice) -> usize {
        self.notices.iter().filter(|(_, _, notice)| *notice == which).count()
    }

    fn step(&mut self) {
        self.now = self.now + STEP;
        for (place, velocity) in &mut self.people {
            place.x += *velocity * STEP.micros() as f64 / 1e6;
            if place.x < 0.4 || place.x > self.plan.width - 0.4 {
                *velocity = -*velocity;
            }
        }
        for index in 0..self.bodies.len() {
            self.drive(index);
        }
        for (index, body) in self.bodies.iter().enumerate() {
            let others = self.bodies[index + 1..].iter();
            let near = others.filter(|other| (other.place - body.place).norm() < 2.0 * RADIUS_M);
            self.overlaps += near.count() as u32;
            self.collisions += u32::from(self.plan.room_around(body.place) < RADIUS_M);
        }
        if self.coordinator.poll_timeout() <= self.now {
            self.tick();
        }
    }

    fn drive(&mut self, index: usize) {
        let (now, rng) = (self.now, &mut self.rng);
        let body = &mut self.bodies[index];
        while let Some((_, path)) = body.mail.pop_front_if(|(at, _)| *at <= now) {
            body.path = path.into();
            body.is_done = false;
        }
        if rng.random_bool(0.001) {
            body.stands_until = now + Duration::from_millis(rng.random_range(500..6_000));
        }
        let step_m = body.speed * STEP.micros() as f64 / 1e6;
        let mut event = None;
        if now >= body.stands_until && body.obeys {
            match body.path.front().copied() {
                Some(next) => {
                    let way = next - body.place;
                    let ahead = body.place + way * (0.3 / way.norm().max(0.3));
                    let is_near =
                        |(it, _): &(Point, f64)| (it - ahead).norm() < RADIUS_M + 0.25 + 0.1;
                    let next = body.place + way * (step_m / way.norm()).min(1.0);
                    // The robot also stops for an unmapped wall.
                    let room_m = self.plan.room_around(next);
                    let is_wall = room_m < RADIUS_M.min(self.plan.room_around(body.place));
                    if is_wall || self.people.iter().any(is_near) {
                        let since = *body.blocked_since.get_or_insert(now);
                        if now == since && !is_wall {
                            event = Some(EventCode::StoppedByPerson);
                        } else if now.since(since) == Duration::from_secs(2) {
                            event = Some(EventCode::PathBlocked);
                        }
                    } else if way.norm() < 0.05 {
                        body.path.pop_front();
                        body.blocked_since = None;
                    } else {
                        body.place = next;
                        body.driven += step_m;
                        body.blocked_since = None;
                    }
                }
                None if !body.is_done => {
                    body.is_done = true;
                    event = Some(EventCode::PathDone);
                }
                None => {}
            }
        }
        let noise = || rng.random_range(-0.015..0.015);
        let seen = body.place
            + nalgebra::Vector2::from_fn({
                let mut noise = noise;
                move |_, _| noise()
            });
        let delay = Duration::from_millis(rng.random_range(50..300));
        body.reports.push_back((now + delay, now, seen));
        while let Some((_, moment, place)) = body.reports.pop_front_if(|(at, ..)| *at <= now) {
            body.reported = (moment, place);
        }
        if let Some(event) = event {
            self.coordinator.event(id(index), event, now);
        }
    }

    /// Whether a camera sees a place; without any camera, all places count as seen.
    pub(super) fn is_in_view(&self, place: Point) -> bool {
        let [column, row] = [place.x, place.y].map(|metres| (metres / SIDE_M).floor() as i32);
        let Some(id) = TileId::of_cell(column, row) else { return false };
        let (west, south) = id.first_cell();
        let cell =
            |(_, tile): (_, &Tile)| tile.cell((column - west) as usize, (row - south) as usize);
        self.coverage.tiles().next().is_none()
            || self.coverage.get(id).is_some_and(|it| cell(it) == Cell::Free)
    }

    fn tick(&mut self) {
        let robot = |(index, body): (usize, &Body)| Whereabouts {
            robot: id(index),
            moment: body.reported.0,
            pose: Pose {
                x: Millimetres::from_metres(body.reported.1.x),
                y: Millimetres::from_metres(body.reported.1.y),
                heading: Angle(0),
            },
            is_in_view: self.has_tags && self.is_in_view(body.reported.1),
            footprint: Footprint::default(),
            obeys: body.obeys,
        };
        let robots: Vec<Whereabouts> = self.bodies.iter().enumerate().map(robot).collect();
        let obstacle = |(place, velocity): &(Point, f64)| Obstacle {
            number: 1,
            class: ObstacleClass::Person,
            x: Millimetres::from_metres(place.x),
            y: Millimetres::from_metres(place.y),
            velocity_x: (velocity * 1000.0) as i16,
            velocity_y: 0,
            radius: 250,
        };
        let obstacles: Vec<Obstacle> = self.people.iter().map(obstacle).collect();
        let situation = Situation {
            fused: &self.fused,
            coverage: &self.coverage,
            robots: &robots,
            obstacles: &obstacles,
        };
        let before = std::time::Instant::now();
        self.coordinator.tick(&situation, self.now);
        self.last_tick = Some(before.elapsed());
        self.slowest_tick = self.slowest_tick.max(before.elapsed());
        while let Some((robot, command)) = self.coordinator.poll_command() {
            let Command::Path(path) = command else { panic!("{command:?}") };
            let body = &mut self.bodies[usize::from(robot.0) - 1];
            self.paths += 1;
            let place =
                |it: &ubimap_protocol::message::Waypoint| Point::new(it.x.metres(), it.y.metres());
            let delay = Duration::from_millis(self.rng.random_range(50..500));
            let arrives = body.mail.back().map_or(Instant(0), |(at, _)| *at).max(self.now + delay);
            body.mail.push_back((arrives, path.waypoints.iter().map(place).collect()));
        }
        while let Some((robot, notice)) = self.coordinator.poll_notice() {
            self.notices.push((self.now, robot, notice));
        }
    }

    /// Lets all robots see the cells within sight and range. Returns the number of cells that were
    /// unknown before.
    pub(super) fn look_around(&mut self) -> usize {
        let unknown: Vec<(i32, i32)> = self
            .plan
            .places()
            .filter(|&it| self.is_unknown(it) && self.plan.cell(middle(it)) != Cell::Unknown)
            .filter(|&it| self.bodies.iter().any(|body| self.sees(body.place, middle(it))))
            .collect();
        let seen: Vec<_> = unknown.into_iter().map(|it| (it, self.plan.cell(middle(it)))).collect();
        let count = seen.len();
        set(&mut self.fused, seen.into_iter());
        count
    }

    pub(super) fn is_unknown(&self, (x, y): (i32, i32)) -> bool {
        let tile = ubimap_protocol::tile::TileId::of_cell(x, y).unwrap();
        self.fused.get(tile).is_none_or(|(_, tile)| {
            tile.cell(x.rem_euclid(32) as usize, y.rem_euclid(32) as usize) == Cell::Unknown
        })
    }

    /// Whether there is nothing between two places; the second one may be occupied.
    fn sees(&self, from: Point, to: Point) -> bool {
        let way = to - from;
        let steps = (way.norm() / SIDE_M * 2.0) as usize;
        way.norm() < RANGE_M
            && (0..steps.saturating_sub(2))
                .all(|step| self.plan.room_around(from + way * (step as f64 / steps as f64)) > 0.0)
    }

    /// A random place in a rectangle, with clearance from walls and from `others`.
    pub(super) fn free_place(
        plan: &Plan,
        rng: &mut ChaCha8Rng,
        [west, south, east, north]: [f64; 4],
        others: &[Point],
    ) -> Point {
        loop {
            let place = Point::new(rng.random_range(west..east), rng.random_range(south..north));
            let is_apart = |it: &Point| (it - place).norm() > 0.9;
            if plan.room_around(place) > 0.4 && others.iter().all(is_apart) {
                return place;
            }
        }
    }
}
