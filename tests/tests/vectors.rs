//! Checks the code against the protocol's vectors. They are normative: **if a vector fails, the
//! code is wrong.** Add vectors with `UBIMAP_WRITE_VECTORS=1 cargo test -p ubimap-tests --test
//! vectors`; those of a released version never change.

use std::{
    collections::{BTreeMap, BTreeSet},
    env,
    fmt::Debug,
    io::Write,
    process::{Command, Stdio},
    sync::Once,
};

use serde_json::{Value, json};
use ubimap_protocol::{
    checksum::crc32,
    frame::{Direction, FrameKind, Header, MIN_VERSION, SessionId, VERSION, cobs, open, seal},
    link::{Answer, Endpoint, Fill, Received, Terms, answer},
    message::{
        Body, Encoded, Hello, MalformedMessage, Message, Messages, ToRobot, ToRobotKind, ToServer,
        ToServerKind, Traffic, Writer,
    },
    tile::{
        Applied, BaseMissing, Digest, Epoch, MAX_TILES_PER_UPDATE, Replica, Stamp, TILE_CELLS,
        TileDecoder, TileEncoder, TileError, TileId, Version, tile_hash,
    },
    time::Instant,
    units::Millimetres,
};
use ubimap_tests::{
    fuzz::{BodyVisitor, visit_body},
    vectors::{direction, folder, hex, load, planes, tile, unhex},
};

#[path = "vectors/generate.rs"]
mod generate;

/// Maximum length of a frame's contents (including the seal) that the receiver accepts in the tests
/// of refused frames.
const FRAME_LIMIT: usize = 64;

/// The cases of a file. If requested, the file is generated first.
fn cases(file: &str) -> Value {
    static WRITTEN: Once = Once::new();
    WRITTEN.call_once(|| {
        if env::var_os("UBIMAP_WRITE_VECTORS").is_some() {
            generate::write_all();
        }
    });
    load(file)
}

fn list(value: &Value) -> &[Value] {
    let list = value.as_array().expect("a list");
    assert!(!list.is_empty());
    list
}

fn text<'v>(case: &'v Value, field: &str) -> &'v str {
    case[field].as_str().unwrap_or_else(|| panic!("{field} of {case}"))
}

fn number(case: &Value, field: &str) -> u64 {
    case[field].as_u64().unwrap_or_else(|| panic!("{field} of {case}"))
}

fn bytes(case: &Value, field: &str) -> Vec<u8> {
    unhex(text(case, field))
}

fn stuff(contents: &[u8]) -> Vec<u8> {
    let mut wire = vec![0; cobs::encoded_len(contents.len())];
    let len = cobs::encode([contents, &[]], &mut wire).unwrap();
    wire.truncate(len);
    wire
}

/// A frame from its parts, with the messages written one by one.
fn frame(way: Direction, session: SessionId, header: Header, payload: &[u8]) -> Vec<u8> {
    let mut buffer = vec![0; payload.len() + 8];
    // The encoding of messages does not depend on the direction.
    let mut writer = Writer::<ToServer>::new(&mut buffer);
    for message in Messages::new(payload) {
        // Malformed payloads occur only in frame cases.
        let Ok(message) = message else { return finish(way, session, header, payload) };
        assert!(writer.push_encoded(message));
    }
    let len = writer.len();
    finish(way, session, header, &buffer[..len])
}

fn finish(way: Direction, session: SessionId, header: Header, payload: &[u8]) -> Vec<u8> {
    let contents = [&header.encode()[..], payload].concat();
    let tail = seal(session, way, &contents);
    stuff(&[&contents[..], &tail].concat())
}

/// The contents of the only frame in these bytes.
fn unstuff(wire: &[u8]) -> Vec<u8> {
    let mut decoder = cobs::Decoder::<1024>::default();
    decoder.next(&mut &wire[..]).expect("a frame").expect("a valid frame").to_vec()
}

