//! Generates the vectors on request (`UBIMAP_WRITE_VECTORS=1`).

use std::fs;

use serde_json::{Value, json};
use ubimap_protocol::{
    frame::{Direction, FrameKind, Header, SessionId, cobs, seal},
    link::{Answer, Terms, answer},
    message::{
        Ack, Body, Certainty, Digests, DistanceVector, EarlierFix, Event, FixSource, Freshness,
        Hello, Interest, Message, Messages, Obstacle, ObstacleClass, Obstacles, ParameterAction,
        ParameterCommand, ParameterOutcome, ParameterReport, ParameterValue, Path, Peer, Peers,
        PoseFix, Posture, Postures, Refusal, RefusalReason, Request, Reset, Severity, State, Stop,
        Stored, TileDigest, TileUpdateHead, TimeReply, TimeRequest, ToRobot, ToServer, Traffic,
        Waypoint, Welcome, Writer,
    },
    tile::{
        Cell, Digest, Epoch, Layer, Replica, Row, Stamp, TILE_CELLS, TILE_SIDE, Tile, TileDecoder,
        TileEncoder, TileId, Version, tile_hash,
    },
    time::Instant,
    units::{Angle, Millimetres, Pose, RobotId},
};
use ubimap_tests::vectors::{direction_name, folder, hex, planes};

use super::{FRAME_LIMIT, outcome_of};

#[path = "first_steps.rs"]
mod first_steps;
#[path = "repair.rs"]
mod repair;
#[path = "rows.rs"]
mod rows;
#[path = "seals.rs"]
mod seals;
#[path = "session.rs"]
mod session;
#[path = "timing.rs"]
mod timing;
#[path = "trace.rs"]
mod trace;

const TO_SERVER: Direction = Direction::ToServer;
const TO_ROBOT: Direction = Direction::ToRobot;

/// All files of vectors that are generated here, by name.
pub(super) fn all() -> Vec<(&'static str, Value)> {
    vec![
        ("first_steps", first_steps::first_steps()),
        ("frames", json!({ "stuffing": stuffing(), "frames": frames() })),
        ("messages", messages()),
        ("payloads", payloads()),
        ("tiles", tiles()),
        ("replica", replica()),
        ("rows", rows::rows()),
        ("repair", repair::repair()),
        ("session", session::session()),
        ("seals", seals::seals()),
        ("digests", digests()),
        ("handshake", json!({ "transcript": transcript(), "answers": answers() })),
        ("window", window()),
        ("timing", timing::timing()),
        (
            "refused",
            json!({
                "frames": refused_frames(), "payloads": refused_payloads(),
                "messages": refused_messages(),
            }),
        ),
    ]
}

/// Writes all files.
pub(super) fn write_all() {
    for (name, cases) in all() {
        let text = match name {
            "first_steps" | "timing" | "session" => printed(&cases),
            _ => serde_json::to_string_pretty(&cases).unwrap(),
        };
        fs::write(folder().join(name).with_extension("json"), text + "\n").unwrap();
    }
}

/// Indented JSON in which a list of numbers and names is one line.
fn printed(value: &Value) -> String {
    let text = serde_json::to_string_pretty(value).unwrap();
    let mut lines: Vec<String> = Vec::new();
    let mut list: Vec<String> = Vec::new();
    for line in text.lines() {
        let inner = line.trim();
        if inner.ends_with('[') {
            lines.append(&mut list);
            list.push(line.into());
        } else if list.is_empty() {
            lines.push(line.into());
        } else if inner.starts_with(']') {
            let (first, rest) = list.split_first().unwrap();
            let rest: Vec<&str> = rest.iter().map(|it| it.trim()).collect();
            lines.push(format!("{first}{}{inner}", rest.join(" ")));
            list.clear();
        } else if inner.ends_with(['{', '}']) || inner.ends_with("},") {
            lines.append(&mut list);
            lines.push(line.into());
        } else {
            list.push(line.into());
        }
    }
    lines.join("\n")
}

fn stuff(contents: &[u8]) -> Vec<u8> {
    let mut wire = vec![0; cobs::encoded_len(contents.len())];
    let len = cobs::encode([contents, &[]], &mut wire).unwrap();
    wire.truncate(len);
    wire
}

fn stuffing() -> Value {
    let ramp: Vec<u8> = (1..=255).collect();
    let cases = [
        ("one zero", vec![0]),
        ("no zero", vec![0x11, 0x22]),
        ("zeros between", vec![0x11, 0, 0, 0x22]),
        ("ends in zero", vec![0x11, 0]),
        ("a full block", ramp[..254].to_vec()),
        ("a full block and one", ramp.clone()),
        ("a full block and a zero", [&ramp[..254], &[0]].concat()),
    ];
    let case = |(name, contents): &(&str, Vec<u8>)| json!({ "name": name, "contents": hex(contents), "wire": hex(&stuff(contents)) });
    cases.iter().map(case).collect()
}

fn sealed(direction: Direction, session: u32, header: Header, payload: &[u8]) -> Vec<u8> {
    let contents = [&header.encode()[..], payload].concat();
    let tail = seal(SessionId(session), direction, &contents);
    stuff(&[&contents[..], &tail].concat())
}

fn header(kind: FrameKind, sequence: u16) -> Header {
    Header { version: 1, kind, sequence }
}

/// An encoded message: kind, length, body.
fn message<D: Traffic>(body: &impl Body<D>) -> Vec<u8> {
    written::<D>(|writer| writer.push(body))
}

/// An encoded message whose body starts with `head`, followed by `rest`.
fn message_with<D: Traffic>(head: &impl Body<D>, rest: &[u8]) -> Vec<u8> {
    written::<D>(|writer| {
        writer.push_with(head, |space| {
            space[..rest.len()].copy_from_slice(rest);
            Some(rest.len())
        })
    })
}

