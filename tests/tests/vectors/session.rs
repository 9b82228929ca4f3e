//! A whole session of the reference robot with the reference server, with its time stamps.

use serde_json::{Value, json};
use ubimap_agent::{Bounds, Config, Memory, Robot, sense::SensorModel};
use ubimap_protocol::{
    frame::{DEFAULT_FRAME, MAX_FRAME},
    link::Terms,
    message::{ParameterAction, ParameterCommand, Path, Stop, Waypoint},
    tile::{Cell, Layer, tile_hash},
    time::Instant,
    units::{Millimetres, Pose, RobotId},
};
use ubimap_sim_host::{
    camera::{Observation, Sighting},
    run::heap::{BOUNDS, Heap},
    server::{Command, Server},
};
use ubimap_tests::vectors::hex;

/// Microseconds that a frame takes.
const TRAVEL: u64 = 12_000;
/// By how much the robot's clock is ahead of the server's, in microseconds.
const AHEAD: u64 = 7_654_321;
/// Microseconds after which the recording ends.
const END: u64 = 9_000_000;
const READINGS: usize = 24;

/// A frame on its way: when it was sent, its number, whether the robot sent it, its bytes, whether
/// it will be lost.
struct Frame {
    sent: u64,
    to_server: bool,
    wire: Vec<u8>,
    is_lost: bool,
}

struct Room<'b> {
    server: Server,
    robot: Robot<'b>,
    frames: Vec<Frame>,
    delivered: usize,
    now: u64,
}

impl Room<'_> {
    fn server_now(&self) -> Instant {
        Instant(self.now)
    }

    fn robot_now(&self) -> Instant {
        Instant(self.now + AHEAD)
    }

    fn drain(&mut self) {
        let mut out = [0; MAX_FRAME];
        while let Some(len) = self.robot.poll_transmit(self.robot_now(), &mut out[..DEFAULT_FRAME])
        {
            self.send(true, &out[..len]);
        }
        while let Some(len) = self.server.poll_transmit(0, self.server_now(), &mut out) {
            self.send(false, &out[..len]);
        }
    }

    fn send(&mut self, to_server: bool, wire: &[u8]) {
        // Frames at odd places, so that messages of all kinds are lost now and then.
        let is_lost = self.frames.len() % 11 == 7;
        self.frames.push(Frame { sent: self.now, to_server, wire: wire.into(), is_lost });
    }

    fn run_until(&mut self, end: u64) {
        loop {
            let arrival = self.frames.get(self.delivered).map(|frame| frame.sent + TRAVEL);
            let robot = Some(self.robot.poll_timeout().0.saturating_sub(AHEAD));
            let server = self.server.poll_timeout(0, self.server_now()).map(|due| due.0);
            let next = [arrival, robot, server].into_iter().flatten().min().unwrap_or(end);
            if next.max(self.now) > end {
                break;
            }
            self.now = self.now.max(next);
            while let Some(frame) = self.frames.get(self.delivered)
                && frame.sent + TRAVEL <= self.now
            {
                self.delivered += 1;
                match (frame.is_lost, frame.to_server) {
                    (true, _) => {}
                    (_, true) => self.server.receive(0, &frame.wire, Instant(self.now)).unwrap(),
                    (_, false) => self.robot.receive(&frame.wire, Instant(self.now + AHEAD)),
                }
            }
            self.robot.timeout(self.robot_now());
            self.server.timeout(self.server_now());
            self.drain();
        }
        self.now = end;
    }
}

/// The recording, and what both sides hold in the end.
pub(super) fn session() -> Value {
    let terms = Terms {
        resolution: Millimetres(50),
        frame: DEFAULT_FRAME as u16,
        server_epoch: 3,
        stores: false,
    };
    let mut server = Server::new(terms, 1);
    server.number_sessions_from(77);
    let bounds = Bounds { readings: READINGS, own_tiles: 16, fused_tiles: 16, ..BOUNDS };
    let sensor = SensorModel::Radial { first: -0.6, step: 0.05 };
    let config = Config::new(RobotId(7), sensor, bounds);
    let mut memory: Memory<Heap> = Memory::new(&bounds);
    let robot = Robot::new(config, &mut memory).unwrap();
    let mut room = Room { server, robot, frames: Vec::new(), delivered: 0, now: 1_000_000 };
    let begin = room.now;
    while room.now < begin + END {
        let seconds = (room.now - begin) as f64 / 1e6;
        act(&mut room, seconds);
        room.run_until(room.now + 100_000);
    }
    summary(&mut room)
}