/// The code still writes the vectors as they are.
#[test]
fn the_code_writes_every_vector() {
    for (name, generated) in generate::all() {
        let kept = cases(name);
        assert!(kept == generated, "{name}.json is not what the code writes");
    }
}

#[test]
fn stuffing() {
    for case in list(&cases("frames")["stuffing"]) {
        let (contents, wire) = (bytes(case, "contents"), bytes(case, "wire"));
        assert_eq!(hex(&stuff(&contents)), hex(&wire), "{case}");
        assert_eq!(hex(&unstuff(&wire)), hex(&contents), "{case}");
    }
}

#[test]
fn frames_read_and_write() {
    for case in list(&cases("frames")["frames"]) {
        let (way, session) = (direction(text(case, "direction")), number(case, "session") as u32);
        let wire = bytes(case, "wire");
        let frame_bytes = unstuff(&wire);
        let contents = open(SessionId(session), way, &frame_bytes).expect("a valid seal");
        let (header, payload) = Header::decode(contents).expect("a header");
        assert_eq!(u64::from(header.version), number(case, "version"), "{case}");
        assert_eq!(format!("{:?}", header.kind).to_lowercase(), text(case, "kind"));
        assert_eq!(u64::from(header.sequence), number(case, "sequence"), "{case}");
        assert_eq!(hex(payload), text(case, "payload"));
        assert_eq!(hex(&frame(way, SessionId(session), header, payload)), hex(&wire));
    }
}

/// Decodes a body into JSON and back, and encodes it again.
struct Rewritten<'a> {
    fields: &'a Value,
}

impl BodyVisitor for Rewritten<'_> {
    type Output = Result<(Value, Vec<u8>, Vec<u8>), MalformedMessage>;

    fn visit<D: Traffic, T: Body<D> + PartialEq + Debug>(
        self,
        body: Encoded<'_, T>,
    ) -> Self::Output {
        let (message, rest) = body.split()?;
        if !self.fields.is_null() {
            let said: T = serde_json::from_value(self.fields.clone()).unwrap();
            assert_eq!(said, message);
        }
        let mut buffer = [0; 1024];
        let mut writer = Writer::<D>::new(&mut buffer);
        assert!(writer.push(&message));
        let len = writer.len();
        let written = Messages::<D>::new(&buffer[..len]).next().unwrap().unwrap();
        Ok((serde_json::to_value(&message).unwrap(), rest.to_vec(), written.body.to_vec()))
    }
}

#[test]
fn messages_read_and_write() {
    let mut seen = BTreeSet::new();
    let mut times = [BTreeMap::new(), BTreeMap::new()];
    for case in list(&cases("messages")) {
        assert!(seen.insert(text(case, "name").to_owned()), "duplicate name: {case}");
        let way = direction(text(case, "direction"));
        let (kind, body) = (number(case, "kind") as u8, bytes(case, "body"));
        let read = visit_body(way, kind, &body, Rewritten { fields: &case["fields"] });
        let (fields, rest, mut written) = read.expect("a known kind").expect("a valid message");
        assert_eq!(fields, case["fields"], "{case}");
        assert_eq!(hex(&rest), text(case, "rest"), "{case}");
        written.extend(rest);
        assert_eq!(hex(&written), hex(&body), "{case}");
        *times[usize::from(way == Direction::ToRobot)].entry(kind).or_insert(0) += 1;
    }
    let to_server = ToServerKind::ALL.iter().map(|&kind| times[0].get(&kind.into()));
    let to_robot = ToRobotKind::ALL.iter().map(|&kind| times[1].get(&kind.into()));
    assert!(to_server.chain(to_robot).all(|times| times >= Some(&2)), "{times:?}");
}

#[test]
fn payloads_are_split() {
    for case in list(&cases("payloads")) {
        let payload = bytes(case, "payload");
        let messages: Vec<_> = Messages::<ToRobot>::new(&payload)
            .map(|message| message.expect("a valid message"))
            .map(|message| json!({ "kind": message.number, "body": hex(message.body) }))
            .collect();
        assert_eq!(Value::Array(messages), case["messages"], "{case}");
    }
}