fn written<D: Traffic>(write: impl FnOnce(&mut Writer<'_, D>) -> bool) -> Vec<u8> {
    let mut buffer = [0; 1024];
    let mut writer = Writer::new(&mut buffer);
    assert!(write(&mut writer));
    let len = writer.len();
    buffer[..len].to_vec()
}

fn frames() -> Value {
    let hello = message::<ToServer>(&small_hello());
    let ack = message::<ToRobot>(&Ack { next: 5, later: 2 });
    let request = message::<ToServer>(&TimeRequest { nonce: 7 });
    let cases = [
        ("handshake", TO_SERVER, 0, header(FrameKind::Handshake, 0), hello),
        ("datagram", TO_SERVER, 0xA1B2_C3D4, header(FrameKind::Datagram, 3), request.clone()),
        (
            "reliable",
            TO_ROBOT,
            0xA1B2_C3D4,
            header(FrameKind::Reliable, 2047),
            [ack, request].concat(),
        ),
        ("empty", TO_ROBOT, 1, header(FrameKind::Datagram, 0), vec![]),
        ("long", TO_ROBOT, u32::MAX, header(FrameKind::Reliable, 1024), vec![0xEE; 1010]),
        (
            "handshake of another version",
            TO_SERVER,
            0,
            Header { version: 3, ..header(FrameKind::Handshake, 0) },
            message::<ToServer>(&Hello { version: 3, min_version: 2, ..small_hello() }),
        ),
    ];
    let case =
        |(name, direction, session, header, payload): &(&str, Direction, u32, Header, Vec<u8>)| {
            json!({
                "name": name, "direction": direction_name(*direction), "session": session,
                "version": header.version, "kind": format!("{:?}", header.kind).to_lowercase(),
                "sequence": header.sequence, "payload": hex(payload),
                "wire": hex(&sealed(*direction, *session, *header, payload)),
            })
        };
    cases.iter().map(case).collect()
}

fn small_hello() -> Hello {
    Hello {
        version: 1,
        min_version: 1,
        robot: RobotId(1),
        nonce: 99,
        frame: 250,
        resolution: Millimetres(50),
        fused_tiles: 16,
    }
}

fn small_welcome() -> Welcome {
    Welcome {
        nonce: 99,
        version: 1,
        session: SessionId(77),
        frame: 250,
        server_epoch: 3,
        first_epoch: 1,
        stores: true,
        renumber: false,
    }
}

fn pose(x: i32, y: i32, heading: u16) -> Pose {
    Pose { x: Millimetres(x), y: Millimetres(y), heading: Angle(heading) }
}

const FAR: Pose =
    Pose { x: Millimetres(i32::MIN), y: Millimetres(i32::MAX), heading: Angle(u16::MAX) };
const END: Instant = Instant(u64::MAX);
const CORNER: TileId = TileId { x: i16::MIN, y: i16::MAX };
const LAST: Stamp = Stamp { epoch: Epoch(u32::MAX), version: Version(u32::MAX) };

struct Cases(Vec<Value>);

impl Cases {
    fn add<D: Traffic>(&mut self, name: &str, body: &impl Body<D>) {
        self.add_with::<D>(name, body, &[]);
    }

    fn add_with<D: Traffic>(&mut self, name: &str, head: &impl Body<D>, rest: &[u8]) {
        let bytes = message_with::<D>(head, rest);
        let message = Messages::<D>::new(&bytes).next().unwrap().unwrap();
        self.0.push(json!({
            "name": name, "direction": direction_name(D::DIRECTION), "kind": message.number,
            "body": hex(message.body), "fields": serde_json::to_value(head).unwrap(),
            "rest": hex(rest),
        }));
    }
}

fn messages() -> Value {
    let mut cases = Cases(Vec::new());
    both_ways::<ToServer>(&mut cases, Layer::Robot);
    both_ways::<ToRobot>(&mut cases, Layer::Fused);
    to_server(&mut cases);
    to_robot(&mut cases);
    Value::Array(cases.0)
}

fn both_ways<D: Traffic>(cases: &mut Cases, layer: Layer)
where
    TileUpdateHead: Body<D>,
    Request: Body<D>,
    Digests: Body<D>,
{
    let name = |what: &str| format!("{what} {}", direction_name(D::DIRECTION));
    cases.add::<D>(&name("ack small"), &Ack { next: 5, later: 0 });
    cases.add::<D>(&name("ack extreme"), &Ack { next: 2047, later: u32::MAX });
    let coded = update_of(1000, |encoder| {
        encoder
            .push(TileId { x: 1, y: -1 }, stamp(2, 1), None, 0, &Tile::UNKNOWN, &room())
            .unwrap();
    });
    let head = TileUpdateHead { layer, seconds: 60 };
    cases.add_with::<D>(&name("tile update small"), &head, &coded);
    let head = TileUpdateHead { layer: Layer::Coverage, seconds: u32::MAX };
    cases.add_with::<D>(&name("tile update extreme"), &head, &coded);
    let request = Request { layer, tiles: [].into_iter().collect() };
    cases.add::<D>(&name("request small"), &request);
    let request = Request { layer, tiles: [CORNER; 8].into_iter().collect() };
    cases.add::<D>(&name("request extreme"), &request);
    let digest = TileDigest { id: TileId { x: -1, y: 1 }, stamp: stamp(1, 9), hash: 0x1234_5678 };
    let digests = Digests { layer, tiles: [digest].into_iter().collect() };
    cases.add::<D>(&name("digests small"), &digests);
    let digest = TileDigest { id: CORNER, stamp: LAST, hash: u32::MAX };
    let digests = Digests { layer, tiles: [digest; 8].into_iter().collect() };
    cases.add::<D>(&name("digests extreme"), &digests);
}

fn to_server(cases: &mut Cases) {
    cases.add::<ToServer>("hello small", &small_hello());
    cases.add::<ToServer>(
        "hello extreme",
        &Hello {
            version: 255,
            min_version: 255,
            robot: RobotId(u16::MAX),
            nonce: u32::MAX,
            frame: u16::MAX,
            resolution: Millimetres(i32::MAX),
            fused_tiles: u16::MAX,
        },
    );
    cases.add_with::<ToServer>(
        "hello with a field that was added later",
        &small_hello(),
        &[1, 2, 3],
    );
    cases.add::<ToServer>("time request small", &TimeRequest { nonce: 0 });
    cases.add::<ToServer>("time request extreme", &TimeRequest { nonce: u16::MAX });
    cases.add::<ToServer>(
        "state small",
        &State { time: None, pose: None, odometry: None, cells_refused: 0 },
    );
    cases.add::<ToServer>(
        "state usual",
        &State {
            time: Some(Instant(61_500_000)),
            pose: Some(pose(-1234, 5678, 16_384)),
            odometry: None,
            cells_refused: 2,
        },
    );
    cases.add::<ToServer>(
        "state extreme",
        &State { time: Some(END), pose: Some(FAR), odometry: Some(FAR), cells_refused: u32::MAX },
    );
    cases.add::<ToServer>(
        "interest small",
        &Interest { number: 1, from: TileId { x: -2, y: -2 }, to: TileId { x: 1, y: 1 } },
    );
    cases.add::<ToServer>(
        "interest extreme",
        &Interest {
            number: u32::MAX,
            from: TileId { x: i16::MIN, y: i16::MIN },
            to: TileId { x: i16::MAX, y: i16::MAX },
        },
    );
    cases.add::<ToServer>(
        "distance vector small",
        &DistanceVector {
            time: Instant(0),
            pose: pose(0, 0, 0),
            first: Angle(0),
            step: 1,
            distances: [].into_iter().collect(),
            odometry: None,
        },
    );
    let usual = DistanceVector {
        time: Instant(61_500_000),
        pose: pose(3000, -250, 49_152),
        first: Angle(5461),
        step: -1365,
        distances: [0, 1, 60, 254, 255].into_iter().collect(),
        odometry: Some(pose(-12_400, 70, 300)),
    };
    let without = DistanceVector { odometry: None, ..usual.clone() };
    cases.add::<ToServer>("distance vector usual", &without);
    cases.add::<ToServer>("distance vector with odometry", &usual);
    cases.add_with::<ToServer>("distance vector with a field that was added later", &usual, &[9]);
    let extreme = DistanceVector {
        time: END,
        pose: FAR,
        first: Angle(u16::MAX),
        step: i16::MIN,
        distances: [255; 64].into_iter().collect(),
        odometry: None,
    };
    cases.add::<ToServer>("distance vector extreme", &extreme);
    cases.add::<ToServer>(
        "distance vector extreme with odometry",
        &DistanceVector { odometry: Some(FAR), ..extreme },
    );
    cases.add::<ToServer>(
        "event small",
        &Event { time: None, severity: Severity::Info, code: 1, detail: "".try_into().unwrap() },
    );
    cases.add::<ToServer>(
        "event usual",
        &Event {
            time: Some(Instant(5)),
            severity: Severity::Warning,
            code: 2,
            detail: "räder".try_into().unwrap(),
        },
    );
    cases.add::<ToServer>(
        "event extreme",
        &Event {
            time: Some(END),
            severity: Severity::Error,
            code: u16::MAX,
            detail: "x".repeat(32).as_str().try_into().unwrap(),
        },
    );
    let value = |parameter, value| ParameterValue { parameter, value };
    for outcome in [ParameterOutcome::Unknown, ParameterOutcome::OutOfRange] {
        cases.add::<ToServer>(
            &format!("parameter report {outcome:?}"),
            &ParameterReport { number: 1, outcome, values: [].into_iter().collect() },
        );
    }
    cases.add::<ToServer>(
        "parameter report usual",
        &ParameterReport {
            number: 4,
            outcome: ParameterOutcome::Done,
            values: [value(1, 120), value(2, -35), value(3, 300)].into_iter().collect(),
        },
    );
    cases.add::<ToServer>(
        "parameter report stored",
        &ParameterReport {
            number: 5,
            outcome: ParameterOutcome::Done,
            values: [value(13, 1)].into_iter().collect(),
        },
    );
    cases.add::<ToServer>(
        "parameter report extreme",
        &ParameterReport {
            number: u16::MAX,
            outcome: ParameterOutcome::Done,
            values: [value(u16::MAX, i32::MIN); 16].into_iter().collect(),
        },
    );
}

fn to_robot(cases: &mut Cases) {
    cases.add::<ToRobot>("welcome small", &small_welcome());
    cases.add::<ToRobot>(
        "welcome extreme",
        &Welcome {
            nonce: u32::MAX,
            version: 255,
            session: SessionId(u32::MAX),
            frame: u16::MAX,
            server_epoch: u32::MAX,
            first_epoch: u32::MAX,
            stores: false,
            renumber: true,
        },
    );
    cases.add::<ToRobot>(
        "time reply small",
        &TimeReply { nonce: 0, received: Instant(0), held_micros: 0 },
    );
    cases.add::<ToRobot>(
        "time reply extreme",
        &TimeReply { nonce: u16::MAX, received: END, held_micros: u32::MAX },
    );
    let certainty = Certainty { x: 20, y: 20, heading: 182 };
    cases.add::<ToRobot>(
        "pose fix small",
        &PoseFix {
            time: Instant(61_500_000),
            pose: pose(100, -5, 10),
            certainty,
            source: FixSource::Camera,
            earlier: [].into_iter().collect(),
        },
    );
    let step = EarlierFix { before_micros: 100_000, dx: 10, dy: -10, turn: -546 };
    cases.add::<ToRobot>(
        "pose fix usual",
        &PoseFix {
            time: Instant(61_500_000),
            pose: pose(100, -5, 10),
            certainty,
            source: FixSource::MapMatch,
            earlier: [step; 3].into_iter().collect(),
        },
    );
    let step = EarlierFix { before_micros: u32::MAX, dx: i32::MIN, dy: i32::MAX, turn: i16::MIN };
    let most = Certainty { x: u16::MAX, y: u16::MAX, heading: u16::MAX };
    cases.add::<ToRobot>(
        "pose fix extreme",
        &PoseFix {
            time: END,
            pose: FAR,
            certainty: most,
            source: FixSource::MapMatch,
            earlier: [step; 3].into_iter().collect(),
        },
    );
    for (name, reason) in [
        ("refusal version", RefusalReason::Version { min: 1, current: 1 }),
        ("refusal resolution", RefusalReason::Resolution(Millimetres(50))),
        ("refusal frame", RefusalReason::Frame(32)),
        ("refusal number in use", RefusalReason::NumberInUse),
        ("refusal too many robots", RefusalReason::TooManyRobots),
    ] {
        cases.add::<ToRobot>(name, &Refusal { nonce: 99, reason });
    }
    cases.add::<ToRobot>(
        "refusal extreme",
        &Refusal { nonce: u32::MAX, reason: RefusalReason::Version { min: 255, current: 255 } },
    );
    cases.add::<ToRobot>("reset", &Reset);
    cases.add_with::<ToRobot>("reset with a field that was added later", &Reset, &[9]);
    let peer = Peer {
        robot: RobotId(2),
        pose: pose(1000, 2000, 3000),
        age: 7,
        half_length: 150,
        half_width: 120,
    };
    cases.add::<ToRobot>(
        "peers small",
        &Peers { time: Instant(61_500_000), peers: [peer].into_iter().collect() },
    );
    let peer = Peer {
        robot: RobotId(u16::MAX),
        pose: FAR,
        age: u8::MAX,
        half_length: u16::MAX,
        half_width: u16::MAX,
    };
    cases.add::<ToRobot>(
        "peers extreme",
        &Peers { time: END, peers: [peer; 8].into_iter().collect() },
    );
    let thing = |class| Obstacle {
        number: 1,
        class,
        x: Millimetres(500),
        y: Millimetres(-500),
        velocity_x: 1200,
        velocity_y: -300,
        radius: 250,
    };
    let classes = [ObstacleClass::Person, ObstacleClass::Movable, ObstacleClass::Fixed];
    let unknown = |class| (thing(class), Posture::Unknown);
    cases.add::<ToRobot>(
        "obstacles small",
        &Obstacles::with_postures(Instant(61_500_000), classes.map(unknown).into_iter()),
    );
    let stays = |number, class| Obstacle { number, velocity_x: 0, velocity_y: 0, ..thing(class) };
    let walks = Obstacle { velocity_x: 1200, ..stays(3, ObstacleClass::Person) };
    let told = [
        (stays(1, ObstacleClass::Person), Posture::Sitting),
        (stays(2, ObstacleClass::Movable), Posture::Unknown),
        (walks, Posture::Standing),
    ];
    let postures = Obstacles::with_postures(Instant(61_500_000), told.into_iter());
    cases.add::<ToRobot>("obstacles postures", &postures);
    cases.add_with::<ToRobot>("obstacles with a field that was added later", &postures, &[9, 9]);
    let thing = Obstacle {
        number: u16::MAX,
        class: ObstacleClass::Fixed,
        x: Millimetres(i32::MIN),
        y: Millimetres(i32::MAX),
        velocity_x: i16::MIN,
        velocity_y: i16::MAX,
        radius: u16::MAX,
    };
    cases.add::<ToRobot>(
        "obstacles extreme",
        &Obstacles {
            time: END,
            obstacles: [thing; 12].into_iter().collect(),
            postures: Postures::default(),
        },
    );
    let lies = Obstacle { class: ObstacleClass::Person, ..thing };
    cases.add::<ToRobot>(
        "obstacles postures extreme",
        &Obstacles::with_postures(END, [(lies, Posture::Lying); 12].into_iter()),
    );
    cases.add::<ToRobot>("path small", &Path { number: 1, waypoints: [].into_iter().collect() });
    let point = Waypoint { x: Millimetres(i32::MIN), y: Millimetres(i32::MAX) };
    cases.add::<ToRobot>(
        "path extreme",
        &Path { number: u32::MAX, waypoints: [point; 16].into_iter().collect() },
    );
    cases.add::<ToRobot>("stop small", &Stop { number: 1, stop: true });
    cases.add::<ToRobot>("stop extreme", &Stop { number: u32::MAX, stop: false });
    cases.add::<ToRobot>(
        "parameter list",
        &ParameterCommand { number: 1, action: ParameterAction::List },
    );
    cases.add::<ToRobot>(
        "parameter get",
        &ParameterCommand { number: 2, action: ParameterAction::Get(3) },
    );
    let stored = ParameterValue { parameter: 13, value: 1 };
    cases.add::<ToRobot>(
        "parameter store",
        &ParameterCommand { number: 5, action: ParameterAction::Set(stored) },
    );
    let value = ParameterValue { parameter: u16::MAX, value: i32::MIN };
    cases.add::<ToRobot>(
        "parameter set",
        &ParameterCommand { number: u16::MAX, action: ParameterAction::Set(value) },
    );
    cases.add::<ToRobot>(
        "stored small",
        &Stored { tiles: [(TileId { x: 1, y: -1 }, stamp(2, 1))].into_iter().collect() },
    );
    cases.add::<ToRobot>(
        "stored extreme",
        &Stored { tiles: [(CORNER, LAST); 8].into_iter().collect() },
    );
    let (time, tiles) = (Instant(61_500_000), [0b0000_0110, 0, 0b1000_0000].into_iter().collect());
    cases.add::<ToRobot>("freshness small", &Freshness { time, interest: 1, first: 0, tiles });
    let (interest, first) = (u32::MAX, u16::MAX);
    let tiles = [0xFF; 32].into_iter().collect();
    cases.add::<ToRobot>("freshness extreme", &Freshness { time: END, interest, first, tiles });
}

fn payloads() -> Value {
    let ack = message::<ToRobot>(&Ack { next: 5, later: 2 });
    let long = written::<ToRobot>(|writer| {
        let text = [&[0x82, 0x01][..], &[b'x'; 130]].concat();
        writer.push_encoded(Message::new(200, &text))
    });
    let stop = message::<ToRobot>(&Stop { number: 1, stop: true });
    let cases = [
        ("nothing", vec![], vec![]),
        ("two messages", [&ack[..], &stop].concat(), vec![&ack, &stop]),
        ("an unknown kind between", [&ack[..], &long, &stop].concat(), vec![&ack, &long, &stop]),
    ];
    let split = |message: &[u8]| {
        let head = if message.len() - 2 < 128 { 2 } else { 3 };
        json!({ "kind": message[0], "body": hex(&message[head..]) })
    };
    let case = |(name, payload, parts): &(&str, Vec<u8>, Vec<&Vec<u8>>)| {
        let messages: Vec<_> = parts.iter().map(|part| split(part)).collect();
        json!({ "name": name, "payload": hex(payload), "messages": messages })
    };
    cases.iter().map(case).collect()
}

fn stamp(epoch: u32, version: u32) -> Stamp {
    Stamp { epoch: Epoch(epoch), version: Version(version) }
}

/// A corner of a room: free inside, walls to the west and south, unknown behind them.
fn room() -> Tile {
    let mut tile = Tile::UNKNOWN;
    for y in 6..TILE_SIDE {
        for x in 9..TILE_SIDE {
            tile.set(x, y, if x == 9 || y == 6 { Cell::Occupied } else { Cell::Free });
        }
    }
    for (x, y) in [(20, 15), (21, 15), (20, 16)] {
        tile.set(x, y, Cell::Movable);
    }
    tile
}

/// The same corner later: a chair was removed, a door opened, and a box added.
fn room_later() -> Tile {
    let mut tile = room();
    for (x, y) in [(20, 15), (21, 15), (20, 16), (25, 6), (26, 6), (27, 6)] {
        tile.set(x, y, Cell::Free);
    }
    for x in 12..15 {
        tile.set(x, 28, Cell::Movable);
    }
    tile
}

fn filled(cell: Cell) -> Tile {
    let mut tile = Tile::UNKNOWN;
    (0..1024).for_each(|at| tile.set(at % 32, at / 32, cell));
    tile
}

fn noise(mut state: u32) -> Tile {
    let mut next = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        state ^ state >> 15
    };
    let mut tile = Tile::UNKNOWN;
    for y in 0..TILE_SIDE {
        tile.set_row(y, Row { low: next(), high: next() });
    }
    tile
}

