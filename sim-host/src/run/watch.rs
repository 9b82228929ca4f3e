//! `ubimap watch`: the camera server on recorded frames of fixed cameras.
//!
//! What looks at a frame, and all that follows, is what a simulation has; there are only no robots
//! at the other end of a link.

use std::{cell::RefCell, fmt::Write, rc::Rc, time};

use ubimap_protocol::{
    message::{Obstacle, ObstacleClass},
    time::{Duration, Instant},
    units::{Pose, RobotId},
};

use super::{
    Outcome, RunError,
    fleet::{Event, Fleet, Stage},
    options::WatchOptions,
    progress::Progress,
    registry::Registry,
};
use crate::{
    camera::{FrameSource, Sighting},
    channel::fault::Faults,
    grid::OccupancyGrid,
    recording::RecordedFrames,
    report::{
        self, CameraSummary, HexDigest, Marker, MarkerKind, PassedEvent, SeenMap, SeenRobot,
        SeenThing, WatchReport,
    },
    server::Server,
};

/// What was followed so short a time before the end is there then.
const AT_THE_END: Duration = Duration::from_secs(1);

/// Watches a recording.
///
/// # Errors
/// What is wrong with the recording or the file of robots.
pub fn run(options: &WatchOptions) -> Result<Outcome<WatchReport>, RunError> {
    let started = time::Instant::now();
    let frames = RecordedFrames::open(&options.folders)?;
    frames.notes().iter().for_each(|note| log::info!("{note}"));
    let registry = Registry::find(options.robots.as_deref(), &options.folders)?;

    let mut fleet = Fleet::new(&[], &mut [], Faults::default(), options.resolution, 0, None)?;
    for (robot, footprint) in registry.footprints() {
        fleet.set_footprint(robot, footprint);
    }
    fleet.look_through(registry.observer(frames.cameras(), options.resolution)?);
    let looks = Rc::new(RefCell::new(vec![0; frames.cameras().len()]));
    let counted = Rc::clone(&looks);
    fleet.watch(Box::new(move |observation| {
        counted.borrow_mut()[observation.camera] += u64::from(!observation.cells.is_empty());
    }));

    let progress = Progress::new(frames.end(), options.json);
    let mut played = Played(frames);
    fleet.run(&mut played, |fleet| progress.at(Instant(0) + fleet.elapsed()))?;
    progress.finish();
    let Played(mut frames) = played;
    if let Some(fault) = frames.take_fault() {
        return Err(fault.into());
    }

    let server = fleet.server();
    let grid_of = |layer: &crate::mapping::ServedLayer| {
        OccupancyGrid::from_tiles(layer.tiles().map(|(id, _, tile)| (id, tile)), options.resolution)
    };
    let (map, coverage) = (grid_of(server.fused())?, grid_of(server.coverage())?);
    let looks = looks.take();
    let cameras = frames.cameras().iter().zip(frames.names()).zip(&looks);
    for ((_, name), _) in cameras.filter(|((it, _), looks)| it.depth.is_some() && **looks == 0) {
        log::warn!(
            "{name} has told of no cell: it takes more than 15 depth images, 0.3 s apart or more, to \
             learn the room first, or its pose is wrong (z is up, and the floor at 0)"
        );
    }
    let cameras = frames.names().iter().zip(frames.counts()).zip(&looks);
    let cameras = cameras.map(|((name, (frames, lost)), &looks)| CameraSummary {
        name: name.clone(),
        frames,
        lost,
        looks,
    });
    let counts = map.counts();
    let report = WatchReport {
        cameras: cameras.collect(),
        robots: seen_robots(&registry, &fleet, &frames),
        things: things(&fleet).iter().map(thing).collect(),
        events: events(server, &frames),
        map: SeenMap {
            resolution_m: map.resolution_m(),
            known: counts.known as u64,
            free: counts.free as u64,
            occupied: counts.occupied as u64,
            in_view: coverage.counts().known as u64,
            digest: HexDigest(server.fused().digest().0),
        },
        recorded_s: fleet.elapsed().micros() as f64 / 1e6,
        elapsed_s: started.elapsed().as_secs_f64(),
        ..WatchReport::default()
    };
    Ok(Outcome {
        report,
        markers: markers(&fleet),
        pictures: vec![("coverage.png", report::render_coverage(&map, &coverage))],
        tables: vec![("robots.csv", poses_csv(&fleet, &frames))],
        map,
    })
}

/// Recorded frames as events.
struct Played(RecordedFrames);

impl Stage for Played {
    fn next_event(&self) -> Option<Instant> {
        self.0.next_arrival()
    }

    fn poll(&mut self, now: Instant) -> Option<Event> {
        self.0.poll(now).map(Event::Frame)
    }
}

