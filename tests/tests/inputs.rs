//! Whatever inputs a robot gets, in any order, it returns a typed error or counts an event, its
//! state stays valid, and it never panics.
//!
//! NaN can't be an input: poses are in whole millimetres and binary angles, and the conversion from
//! floating point maps NaN to zero and saturates.

use proptest::{collection::vec, prelude::*};
use ubimap_agent::{
    Bounds, Config, Memory, Robot,
    sense::{ScanError, SensorModel},
};
use ubimap_protocol::{
    frame::{DEFAULT_FRAME, MAX_FRAME, SessionId},
    link::{Answer, Endpoint, Fill, Received, Terms, answer},
    message::{
        self as protocol, Body, Certainty, Digests, EventCode, FixSource, Freshness, Hello,
        ParameterAction, ParameterCommand, ParameterValue, Path, Peer, Peers, PoseFix, Refusal,
        RefusalReason, Request, Reset, Stop, Stored, TileDigest, TileUpdateHead, TimeReply,
        ToRobot, ToRobotKind, Waypoint, Writer,
    },
    tile::{Cell, Epoch, Layer, Stamp, Tile, TileEncoder, TileId, Version},
    time::{Duration, Instant},
    units::{Angle, Millimetres, Pose, RobotId},
};
use ubimap_sim_host::run::heap::{BOUNDS, Heap};

const BEAMS: usize = 12;
/// Fewer tiles than a scan touches.
const TILES: usize = 3;

/// An input.
#[derive(Clone, Debug)]
enum Input {
    Scan {
        taken: Instant,
        readings: Vec<u16>,
    },
    Odometry {
        moment: Instant,
        pose: Pose,
    },
    Gyro {
        moment: Instant,
        turn: u16,
    },
    Jolt {
        moment: Instant,
    },
    /// Random bytes.
    Noise(Vec<u8>),
    /// A message of the session with a random body.
    Body {
        kind: u8,
        body: Vec<u8>,
    },
    Message(Message),
    Reset,
    Transmit {
        room: usize,
    },
    Timeout,
    /// A Welcome from the same server or from a restarted one.
    Welcome {
        epoch: u32,
        stores: bool,
    },
    Refusal,
}

/// Well-formed messages, which need not be consistent.
#[derive(Clone, Debug)]
enum Message {
    Time(TimeReply),
    Fix(PoseFix),
    Tile { layer: Layer, id: TileId, stamp: Stamp, base: Option<Version>, cells: u32 },
    Request(Request),
    Peers(Peers),
    Path(Path),
    Stop(Stop),
    Parameter(ParameterCommand),
    Stored(Stored),
    Digests(Digests),
    Freshness(Freshness),
}

/// A time, usually in the first minute.
fn moment() -> impl Strategy<Value = Instant> {
    prop_oneof![
        8 => (0..60_000u64).prop_map(|millis| Instant(millis * 1_000)),
        1 => any::<u64>().prop_map(Instant),
        1 => Just(Instant(u64::MAX)),
    ]
}

fn pose() -> impl Strategy<Value = Pose> {
    let length = || prop_oneof![4 => -3_000..3_000i32, 1 => any::<i32>()];
    (length(), length(), any::<u16>()).prop_map(|(x, y, heading)| Pose {
        x: Millimetres(x),
        y: Millimetres(y),
        heading: Angle(heading),
    })
}

fn id() -> impl Strategy<Value = TileId> {
    let place = || prop_oneof![6 => -3..3i16, 1 => any::<i16>()];
    (place(), place()).prop_map(|(x, y)| TileId { x, y })
}

fn stamp() -> impl Strategy<Value = Stamp> {
    let number = || prop_oneof![6 => 0..4u32, 1 => any::<u32>()];
    (number(), number())
        .prop_map(|(epoch, version)| Stamp { epoch: Epoch(epoch), version: Version(version) })
}

fn layer() -> impl Strategy<Value = Layer> {
    prop_oneof![Just(Layer::Robot), Just(Layer::Coverage), Just(Layer::Fused)]
}

