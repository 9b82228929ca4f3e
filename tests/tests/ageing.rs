//! Evidence against the server's map that is too weak to be reported is forgotten, even if the
//! robot can't send anything.

use ubimap_agent::{Bounds, Config, Memory, Robot, sense::SensorModel};
use ubimap_protocol::{
    frame::DEFAULT_FRAME,
    link::{Answer, Endpoint, Fill, Received, Terms, answer},
    message::{
        Body, Certainty, FixSource, Hello, PoseFix, TileUpdateHead, TimeReply, ToRobot, Writer,
    },
    tile::{Epoch, Layer, Stamp, TILE_SIDE, Tile, TileEncoder, TileId, Version},
    time::{Duration, Instant},
    units::{Pose, RobotId, SessionId},
};
use ubimap_sim_host::run::heap::{BOUNDS, Heap};

/// Beams of the sensor.
const BEAMS: usize = 12;
/// Angle between neighbouring beams in radians.
const STEP: f32 = 0.2;
/// Tile of the cell (41, 4), in which the beam at 0.1 radians from the x axis of `map` ends after
/// [`READING`].
const ID: TileId = TileId { x: 1, y: 0 };
/// Column and row of that cell in its tile.
const CELL: (usize, usize) = (9, 4);
/// The reading that hits the cell, in millimetres.
const READING: u16 = 2_100;

/// The server's end of the link, which receives only what the session needs.
struct Server {
    link: Endpoint<ToRobot, (), 8, DEFAULT_FRAME>,
}

impl Server {
    /// Opens a session and synchronises the clocks.
    fn connect(robot: &mut Robot<'_>, config: &Config) -> Self {
        let mut link = Endpoint::new();
        let mut out = [0; DEFAULT_FRAME];
        let len = robot.poll_transmit(Instant(0), &mut out).expect("a Hello");
        let Some(Received::Handshake(hello)) = link.receive(&mut &out[..len], Instant(0)) else {
            panic!("no Hello")
        };
        let hello = hello.decode::<Hello>().unwrap();
        let (resolution, frame) = (config.bounds.resolution, DEFAULT_FRAME as u16);
        let terms = Terms { resolution, frame, server_epoch: 1, stores: false };
        let Answer::Welcome(welcome) = answer(&hello, &terms, SessionId(1), 1) else {
            panic!("refused")
        };
        let len = link.handshake(&welcome, &mut out).unwrap();
        link.begin(welcome.session, DEFAULT_FRAME);
        robot.receive(&out[..len], Instant(0));
        // The reply answers the robot's first time request, which has nonce 0.
        robot.poll_transmit(Instant(0), &mut out).expect("a request for the time");
        let mut server = Self { link };
        let reply = TimeReply { nonce: 0, received: Instant(0), held_micros: 0 };
        server.say(robot, Instant(0), &reply);
        server
    }

    fn say(&mut self, robot: &mut Robot<'_>, now: Instant, message: &impl Body<ToRobot>) {
        self.send(robot, now, |writer| writer.push(message));
    }

    fn send(
        &mut self,
        robot: &mut Robot<'_>,
        now: Instant,
        fill: impl FnOnce(&mut Writer<'_, ToRobot>) -> bool,
    ) {
        let mut out = [0; DEFAULT_FRAME];
        let sent = self.link.poll_transmit(now, &mut out, true, |writer, _| {
            assert!(fill(writer));
            Fill::Datagram
        });
        robot.receive(&out[..sent.unwrap().len], now);
    }
}

/// Whether the robot marks the cell as occupied after ten scans with a hit in it, although the cell
/// is free on the server's map. The robot has a session, but its port never accepts a frame.
fn contradicts(apart: Duration) -> bool {
    let sensor = SensorModel::Radial { first: -1.1, step: STEP };
    let bounds = Bounds { readings: BEAMS, own_tiles: 8, fused_tiles: 16, ..BOUNDS };
    let config = Config::new(RobotId(3), sensor, bounds);
    let mut memory = Memory::<Heap>::new(&bounds);
    let mut robot = Robot::new(config, &mut memory).unwrap();
    let mut server = Server::connect(&mut robot, &config);
    let mut now = Instant(0);
    for scan in 0..=10u32 {
        let end = now + apart;
        while now < end {
            now = end.min(now + Duration::from_millis(500));
            robot.timeout(now);
        }
        // Alternates the heading by one beam, so that each scan is mapped.
        let pose = Pose::from_metres(0.0, 0.0, f64::from(STEP) * f64::from(scan % 2));
        let before = std::iter::empty();
        let certainty = Certainty { x: 5, y: 5, heading: 50 };
        let fix = PoseFix::from_fixes((now, pose), before, certainty, FixSource::Camera);
        server.say(&mut robot, now, &fix);
        robot.odometry(now, pose, now);
        // The first scan only initialises the pose.
        let reading = if scan == 0 { 0 } else { READING };
        robot.scan(now, &[reading; BEAMS], now).unwrap();
        if scan == 0 {
            say_free(&mut server, &mut robot, now);
        }
    }
    assert_eq!(robot.statistics().mapped, 11);
    let tile = robot.own_tiles().find(ID).expect("it was hit");
    tile.row(CELL.1).high >> CELL.0 & 1 != 0
}

/// Sends a tile whose cells are all free.
fn say_free(server: &mut Server, robot: &mut Robot<'_>, now: Instant) {
    let free = Tile { low: [u32::MAX; TILE_SIDE], ..Tile::UNKNOWN };
    let stamp = Stamp { epoch: Epoch(1), version: Version(1) };
    server.send(robot, now, |writer| {
        writer.push_with(&TileUpdateHead { layer: Layer::Fused, seconds: 0 }, |coded| {
            let mut encoder = TileEncoder::new(coded);
            encoder.push(ID, stamp, None, 0, &Tile::UNKNOWN, &free)?;
            encoder.finish()
        })
    });
    assert_eq!(robot.fused_tiles().tile(ID), Some(&free));
}

#[test]
fn hits_minutes_apart_are_forgotten_even_without_sending() {
    assert!(contradicts(Duration::from_secs(1)), "ten hits in ten seconds are a change");
    assert!(!contradicts(Duration::from_secs(60)), "ten hits in ten minutes are noise");
}