fn update_of(room: usize, fill: impl FnOnce(&mut TileEncoder<'_>)) -> Vec<u8> {
    let mut out = vec![0; room];
    let mut encoder = TileEncoder::new(&mut out);
    fill(&mut encoder);
    let len = encoder.finish().unwrap();
    out.truncate(len);
    out
}

/// One tile of a case: id, stamp, base, and the cells before and after.
type Change = (TileId, Stamp, Option<u32>, Tile, Tile);

fn tile_case(name: &str, room: usize, start: u16, changes: &[Change]) -> (Value, u16) {
    let mut parts = Vec::new();
    let mut reached = 0;
    let coded = update_of(room, |encoder| {
        for (id, stamp, base, before, after) in changes {
            let base = base.map(Version);
            let end = encoder.push(*id, *stamp, base, start, before, after).unwrap();
            let mut held = *before;
            for cell in usize::from(start)..usize::from(end) {
                held.set(cell % 32, cell / 32, after.cell(cell % 32, cell / 32));
            }
            parts.push(json!({
                "x": id.x, "y": id.y, "epoch": stamp.epoch.0, "version": stamp.version.0,
                "base": base.map(|base| base.0), "start": start, "end": end,
                "before": planes(before), "after": planes(&held), "hash": tile_hash(&held),
            }));
            reached = end;
        }
    });
    (json!({ "name": name, "room": room, "coded": hex(&coded), "tiles": parts }), reached)
}

fn tiles() -> Value {
    let origin = TileId { x: 0, y: 0 };
    let whole = |id, stamp, tile| (id, stamp, None, Tile::UNKNOWN, tile);
    let mut one = Tile::UNKNOWN;
    one.set(0, 0, Cell::Free);
    let mut cases = Vec::new();
    let mut add =
        |name: &str, changes: &[Change]| cases.push(tile_case(name, 40_000, 0, changes).0);
    add("unknown", &[whole(origin, stamp(0, 1), Tile::UNKNOWN)]);
    add("one cell", &[whole(origin, stamp(1, 1), one)]);
    add("free", &[whole(TileId { x: 3, y: -2 }, stamp(1, 1), filled(Cell::Free))]);
    add("occupied", &[whole(TileId { x: 3, y: -2 }, stamp(1, 1), filled(Cell::Occupied))]);
    add("movable", &[whole(TileId { x: 3, y: -2 }, stamp(1, 1), filled(Cell::Movable))]);
    add("a corner of a room", &[whole(TileId { x: 1, y: -1 }, stamp(2, 1), room())]);
    add(
        "the corner changes",
        &[(TileId { x: 1, y: -1 }, stamp(2, 2), Some(1), room(), room_later())],
    );
    add(
        "the corner is forgotten",
        &[(TileId { x: 1, y: -1 }, stamp(2, 9), Some(2), room_later(), Tile::UNKNOWN)],
    );
    add("nothing changes", &[(origin, stamp(2, 3), Some(2), room(), room())]);
    add("noise", &[whole(TileId { x: -7, y: 12 }, stamp(40, 300), noise(1))]);
    add(
        "noise becomes other noise",
        &[(TileId { x: -7, y: 12 }, stamp(40, 301), Some(300), noise(1), noise(2))],
    );
    add(
        "extreme numbers",
        &[
            whole(CORNER, LAST, one),
            (
                TileId { x: i16::MAX, y: i16::MIN },
                stamp(0, u32::MAX),
                Some(1),
                room(),
                room_later(),
            ),
            (
                TileId { x: i16::MAX, y: i16::MIN },
                stamp(0, u32::MAX),
                Some(u32::MAX - 1),
                one,
                room(),
            ),
        ],
    );
    add(
        "several tiles, one epoch",
        &[
            whole(TileId { x: 0, y: 0 }, stamp(5, 1), room()),
            whole(TileId { x: 0, y: 1 }, stamp(5, 1), filled(Cell::Free)),
            (TileId { x: 1, y: 0 }, stamp(5, 4), Some(3), room(), room_later()),
            whole(TileId { x: 1, y: 1 }, stamp(6, 1), noise(3)),
        ],
    );
    let many: Vec<_> = (0..32).map(|x| whole(TileId { x, y: -x }, stamp(1, 1), one)).collect();
    add("as many tiles as there may be", &many);
    let mut cut = |name: &str, room: usize, base: Option<u32>, before: Tile, after: Tile| {
        let (mut start, mut held, mut number) = (0, before, 1);
        while start < TILE_CELLS {
            let change = (TileId { x: -3, y: 9 }, stamp(7, 5), base, held, after);
            let (case, end) = tile_case(&format!("{name}, part {number}"), room, start, &[change]);
            cases.push(case);
            for cell in usize::from(start)..usize::from(end) {
                held.set(cell % 32, cell / 32, after.cell(cell % 32, cell / 32));
            }
            (start, number) = (end, number + 1);
        }
    };
    cut("noise in parts", 100, None, Tile::UNKNOWN, noise(9));
    cut("a change in parts", 24, Some(4), room(), noise(5));
    Value::Array(cases)
}

fn replica() -> Value {
    let id = TileId { x: 1, y: -1 };
    let one = |room: usize, stamp, base: Option<u32>, start, before: &Tile, after: &Tile| {
        update_of(room, |encoder| {
            encoder.push(id, stamp, base.map(Version), start, before, after).unwrap();
        })
    };
    let unknown = Tile::UNKNOWN;
    let whole = one(900, stamp(2, 1), None, 0, &unknown, &room());
    let change = one(900, stamp(2, 2), Some(1), 0, &room(), &room_later());
    let anew = one(900, stamp(3, 1), None, 0, &unknown, &room());
    let first = one(100, stamp(2, 5), None, 0, &unknown, &noise(1));
    let end = TileDecoder::new(&first).header().unwrap().unwrap().end;
    let mut held = Tile::UNKNOWN;
    (0..usize::from(end))
        .for_each(|at| held.set(at % 32, at / 32, noise(1).cell(at % 32, at / 32)));
    let second = one(900, stamp(2, 5), None, end, &held, &noise(1));
    let part = one(100, stamp(2, 5), None, end, &held, &noise(1));
    let part_end = TileDecoder::new(&part).header().unwrap().unwrap().end;
    (usize::from(end)..usize::from(part_end))
        .for_each(|at| held.set(at % 32, at / 32, noise(1).cell(at % 32, at / 32)));
    let third = one(900, stamp(2, 5), None, part_end, &held, &noise(1));
    let upon_all = one(900, stamp(2, 6), Some(5), 0, &noise(1), &room());
    let upon_another = one(900, stamp(2, 2), Some(1), 0, &room_later(), &room());
    let held_already = one(1000, stamp(2, 5), None, 0, &unknown, &noise(1));
    let of_an_earlier_life = one(900, stamp(2, 5), None, 0, &unknown, &room());
    let cases = [
        (
            "another state with the same stamp is held, and it comes in parts",
            vec![&of_an_earlier_life, &first, &second],
        ),
        ("held already, and comes in parts", vec![&held_already, &first, &second]),
        ("an older whole tile between two parts", vec![&first, &whole, &second]),
        ("whole, then a change", vec![&whole, &change]),
        ("a change without its base", vec![&change]),
        ("the same update twice", vec![&whole, &whole, &change, &change]),
        ("an older whole tile comes late", vec![&whole, &change, &whole]),
        ("a new epoch, and the old one late", vec![&whole, &anew, &change, &whole]),
        ("two parts", vec![&first, &second]),
        ("the second part alone", vec![&second]),
        ("the second part twice", vec![&first, &second, &second]),
        ("a part, and a change of what was before", vec![&whole, &first, &change, &second]),
        ("a part again after a loss", vec![&first, &first, &second]),
        ("a part is skipped", vec![&first, &third, &part, &third]),
        ("a change while parts are missing", vec![&first, &upon_all, &second, &upon_all]),
        ("a change of other cells with the same stamp", vec![&whole, &upon_another, &change]),
    ];
    let case = |(name, updates): &(&str, Vec<&Vec<u8>>)| {
        let mut replica = Replica::default();
        let steps: Vec<_> = updates
            .iter()
            .map(|coded| {
                let outcome = outcome_of(&mut replica, coded);
                let stamp = replica.stamp();
                json!({
                    "coded": hex(coded), "outcome": outcome, "epoch": stamp.epoch.0,
                    "version": stamp.version.0, "hash": tile_hash(replica.tile()),
                })
            })
            .collect();
        json!({ "name": name, "steps": steps })
    };
    cases.iter().map(case).collect()
}

fn digests() -> Value {
    let entry = |id: TileId, stamp: Stamp, tile: &Tile| (id, stamp, tile_hash(tile));
    let here = entry(TileId { x: 1, y: -1 }, stamp(2, 1), &room());
    let there = entry(CORNER, LAST, &noise(1));
    let blank = entry(TileId { x: 0, y: 0 }, stamp(0, 1), &Tile::UNKNOWN);
    let cases = [
        ("nothing", vec![]),
        ("one tile", vec![here]),
        ("three tiles", vec![here, there, blank]),
        ("more than 32 bits", vec![there; 9]),
    ];
    let case = |(name, entries): &(&str, Vec<(TileId, Stamp, u32)>)| {
        let mut digest = Digest::default();
        entries.iter().for_each(|&(id, stamp, hash)| digest.add(id, stamp, hash));
        let tiles: Vec<_> = entries
            .iter()
            .map(|(id, stamp, hash)| {
                json!({
                    "x": id.x, "y": id.y, "epoch": stamp.epoch.0, "version": stamp.version.0,
                    "hash": hash,
                })
            })
            .collect();
        json!({ "name": name, "tiles": tiles, "digest": digest.0 })
    };
    cases.iter().map(case).collect()
}

const TERMS: Terms =
    Terms { resolution: Millimetres(50), frame: 250, server_epoch: 3, stores: true };

fn transcript() -> Value {
    let mut lines = Vec::new();
    let session = 77;
    let mut say = |about: &str, direction, session, header, messages: &[Vec<u8>]| {
        let wire = sealed(direction, session, header, &messages.concat());
        lines.push(json!({
            "name": about, "direction": direction_name(direction), "session": session,
            "wire": hex(&wire), "lost": about.ends_with("(lost)"),
        }));
    };
    let handshake = header(FrameKind::Handshake, 0);
    let datagram = |sequence| header(FrameKind::Datagram, sequence);
    let reliable = |sequence| header(FrameKind::Reliable, sequence);
    let id = TileId { x: 1, y: -1 };
    let coded = update_of(200, |encoder| {
        encoder.push(id, stamp(1, 1), None, 0, &Tile::UNKNOWN, &room()).unwrap();
    });
    let update =
        message_with::<ToServer>(&TileUpdateHead { layer: Layer::Robot, seconds: 60 }, &coded);
    let state = State { time: None, pose: None, odometry: None, cells_refused: 0 };
    let interest = Interest { number: 1, from: TileId { x: -2, y: -2 }, to: TileId { x: 1, y: 1 } };
    let ack = |next, later| message::<ToRobot>(&Ack { next, later });
    say(
        "the server has restarted and knows no session",
        TO_ROBOT,
        0,
        handshake,
        &[message::<ToRobot>(&Reset)],
    );
    say("the robot says hello", TO_SERVER, 0, handshake, &[message::<ToServer>(&small_hello())]);
    say("the server welcomes it", TO_ROBOT, 0, handshake, &[message::<ToRobot>(&small_welcome())]);
    say(
        "time is asked for, and a state told",
        TO_SERVER,
        session,
        datagram(0),
        &[message::<ToServer>(&TimeRequest { nonce: 0 }), message::<ToServer>(&state)],
    );
    say(
        "the time",
        TO_ROBOT,
        session,
        datagram(0),
        &[message::<ToRobot>(&TimeReply {
            nonce: 0,
            received: Instant(61_000_000),
            held_micros: 120,
        })],
    );
    say(
        "a window of interest (lost)",
        TO_SERVER,
        session,
        reliable(0),
        &[message::<ToServer>(&interest)],
    );
    say("a tile", TO_SERVER, session, reliable(1), std::slice::from_ref(&update));
    say("the tile is acknowledged", TO_ROBOT, session, datagram(1), &[ack(0, 1)]);
    say("the window again", TO_SERVER, session, reliable(0), &[message::<ToServer>(&interest)]);
    say("both are acknowledged", TO_ROBOT, session, datagram(2), &[ack(2, 0)]);
    say(
        "the tile is on disk",
        TO_ROBOT,
        session,
        reliable(0),
        &[message::<ToRobot>(&Stored { tiles: [(id, stamp(1, 1))].into_iter().collect() })],
    );
    say("which is acknowledged", TO_SERVER, session, datagram(1), &[ack(1, 0)]);
    say(
        "a stop",
        TO_ROBOT,
        session,
        reliable(1),
        &[message::<ToRobot>(&Stop { number: 1, stop: true })],
    );
    Value::Array(lines)
}

fn answers() -> Value {
    let hello = small_hello();
    let cases = [
        ("welcome", hello, TERMS),
        ("welcome, the smaller frame is the server's", hello, Terms { frame: 200, ..TERMS }),
        (
            "welcome, the frame is bounded",
            Hello { frame: u16::MAX, ..hello },
            Terms { frame: u16::MAX, ..TERMS },
        ),
        (
            "welcome, a newer robot that still speaks ours",
            Hello { version: 9, min_version: 1, ..hello },
            TERMS,
        ),
        ("refusal, the robot is too new", Hello { version: 9, min_version: 2, ..hello }, TERMS),
        ("refusal, the robot is too old", Hello { version: 0, min_version: 0, ..hello }, TERMS),
        ("refusal, other cells", Hello { resolution: Millimetres(100), ..hello }, TERMS),
        ("refusal, frames too small", Hello { frame: 31, ..hello }, TERMS),
        (
            "refusal, the version is named first",
            Hello { version: 0, min_version: 0, frame: 1, resolution: Millimetres(1), ..hello },
            TERMS,
        ),
    ];
    let case = |(name, hello, terms): &(&str, Hello, Terms)| {
        let answer = match answer(hello, terms, SessionId(77), 5) {
            Answer::Welcome(welcome) => message::<ToRobot>(&welcome),
            Answer::Refusal(refusal) => message::<ToRobot>(&refusal),
        };
        json!({
            "name": name, "hello": hex(&message::<ToServer>(hello)[2..]), "resolution": terms.resolution.0,
            "frame": terms.frame, "server_epoch": terms.server_epoch, "stores": terms.stores,
            "session": 77, "first_epoch": 5, "kind": answer[0], "body": hex(&answer[2..]),
        })
    };
    cases.iter().map(case).collect()
}

fn window() -> Value {
    type Case<'a> = (&'a str, u16, &'a [(u16, &'a str)], Ack);
    let cases: [Case<'_>; 10] = [
        ("in order", 0, &[(0, "new"), (1, "new"), (2, "new")], Ack { next: 3, later: 0 }),
        ("twice", 0, &[(0, "new"), (0, "duplicate"), (1, "new")], Ack { next: 2, later: 0 }),
        (
            "a gap",
            0,
            &[(0, "new"), (2, "new"), (3, "new"), (2, "duplicate")],
            Ack { next: 1, later: 3 },
        ),
        (
            "a gap that closes",
            0,
            &[(1, "new"), (2, "new"), (4, "new"), (0, "new")],
            Ack { next: 3, later: 1 },
        ),
        (
            "as far ahead as may be",
            0,
            &[(32, "new"), (33, "refused"), (0, "new"), (33, "new")],
            Ack { next: 1, later: 3 << 30 },
        ),
        (
            "out of the window",
            0,
            &[
                (40, "refused"),
                (1023, "refused"),
                (1024, "duplicate"),
                (2047, "duplicate"),
                (0, "new"),
            ],
            Ack { next: 1, later: 0 },
        ),
        (
            "ahead, and again",
            0,
            &[(1, "new"), (1, "duplicate"), (4, "new"), (4, "duplicate"), (3, "new")],
            Ack { next: 0, later: 0b1101 },
        ),
        ("the last number", 2047, &[(2047, "new")], Ack { next: 0, later: 0 }),
        (
            "the last number, and the one before",
            2046,
            &[(2047, "new"), (2046, "new")],
            Ack { next: 0, later: 0 },
        ),
        (
            "the numbers begin again",
            2045,
            &[(2046, "new"), (0, "new"), (2045, "new"), (2044, "duplicate"), (2047, "new")],
            Ack { next: 1, later: 0 },
        ),
    ];
    let case = |(name, first, arrivals, ack): &Case<'_>| {
        let frames: Vec<_> = arrivals
            .iter()
            .map(|&(sequence, outcome)| {
                let payload = [9, 0];
                let wire = sealed(TO_SERVER, 5, header(FrameKind::Reliable, sequence), &payload);
                json!({ "sequence": sequence, "wire": hex(&wire), "outcome": outcome })
            })
            .collect();
        let answer =
            sealed(TO_ROBOT, 5, header(FrameKind::Datagram, *first), &message::<ToRobot>(ack));
        let mut case = json!({
            "name": name, "session": 5, "frames": frames, "next": ack.next, "later": ack.later,
            "answer": hex(&answer),
        });
        if *first > 0 {
            // The frames before this one have arrived, and have been acknowledged.
            case["first"] = json!(first);
        }
        case
    };
    cases.iter().map(case).collect()
}

