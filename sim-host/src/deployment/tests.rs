use image::GrayImage;
use nalgebra::Isometry3;
use ubimap_protocol::{
    frame::{DEFAULT_FRAME, MIN_VERSION, VERSION},
    link::{Endpoint, Fill, Received},
    message::{
        Body, Hello, Path, PoseFix, Stored, TileUpdateHead, ToRobotKind, ToServer, Welcome, Writer,
    },
    tile::{Cell, Epoch, Layer, Stamp, Tile, TileEncoder, TileId, Version},
    units::Pose,
};

use super::*;
use crate::{
    camera::{Calibration, DepthImage, DepthNoise, Intrinsics, Lens, Picture},
    perception::{FrameError, robots::SightingEvent},
    server::{self, coordination::Settings},
};

const RESOLUTION: Millimetres = Millimetres(50);
const ROBOT: RobotId = RobotId(1);
const DRAWN: TileId = TileId { x: 3, y: 4 };

fn at(millis: u64) -> Instant {
    Instant(millis * 1_000)
}

/// A deployment with a store that is empty except for its clock.
fn keeping(clock: Instant) -> Deployment {
    let kept = Some(Kept { clock, ..Kept::default() });
    Deployment::new(Config::new(RESOLUTION), Life { kept, ..Life::default() }).unwrap()
}

/// An observation of a robot and a wall.
fn seen(captured: Instant) -> Observation {
    let robots = vec![Sighting::usual(ROBOT, Pose::from_metres(0.5, 0.5, 0.0))];
    let cells = vec![((40, 3), Cell::Occupied)];
    Observation { captured, robots, cells, ..Observation::default() }
}

/// A scripted robot.
struct Robot {
    port: PortId,
    link: Endpoint<ToServer, (), 1, MAX_FRAME>,
}

impl Robot {
    /// Opens a session at a port.
    fn connect(deployment: &mut Deployment, port: PortId, now: Instant) -> Self {
        let mut link = Endpoint::default();
        let hello = Hello {
            version: VERSION,
            min_version: MIN_VERSION,
            robot: ROBOT,
            nonce: 7,
            frame: DEFAULT_FRAME as u16,
            resolution: RESOLUTION,
            fused_tiles: 64,
        };
        let mut out = [0; MAX_FRAME];
        let len = link.handshake(&hello, &mut out).unwrap();
        deployment.receive(port, &out[..len], now).unwrap();
        let (answered, len) = deployment.poll_transmit(now, &mut out).unwrap();
        assert_eq!(answered, port);
        match link.receive(&mut &out[..len], now) {
            Some(Received::Handshake(message)) => {
                let welcome = message.decode::<Welcome>().unwrap();
                link.begin(welcome.session, DEFAULT_FRAME);
            }
            other => panic!("{other:?}"),
        }
        Self { port, link }
    }

    /// Draws a wall into its tile and sends it.
    fn draw(&mut self, deployment: &mut Deployment, version: u32, now: Instant) {
        let mut tile = Tile::UNKNOWN;
        (0..version as usize).for_each(|x| tile.set(x, 0, Cell::Occupied));
        let mut out = [0; MAX_FRAME];
        let stamp = Stamp { epoch: Epoch(1), version: Version(version) };
        let sent =
            self.link.poll_transmit(now, &mut out, true, |writer: &mut Writer<'_, ToServer>, _| {
                let head = TileUpdateHead { layer: Layer::Robot, seconds: 0 };
                assert!(writer.push_with(&head, |coded| {
                    let mut encoder = TileEncoder::new(coded);
                    encoder.push(DRAWN, stamp, None, 0, &Tile::UNKNOWN, &tile)?;
                    encoder.finish()
                }));
                Fill::Datagram
            });
        deployment.receive(self.port, &out[..sent.unwrap().len], now).unwrap();
    }

    /// Receives all frames. Returns the kinds of messages, and the version of the robot's tile that
    /// the server reports as stored.
    fn hear(
        &mut self,
        deployment: &mut Deployment,
        now: Instant,
    ) -> (Vec<ToRobotKind>, Option<Version>) {
        let (mut kinds, mut stored) = (Vec::new(), None);
        let mut out = [0; MAX_FRAME];
        while let Some((port, len)) = deployment.poll_transmit(now, &mut out) {
            assert_eq!(port, self.port);
            let Some(Received::Session(messages)) = self.link.receive(&mut &out[..len], now) else {
                continue;
            };
            for message in messages.map(Result::unwrap) {
                kinds.extend(message.kind());
                if let Ok(Stored { tiles }) = message.decode() {
                    stored = tiles.iter().find(|(id, _)| *id == DRAWN).map(|(_, it)| it.version);
                }
            }
        }
        (kinds, stored)
    }
}