fn message() -> impl Strategy<Value = Message> {
    let peer = (any::<u16>(), pose(), any::<(u8, u16, u16)>());
    let peer = peer.prop_map(|(robot, pose, (age, half_length, half_width))| Peer {
        robot: RobotId(robot),
        pose,
        age,
        half_length,
        half_width,
    });
    let certainty = any::<(u16, u16, u16)>();
    let fix = ((moment(), pose()), vec((moment(), pose()), 0..3), certainty).prop_map(
        |(newest, before, (x, y, heading))| {
            let certainty = Certainty { x, y, heading };
            PoseFix::from_fixes(newest, before.into_iter(), certainty, FixSource::Camera)
        },
    );
    let digest =
        (id(), stamp(), any::<u32>()).prop_map(|(id, stamp, hash)| TileDigest { id, stamp, hash });
    let base = proptest::option::of((0..3u32).prop_map(Version));
    let action = prop_oneof![
        Just(ParameterAction::List),
        any::<u16>().prop_map(ParameterAction::Get),
        (0..10u16, prop_oneof![-100..70_000i32, any::<i32>()]).prop_map(|(parameter, value)| {
            ParameterAction::Set(ParameterValue { parameter, value })
        }),
    ];
    prop_oneof![
        3 => (0..3u16, moment(), any::<u32>()).prop_map(|(nonce, received, held_micros)| {
            Message::Time(TimeReply { nonce, received, held_micros })
        }),
        6 => fix.prop_map(Message::Fix),
        3 => (layer(), id(), stamp(), base, any::<u32>()).prop_map(
            |(layer, id, stamp, base, cells)| Message::Tile { layer, id, stamp, base, cells }
        ),
        1 => (layer(), vec(id(), 0..4)).prop_map(|(layer, tiles)| {
            Message::Request(Request { layer, tiles: tiles.into_iter().collect() })
        }),
        3 => (moment(), vec(peer, 0..8)).prop_map(|(time, peers)| {
            Message::Peers(Peers { time, peers: peers.into_iter().collect() })
        }),
        1 => (any::<u32>(), vec(pose(), 0..4)).prop_map(|(number, way)| {
            let waypoints = way.into_iter().map(|Pose { x, y, .. }| Waypoint { x, y }).collect();
            Message::Path(Path { number, waypoints })
        }),
        1 => any::<(u32, bool)>().prop_map(|(number, stop)| Message::Stop(Stop { number, stop })),
        2 => (any::<u16>(), action).prop_map(|(number, action)| {
            Message::Parameter(ParameterCommand { number, action })
        }),
        1 => vec((id(), stamp()), 0..4).prop_map(|tiles| {
            Message::Stored(Stored { tiles: tiles.into_iter().collect() })
        }),
        1 => (layer(), vec(digest, 0..4)).prop_map(|(layer, tiles)| {
            Message::Digests(Digests { layer, tiles: tiles.into_iter().collect() })
        }),
        1 => (moment(), any::<(u32, u16)>(), vec(any::<u8>(), 0..9)).prop_map(
            |(time, (interest, first), tiles)| {
                let tiles = tiles.into_iter().collect();
                Message::Freshness(Freshness { time, interest, first, tiles })
            }
        ),
    ]
}

fn input() -> impl Strategy<Value = Input> {
    let width = prop_oneof![9 => Just(BEAMS), 1 => 0..2 * BEAMS];
    let readings = width.prop_flat_map(|width| {
        vec(prop_oneof![4 => 200..4_200u16, 1 => Just(0u16), 1 => any::<u16>()], width)
    });
    prop_oneof![
        8 => (moment(), readings).prop_map(|(taken, readings)| Input::Scan { taken, readings }),
        3 => (moment(), pose()).prop_map(|(moment, pose)| Input::Odometry { moment, pose }),
        1 => (moment(), any::<u16>()).prop_map(|(moment, turn)| Input::Gyro { moment, turn }),
        1 => moment().prop_map(|moment| Input::Jolt { moment }),
        2 => vec(any::<u8>(), 0..80).prop_map(Input::Noise),
        2 => (0..20u8, vec(any::<u8>(), 0..60)).prop_map(|(kind, body)| Input::Body { kind, body }),
        12 => message().prop_map(Input::Message),
        1 => Just(Input::Reset),
        3 => (0..300usize).prop_map(|room| Input::Transmit { room }),
        2 => Just(Input::Timeout),
        1 => (1..3u32, any::<bool>()).prop_map(|(epoch, stores)| Input::Welcome { epoch, stores }),
        1 => Just(Input::Refusal),
    ]
}

/// The server's end of a link.
struct Server {
    link: Endpoint<ToRobot, (), 8, DEFAULT_FRAME>,
    hello: Option<Hello>,
    sessions: u32,
    terms: Terms,
}