fn stamp_of(case: &Value) -> Stamp {
    Stamp {
        epoch: Epoch(number(case, "epoch") as u32),
        version: Version(number(case, "version") as u32),
    }
}

fn id_of(case: &Value) -> TileId {
    let side = |field: &str| i16::try_from(case[field].as_i64().unwrap()).unwrap();
    TileId { x: side("x"), y: side("y") }
}

#[test]
fn tiles_read_and_write() {
    for case in list(&cases("tiles")) {
        let coded = bytes(case, "coded");
        let mut decoder = TileDecoder::new(&coded);
        let mut out = vec![0; number(case, "room") as usize];
        let mut encoder = TileEncoder::new(&mut out);
        for part in list(&case["tiles"]) {
            let header = decoder.header().unwrap().expect("one more tile");
            assert_eq!((header.id, header.stamp), (id_of(part), stamp_of(part)), "{case}");
            assert_eq!(header.base.map(|base| u64::from(base.0)), part["base"].as_u64());
            assert_eq!(u64::from(header.start), number(part, "start"));
            assert_eq!(u64::from(header.end), number(part, "end"));
            let mut cells = tile(text(part, "before"));
            let before = cells;
            decoder.cells(&header, &mut cells);
            assert_eq!(planes(&cells), text(part, "after"), "{}", case["name"]);
            assert_eq!(u64::from(tile_hash(&cells)), number(part, "hash"));
            // The cells after this part are unknown here, so `whole` may differ in them: the
            // encoder stops where its space ends, as in the vector.
            let whole = if header.end < TILE_CELLS { series_end(case) } else { cells };
            let end =
                encoder.push(header.id, header.stamp, header.base, header.start, &before, &whole);
            assert_eq!(end, Some(header.end), "{}", case["name"]);
        }
        assert_eq!(decoder.header(), Ok(None), "{}", case["name"]);
        let len = encoder.finish().unwrap();
        assert_eq!(hex(&out[..len]), hex(&coded), "{}", case["name"]);
    }
}

/// The complete tile to which the parts of a case belong: the result of the last part.
fn series_end(case: &Value) -> ubimap_protocol::tile::Tile {
    let series = text(case, "name").split(", part").next().unwrap();
    let all = cases("tiles");
    let last = list(&all).iter().rfind(|other| text(other, "name").starts_with(series)).unwrap();
    tile(text(&last["tiles"][0], "after"))
}

/// The result of a single-tile update at a replica.
fn outcome_of(replica: &mut Replica, coded: &[u8]) -> &'static str {
    let mut decoder = TileDecoder::new(coded);
    let header = decoder.header().unwrap().unwrap();
    let mut applied = replica.clone();
    let outcome = applied.apply(&header, &mut decoder);
    if outcome.is_ok() && header.names_base() && decoder.header().is_err() {
        return "wrong base";
    }
    *replica = applied;
    match outcome {
        Ok(Applied::Complete) => "complete",
        Ok(Applied::Partial) => "partial",
        Ok(Applied::Old) => "old",
        Err(BaseMissing) => "base missing",
    }
}

#[test]
fn replicas() {
    for case in list(&cases("replica")) {
        let mut replica = Replica::default();
        for step in list(&case["steps"]) {
            let outcome = outcome_of(&mut replica, &bytes(step, "coded"));
            assert_eq!(outcome, text(step, "outcome"), "{}", case["name"]);
            assert_eq!(replica.stamp(), stamp_of(step), "{}", case["name"]);
            assert_eq!(u64::from(tile_hash(replica.tile())), number(step, "hash"));
        }
    }
}

#[test]
fn digests() {
    for case in list(&cases("digests")) {
        let mut digest = Digest::default();
        for tile in case["tiles"].as_array().unwrap() {
            digest.add(id_of(tile), stamp_of(tile), number(tile, "hash") as u32);
        }
        assert_eq!(digest.0, number(case, "digest"), "{case}");
    }
}