#[test]
fn a_failing_store_delays_only_acknowledgements() {
    let mut deployment = keeping(Instant(0));
    let port = deployment.open_port(Policy::Open);
    let mut robot = Robot::connect(&mut deployment, port, at(0));
    robot.draw(&mut deployment, 1, at(10));
    assert!(deployment.poll_timeout(at(10)).is_some_and(|due| due <= at(10)));
    let batch = deployment.poll_store(at(10)).unwrap();
    assert!(batch.tiles.len() == 1 && batch.cures.is_empty() && batch.camera_tiles.is_empty());
    assert_eq!(deployment.poll_store(at(500)), None, "one batch at a time");
    assert!(deployment.has_unsaved(), "unsaved until the batch is given back");
    assert_eq!(robot.hear(&mut deployment, at(500)).1, None);

    // The disk is full: the next attempt is a second later.
    deployment.store_failed(batch, at(500));
    assert_eq!(deployment.poll_store(at(1_499)), None, "not yet");
    assert!(deployment.poll_timeout(at(1_500)).is_some_and(|due| due <= at(1_500)));
    let batch = deployment.poll_store(at(1_500)).unwrap();
    assert_eq!(versions(&batch), [Version(1)]);

    // The disk is still full. Meanwhile the robot keeps drawing and gets its fixes.
    deployment.store_failed(batch, at(1_500));
    robot.draw(&mut deployment, 2, at(1_600));
    deployment.observe(seen(at(1_600)));
    let (kinds, stored) = robot.hear(&mut deployment, at(1_600));
    assert!(kinds.contains(&PoseFix::KIND) && stored.is_none(), "{kinds:?}");
    let batch = deployment.poll_store(at(2_500)).unwrap();
    assert_eq!(versions(&batch), [Version(2)], "the current version");
    deployment.stored(batch);
    assert_eq!(robot.hear(&mut deployment, at(2_500)).1, Some(Version(2)));
    assert!(!deployment.has_unsaved());
}

fn versions(batch: &Batch) -> Vec<Version> {
    batch.tiles.iter().map(|(_, record)| record.stamp.version).collect()
}

#[test]
fn camera_tiles_are_handed_out_again_after_a_failure() {
    let mut deployment = keeping(Instant(0));
    deployment.observe(seen(at(100)));
    assert_eq!(deployment.poll_store(at(9_999)), None);
    let batch = deployment.poll_store(at(10_000)).unwrap();
    assert_eq!(batch.camera_tiles.len(), 1);
    deployment.store_failed(batch.clone(), at(10_000));
    assert_eq!(deployment.poll_store(at(10_999)), None);
    let again = deployment.poll_store(at(11_000)).unwrap();
    assert_eq!(again.camera_tiles, batch.camera_tiles);
    deployment.stored(again);
    assert_eq!(deployment.poll_store(at(99_000)), None);
}