impl Server {
    fn new(resolution: Millimetres) -> Self {
        let frame = DEFAULT_FRAME as u16;
        Self {
            link: Endpoint::new(),
            hello: None,
            sessions: 0,
            terms: Terms { resolution, frame, server_epoch: 1, stores: false },
        }
    }

    /// Receives the robot's readable messages.
    fn hear(&mut self, mut bytes: &[u8], now: Instant) {
        while let Some(received) = self.link.receive(&mut bytes, now) {
            if let Received::Handshake(message) = received {
                self.hello = message.decode().ok();
            }
        }
    }

    /// The bytes of a handshake frame.
    fn handshake(&mut self, body: &impl Body<ToRobot>) -> Vec<u8> {
        let mut out = vec![0; MAX_FRAME];
        let len = self.link.handshake(body, &mut out).expect("it fits");
        out.truncate(len);
        out
    }

    /// The frame of a welcome, in reply to the last hello.
    fn welcome(&mut self, epoch: u32, stores: bool) -> Option<Vec<u8>> {
        self.sessions += 1;
        (self.terms.server_epoch, self.terms.stores) = (epoch, stores);
        let session = SessionId(self.sessions);
        let Answer::Welcome(welcome) = answer(&self.hello?, &self.terms, session, epoch) else {
            return None;
        };
        let frame = self.handshake(&welcome);
        self.link.begin(session, DEFAULT_FRAME);
        Some(frame)
    }

    /// A frame with a message of the session; `None` without one.
    fn frame(&mut self, kind: u8, body: &[u8], now: Instant) -> Option<Vec<u8>> {
        let mut out = vec![0; MAX_FRAME];
        let sent = self.link.poll_transmit(now, &mut out, true, |writer, _| {
            let fits = writer.push_encoded(protocol::Message::new(kind, body));
            if fits { Fill::Datagram } else { Fill::Nothing }
        })?;
        out.truncate(sent.len);
        Some(out)
    }
}

impl Message {
    /// The number of the message's kind, and its body.
    fn bytes(&self) -> (u8, Vec<u8>) {
        let mut buffer = [0; MAX_FRAME];
        let mut writer = Writer::new(&mut buffer);
        assert!(self.write(&mut writer));
        let len = writer.len();
        let written = protocol::Messages::<ToRobot>::new(&buffer[..len]).next().unwrap().unwrap();
        (written.number, written.body.to_vec())
    }

    fn write(&self, writer: &mut Writer<'_, ToRobot>) -> bool {
        match self {
            Self::Time(it) => writer.push(it),
            Self::Fix(it) => writer.push(it),
            Self::Request(it) => writer.push(it),
            Self::Peers(it) => writer.push(it),
            Self::Path(it) => writer.push(it),
            Self::Stop(it) => writer.push(it),
            Self::Parameter(it) => writer.push(it),
            Self::Stored(it) => writer.push(it),
            Self::Digests(it) => writer.push(it),
            Self::Freshness(it) => writer.push(it),
            &Self::Tile { layer, id, stamp, base, cells } => {
                writer.push_with(&TileUpdateHead { layer, seconds: cells }, |coded| {
                    let mut tile = Tile::UNKNOWN;
                    tile.low[3] = cells;
                    let mut encoder = TileEncoder::new(coded);
                    let _ = encoder.push(id, stamp, base, 0, &Tile::UNKNOWN, &tile);
                    Some(encoder.finish().unwrap_or(0))
                })
            }
        }
    }
}

/// Everything that the robot knows, except for what is queued, in flight or counted.
fn state(robot: &Robot<'_>) -> String {
    let own: Vec<_> = robot.own_tiles().tiles().collect();
    let [fused, coverage] = [Layer::Fused, Layer::Coverage]
        .map(|layer| robot.fused_tiles().tiles(layer).collect::<Vec<_>>());
    format!("{own:?} {fused:?} {coverage:?} {:?} {:?}", robot.commands(), robot.pose())
}

fn config() -> Config {
    let sensor = SensorModel::Radial { first: -1.1, step: 0.2 };
    let bounds = Bounds { readings: BEAMS, own_tiles: TILES, fused_tiles: 4, ..BOUNDS };
    Config::new(RobotId(3), sensor, bounds)
}

