//! Constant errors of robots in a simulated room: found, told apart and cured. `UBIMAP_SEEDS=10` runs
//! ten seeds.

use std::{cell::RefCell, collections::BTreeMap, rc::Rc};

use ubimap_protocol::{
    time::{Duration, Instant},
    units::RobotId,
};
use ubimap_sim_host::{
    camera::Sighting,
    channel::fault::Faults,
    grid::OccupancyGrid,
    run::{
        fleet::{Event, Fleet, OWN_TILES, Stage},
        scoring::score,
        simulate::{RESOLUTION, Room, config, memory},
    },
    server::RobotEvent,
    world::{Scenario, World},
};
use ubimap_tests::seeds::seeds;

/// Whose sensor is askew, and whose identifier.
const SENSOR: RobotId = RobotId(4);
const IDENTIFIER: RobotId = RobotId(3);

/// A room that counts for how long each robot has been in view.
struct Watched {
    room: Room,
    /// The last moment, and the time in view, of each robot.
    seen: Rc<RefCell<BTreeMap<RobotId, (Instant, Duration)>>>,
}

impl Stage for Watched {
    fn next_event(&self) -> Option<Instant> {
        self.room.next_event()
    }

    fn poll(&mut self, now: Instant) -> Option<Event> {
        let event = self.room.poll(now)?;
        if let Event::Observation(observation) = &event {
            for &Sighting { robot, .. } in &observation.robots {
                let mut seen = self.seen.borrow_mut();
                let (last, time) = seen.entry(robot).or_default();
                let gap = observation.captured.since(*last);
                if gap <= Duration::from_millis(200) {
                    *time = Duration(time.0 + gap.0);
                }
                *last = (*last).max(observation.captured);
            }
        }
        Some(event)
    }
}

/// What a run came to.
struct Run {
    f1: f64,
    /// What has been taken out of the fixes of each robot, and added to its sensor's heading, in
    /// degrees, and after how many seconds in view.
    identifiers: BTreeMap<RobotId, (f64, f64)>,
    sensors: BTreeMap<RobotId, (f64, f64)>,
    /// What robots did that none should.
    events: Vec<RobotEvent>,
}

fn run(seed: u64, askew_deg: f64, cures: bool) -> Run {
    let mut scenario = Scenario::built_in().unwrap();
    for robot in &mut scenario.robots {
        match RobotId(robot.id) {
            SENSOR => robot.sensor.askew_deg = askew_deg,
            IDENTIFIER => robot.identifier_askew_deg = -askew_deg,
            _ => {}
        }
    }
    let world = World::new(&scenario, None, RESOLUTION, seed).unwrap();
    let configs: Vec<_> = world.robots().iter().map(|robot| config(robot, seed)).collect();
    let mut memory = memory(&world, &configs, OWN_TILES);
    let faults = Faults { latency: Duration::from_millis(20), ..Faults::default() };
    let mut fleet = Fleet::new(&configs, &mut memory, faults, RESOLUTION, seed, None).unwrap();
    if !cures {
        fleet.leave_errors();
    }
    let seen = Rc::new(RefCell::new(BTreeMap::new()));
    let end = Instant(0) + Duration::from_secs(240);
    let mut stage = Watched { room: Room::new(world, end), seen: seen.clone() };
    let (mut identifiers, mut sensors) = (BTreeMap::new(), BTreeMap::new());
    let converged = fleet.run(&mut stage, |fleet| {
        for robot in configs.iter().map(|config| config.robot) {
            let Some(errors) = fleet.server().errors(robot) else { continue };
            let in_view = seen
                .borrow()
                .get(&robot)
                .map_or(0.0, |it: &(_, Duration)| it.1.micros() as f64 / 1e6);
            let note = |of: &mut BTreeMap<_, _>, degrees: f64| {
                if degrees != 0.0 {
                    let first = of.get(&robot).map_or(in_view, |it: &(f64, f64)| it.1);
                    of.insert(robot, (degrees, first));
                }
            };
            note(&mut identifiers, errors.cured().taken_out);
            note(&mut sensors, errors.cured().added);
        }
    });
    assert!(converged.unwrap());
    let tiles = fleet.server().fused().tiles().map(|(id, _, tile)| (id, tile));
    let map = OccupancyGrid::from_tiles(tiles, RESOLUTION).unwrap();
    let f1 = score(&map, stage.room.world()).unwrap().f1_occupied;
    let events = fleet.server().robot_events().iter().map(|(event, ..)| event).collect();
    Run { f1, identifiers, sensors, events }
}

/// How far off what was found of one kind of error is, over all runs: degrees, and seconds in view.
#[derive(Debug, Default)]
struct Off {
    greatest_deg: f64,
    squares: f64,
    latest_s: f64,
}

impl Off {
    /// Takes what a run has found: it must be of this robot alone.
    fn add(&mut self, found: &BTreeMap<RobotId, (f64, f64)>, robot: RobotId, truth_deg: f64) {
        let [(&who, &(degrees, seconds))] = found.iter().collect::<Vec<_>>()[..] else {
            panic!("{found:?}")
        };
        assert_eq!(who, robot);
        let off = degrees - truth_deg;
        self.greatest_deg = self.greatest_deg.max(off.abs());
        self.squares += off * off;
        self.latest_s = self.latest_s.max(seconds);
    }
}

/// Ahmed's stated error, a heading that is wrong by some degrees, and its cure.
#[test]
fn askew_sensors_and_identifiers_are_told_apart_and_cured() {
    let (mut falls, mut offs, mut count) = ([0.0; 2], <[Off; 2]>::default(), 0.0);
    for seed in seeds(3) {
        let [straight, left, cured] =
            [(0.0, true), (3.0, false), (3.0, true)].map(|(askew, cures)| run(seed, askew, cures));
        println!(
            "seed {seed}: F1 {:.4} without errors, {:.4} with them, {:.4} cured; sensors {:.2?}, \
             identifiers {:.2?} (degrees, seconds in view)",
            straight.f1, left.f1, cured.f1, cured.sensors, cured.identifiers
        );
        assert!(straight.sensors.is_empty() && straight.identifiers.is_empty(), "seed {seed}");
        // What is explained lowers nobody's weight.
        assert_eq!((straight.events, cured.events), (vec![], vec![]), "seed {seed}");
        offs[0].add(&cured.sensors, SENSOR, 3.0);
        offs[1].add(&cured.identifiers, IDENTIFIER, -3.0);
        falls[0] += straight.f1 - left.f1;
        falls[1] += straight.f1 - cured.f1;
        count += 1.0;
    }
    for (name, Off { greatest_deg, squares, latest_s }) in
        ["sensor", "identifier"].iter().zip(&offs)
    {
        println!(
            "{name}: off by at most {greatest_deg:.2} degrees, {:.2} RMS, after at most {latest_s:.1} s \
             in view",
            (squares / count).sqrt()
        );
    }
    falls = falls.map(|it| it / count);
    println!(
        "F1 falls by {:.4} if they are left, and by {:.4} if they are cured",
        falls[0], falls[1]
    );
    assert!(offs.iter().all(|it| it.greatest_deg <= 0.5 && it.latest_s <= 30.0), "{offs:?}");
    assert!(falls[0] > 0.05 && falls[1] <= 0.01, "{falls:?}");
}
