//! Fuzz targets for the protocol: arbitrary bytes, and arbitrary sequences of operations. A target
//! must not panic on any input. The fuzzer's workspace (`fuzz/`) and the corpus test share this
//! file, so it depends on the protocol only.

use std::fmt::Debug;

use ubimap_protocol::{
    frame::{Direction, FrameKind, HEADER_LEN, Header, MAX_FRAME, SessionId, cobs, open, seal},
    link::{Endpoint, Fill, Received},
    message::{
        Body, Encoded, Message, Messages, Request, ToRobot, ToRobotMessage, ToServer,
        ToServerMessage, Traffic, Writer,
    },
    tile::{
        Layer, MAX_TILES_PER_UPDATE, Replica, TILE_CELLS, Tile, TileDecoder, TileEncoder,
        TileHeader, TileId,
    },
    time::{Duration, Instant},
};

/// An operation on the body of a message of any type.
pub trait BodyVisitor {
    /// The operation's result.
    type Output;

    /// Performs the operation on a body of type `T`.
    fn visit<D: Traffic, T: Body<D> + PartialEq + Debug>(
        self,
        body: Encoded<'_, T>,
    ) -> Self::Output;
}

/// Visits the body of a message with the type for its kind. `None` if this version does not know
/// the kind.
pub fn visit_body<V: BodyVisitor>(
    direction: Direction,
    number: u8,
    body: &[u8],
    visitor: V,
) -> Option<V::Output> {
    Some(match direction {
        Direction::ToServer => match Message::<ToServer>::new(number, body).by_kind()? {
            ToServerMessage::Ack(body) => visitor.visit::<ToServer, _>(body),
            ToServerMessage::Hello(body) => visitor.visit(body),
            ToServerMessage::TimeRequest(body) => visitor.visit(body),
            ToServerMessage::TileUpdate(body) => visitor.visit::<ToServer, _>(body),
            ToServerMessage::State(body) => visitor.visit(body),
            ToServerMessage::Interest(body) => visitor.visit(body),
            ToServerMessage::Request(body) => visitor.visit::<ToServer, _>(body),
            ToServerMessage::DistanceVector(body) => visitor.visit(body),
            ToServerMessage::Event(body) => visitor.visit(body),
            ToServerMessage::Digests(body) => visitor.visit::<ToServer, _>(body),
            ToServerMessage::ParameterReport(body) => visitor.visit(body),
        },
        Direction::ToRobot => match Message::<ToRobot>::new(number, body).by_kind()? {
            ToRobotMessage::Ack(body) => visitor.visit::<ToRobot, _>(body),
            ToRobotMessage::Welcome(body) => visitor.visit(body),
            ToRobotMessage::TimeReply(body) => visitor.visit(body),
            ToRobotMessage::TileUpdate(body) => visitor.visit::<ToRobot, _>(body),
            ToRobotMessage::PoseFix(body) => visitor.visit(body),
            ToRobotMessage::Refusal(body) => visitor.visit(body),
            ToRobotMessage::Request(body) => visitor.visit::<ToRobot, _>(body),
            ToRobotMessage::Reset(body) => visitor.visit(body),
            ToRobotMessage::Peers(body) => visitor.visit(body),
            ToRobotMessage::Obstacles(body) => visitor.visit(body),
            ToRobotMessage::Path(body) => visitor.visit(body),
            ToRobotMessage::Stop(body) => visitor.visit(body),
            ToRobotMessage::Parameter(body) => visitor.visit(body),
            ToRobotMessage::Stored(body) => visitor.visit(body),
            ToRobotMessage::Digests(body) => visitor.visit::<ToRobot, _>(body),
            ToRobotMessage::Freshness(body) => visitor.visit(body),
        },
    })
}