/// Applies one input.
fn put(robot: &mut Robot<'_>, server: &mut Server, input: Input, now: Instant) {
    // First does the work that is already due, so that its effects are not attributed to this
    // input.
    robot.timeout(now);
    let (before, counted) = (state(robot), robot.statistics());
    match input {
        Input::Scan { taken, readings } => {
            let taken_in = robot.scan(taken, &readings, now);
            let after = robot.statistics();
            if let Err(error) = taken_in {
                assert_eq!(state(robot), before, "{error:?}");
                assert_eq!(after.scans, counted.scans, "{error:?}");
                let overflowed = u32::from(error == ScanError::Full);
                assert_eq!(after.overflowed, counted.overflowed + overflowed);
            } else {
                assert_eq!(readings.len(), BEAMS);
                assert_eq!(after.scans, counted.scans + 1);
            }
            if readings.len() != BEAMS {
                let (expected, found) = (BEAMS, readings.len());
                assert_eq!(taken_in, Err(ScanError::Width { expected, found }));
            }
        }
        Input::Odometry { moment, pose } => robot.odometry(moment, pose, now),
        Input::Gyro { moment, turn } => robot.gyro(moment, Angle(turn)),
        Input::Jolt { moment } => robot.jolt(moment),
        Input::Noise(bytes) => {
            robot.receive(&bytes, now);
            assert_eq!(state(robot), before, "noise changed the state");
        }
        Input::Body { kind, body } => {
            if let Some(frame) = server.frame(kind, &body, now) {
                robot.receive(&frame, now);
                let after = robot.statistics();
                let unread =
                    |it: &ubimap_agent::Statistics| it.unknown_messages + it.malformed_messages;
                if unread(&after) != unread(&counted) {
                    assert_eq!(unread(&after), unread(&counted) + 1);
                    // From an incomplete tile update, the robot keeps the tiles before the error.
                    if kind != u8::from(ToRobotKind::TileUpdate) {
                        assert_eq!(
                            state(robot),
                            before,
                            "an unreadable message of kind {kind} changed the state"
                        );
                    }
                }
            }
        }
        Input::Message(message) => {
            let (kind, body) = message.bytes();
            if let Some(frame) = server.frame(kind, &body, now) {
                robot.receive(&frame, now);
                let after = robot.statistics();
                let passed_over = match message {
                    Message::Tile { layer, .. } => layer == Layer::Robot,
                    Message::Fix(_) => after.fixes == counted.fixes,
                    _ => false,
                };
                assert!(
                    !passed_over || state(robot) == before,
                    "an ignored message changed the state"
                );
            }
        }
        Input::Reset => {
            let frame = server.handshake(&Reset);
            robot.receive(&frame, now);
            assert_eq!(state(robot), before);
        }
        Input::Transmit { room } => {
            let mut out = vec![0; room];
            if let Some(len) = robot.poll_transmit(now, &mut out) {
                assert!(len <= room);
                server.hear(&out[..len], now);
            }
        }
        Input::Timeout => robot.timeout(now),
        Input::Welcome { epoch, stores } => {
            if let Some(frame) = server.welcome(epoch, stores) {
                robot.receive(&frame, now);
            }
        }
        Input::Refusal => {
            let nonce = server.hello.map_or(0, |hello| hello.nonce);
            let refusal = Refusal { nonce, reason: RefusalReason::Resolution(Millimetres(1)) };
            let frame = server.handshake(&refusal);
            robot.receive(&frame, now);
            assert_eq!(state(robot), before);
        }
    }
    assert!(robot.own_tiles().tiles().count() <= TILES);
    let _ = robot.poll_timeout();
}

/// Opens a session, with the frame sizes of both ends.
fn connect(robot: &mut Robot<'_>, server: &mut Server) {
    put(robot, server, Input::Transmit { room: DEFAULT_FRAME }, Instant(0));
    put(robot, server, Input::Welcome { epoch: 1, stores: false }, Instant(0));
    assert!(robot.is_connected());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn any_inputs_in_any_order_are_errors_or_counted(
        inputs in vec((input(), moment()), 0..80),
        in_order: bool,
    ) {
        let config = config();
        let mut memory = Memory::<Heap>::new(&config.bounds);
        let mut robot = Robot::new(config, &mut memory).unwrap();
        let mut server = Server::new(config.bounds.resolution);
        connect(&mut robot, &mut server);
        let mut now = Instant(0);
        for (input, moment) in inputs {
            // Time advances, or jumps back and forth.
            now = if in_order { now + Duration(moment.0 % 700_000) } else { moment };
            put(&mut robot, &mut server, input, now);
        }
    }
}