fn refused_frames() -> Value {
    let good = |kind, payload: &[u8]| sealed(TO_SERVER, 5, header(kind, 0), payload);
    let stop = message::<ToRobot>(&Stop { number: 1, stop: true });
    let datagram = good(FrameKind::Datagram, &stop);
    let mut flipped = datagram.clone();
    flipped[5] ^= 0x10;
    let raw =
        |contents: &[u8]| stuff(&[contents, &seal(SessionId(5), TO_SERVER, contents)].concat());
    let reserved = raw(&0x3800u16.to_le_bytes());
    let version =
        |version| sealed(TO_SERVER, 5, Header { version, ..header(FrameKind::Datagram, 0) }, &stop);
    let mut truncated = datagram[..6].to_vec();
    truncated.push(0);
    let cases = [
        ("a bit is flipped", flipped, "seal"),
        ("too short for a seal", stuff(&[1, 2, 3]), "seal"),
        ("another session", sealed(TO_SERVER, 6, header(FrameKind::Datagram, 0), &stop), "seal"),
        ("an echo", sealed(TO_ROBOT, 5, header(FrameKind::Datagram, 0), &stop), "seal"),
        ("a block that does not end", truncated, "truncated"),
        ("one code byte too large", vec![5, 1, 0], "truncated"),
        (
            "one byte too long",
            sealed(TO_SERVER, 5, header(FrameKind::Datagram, 0), &[1; FRAME_LIMIT - 5]),
            "too long",
        ),
        ("very long", vec![0xFF; 2000].into_iter().chain([0]).collect(), "too long"),
        ("nothing but a seal", raw(&[]), "header"),
        ("half a header", raw(&[1]), "header"),
        ("the reserved kind", reserved, "header"),
        (
            "a handshake within a session",
            good(FrameKind::Handshake, &message::<ToServer>(&small_hello())),
            "kind",
        ),
        (
            "a datagram outside of any session",
            sealed(TO_SERVER, 0, header(FrameKind::Datagram, 0), &stop),
            "kind",
        ),
        (
            "a reliable frame outside of any session",
            sealed(TO_SERVER, 0, header(FrameKind::Reliable, 0), &stop),
            "kind",
        ),
        ("a version that was not agreed upon", version(2), "version"),
        ("version zero", version(0), "version"),
        (
            "a handshake without a message",
            sealed(TO_SERVER, 0, header(FrameKind::Handshake, 0), &[]),
            "payload",
        ),
        (
            "a handshake with half a message",
            sealed(TO_SERVER, 0, header(FrameKind::Handshake, 0), &[1, 9, 1]),
            "payload",
        ),
        (
            "out of the window",
            sealed(TO_SERVER, 5, header(FrameKind::Reliable, 33), &stop),
            "sequence",
        ),
    ];
    let case = |(name, wire, error): &(&str, Vec<u8>, &str)| json!({ "name": name, "direction": "to server", "session": 5, "wire": hex(wire), "error": error });
    cases.iter().map(case).collect()
}