/// The caller's clock restarts with each process; the server's clock continues across lives.
#[test]
fn times_are_by_the_callers_clock_in_every_life() {
    let earlier = at(60_000);
    let mut deployment = keeping(earlier);
    assert_eq!(deployment.server_time(at(0)), at(61_000));
    deployment.observe(seen(at(300)));
    let (moment, event) = deployment.poll_event().unwrap();
    assert_eq!((moment, event), (at(300), Event::Observed(seen(at(300)))));
    let (of_server, _) = deployment.server().whereabouts(at(61_300)).next().unwrap();
    assert_eq!(of_server, ROBOT);
    // Coverage is recomputed immediately, and then four times per second.
    assert!(deployment.poll_timeout(at(300)).is_some_and(|due| due <= at(300)));
    assert_eq!(deployment.poll_transmit(at(300), &mut []), None);
    let due = deployment.poll_timeout(at(300)).unwrap();
    assert!((at(301)..at(1_000)).contains(&due), "{due:?}");
    let batch = deployment.poll_store(at(10_000)).unwrap();
    assert_eq!(batch.clock, at(71_000));
}

#[test]
fn sightings_are_kept_on_request() {
    let config = Config { keeps_sightings: true, ..Config::new(RESOLUTION) };
    for (config, count) in [(config, 2), (Config::new(RESOLUTION), 0)] {
        let mut deployment = Deployment::new(config, Life::default()).unwrap();
        deployment.observe(seen(at(100)));
        deployment.observe(seen(at(50)));
        let moments: Vec<Instant> = deployment.sightings().iter().map(|(at, _)| *at).collect();
        assert_eq!(moments, [at(100), at(50)][..count]);
        let CameraStatus { observations, looks, .. } = deployment.status().cameras[&0];
        assert_eq!((observations, looks), (2, 2));
    }
}

#[test]
fn the_coordinator_executes_goals_and_exploration() {
    let floor = || Observation {
        captured: at(100),
        robots: vec![Sighting::usual(ROBOT, Pose::from_metres(2.5, 2.5, 0.0))],
        cells: (0..100).flat_map(|x| (0..100).map(move |y| ((x, y), Cell::Free))).collect(),
        ..Observation::default()
    };
    let run = |coordination: Option<Settings>, order: fn(&mut Deployment)| {
        let config = Config { coordination, ..Config::new(RESOLUTION) };
        let mut deployment = Deployment::new(config, Life::default()).unwrap();
        let port = deployment.open_port(Policy::Open);
        let mut robot = Robot::connect(&mut deployment, port, at(0));
        deployment.observe(floor());
        // The coordinator learns of the robot, receives the order, and decides.
        robot.hear(&mut deployment, at(100));
        deployment.timeout(at(100));
        order(&mut deployment);
        // Frontiers are surveyed once per second.
        let ticks = (1..=6).map(|tick| at(100 + 250 * tick));
        let heard = ticks.flat_map(|now| {
            deployment.timeout(now);
            robot.hear(&mut deployment, now).0
        });
        heard.filter(|kind| *kind == Path::KIND).count()
    };
    let go = |deployment: &mut Deployment| {
        deployment.goal(ROBOT, [3.5, 2.5], at(110)).unwrap();
    };
    let go_outside = |deployment: &mut Deployment| {
        let refused = deployment.goal(ROBOT, [20.0, 2.5], at(110));
        assert_eq!(refused, Err(GoalError::OutsideMap));
    };
    let alone = |deployment: &mut Deployment| {
        let refused = deployment.goal(ROBOT, [3.5, 2.5], at(110));
        assert_eq!(refused, Err(GoalError::UnknownRobot(ROBOT)));
        deployment.explore(ROBOT, true);
    };
    // With this view radius, the robot does not see the edge of the floor from its position.
    let coordination = Some(Settings { view_m: 1.5, ..Settings::default() });
    assert_eq!(run(coordination, go), 1);
    assert_eq!(run(coordination, go_outside), 0);
    assert_eq!(run(None, alone), 0);
    assert!(run(coordination, |deployment| deployment.explore(ROBOT, true)) > 0);
    let stop = |deployment: &mut Deployment| {
        deployment.explore(ROBOT, true);
        deployment.explore(ROBOT, false);
    };
    assert_eq!(run(coordination, stop), 0);
}