/// Each bad input that must be reported, one at a time, with its result.
#[test]
fn each_bad_input_is_reported() {
    let config = config();
    let mut memory = Memory::<Heap>::new(&config.bounds);
    let mut robot = Robot::new(config, &mut memory).unwrap();
    let mut server = Server::new(config.bounds.resolution);
    connect(&mut robot, &mut server);
    let at = |millis: u64| Instant(millis * 1_000);
    let fix = |millis: u64, x: f64| {
        let fix = (at(millis), Pose::from_metres(x, 0.0, 0.0));
        let certainty = Certainty { x: 20, y: 20, heading: 100 };
        let before = std::iter::empty();
        let fix = PoseFix::from_fixes(fix, before, certainty, FixSource::Camera);
        Input::Message(Message::Fix(fix))
    };
    let scan = |millis| Input::Scan { taken: at(millis), readings: vec![3_000; BEAMS] };

    // A fix whose time is unknown, because the clocks are not synchronised yet.
    put(&mut robot, &mut server, fix(10, 0.0), at(10));
    assert_eq!((robot.statistics().fixes_untimely, robot.pose()), (1, None));
    put(&mut robot, &mut server, Input::Transmit { room: 250 }, at(20));
    let reply = TimeReply { nonce: 0, received: at(20), held_micros: 0 };
    put(&mut robot, &mut server, Input::Message(Message::Time(reply)), at(20));
    assert!(robot.server_time(at(20)).is_some());
    // A fix from the future.
    put(&mut robot, &mut server, fix(9_000, 0.0), at(30));
    assert_eq!((robot.statistics().fixes_untimely, robot.pose()), (2, None));
    put(&mut robot, &mut server, fix(100, 0.0), at(100));
    assert_eq!((robot.statistics().fixes, robot.statistics().fixes_untimely), (1, 2));
    // Odometry whose time goes backwards.
    let pose = Pose::default();
    for moment in [at(120), at(110)] {
        put(&mut robot, &mut server, Input::Odometry { moment, pose }, at(120));
    }
    assert_eq!(robot.statistics().odometry_backwards, 1);

    // A scan older than the last one, and more scans than can wait. Within 4 m there are more tiles
    // than the pool has.
    put(&mut robot, &mut server, scan(150), at(150));
    assert_eq!(robot.scan(at(140), &[3_000; BEAMS], at(150)), Err(ScanError::Backwards));
    let full =
        (0..20).find_map(|count| robot.scan(at(151 + count), &[3_000; BEAMS], at(180)).err());
    assert_eq!(full, Some(ScanError::Full));
    assert_eq!(robot.statistics().overflowed, 1);
    put(&mut robot, &mut server, fix(200, 0.0), at(200));
    put(&mut robot, &mut server, Input::Odometry { moment: at(200), pose }, at(200));
    let counted = robot.statistics();
    assert!(counted.mapped > 0 && counted.cells_refused > 0, "{counted:?}");
    assert_eq!(robot.own_tiles().tiles().count(), TILES);

    // An update relative to a version that the robot does not hold: the robot requests the whole
    // tile.
    let (id, base) = (TileId { x: 0, y: 0 }, Some(Version(8)));
    let stamp = Stamp { epoch: Epoch(1), version: Version(9) };
    let update = Message::Tile { layer: Layer::Fused, id, stamp, base, cells: 7 };
    put(&mut robot, &mut server, Input::Message(update), at(210));
    assert!(robot.fused_tiles().tile(id).is_none_or(|tile| tile.cell(0, 3) == Cell::Unknown));
    // A fix that is an outlier.
    put(&mut robot, &mut server, fix(220, 900.0), at(220));
    assert_eq!(robot.statistics().fixes_rejected, 1);
    // Poses from NaN.
    assert_eq!(Pose::from_metres(f64::NAN, f64::NAN, f64::NAN), Pose::default());
    // Events that were raised are recognised by their codes.
    let codes = format!("{robot:?}");
    for code in [
        EventCode::SensorFault,
        EventCode::ClockBackwards,
        EventCode::ScanOverflow,
        EventCode::PoolFull,
        EventCode::FixRejected,
    ] {
        let told = codes.contains(&format!("code: {code:?}"));
        assert_eq!(told, code != EventCode::SensorFault, "{code:?}");
    }
}