#[test]
fn a_sessions_transcript_reads_and_writes() {
    let mut robot = Endpoint::<ToServer, u8, 8, 1024>::new();
    let mut server = Endpoint::<ToRobot, u8, 8, 1024>::new();
    let mut kinds = Vec::new();
    for line in list(&cases("handshake")["transcript"]) {
        let way = direction(text(line, "direction"));
        let session = SessionId(number(line, "session") as u32);
        let wire = bytes(line, "wire");
        let contents = unstuff(&wire);
        let (header, payload) =
            Header::decode(open(session, way, &contents).expect("a valid seal")).unwrap();
        assert_eq!(hex(&frame(way, session, header, payload)), hex(&wire), "{line}");
        if session != SessionId::NONE && robot.session() == SessionId::NONE {
            robot.begin(session, 250);
            server.begin(session, 250);
        }
        if line["lost"].as_bool().unwrap() {
            continue;
        }
        kinds.extend(match way {
            Direction::ToServer => numbers(&mut server, &wire, session),
            Direction::ToRobot => numbers(&mut robot, &wire, session),
        });
    }
    assert_eq!(kinds, [7, 1, 1, 2, 4, 2, 3, 0, 5, 0, 13, 0, 11]);
    for counters in [robot.counters(), server.counters()] {
        assert_eq!(counters.bad + counters.refused, 0);
    }
}

/// The kinds of the messages in a frame of a session or a handshake.
fn numbers<D: Traffic>(
    end: &mut Endpoint<D, u8, 8, 1024>,
    mut wire: &[u8],
    session: SessionId,
) -> Vec<u8> {
    match end.receive(&mut wire, Instant(0)).expect("a frame") {
        Received::Handshake(message) => {
            assert_eq!(session, SessionId::NONE);
            vec![message.number]
        }
        Received::Session(messages) => {
            assert_ne!(session, SessionId::NONE);
            messages.map(|message| message.unwrap().number).collect()
        }
        Received::Bad(fault) | Received::Stray(_, fault) => panic!("a bad frame: {fault}"),
        Received::Sealed(_) => panic!("a sealed frame"),
    }
}

#[test]
fn hellos_are_answered() {
    for case in list(&cases("handshake")["answers"]) {
        let hello = bytes(case, "hello");
        let hello = Message::<ToServer>::new(ToServerKind::Hello.into(), &hello);
        let hello = hello.decode::<Hello>().unwrap();
        let terms = Terms {
            resolution: Millimetres(number(case, "resolution") as i32),
            frame: number(case, "frame") as u16,
            server_epoch: number(case, "server_epoch") as u32,
            stores: case["stores"].as_bool().unwrap(),
        };
        let session = SessionId(number(case, "session") as u32);
        let mut buffer = [0; 64];
        let mut writer = Writer::<ToRobot>::new(&mut buffer);
        match answer(&hello, &terms, session, number(case, "first_epoch") as u32) {
            Answer::Welcome(welcome) => assert!(writer.push(&welcome)),
            Answer::Refusal(refusal) => assert!(writer.push(&refusal)),
        }
        let len = writer.len();
        assert_eq!(u64::from(buffer[0]), number(case, "kind"), "{case}");
        assert_eq!(hex(&buffer[2..len]), text(case, "body"), "{case}");
    }
}