/// When and where a robot was localised.
fn sightings_of(fleet: &Fleet<'_>, robot: RobotId) -> Vec<(Instant, Sighting)> {
    let all = fleet.sightings().iter();
    let mut found: Vec<_> = all.filter(|(_, it)| it.robot == robot).copied().collect();
    // Frames may come in any order.
    found.sort_by_key(|(captured, _)| *captured);
    found
}

/// The robots that the cameras localised.
fn localised(fleet: &Fleet<'_>) -> Vec<(RobotId, Vec<(Instant, Sighting)>)> {
    let mut robots: Vec<RobotId> = fleet.sightings().iter().map(|(_, it)| it.robot).collect();
    robots.sort_unstable();
    robots.dedup();
    robots.into_iter().map(|robot| (robot, sightings_of(fleet, robot))).collect()
}

fn seen_robots(registry: &Registry, fleet: &Fleet<'_>, frames: &RecordedFrames) -> Vec<SeenRobot> {
    let mut robots: Vec<RobotId> = registry.footprints().map(|(robot, _)| robot).collect();
    robots.sort_unstable();
    let summary = |robot| {
        let seen = sightings_of(fleet, robot);
        let last = seen.last();
        SeenRobot {
            id: robot.0,
            sightings: seen.len() as u64,
            last_s: last.map(|(captured, _)| frames.clock_s(*captured)),
            pose: last.map(|(_, sighting)| metres_and_degrees(sighting.pose)),
        }
    };
    robots.into_iter().map(summary).collect()
}

fn metres_and_degrees(pose: Pose) -> [f64; 3] {
    [pose.x.metres(), pose.y.metres(), pose.heading.degrees()]
}

/// What the cameras followed at the end.
fn things(fleet: &Fleet<'_>) -> Vec<Obstacle> {
    let (moment, obstacles) = fleet.server().obstacles();
    if fleet.now().since(moment) <= AT_THE_END { obstacles } else { Vec::new() }
}

fn thing(obstacle: &Obstacle) -> SeenThing {
    let metres = |millimetres: i16| f64::from(millimetres) / 1000.0;
    SeenThing {
        class: match obstacle.class {
            ObstacleClass::Person => "person",
            ObstacleClass::Movable => "movable",
            ObstacleClass::Fixed => "fixed",
        },
        position_m: [obstacle.x.metres(), obstacle.y.metres()],
        velocity_m_s: [obstacle.velocity_x, obstacle.velocity_y].map(metres),
        radius_m: f64::from(obstacle.radius) / 1000.0,
    }
}

fn events(server: &Server, frames: &RecordedFrames) -> Vec<PassedEvent> {
    let event =
        |what: String, count, last| PassedEvent { what, count, last_s: frames.clock_s(last) };
    let of_robots = server.sighting_events().iter();
    let of_robots = of_robots.map(|(what, count, last)| event(what.to_string(), count, last));
    let of_people = server.person_events().iter();
    of_robots
        .chain(of_people.map(|(what, count, last)| event(what.to_string(), count, last)))
        .collect()
}

/// The robots with their ways, where they were localised last, and the people at the end.
fn markers(fleet: &Fleet<'_>) -> Vec<Marker> {
    let robots = localised(fleet).into_iter().filter_map(|(_, seen)| {
        let &(_, Sighting { pose, .. }) = seen.last()?;
        Some(Marker {
            kind: MarkerKind::Robot,
            x_m: pose.x.metres(),
            y_m: pose.y.metres(),
            heading_rad: pose.heading.radians(),
            path: seen.iter().map(|(_, it)| [it.pose.x.metres(), it.pose.y.metres()]).collect(),
        })
    });
    let people = things(fleet).into_iter().filter(|it| it.class == ObstacleClass::Person);
    let people = people.map(|person| Marker {
        kind: MarkerKind::Person,
        x_m: person.x.metres(),
        y_m: person.y.metres(),
        heading_rad: f64::from(person.velocity_y).atan2(person.velocity_x.into()),
        path: Vec::new(),
    });
    robots.chain(people).collect()
}

/// Every pose of every robot, by the recording's clock.
fn poses_csv(fleet: &Fleet<'_>, frames: &RecordedFrames) -> String {
    let mut text = "time_s,robot,x_m,y_m,heading_deg,sd_x_m,sd_y_m,sd_heading_deg\n".to_owned();
    for (robot, seen) in localised(fleet) {
        for (captured, Sighting { pose, certainty, .. }) in seen {
            let [x, y, heading] = metres_and_degrees(pose);
            let [sd_x, sd_y] = [certainty.x, certainty.y].map(|it| f64::from(it) / 1000.0);
            let sd_heading = f64::from(certainty.heading) * 360.0 / 65536.0;
            let time = frames.clock_s(captured);
            // To a string: there is nothing that could fail.
            let _ = writeln!(
                text,
                "{time:.6},{},{x:.3},{y:.3},{heading:.2},{sd_x:.3},{sd_y:.3},{sd_heading:.2}",
                robot.0
            );
        }
    }
    text
}
