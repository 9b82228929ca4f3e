//! How long a robot that joins or reboots takes to hold the map around it.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ubimap_agent::{Config, Memory, locate::PoseSource};
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

/// How a robot comes to hold none of the server's tiles.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Newcomer {
    /// The robot is new.
    Joins,
    /// The robot has rebooted.
    Reboots,
}

/// How long a newcomer took to hold its window.
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
}
