//! The attacks of SPEC.md 12.6: what each costs on an open link, and that on a sealed one it costs a
//! counter. Every attack runs beside a robot that draws a room for ten seconds, and is compared with
//! the same ten seconds without it.
//!
//! The attacker reads and writes both wires, has a port of its own, and knows the session's number,
//! but not the key.

use ubimap_agent::{Bounds, Config, Memory, Robot, Seal, sense::SensorModel};
use ubimap_protocol::{
    frame::{
        Attempt, Direction, FrameKind, Header, Key, MAX_FRAME, SessionId, SessionKey, VERSION,
        cobs, seal, seal_session,
    },
    link::{Counters, Terms, write_hello},
    message::{
        Hello, ParameterAction, ParameterCommand, ParameterValue, State, Stop, ToRobot, ToServer,
        Traffic, Writer,
    },
    tile::{Cell, Tile, TileId, tile_hash},
    time::{Duration, Instant},
    units::{Angle, Millimetres, Pose, RobotId},
};
use ubimap_sim_host::{
    camera::{Observation, Sighting},
    run::heap::{BOUNDS, Heap},
    server::{Command, Policy, Server},
};
use ubimap_tests::raw_robot::RawRobot;

const ID: RobotId = RobotId(1);
const STRANGER: RobotId = RobotId(2);
const KEY: Key = Key::new([7; 16]);
const WRONG_KEY: Key = Key::new([8; 16]);
const STEP: Duration = Duration::from_millis(50);
/// Ten seconds; the attacks begin after one and a half.
const STEPS: u64 = 200;
const CALM: u64 = 30;
const BOUNDS_HERE: Bounds = Bounds { readings: 60, fused_tiles: 16, max_range: 1_400, ..BOUNDS };

/// A server with a robot at port 0 or, after its cable was moved, at port 2; a stranger at port 1.
struct Room<'b> {
    server: Server,
    robot: Robot<'b>,
    port: usize,
    now: Instant,
    is_sealed: bool,
    /// The frames on the wire so far.
    up: Vec<Vec<u8>>,
    down: Vec<Vec<u8>>,
}

/// What an attack must not change.
#[derive(Debug, PartialEq)]
struct Outcome {
    tiles: Vec<(TileId, u32)>,
    /// Known cells of the robot's layer as the server has it.
    drawn: u32,
    fixes: u32,
    sessions: u32,
    mounting: Pose,
    must_stop: bool,
    whereabouts: Vec<(RobotId, Pose)>,
    robot_at: Option<RobotId>,
}