fn act(room: &mut Room<'_>, seconds: f64) {
    let tenths = (seconds * 10.0).round() as u64;
    let pose = Pose::from_metres(0.5 + 0.08 * seconds, 0.4, 0.2 + 0.02 * seconds);
    let now = room.robot_now();
    room.robot.odometry(now, pose, now);
    if tenths.is_multiple_of(3) {
        let robots = vec![Sighting::usual(RobotId(7), pose)];
        let cells = if tenths.is_multiple_of(6) { seen(seconds) } else { Vec::new() };
        let captured = room.server_now();
        room.server.observe(&Observation { captured, robots, cells, ..Observation::default() });
    }
    if tenths % 5 == 2 {
        let readings: Vec<u16> = (0..READINGS as u16).map(|at| 1_500 + 20 * at).collect();
        let _ = room.robot.scan(now, &readings, now);
    }
    let commands = [
        (40, Command::Parameter(ParameterCommand { number: 1, action: ParameterAction::List })),
        (50, Command::Stop(Stop { number: 1, stop: true })),
        (60, Command::Path(Path { number: 1, waypoints: [waypoint(2_000)].into_iter().collect() })),
        (65, Command::Stop(Stop { number: 2, stop: false })),
    ];
    for (_, command) in commands.into_iter().filter(|(at, _)| *at == tenths) {
        room.server.command(RobotId(7), command).unwrap();
    }
    room.drain();
}

fn waypoint(x: i32) -> Waypoint {
    Waypoint { x: Millimetres(x), y: Millimetres(400) }
}

/// What a camera sees behind the robot: free ground with a box that comes and goes.
fn seen(seconds: f64) -> Vec<((i32, i32), Cell)> {
    let is_there = (2.0..5.0).contains(&seconds);
    let code = |x: i32, y: i32| match (3..5).contains(&x) && (20..22).contains(&y) && is_there {
        true => Cell::Occupied,
        false => Cell::Free,
    };
    (0..8).flat_map(|x| (16..26).map(move |y| ((x, y), code(x, y)))).collect()
}

fn summary(room: &mut Room<'_>) -> Value {
    let frames: Vec<Value> = room
        .frames
        .iter()
        .map(|frame| {
            let direction = if frame.to_server { "to server" } else { "to robot" };
            let fate = if frame.is_lost { "lost" } else { "arrives" };
            json!([frame.sent, direction, fate, hex(&frame.wire)])
        })
        .collect();
    let mut own = Vec::new();
    for tile in room.robot.own_tiles().tiles() {
        let (Some(id), publication) = (tile.id(), tile.publication()) else { continue };
        if publication.is_acknowledged() {
            let (version, hash) = (publication.version().0, tile_hash(publication.sent()));
            own.push(json!({ "x": id.x, "y": id.y, "version": version, "hash": hash }));
        }
    }
    let held = |layer: Layer| -> Vec<Value> {
        let tiles = room.robot.fused_tiles().tiles(layer);
        let tiles = tiles.filter(|(_, tile)| tile.stamp().version.0 > 0);
        tiles
            .map(|(id, tile)| {
                json!({
                    "x": id.x, "y": id.y, "version": tile.stamp().version.0,
                    "hash": tile_hash(tile.tile()),
                })
            })
            .collect()
    };
    let (fused, coverage) = (held(Layer::Fused), held(Layer::Coverage));
    json!([{
        "name": "nine seconds",
        "travel": TRAVEL,
        "robot_ahead": AHEAD,
        "server_epoch": 3,
        "frames": frames,
        "own": own,
        "fused": fused,
        "coverage": coverage,
    }])
}