fn refused_payloads() -> Value {
    let stop = message::<ToRobot>(&Stop { number: 1, stop: true });
    let with = |tail: &[u8]| [&stop[..], tail].concat();
    let cases = [
        ("a kind without a length", with(&[9]), 1),
        ("a body that is cut short", with(&[9, 3, 1, 2]), 1),
        ("a length of more than 16 bits", with(&[9, 0x80, 0x80, 0x04, 0]), 1),
        ("a length that does not end", with(&[9, 0x80, 0x80, 0x80, 0]), 1),
        ("a length whose bytes are missing", vec![9, 0x80], 0),
    ];
    let case = |(name, payload, before): &(&str, Vec<u8>, i32)| json!({ "name": name, "payload": hex(payload), "messages_before": before });
    cases.iter().map(case).collect()
}

fn refused_messages() -> Value {
    let cases: [(&str, Direction, u8, &[u8]); 33] = [
        ("hello cut short", TO_SERVER, 1, &[1, 1, 1, 99, 0xFA, 1, 100]),
        (
            "hello, a nonce of more than 32 bits",
            TO_SERVER,
            1,
            &[1, 1, 1, 0xFF, 0xFF, 0xFF, 0xFF, 0x1F, 0xFA, 1, 100, 16],
        ),
        (
            "hello, a nonce that does not end",
            TO_SERVER,
            1,
            &[1, 1, 1, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 1, 0xFA, 1, 100, 16],
        ),
        (
            "hello, a robot of more than 16 bits",
            TO_SERVER,
            1,
            &[1, 1, 0xFF, 0xFF, 0x07, 99, 0xFA, 1, 100, 16],
        ),
        ("ack, a sequence number of more than 11 bits", TO_SERVER, 0, &[0x80, 0x10, 0]),
        ("ack to a robot, a sequence number of more than 11 bits", TO_ROBOT, 0, &[0x80, 0x10, 0]),
        ("ack, bits of more than 32 bits", TO_SERVER, 0, &[5, 0xFF, 0xFF, 0xFF, 0xFF, 0x10]),
        ("time request, empty", TO_SERVER, 2, &[]),
        ("time request, a nonce of 17 bits", TO_SERVER, 2, &[0x80, 0x80, 0x04]),
        ("state, an option that is neither", TO_SERVER, 4, &[2, 0, 0, 0]),
        ("request, a layer that there is not", TO_SERVER, 6, &[3, 0]),
        (
            "request, too many tiles",
            TO_SERVER,
            6,
            &[0, 9, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0],
        ),
        ("request, fewer tiles than it says", TO_SERVER, 6, &[0, 2, 0, 0]),
        ("distance vector, too many columns", TO_SERVER, 7, &{
            let mut body = [0; 6 + 66];
            body[6] = 65;
            body
        }),
        ("event, a severity that there is not", TO_SERVER, 8, &[0, 3, 1, 0]),
        ("event, too long", TO_SERVER, 8, &{
            let mut body = [b'x'; 4 + 33];
            body[0] = 0;
            body[1] = 0;
            body[2] = 1;
            body[3] = 33;
            body
        }),
        ("event, no text", TO_SERVER, 8, &[0, 0, 1, 2, 0xC3, 0x28]),
        ("parameter report, an outcome that there is not", TO_SERVER, 10, &[1, 3, 0]),
        ("welcome, neither true nor false", TO_ROBOT, 1, &[99, 1, 77, 0xFA, 1, 3, 1, 2]),
        (
            "time reply, a time of more than 64 bits",
            TO_ROBOT,
            2,
            &[0, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0x02, 0],
        ),
        ("refusal, a reason that there is not", TO_ROBOT, 5, &[99, 5, 0]),
        ("refusal, a frame of 17 bits", TO_ROBOT, 5, &[99, 2, 0x80, 0x80, 0x04]),
        ("pose fix, too many earlier ones", TO_ROBOT, 4, &{
            let mut body = [0; 9 + 16];
            body[8] = 4;
            body
        }),
        ("obstacles, a class that there is not", TO_ROBOT, 9, &[0, 1, 1, 3, 0, 0, 0, 0, 0]),
        ("obstacles, postures cut short", TO_ROBOT, 9, &[0, 0, 0x80]),
        ("obstacles, 33 bits of postures", TO_ROBOT, 9, &[0, 0, 0x80, 0x80, 0x80, 0x80, 0x10]),
        ("distance vector, odometry cut short", TO_SERVER, 7, &[0, 0, 0, 0, 0, 2, 0, 3, 4]),
        ("stop, neither true nor false", TO_ROBOT, 11, &[1, 2]),
        ("parameter, an action that there is not", TO_ROBOT, 12, &[1, 3, 0]),
        ("parameter, a number of 17 bits", TO_ROBOT, 12, &[1, 1, 0x80, 0x80, 0x04]),
        ("tile update, 33 bits of seconds", TO_SERVER, 3, &[0, 0x80, 0x80, 0x80, 0x80, 0x10]),
        (
            "tile update to a robot, 33 bits of seconds",
            TO_ROBOT,
            3,
            &[2, 0x80, 0x80, 0x80, 0x80, 0x10],
        ),
        ("freshness, too many tiles", TO_ROBOT, 15, &{
            let mut body = [0; 4 + 33];
            body[3] = 33;
            body
        }),
    ];
    let case = |(name, direction, kind, body): &(&str, Direction, u8, &[u8])| json!({ "name": name, "direction": direction_name(*direction), "kind": kind, "body": hex(body), "error": "malformed" });
    cases.iter().map(case).collect()
}