/// One step of an attack.
type Attack = fn(&mut Room<'_>, u64);

/// Runs the room, and the counters of the port and the robot at the end.
fn run(is_sealed: bool, attack: Attack) -> (Outcome, Counters, Counters) {
    let mut memory: Memory<Heap> = Memory::new(&BOUNDS_HERE);
    let sensor = SensorModel::Radial { first: -3.0, step: 0.1 };
    let seal = is_sealed.then_some(Seal { key: KEY, boot: 3 });
    let config = Config { seal, boot_nonce: 99, ..Config::new(ID, sensor, BOUNDS_HERE) };
    let terms = Terms { resolution: Millimetres(50), frame: 250, server_epoch: 1, stores: false };
    let mut server = Server::new(terms, 0);
    server.set_key(ID, KEY);
    let policy = if is_sealed { Policy::Keyed } else { Policy::Open };
    (0..2).for_each(|_| _ = server.open_port(policy));
    let mut room = Room {
        server,
        robot: Robot::new(config, &mut memory).unwrap(),
        port: 0,
        now: Instant(0),
        is_sealed,
        up: Vec::new(),
        down: Vec::new(),
    };
    for step in 0..STEPS {
        room.now = Instant(step * STEP.0);
        if step == CALM / 2 {
            // The cable is moved, so that a Reset is on the wire.
            room.server.close_port(0).unwrap();
            room.port = room.server.open_port(policy);
        }
        room.observe(step);
        room.exchange();
        if step >= CALM {
            room.now = room.now + Duration::from_millis(10);
            attack(&mut room, step);
            room.exchange();
        }
    }
    let here = room.now;
    let Room { server, robot, port, .. } = room;
    let layer = server.layer(ID);
    let outcome = Outcome {
        tiles: server.fused().tiles().map(|(id, _, tile)| (id, tile_hash(tile))).collect(),
        drawn: layer.map_or(0, |layer| layer.tiles().map(|(_, seen)| known(&seen.tile)).sum()),
        fixes: robot.statistics().fixes,
        sessions: robot.statistics().sessions,
        mounting: robot.settings().mounting,
        must_stop: robot.commands().must_stop(),
        whereabouts: server.whereabouts(here).collect(),
        robot_at: server.robot_at(port),
    };
    let mut counters = server.link_counters(port);
    let strangers = server.link_counters(1);
    counters.forged += strangers.forged;
    counters.refused += strangers.refused;
    counters.replayed += strangers.replayed;
    (outcome, counters, robot.link_counters())
}

fn known(tile: &Tile) -> u32 {
    let (free, occupied, movable) = tile.counts();
    free + occupied + movable
}

impl Room<'_> {
    /// A camera sees the robot, which moves and looks around.
    fn observe(&mut self, step: u64) {
        let pose = Pose::from_metres(0.01 * step as f64, 0.5, 0.0);
        self.server.timeout(self.now);
        self.server.observe(&Observation {
            captured: self.now,
            robots: vec![Sighting::usual(ID, pose)],
            ..Observation::default()
        });
        self.robot.odometry(self.now, pose, self.now);
        if step.is_multiple_of(4) {
            let readings: Vec<u16> = (0..60).map(|at| 800 + 3 * at).collect();
            let _ = self.robot.scan(self.now, &readings, self.now);
        }
        self.robot.timeout(self.now);
    }

    /// Passes frames on until both sides are silent.
    fn exchange(&mut self) {
        let mut out = [0; MAX_FRAME];
        loop {
            let before = self.up.len() + self.down.len();
            while let Some(len) = self.robot.poll_transmit(self.now, &mut out[..250]) {
                self.up.push(out[..len].to_vec());
                self.server.receive(self.port, &out[..len], self.now).unwrap();
            }
            while let Some(len) = self.server.poll_transmit(self.port, self.now, &mut out) {
                self.down.push(out[..len].to_vec());
                self.robot.receive(&out[..len], self.now);
            }
            while self.server.poll_transmit(1, self.now, &mut out).is_some() {}
            if self.up.len() + self.down.len() == before {
                return;
            }
        }
    }

    /// Sends frames to the server at the robot's port.
    fn give_server(&mut self, frames: &[Vec<u8>]) {
        for frame in frames {
            self.server.receive(self.port, frame, self.now).unwrap();
        }
    }

    fn give_robot(&mut self, frames: &[Vec<u8>]) {
        frames.iter().for_each(|frame| self.robot.receive(frame, self.now));
    }

    /// Frames of the session with messages of the attacker: with a right checksum, and on a sealed
    /// link also with a wrong key.
    fn forge<D: Traffic>(
        &self,
        kind: FrameKind,
        sequence: u16,
        write: impl FnOnce(&mut Writer<'_, D>) -> bool,
    ) -> Vec<Vec<u8>> {
        let session = self.server.session_at(self.port).unwrap_or(SessionId(1));
        let header = Header { version: VERSION, kind, sequence };
        let mut text = [0; 200];
        let mut writer = Writer::new(&mut text);
        assert!(write(&mut writer));
        let len = writer.len();
        let text = &mut text[..len];
        let contents = [&header.encode()[..], text].concat();
        let tail = seal(session, D::DIRECTION, &contents);
        let mut frames = vec![stuffed(&contents, &tail)];
        if self.is_sealed {
            let attempt = Attempt { boot: 3, clock: 0 };
            let key = SessionKey::derive(&WRONG_KEY, ID, attempt, 1, session);
            let counter = 9 * u32::from(sequence) + 5_000;
            let names = (ID, session);
            let (clear, tag) = seal_session(&key, names, D::DIRECTION, header, counter, text);
            frames.push(stuffed(&[&clear, &*text].concat(), &tag));
        }
        frames
    }
}

fn stuffed(contents: &[u8], tail: &[u8]) -> Vec<u8> {
    let mut out = [0; MAX_FRAME];
    let len = cobs::encode([contents, tail], &mut out).unwrap();
    out[..len].to_vec()
}

fn is_handshake(frame: &[u8]) -> bool {
    let mut decoder = cobs::Decoder::<MAX_FRAME>::default();
    let contents = decoder.next(&mut &*frame).unwrap().unwrap();
    Header::decode(contents).unwrap().0.kind == FrameKind::Handshake
}

fn undisturbed(is_sealed: bool) -> Outcome {
    let (outcome, server, robot) = run(is_sealed, |_, _| {});
    assert_eq!((server.refused, server.replayed, robot.refused), (0, 0, 0));
    assert_eq!((robot.forged, robot.replayed), (0, 0));
    assert!(outcome.fixes > 100 && outcome.drawn > 300 && outcome.sessions == 2, "{outcome:?}");
    outcome
}

/// With keys an attack changes nothing; returns what the counters have counted.
#[track_caller]
fn costs_a_counter(attack: Attack) -> u32 {
    let (outcome, server, robot) = run(true, attack);
    assert_eq!(outcome, undisturbed(true));
    let count = |it: Counters| it.bad + it.refused + it.replayed + it.forged;
    let all = count(server) + count(robot);
    // The frames between the moved cable and the Reset count, too.
    assert!(all > 20, "{server:?} {robot:?}");
    all
}

#[track_caller]
fn costs_nothing_without_keys(attack: Attack) {
    assert_eq!(run(false, attack).0, undisturbed(false));
}

fn hello(id: RobotId, nonce: u32) -> Hello {
    Hello {
        version: VERSION,
        min_version: VERSION,
        robot: id,
        nonce,
        frame: 250,
        resolution: Millimetres(50),
        fused_tiles: 16,
    }
}

/// Hellos at the stranger's port for a number: open, and sealed with a wrong key in the newest boot.
fn knock(room: &mut Room<'_>, id: RobotId, step: u64) {
    let open = RawRobot::hello(id, 7_000 + step as u32);
    let mut out = [0; MAX_FRAME];
    let attempt = Attempt { boot: u32::MAX, clock: step };
    let len = write_hello(&WRONG_KEY, attempt, &hello(id, step as u32), &mut out).unwrap();
    for frame in [&open[..], &out[..len]] {
        room.server.receive(1, frame, room.now).unwrap();
    }
}

#[test]
fn taking_over_a_number_from_another_port() {
    let attack: Attack = |room, step| knock(room, ID, step);
    costs_nothing_without_keys(attack);
    costs_a_counter(attack);
}

#[test]
fn replayed_hellos() {
    let attack: Attack = |room, _| {
        let hellos: Vec<_> = room.up.iter().filter(|it| is_handshake(it)).cloned().collect();
        let five: Vec<_> = hellos.iter().cycle().take(5).cloned().collect();
        room.give_server(&five);
    };
    costs_nothing_without_keys(attack);
    assert!(costs_a_counter(attack) > 5 * 100);
}

#[test]
fn a_forged_parameter() {
    let attack: Attack = |room, step| {
        let value = 3_641;
        let set = ParameterAction::Set(ParameterValue { parameter: 3, value });
        let command = ParameterCommand { number: step as u16, action: set };
        let frames = room.forge::<ToRobot>(FrameKind::Datagram, 0, |it| it.push(&command));
        room.give_robot(&frames);
    };
    let turned = run(false, attack).0.mounting;
    assert_eq!(turned.heading, Angle(3_641), "20 degrees");
    costs_a_counter(attack);
}

#[test]
fn a_forged_stop_with_the_highest_number() {
    let attack: Attack = |room, step| {
        if step == CALM {
            let stop = Stop { number: u32::MAX, stop: true };
            let frames = room.forge::<ToRobot>(FrameKind::Datagram, 0, |it| it.push(&stop));
            room.give_robot(&frames);
            room.give_robot(&frames);
        }
        // The server's own commands have lower numbers.
        let go = Command::Stop(Stop { number: step as u32, stop: false });
        room.server.command(ID, go).unwrap();
    };
    assert!(run(false, attack).0.must_stop);
    let (outcome, _, robot) = run(true, attack);
    assert_eq!(outcome, undisturbed(true));
    assert_eq!((robot.bad, robot.forged), (2, 2));
}

#[test]
fn empty_frames_that_use_up_sequence_numbers() {
    let attack: Attack = |room, step| {
        if step == CALM {
            for sequence in 0..200 {
                let frames = room.forge::<ToServer>(FrameKind::Reliable, sequence, |_| true);
                room.give_server(&frames);
            }
        }
    };
    let open = undisturbed(false);
    let robbed = run(false, attack).0;
    assert!(robbed.drawn < open.drawn, "tiles were acknowledged and lost: {robbed:?}");
    assert!(costs_a_counter(attack) >= 400);
}

#[test]
fn a_phantom_through_a_forged_state() {
    let attack: Attack = |room, _| {
        let pose = Some(Pose::from_metres(9.0, 9.0, 0.0));
        let state = State { time: Some(room.now), pose, odometry: None, cells_refused: 0 };
        let frames = room.forge::<ToServer>(FrameKind::Datagram, 0, |it| it.push(&state));
        room.give_server(&frames);
    };
    let [(ID, pose)] = run(false, attack).0.whereabouts[..] else { panic!("one robot") };
    assert!(pose.x.metres() > 8.0, "{pose:?}");
    costs_a_counter(attack);
}

#[test]
fn a_stranger_who_draws_where_nobody_else_has_been() {
    let attack: Attack = |room, step| {
        let now = room.now;
        if let Some(mut stranger) = RawRobot::try_connect(&mut room.server, 1, STRANGER, now) {
            let mut tile = Tile::UNKNOWN;
            for (x, y) in (0..32).flat_map(|y| (0..32).map(move |x| (x, y))) {
                tile.set(x, y, if y == 5 { Cell::Occupied } else { Cell::Free });
            }
            stranger.draw(&mut room.server, now, TileId { x: 40, y: 40 }, &tile);
        }
        knock(room, STRANGER, step);
    };
    let poisoned = run(false, attack).0;
    assert!(poisoned.tiles.iter().any(|(id, _)| *id == TileId { x: 40, y: 40 }));
    costs_a_counter(attack);
}

#[test]
fn replayed_frames_of_the_session() {
    let attack: Attack = |room, step| {
        let newest = |frames: &[Vec<u8>]| {
            let frames: Vec<_> = frames.iter().filter(|it| !is_handshake(it)).cloned().collect();
            let from = frames.len().saturating_sub(100);
            [&frames[..10], &frames[from..]].concat()
        };
        if step.is_multiple_of(20) {
            let (up, down) = (newest(&room.up), newest(&room.down));
            room.give_server(&up);
            room.give_robot(&down);
        }
    };
    assert!(costs_a_counter(attack) > 500);
}

#[test]
fn altered_and_truncated_frames() {
    let attack: Attack = |room, step| {
        let damaged = |frames: &[Vec<u8>]| {
            let mut frame = frames.last().cloned().unwrap();
            let at = step as usize % (frame.len() - 1);
            // Never to zero, which would end the frame.
            frame[at] = if frame[at] == 0x55 { 0x56 } else { 0x55 };
            let mut short = frames.last().cloned().unwrap();
            short.truncate(at.max(1));
            short.push(0);
            [frame, short]
        };
        let (up, down) = (damaged(&room.up), damaged(&room.down));
        room.give_server(&up);
        room.give_robot(&down);
    };
    costs_nothing_without_keys(attack);
    costs_a_counter(attack);
}

#[test]
fn replayed_welcomes_and_resets() {
    let attack: Attack = |room, _| {
        let answers: Vec<_> = room.down.iter().filter(|it| is_handshake(it)).cloned().collect();
        assert!(answers.len() >= 3, "two Welcomes and a Reset");
        room.give_robot(&answers);
    };
    costs_nothing_without_keys(attack);
    assert!(costs_a_counter(attack) > 300);
}

/// The robot hears nothing for a second: then a Reset counts.
#[test]
fn a_reset_in_a_silence() {
    let attack: Attack = |room, step| {
        if step == CALM {
            let answers: Vec<_> = room.down.iter().filter(|it| is_handshake(it)).cloned().collect();
            let forged = {
                let header = Header { version: VERSION, kind: FrameKind::Handshake, sequence: 0 };
                let contents = [&header.encode()[..], &[7, 0]].concat();
                stuffed(&contents, &seal(SessionId::NONE, Direction::ToRobot, &contents))
            };
            // Frames on the wire are lost while the attacker's arrive.
            let later = room.now + Duration::from_secs(1);
            answers.iter().chain([&forged]).for_each(|frame| room.robot.receive(frame, later));
        }
    };
    assert_eq!(run(false, attack).0.sessions, 3);
    let (outcome, _, robot) = run(true, attack);
    assert_eq!(outcome, undisturbed(true));
    // The forged one, and two Welcomes and a Reset.
    assert!(robot.refused == 1 && robot.replayed >= 3, "{robot:?}");
}