/// Decodes a byte stream into frames. Every frame that can be decoded is encoded and decoded again.
pub fn frames(data: &[u8]) {
    let mut decoder = cobs::Decoder::<256>::default();
    let mut input = data;
    let mut read = 0;
    while let Some(frame) = decoder.next(&mut input) {
        read += 1;
        let Ok(frame) = frame else { continue };
        let frame = &*frame;
        let mut wire = [0; cobs::encoded_len(256)];
        let len = cobs::encode([frame, &[]], &mut wire).expect("there is room");
        let mut again = cobs::Decoder::<256>::default();
        assert_eq!(again.next(&mut &wire[..len]).map(|it| it.map(|it| &*it)), Some(Ok(frame)));
        let Some(contents) = open(SessionId(1), Direction::ToServer, frame) else { continue };
        if let Some((header, payload)) = Header::decode(contents) {
            assert_eq!(header.encode(), contents[..HEADER_LEN]);
            assert!(Messages::<ToServer>::new(payload).count() <= payload.len());
        }
    }
    assert!(read <= data.len());
    // A valid frame is decoded after any input.
    let contents = Header { version: 1, kind: FrameKind::Datagram, sequence: 9 }.encode();
    let tail = seal(SessionId(1), Direction::ToServer, &contents);
    let mut wire = [0; 32];
    let len = cobs::encode([&contents, &tail], &mut wire).expect("there is room");
    let mut good = vec![0];
    good.extend(&wire[..len]);
    let mut input = &good[..];
    let mut last = None;
    while let Some(frame) = decoder.next(&mut input) {
        last = frame
            .ok()
            .and_then(|frame| open(SessionId(1), Direction::ToServer, frame))
            .map(<[u8]>::to_vec);
    }
    assert_eq!(last.as_deref(), Some(&contents[..]));
}

/// Reads direction and kind from the first byte, then a body. A body that can be decoded is encoded
/// and decoded again.
pub fn messages(data: &[u8]) {
    let Some((&first, body)) = data.split_first() else { return };
    let direction = if first & 0x80 == 0 { Direction::ToServer } else { Direction::ToRobot };
    let _ = visit_body(direction, first & 0x7F, body, RoundTrip);
    for message in Messages::<ToServer>::new(body).map_while(Result::ok) {
        let _ = visit_body(direction, message.number, message.body, RoundTrip);
    }
}

struct RoundTrip;

impl BodyVisitor for RoundTrip {
    type Output = ();

    fn visit<D: Traffic, T: Body<D> + PartialEq + Debug>(self, body: Encoded<'_, T>) {
        let Ok(message) = body.decode() else { return };
        let mut buffer = [0; MAX_FRAME];
        let mut writer = Writer::<D>::new(&mut buffer);
        assert!(writer.push(&message), "{message:?} does not fit any frame");
        let len = writer.len();
        let written =
            Messages::<D>::new(&buffer[..len]).next().and_then(Result::ok).expect("one message");
        assert_eq!(written.decode(), Ok(message));
    }
}

/// Reads a tile update, applies it to a replica and also decodes it directly. What can be decoded
/// is encoded and decoded again.
pub fn tiles(data: &[u8]) {
    let mut decoder = TileDecoder::new(data);
    let mut read: Vec<(TileHeader, Tile)> = Vec::new();
    let whole = loop {
        match decoder.header() {
            Ok(Some(header)) => {
                let mut tile = Tile::UNKNOWN;
                decoder.cells(&header, &mut tile);
                for cell in (0..usize::from(header.start)).chain(usize::from(header.end)..1024) {
                    assert_eq!(
                        tile.cell(cell % 32, cell / 32).code(),
                        0,
                        "a cell outside of the part"
                    );
                }
                read.push((header, tile));
            }
            Ok(None) => break true,
            Err(_) => break false,
        }
    };
    assert!(read.len() <= MAX_TILES_PER_UPDATE);
    if whole && read.iter().all(|(header, _)| header.start == 0 && header.end == TILE_CELLS) {
        let mut out = vec![0; 32 * 2048];
        let mut encoder = TileEncoder::new(&mut out);
        for (header, tile) in &read {
            let TileHeader { id, stamp, base, .. } = *header;
            let pushed = encoder.push(id, stamp, base, 0, &Tile::UNKNOWN, tile);
            assert_eq!(pushed, Some(TILE_CELLS));
        }
        let len = encoder.finish().expect("there is a tile");
        let mut again = TileDecoder::new(&out[..len]);
        for (header, tile) in &read {
            assert_eq!(again.header(), Ok(Some(*header)));
            let mut cells = Tile::UNKNOWN;
            again.cells(header, &mut cells);
            assert_eq!(&cells, tile);
        }
        assert_eq!(again.header(), Ok(None));
    }
    let mut replica = Replica::default();
    let mut decoder = TileDecoder::new(data);
    while let Ok(Some(header)) = decoder.header() {
        let before = replica.stamp();
        if replica.apply(&header, &mut decoder).is_err() {
            assert_eq!(replica.stamp(), before);
            break;
        }
    }
}