#[test]
fn closed_ports_are_refused_and_not_reused() {
    let mut deployment = Deployment::new(Config::new(RESOLUTION), Life::default()).unwrap();
    let [first, second, third] = [(); 3].map(|()| deployment.open_port(Policy::Open));
    deployment.close_port(second).unwrap();
    assert_eq!(deployment.close_port(second), Err(PortClosed(second)));
    assert_eq!(deployment.receive(second, &[0], at(0)), Err(PortClosed(second)));
    assert_eq!(deployment.port(second), Err(PortClosed(second)));
    // Bytes that are not a frame are answered at the port where they arrived.
    for port in [third, first] {
        deployment.receive(port, &[1, 2, 3, 0], at(0)).unwrap();
    }
    let mut out = [0; MAX_FRAME];
    let frames = std::iter::from_fn(|| deployment.poll_transmit(at(0), &mut out));
    assert_eq!(frames.map(|(port, _)| port).collect::<Vec<_>>(), [first, third]);

    let _robot = Robot::connect(&mut deployment, third, at(1));
    let joined = server::Event::Joined(ROBOT, third.number());
    let events: Vec<_> = std::iter::from_fn(|| deployment.poll_event()).collect();
    let dropped =
        |(_, event): &&(_, Event)| matches!(event, Event::Server(server::Event::Dropped(..)));
    assert_eq!(events.iter().take_while(dropped).count(), 2);
    assert_eq!(events.get(2), Some(&(at(1), Event::Server(joined))));
    assert_eq!(deployment.port(third).unwrap().robot, Some(ROBOT));
    let fourth = deployment.open_port(Policy::Open);
    assert!(fourth > third);
    assert_eq!(
        deployment.status().ports.iter().map(|it| it.port).collect::<Vec<_>>(),
        [first, third, fourth]
    );
}

#[test]
fn faulty_frames_are_reported_with_the_callers_time() {
    let lens = Lens::new(Intrinsics::pinhole(64, 48, 1.4), Isometry3::identity()).unwrap();
    let camera =
        Calibration { depth: Some(lens), depth_noise: DepthNoise::default(), picture: Some(lens) };
    let config = Config { cameras: vec![camera], ..Config::new(RESOLUTION) };
    let kept = Some(Kept { clock: at(60_000), ..Kept::default() });
    let mut deployment = Deployment::new(config, Life { kept, ..Life::default() }).unwrap();
    let frame = |captured| Frame {
        camera: 0,
        captured,
        depth: Some(DepthImage::new(32, 24)),
        picture: Some(Picture::Grey(GrayImage::new(64, 48))),
    };
    deployment.frame(frame(at(500)), at(500));
    deployment.frame(frame(at(900)), at(700));
    let events = std::iter::from_fn(|| deployment.poll_event());
    let events: Vec<_> = events.filter(|(_, event)| !matches!(event, Event::Observed(_))).collect();
    let (expected, found) = ((64, 48), (32, 24));
    let size = FrameError::Size { camera: 0, found, expected };
    let ahead = FrameError::Future { camera: 0, millis: 200 };
    let clock = server::Event::Sighting(SightingEvent::ClockAhead { camera: 0 });
    assert_eq!(
        events,
        [
            (at(500), Event::Frame(size)),
            (at(700), Event::Frame(ahead)),
            (at(700), Event::Server(clock)),
        ]
    );
    assert_eq!(deployment.server().sighting_events().iter().count(), 1);
    let CameraStatus { observations, looks, .. } = deployment.status().cameras[&0];
    assert_eq!((observations, looks), (2, 0));
}
