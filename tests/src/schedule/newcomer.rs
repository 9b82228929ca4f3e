//! How long a robot that joins or reboots takes to get the map around it; and whether a robot loses
//! tiles while another one uses its number.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ubimap_agent::{Bounds, Config, Memory, locate::PoseSource};
use ubimap_protocol::{
    frame::DEFAULT_FRAME,
    tile::Layer,
    time::{Duration, Instant},
    units::Pose,
};
use ubimap_sim_host::channel::fault::Faults;

use super::{Happening, PATIENCE, STEP, Schedule};
use crate::star::{Member, Star};

/// Time resolution for a newcomer.
const TICK: Duration = Duration::from_millis(1);

/// Why a robot holds none of the server's tiles.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Newcomer {
    /// The robot is new.
    Joins,
    /// The robot has rebooted.
    Reboots,
}

/// How long a newcomer took to get all tiles of its window.
#[derive(Clone, Copy, Debug)]
pub struct Level {
    /// Time since its boot.
    pub took: Duration,
    /// Round-trip time of a frame.
    pub round_trip: Duration,
    /// Number of tiles in the robot's window.
    pub tiles: usize,
    /// Total bytes that the server sent to the robot meanwhile.
    pub bytes: u64,
}

impl Level {
    /// Time limit: two round trips (Hello and Welcome, Interest and tiles), plus the time to send
    /// all bytes at 2 kB/s except one second's worth and one frame, as the rate limiter counts
    /// whole frames. The server's delay of changes (up to 1 s) does not matter, as nothing changes.
    pub fn bound(&self) -> Duration {
        let paced = self.bytes.saturating_sub(2_000) * 1_000_000 / 2_000;
        let frame = DEFAULT_FRAME as u64 * 1_000_000 / 2_000;
        Duration(2 * self.round_trip.0 + TICK.0 + paced + if paced > 0 { frame } else { 0 })
    }
}

impl Schedule {
    /// A schedule on a clean link, for [`Self::level_after`]: two robots, the second of which is
    /// the newcomer.
    pub fn newcomer(seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut schedule = Self::quiet(seed, &mut rng, 2, Instant(20_000_000));
        for plan in &mut schedule.plans {
            plan.config.pose_source = PoseSource::Odometry(Pose::default());
            let bounds = &mut plan.config.bounds;
            (bounds.own_tiles, bounds.fused_tiles, bounds.max_range) = (128, 100, 4_000);
            plan.scan_every = 3;
        }
        schedule.frame = DEFAULT_FRAME as u16;
        schedule.calm_faults =
            Faults { latency: schedule.calm_faults.latency, ..Faults::default() };
        schedule
    }

    /// The first robot maps. When everything has settled, the second one boots, knows its pose and
    /// sees nothing. Measures how long the second robot takes to hold its window.
    ///
    /// # Panics If it never holds its window.
    pub fn level_after(&self, who: Newcomer) -> Level {
        let plans = [&self.plans[0], &self.plans[1], &self.plans[1]];
        let mut lives = plans.map(|plan| Memory::new(&plan.config.bounds));
        let [first, second, third] = &mut lives;
        let terms = self.terms();
        let mut star = Star::new(terms, self.ports, self.seed);
        let ids = self.plans.iter().enumerate();
        star.members = ids.map(|(port, plan)| Member::new(plan.config.robot, port)).collect();
        let (up, down) = (self.calm_faults, self.calm_faults);
        for robot in 0..2 {
            self.happen(&mut star, Instant(0), Happening::Weather { robot, up, down });
        }
        star.boot(0, self.plans[0].config, first);
        if who == Newcomer::Reboots {
            star.boot(1, self.plans[1].config, second);
        }
        // Some of the worlds are full of rubble, so that the encoded tiles are long.
        let mut rubble = ChaCha8Rng::seed_from_u64(self.seed);
        let density = if self.seed.is_multiple_of(2) { 0.0 } else { 0.9 };
        let mut step = 0;
        while Instant(step * STEP.0) < self.calm {
            star.run_until(Instant(step * STEP.0));
            if rubble.random_bool(density) {
                let readings = (0..self.sensor.beams).map(|_| rubble.random_range(300..4_000));
                let pose = self.plans[0].walk.pose(star.now());
                star.scan(0, Some(pose), &readings.collect::<Vec<u16>>());
            } else {
                self.step(&mut star, step);
            }
            step += 1;
        }
        star.run_until(self.calm + Duration::from_secs(20));
        assert_eq!(star.behind(), None);

        let booted = star.now();
        let before = star.members[1].down.bytes();
        star.boot(1, Config { boot_nonce: 99, ..self.plans[1].config }, third);
        star.scan(1, Some(self.plans[1].walk.pose(booted)), &vec![0; self.sensor.beams]);
        while star.holds_its_window(1) != Some(true) {
            assert!(star.now() < booted + PATIENCE, "the newcomer never holds its window");
            star.run_until(star.now() + TICK);
        }
        let fused =
            star.members[1].robot().map(|robot| robot.fused_tiles().tiles(Layer::Fused).count());
        Level {
            took: star.now().since(booted),
            round_trip: Duration(2 * self.calm_faults.latency.0),
            tiles: fused.unwrap_or(0),
            bytes: star.members[1].down.bytes() - before,
        }
    }

    /// Two robots with the first one's number draw the same ground one after the other: the first
    /// one, then the second one while the first one's link is cut, and the first one again. Returns
    /// the number of the first one's tiles whose epochs the second one has closed.
    ///
    /// # Panics If the first one and the server do not have the same map in the end.
    pub fn take_over(mut self) -> usize {
        let plan = &mut self.plans[0];
        let bounds = Bounds { max_range: 1_200, own_tiles: 10, ..plan.config.bounds };
        let config = Config::new(plan.config.robot, self.sensor.model(), bounds);
        plan.config = Config { pose_source: plan.config.pose_source, ..config };
        self.plans = vec![self.plans[0].clone(), self.plans[0].clone()];
        let mut lives = [(); 2].map(|()| Memory::new(&bounds));
        let [first, second] = &mut lives;
        let mut star = Star::new(self.terms(), 2, self.seed);
        star.members = (0..2).map(|port| Member::new(config.robot, port)).collect();
        let seconds = |count| Instant(0) + Duration::from_secs(count);
        // The server keeps the number of a silent robot for 15 s.
        let [change, back, calm] = [40, 180, 260].map(seconds);
        star.boot(0, self.plans[0].config, first);
        self.steps(&mut star, change);
        star.members[0].up.cut(back);
        star.members[0].down.cut(back);
        self.steps(&mut star, change + Duration::from_secs(20));
        star.boot(1, Config { boot_nonce: 99, ..self.plans[1].config }, second);
        self.steps(&mut star, back);
        let layer = star.server().layer(config.robot).expect("it has drawn");
        let tiles = star.members[0].robot().expect("it has booted").own_tiles().tiles();
        let closed = tiles.filter(|it| it.id().is_some_and(|id| layer.is_closed(id, it.epoch())));
        let closed = closed.count();
        star.members[1].up.cut(calm);
        star.members[1].down.cut(calm);
        self.steps(&mut star, calm);
        star.members.truncate(1);
        self.calm = calm;
        let converged = self.converge(&mut star, calm + PATIENCE);
        assert!(converged.is_ok(), "schedule {}: {converged:?}", self.seed);
        star.check_all();
        closed
    }

    fn steps(&self, star: &mut Star<'_>, until: Instant) {
        while star.now() < until {
            let step = star.now().micros() / STEP.0;
            self.step(star, step);
            star.run_until(Instant((step + 1) * STEP.0));
        }
    }
}