type End<D> = Endpoint<D, u32, 8, 64>;

/// Runs two link endpoints under an arbitrary sequence of operations of one or two bytes each:
/// send, deliver, lose, hold back, damage, let time pass, start a new session. Then the wire
/// becomes perfect: everything sent reliably in the last session must arrive exactly once and be
/// acknowledged.
pub fn links(data: &[u8]) {
    let mut pair = Pair::new();
    // Limits the number of operations, so that no frame is held back while a thousand others pass.
    let mut operations = data.iter().copied().take(1_500);
    while let Some(operation) = operations.next() {
        let side = usize::from(operation >> 7);
        match operation & 7 {
            0 | 1 => pair.say(side, true),
            2 => pair.say(side, false),
            3 => pair.poll(side),
            4 => pair.deliver(side, usize::from(operation >> 3 & 15)),
            5 => {
                let count = pair.wire[side].len();
                if count > 0 {
                    pair.wire[side].remove(usize::from(operation >> 3 & 15) % count);
                }
            }
            6 => {
                let (at, bit) = (operations.next().unwrap_or(0), operation >> 3 & 7);
                // While fuzzing, checksums are off, and damaged frames would be accepted.
                let frame = pair.wire[side].last_mut().filter(|_| !cfg!(fuzzing));
                if let Some(frame) = frame
                    && let Some(byte) = {
                        let at = usize::from(at) % frame.len();
                        frame.get_mut(at)
                    }
                {
                    *byte ^= 1 << bit;
                }
            }
            _ if operation & 0x7F == 0x7F => pair.begin(),
            _ => pair.now = pair.now + Duration::from_millis(u64::from(operation >> 3 & 15) * 20),
        }
    }
    pair.settle();
}

struct Pair {
    robot: End<ToServer>,
    server: End<ToRobot>,
    /// Frames in flight from each end.
    wire: [Vec<Vec<u8>>; 2],
    session: u32,
    now: Instant,
    /// For each end, the count of numbers sent reliably in this session, and the numbers received
    /// from the other end.
    said: [u32; 2],
    heard: [Vec<u32>; 2],
    acknowledged: [Vec<u32>; 2],
    wanted: [Vec<Option<u32>>; 2],
}

impl Pair {
    fn new() -> Self {
        let mut pair = Self {
            robot: End::new(),
            server: End::new(),
            wire: Default::default(),
            session: 0,
            now: Instant(0),
            said: [0; 2],
            heard: Default::default(),
            acknowledged: Default::default(),
            wanted: Default::default(),
        };
        pair.begin();
        pair
    }

    fn begin(&mut self) {
        self.session += 1;
        self.robot.begin(SessionId(self.session), 64);
        self.server.begin(SessionId(self.session), 64);
        self.said = [0; 2];
        self.heard = Default::default();
        self.acknowledged = Default::default();
        self.wanted = Default::default();
        if cfg!(fuzzing) {
            // Checksums are off while fuzzing, and frames of the previous session would be
            // accepted.
            self.wire = Default::default();
        }
    }

    fn say(&mut self, side: usize, reliable: bool) {
        if self.wanted[side].len() < 8 {
            let number = self.said[side];
            self.said[side] += u32::from(reliable);
            self.wanted[side].push(reliable.then_some(number));
        }
        self.poll(side);
    }