#[test]
fn reliable_frames_are_acknowledged() {
    for case in list(&cases("window")) {
        let mut end = Endpoint::<ToRobot, u8, 8, 64>::new();
        let session = SessionId(number(case, "session") as u32);
        end.begin(session, 64);
        for sequence in 0..case["first"].as_u64().unwrap_or(0) as u16 {
            let header = Header { version: 1, kind: FrameKind::Reliable, sequence };
            let wire = frame(Direction::ToServer, session, header, &[9, 0]);
            assert!(matches!(end.receive(&mut &wire[..], Instant(0)), Some(Received::Session(_))));
            let due = end.poll_timeout().unwrap();
            let sent = end.poll_transmit(due, &mut [0; 64], false, |_, _| Fill::Nothing);
            assert!(sent.is_some());
        }
        for frame in list(&case["frames"]) {
            let before = end.counters();
            let wire = bytes(frame, "wire");
            let mut input = &wire[..];
            let new = match end.receive(&mut input, Instant(0)) {
                Some(Received::Session(messages)) => messages.count() == 1,
                Some(Received::Bad(_)) => false,
                _ => panic!("{frame}"),
            };
            let duplicate = end.counters().duplicates > before.duplicates;
            let refused = end.counters().refused > before.refused;
            let outcome = match (new, duplicate, refused) {
                (true, false, false) => "new",
                (false, true, false) => "duplicate",
                (false, false, true) => "refused",
                _ => panic!("{frame}"),
            };
            assert_eq!(outcome, text(frame, "outcome"), "{frame} of {}", case["name"]);
        }
        let due = end.poll_timeout().unwrap();
        let mut out = [0; 64];
        let sent = end.poll_transmit(due, &mut out, false, |_, _| Fill::Nothing).unwrap();
        assert_eq!(hex(&out[..sent.len]), text(case, "answer"), "{}", case["name"]);
    }
}

/// The reason why a frame is refused, by the specification's rules in order.
fn error_of(wire: &[u8], way: Direction, session: SessionId) -> Option<&'static str> {
    let mut decoder = cobs::Decoder::<FRAME_LIMIT>::default();
    let frame = match decoder.next(&mut &wire[..]).expect("a delimiter") {
        Err(cobs::CobsError::Truncated) => return Some("truncated"),
        Err(cobs::CobsError::TooLong) => return Some("too long"),
        Ok(frame) => frame,
    };
    let within = open(session, way, frame);
    let Some(contents) = within.or_else(|| open(SessionId::NONE, way, frame)) else {
        return Some("seal");
    };
    let Some((header, payload)) = Header::decode(contents) else { return Some("header") };
    if within.is_some() == (header.kind == FrameKind::Handshake) {
        return Some("kind");
    }
    if within.is_none() {
        return (!matches!(Messages::<ToServer>::new(payload).next(), Some(Ok(_))))
            .then_some("payload");
    }
    if !(MIN_VERSION..=VERSION).contains(&header.version) {
        return Some("version");
    }
    (header.kind == FrameKind::Reliable && header.sequence > 32).then_some("sequence")
}

#[test]
fn invalid_input_is_refused() {
    let refused = cases("refused");
    for case in list(&refused["frames"]) {
        let (way, session) = (direction(text(case, "direction")), number(case, "session") as u32);
        let wire = bytes(case, "wire");
        assert_eq!(error_of(&wire, way, SessionId(session)), Some(text(case, "error")), "{case}");
        // The endpoint also refuses the frame, and reads the valid frame that follows.
        let mut end = Endpoint::<ToRobot, u8, 8, FRAME_LIMIT>::new();
        end.begin(SessionId(session), FRAME_LIMIT);
        let header = Header { version: 1, kind: FrameKind::Datagram, sequence: 0 };
        let good = frame(way, SessionId(session), header, &[200, 0]);
        let stream = [&wire[..], &good].concat();
        let mut input = &stream[..];
        let mut read = 0;
        while let Some(received) = end.receive(&mut input, Instant(0)) {
            if let Received::Session(messages) = received {
                read += messages.count();
            }
        }
        let bad = u32::from(["truncated", "too long", "seal"].contains(&text(case, "error")));
        let counters = end.counters();
        assert_eq!((counters.bad, counters.refused, read), (bad, 1 - bad, 1), "{case}");
    }
    for case in list(&refused["payloads"]) {
        let payload = bytes(case, "payload");
        let read: Vec<_> = Messages::<ToServer>::new(&payload).collect();
        let (last, before) = read.split_last().unwrap();
        assert_eq!(last, &Err(MalformedMessage), "{case}");
        assert_eq!(before.len() as u64, number(case, "messages_before"), "{case}");
        assert!(before.iter().all(Result::is_ok));
    }
    for case in list(&refused["messages"]) {
        let way = direction(text(case, "direction"));
        let (kind, body) = (number(case, "kind") as u8, bytes(case, "body"));
        let read = visit_body(way, kind, &body, Rewritten { fields: &Value::Null });
        assert_eq!(read.expect("a known kind"), Err(MalformedMessage), "{case}");
        assert_eq!(text(case, "error"), "malformed");
    }
    for case in list(&load("coder")["refused"]) {
        let coded = bytes(case, "coded");
        let mut decoder = TileDecoder::new(&coded);
        let mut before = 0;
        let error = loop {
            match decoder.header() {
                Ok(Some(header)) => {
                    decoder.cells(&header, &mut tile(&"00".repeat(256)));
                    before += 1;
                }
                Ok(None) => panic!("not refused: {case}"),
                Err(TileError::Malformed) => break "malformed",
                Err(TileError::TooManyTiles) => break "too many tiles",
                Err(TileError::WrongBase) => break "wrong base",
            }
        };
        assert_eq!((error, before), (text(case, "error"), number(case, "tiles_before")), "{case}");
    }
    assert_eq!(MAX_TILES_PER_UPDATE, 32);
}

/// Every example in the specification is a case of the vectors: a block tagged `vector FILE FIELD
/// NAME` contains that field of that case.
#[test]
fn examples_of_the_specification_are_vectors() {
    let path = folder().join("../../protocol/SPEC.md");
    let text = std::fs::read_to_string(path).unwrap();
    let mut blocks = 0;
    for block in text.split("```vector ").skip(1) {
        let (tag, rest) = block.split_once('\n').unwrap();
        let shown = unhex(rest.split("```").next().unwrap());
        let mut tag = tag.splitn(3, ' ');
        let (file, field, name) = (tag.next().unwrap(), tag.next().unwrap(), tag.next().unwrap());
        let found = find(&cases(file), name).unwrap_or_else(|| panic!("no case {name} in {file}"));
        assert_eq!(hex(&shown), self::text(&found, field), "{name}");
        blocks += 1;
    }
    assert!(blocks >= 8, "{blocks} examples");
    assert_eq!(crc32(&[b"123456789"]), 0xCBF4_3926);
    assert!(text.contains("0xCBF43926"));
}

fn find(value: &Value, name: &str) -> Option<Value> {
    match value {
        Value::Array(cases) => cases.iter().find_map(|case| find(case, name)),
        Value::Object(fields) if fields.get("name").is_some_and(|it| it == name) => {
            Some(value.clone())
        }
        Value::Object(fields) => fields.values().find_map(|inner| find(inner, name)),
        _ => None,
    }
}

/// The same vectors, checked by a decoder written from the specification in another language.
#[test]
fn a_second_implementation_agrees() {
    if let Some(said) = python("check_vectors.py", &[]) {
        assert!(said.contains(" passed, 0 failed"), "{said}");
    }
}

/// The code, the layouts and the priors in SPEC.md are what that decoder runs: wherever one of them
/// is broken, the vectors fail.
#[test]
fn the_document_cannot_be_broken_unnoticed() {
    if let Some(said) = python("break_document.py", &["60"]) {
        assert!(said.contains("breaks noticed, 0 missed"), "{said}");
    }
}

/// What a script in `tests/python` prints; `None`, and a line that says so, without Python.
fn python(script: &str, arguments: &[&str]) -> Option<String> {
    let path = folder().join("../python").join(script);
    let mut run = Command::new("python3");
    run.arg("-B").arg(path).args(arguments).stdin(Stdio::null());
    match run.output() {
        Ok(output) => {
            let said = String::from_utf8_lossy(&output.stdout).into_owned();
            let wrong = String::from_utf8_lossy(&output.stderr);
            assert!(output.status.success(), "{script}: {said}{wrong}");
            Some(said)
        }
        Err(error) => {
            assert!(env::var_os("CI").is_none(), "python3: {error}");
            let _ = writeln!(std::io::stderr(), "skipped: {script}: no python3: {error}");
            None
        }
    }
}