    fn poll(&mut self, side: usize) {
        let (wanted, wire) = (&mut self.wanted[side], &mut self.wire[side]);
        match side {
            0 => send_all(&mut self.robot, wanted, wire, self.now),
            _ => send_all(&mut self.server, wanted, wire, self.now),
        }
    }

    fn deliver(&mut self, from: usize, index: usize) {
        let count = self.wire[from].len();
        if count == 0 {
            return;
        }
        let frame = self.wire[from].remove(index % count);
        let to = 1 - from;
        let (heard, acknowledged) = (&mut self.heard[to], &mut self.acknowledged[to]);
        match to {
            0 => hear(&mut self.robot, &frame, self.now, heard, acknowledged),
            _ => hear(&mut self.server, &frame, self.now, heard, acknowledged),
        }
    }

    fn settle(&mut self) {
        for _ in 0..400 {
            for side in [0, 1] {
                self.poll(side);
                while !self.wire[side].is_empty() {
                    self.deliver(side, 0);
                }
            }
            let timeouts = [self.robot.poll_timeout(), self.server.poll_timeout()];
            match timeouts.into_iter().flatten().min() {
                Some(timeout) => self.now = self.now.max(timeout),
                None if self.wanted.iter().all(Vec::is_empty) => break,
                None => {}
            }
        }
        for side in [0, 1] {
            let all: Vec<u32> = (0..self.said[side]).collect();
            self.heard[1 - side].sort_unstable();
            assert_eq!(self.heard[1 - side], all, "each number arrives exactly once");
            self.acknowledged[side].sort_unstable();
            assert_eq!(self.acknowledged[side], all, "each number is acknowledged exactly once");
        }
    }
}

/// A message that carries a number in either direction.
fn numbered(number: u32) -> Request {
    let id = TileId { x: (number & 0x7FFF) as i16, y: (number >> 15) as i16 };
    Request { layer: Layer::Robot, tiles: [id].into_iter().collect() }
}

/// The number that a message carries.
fn number_of(request: &Request) -> Option<u32> {
    request.tiles.first().map(|id| id.x as u32 | (id.y as u32) << 15)
}

/// Puts everything that an end has to send on the wire. `wanted` contains the numbers to send
/// reliably, and `None` for datagrams.
fn send_all<D: Traffic>(
    end: &mut End<D>,
    wanted: &mut Vec<Option<u32>>,
    wire: &mut Vec<Vec<u8>>,
    now: Instant,
) where
    Request: Body<D>,
{
    for _ in 0..64 {
        let mut out = [0; 64];
        let urgent = wanted.first() == Some(&None);
        let sent =
            end.poll_transmit(now, &mut out, urgent, |writer, reliable| match wanted.first() {
                Some(&Some(number)) if reliable => {
                    assert!(writer.push(&numbered(number)));
                    wanted.remove(0);
                    Fill::Reliable(number)
                }
                Some(None) => {
                    let nothing = Request { layer: Layer::Robot, tiles: Default::default() };
                    assert!(writer.push(&nothing));
                    wanted.remove(0);
                    Fill::Datagram
                }
                _ => Fill::Nothing,
            });
        let Some(sent) = sent else { return };
        if wire.len() < 64 {
            wire.push(out[..sent.len].to_vec());
        }
    }
    panic!("an endpoint does not stop sending");
}

/// Passes a frame to an end, and records the numbers received and acknowledged.
fn hear<D: Traffic>(
    end: &mut End<D>,
    mut bytes: &[u8],
    now: Instant,
    heard: &mut Vec<u32>,
    acknowledged: &mut Vec<u32>,
) where
    Request: Body<D::Opposite>,
{
    while let Some(received) = end.receive(&mut bytes, now) {
        if let Received::Session(messages) = received {
            let requests = messages.map_while(Result::ok).filter_map(|it| it.decode().ok());
            heard.extend(requests.filter_map(|request| number_of(&request)));
        }
    }
    while let Some(number) = end.poll_acknowledged() {
        acknowledged.push(number);
    }
}
