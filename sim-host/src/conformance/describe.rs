//! Captured bytes as text, frame by frame.

use std::{collections::BTreeMap, fmt::Debug};

use ubimap_protocol::{
    frame::{Direction, FrameKind, HEADER_LEN, Header, SEAL_LEN, SessionId, cobs::DELIMITER},
    message::{
        Encoded, MalformedMessage, Message, TileUpdateHead, ToRobot, ToRobotMessage, ToServer,
        ToServerMessage, Welcome,
    },
    tile::{Applied, Epoch, Replica, TileDecoder, TileHeader, TileId, tile_hash},
};

use super::frames::{Frame, MIN_CONTENTS, Note, Unreadable, unstuffed};

/// Describes captured bytes. It learns the sessions from the welcomes, and keeps the tiles that
/// updates build upon.
#[derive(Debug, Default)]
pub struct Describer {
    sessions: Vec<SessionId>,
    /// The direction of all frames, if it is known.
    direction: Option<Direction>,
    tiles: BTreeMap<(u8, TileId, Epoch), Replica>,
}

impl Describer {
    /// A describer that knows a session and the direction of all frames, if they are given.
    pub fn new(session: Option<SessionId>, direction: Option<Direction>) -> Self {
        Self { sessions: session.into_iter().collect(), direction, tiles: BTreeMap::new() }
    }

    /// Adds a session.
    pub fn know(&mut self, session: SessionId) {
        self.sessions.insert(0, session);
    }

    /// Learns the sessions of all welcomes in a capture, so that frames before them are read too.
    pub fn learn(&mut self, bytes: &[u8]) {
        for (_, wire) in split(bytes) {
            let Ok(contents) = unstuffed(wire) else { continue };
            let Ok(frame) = Frame::read(&contents, Direction::ToRobot, []) else { continue };
            for note in frame.notes().0 {
                self.meet(&note);
            }
        }
    }

    fn meet(&mut self, note: &Note) {
        let message = Message::<ToRobot>::new(note.number, &note.body);
        if let Ok(welcome) = message.decode::<Welcome>()
            && !self.sessions.contains(&welcome.session)
        {
            self.sessions.insert(0, welcome.session);
        }
    }

    /// Describes all frames of a capture: a line for each frame and each of its messages.
    pub fn describe(&mut self, bytes: &[u8]) -> String {
        let mut lines = String::new();
        for (offset, wire) in split(bytes) {
            lines.push_str(&format!("{offset:>6}  {}\n", self.frame(wire)));
        }
        lines
    }

    /// Describes a frame as it is on the wire, with its messages on further lines.
    pub fn frame(&mut self, wire: &[u8]) -> String {
        let size = format!("{:>4} bytes  ", wire.len());
        if wire.last() != Some(&DELIMITER) {
            return format!(
                "{size}incomplete: the capture ends before the delimiter: {}",
                hex(wire)
            );
        }
        let contents = match unstuffed(wire) {
            Ok(contents) => contents,
            Err(error) => return format!("{size}no frame: {error}: {}", hex(wire)),
        };
        match self.read(&contents) {
            Ok(frame) => size + &self.opened(&frame),
            Err(unreadable) => size + &self.unread(&contents, unreadable),
        }
    }

    /// Describes a frame that was read by another means.
    pub(super) fn read_frame(&mut self, len: usize, frame: &Frame) -> String {
        format!("{len:>4} bytes  {}", self.opened(frame))
    }

    fn read(&self, contents: &[u8]) -> Result<Frame, Unreadable> {
        let directions = match self.direction {
            Some(direction) => vec![direction],
            None => vec![Direction::ToServer, Direction::ToRobot],
        };
        let mut unread = Unreadable::Seal;
        for direction in directions {
            match Frame::read(contents, direction, self.sessions.iter().copied()) {
                Err(Unreadable::Seal) => {}
                Err(other) => unread = other,
                Ok(frame) => return Ok(frame),
            }
        }
        Err(unread)
    }

    fn opened(&mut self, frame: &Frame) -> String {
        let to = match frame.direction {
            Direction::ToServer => "to server",
            Direction::ToRobot => "to robot",
        };
        let seal = match frame.session {
            SessionId::NONE => "sealed outside any session".into(),
            SessionId(session) => format!("sealed in session {session:08X}"),
        };
        let mut text = format!("{to}  {}  {seal}", head(frame.header));
        text.push_str(&self.messages(frame));
        text
    }

    /// A frame without a good seal: its header, and its messages if the direction is known.
    fn unread(&mut self, contents: &[u8], unreadable: Unreadable) -> String {
        let why = match unreadable {
            Unreadable::Stuffing(error) => error.to_string(),
            Unreadable::Header => "SEAL GOOD, but no complete header of a known kind".into(),
            Unreadable::Seal if contents.len() < MIN_CONTENTS => "too short for a frame".into(),
            Unreadable::Seal if self.sessions.is_empty() => {
                "SEAL BAD, or of an unknown session or the other direction".into()
            }
            Unreadable::Seal => "SEAL BAD: damaged, or of another session or direction".into(),
        };
        let header = Header::decode(contents).filter(|_| contents.len() >= MIN_CONTENTS);
        let Some((header, _)) = header else { return format!("{why}: {}", hex(contents)) };
        let mut text = format!("{}  {why}", head(header));
        match self.direction {
            None => text.push_str(&format!(": {}", hex(contents))),
            Some(direction) => {
                let payload = contents[HEADER_LEN..contents.len() - SEAL_LEN].to_vec();
                let frame = Frame { session: SessionId::NONE, direction, header, payload };
                text.push_str(&self.messages(&frame));
            }
        }
        text
    }

    fn messages(&mut self, frame: &Frame) -> String {
        let (notes, is_cut) = frame.notes();
        let mut text = String::new();
        let mut at = HEADER_LEN;
        for note in &notes {
            let what = match frame.direction {
                Direction::ToServer => self.robots(note),
                Direction::ToRobot => self.servers(note),
            };
            text.push_str(&format!("\n            {at:>4}  {what}"));
            let mut written = Vec::new();
            note.write(&mut written);
            at += written.len();
            if frame.direction == Direction::ToRobot {
                self.meet(note);
            }
        }
        if is_cut {
            let rest = frame.payload.get(at - HEADER_LEN..).unwrap_or_default();
            text.push_str(&format!("\n            {at:>4}  MALFORMED: cut short: {}", hex(rest)));
        }
        text
    }

    /// Describes a message of a robot.
    fn robots(&mut self, note: &Note) -> String {
        use ToServerMessage as M;
        let Some(message) = Message::<ToServer>::new(note.number, &note.body).by_kind() else {
            return unknown(note);
        };
        match message {
            M::Ack(it) => show(note, it),
            M::Hello(it) => show(note, it),
            M::TimeRequest(it) => show(note, it),
            M::TileUpdate(it) => self.tiles(note, it.split()),
            M::State(it) => show(note, it),
            M::Interest(it) => show(note, it),
            M::Request(it) => show(note, it),
            M::DistanceVector(it) => show(note, it),
            M::Event(it) => show(note, it),
            M::Digests(it) => show(note, it),
            M::ParameterReport(it) => show(note, it),
        }
    }

    /// Describes a message of a server.
    fn servers(&mut self, note: &Note) -> String {
        use ToRobotMessage as M;
        let Some(message) = Message::<ToRobot>::new(note.number, &note.body).by_kind() else {
            return unknown(note);
        };
        match message {
            M::Ack(it) => show(note, it),
            M::Welcome(it) => show(note, it),
            M::TimeReply(it) => show(note, it),
            M::TileUpdate(it) => self.tiles(note, it.split()),
            M::PoseFix(it) => show(note, it),
            M::Refusal(it) => show(note, it),
            M::Request(it) => show(note, it),
            M::Reset(it) => show(note, it),
            M::Peers(it) => show(note, it),
            M::Obstacles(it) => show(note, it),
            M::Path(it) => show(note, it),
            M::Stop(it) => show(note, it),
            M::Parameter(it) => show(note, it),
            M::Stored(it) => show(note, it),
            M::Digests(it) => show(note, it),
            M::Freshness(it) => show(note, it),
        }
    }

    fn tiles(
        &mut self,
        note: &Note,
        update: Result<(TileUpdateHead, &[u8]), MalformedMessage>,
    ) -> String {
        let Ok((head, coded)) = update else { return malformed(note) };
        let mut text = plain(&format!("{head:?}")).replace("TileUpdateHead", "TileUpdate");
        let mut decoder = TileDecoder::new(coded);
        loop {
            let line = match decoder.header() {
                Ok(None) => return text,
                Err(error) => format!("MALFORMED: {error}"),
                Ok(Some(header)) => {
                    let key = (head.layer as u8, header.id, header.stamp.epoch);
                    let held = self.tiles.entry(key).or_default();
                    match held.apply(&header, &mut decoder) {
                        Ok(applied) => {
                            text.push_str(&format!(
                                "\n                  {}",
                                tile(&header, applied, held)
                            ));
                            continue;
                        }
                        Err(_) => format!(
                            "{}: its base is not in this capture, so the rest can't be read",
                            named(&header)
                        ),
                    }
                }
            };
            text.push_str(&format!("\n                  {line}"));
            return text;
        }
    }
}

/// The stuffed frames of a capture with their offsets, each with its delimiter; the last one may lack
/// it. Consecutive delimiters are left out.
pub fn split(bytes: &[u8]) -> impl Iterator<Item = (usize, &[u8])> {
    let mut offset = 0;
    bytes.split_inclusive(|&byte| byte == DELIMITER).filter_map(move |wire| {
        let at = offset;
        offset += wire.len();
        (wire != [DELIMITER]).then_some((at, wire))
    })
}

/// Bytes as hexadecimal digits, with a space between them.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect::<Vec<_>>().join(" ")
}

fn head(header: Header) -> String {
    let kind = match header.kind {
        FrameKind::Handshake => "handshake",
        FrameKind::Reliable => "reliable",
        FrameKind::Datagram => "datagram",
    };
    format!("{kind} {}, version {}", header.sequence, header.version)
}

fn named(header: &TileHeader) -> String {
    let TileHeader { id, stamp, base, start, end } = header;
    let base = base.map_or("whole".into(), |base| format!("on version {}", base.0));
    format!(
        "tile ({}, {}) epoch {} version {} {base}, cells {start} to {}",
        id.x,
        id.y,
        stamp.epoch.0,
        stamp.version.0,
        end - 1
    )
}

fn tile(header: &TileHeader, applied: Applied, held: &Replica) -> String {
    let (free, occupied, movable) = held.tile().counts();
    let state = match applied {
        Applied::Old => "old: skipped".into(),
        Applied::Partial => "in part".into(),
        Applied::Complete => format!("hash {:08X}", tile_hash(held.tile())),
    };
    format!("{}: {free} free, {occupied} occupied, {movable} movable; {state}", named(header))
}

fn show<T: Debug + serde::de::DeserializeOwned>(note: &Note, encoded: Encoded<'_, T>) -> String {
    encoded.decode().map_or_else(|_| malformed(note), |body| plain(&format!("{body:?}")))
}

fn malformed(note: &Note) -> String {
    format!("MALFORMED message of kind {}: {}", note.number, hex(&note.body))
}

fn unknown(note: &Note) -> String {
    format!("message of the unknown kind {}: {}", note.number, hex(&note.body))
}

/// A value's debug text without the names of types that only wrap a number: `Instant(7)` becomes `7`.
fn plain(debug: &str) -> String {
    const WRAPPERS: [&str; 8] = [
        "Instant(",
        "Duration(",
        "Millimetres(",
        "Angle(",
        "RobotId(",
        "SessionId(",
        "Epoch(",
        "Version(",
    ];
    let mut text = String::new();
    let mut rest = debug;
    'next: while let Some(letter) = rest.chars().next() {
        let is_start = !text.ends_with(char::is_alphanumeric);
        for wrapper in WRAPPERS {
            if let Some((number, after)) =
                rest.strip_prefix(wrapper).filter(|_| is_start).and_then(|it| it.split_once(')'))
            {
                text.push_str(number);
                rest = after;
                continue 'next;
            }
        }
        text.push(letter);
        rest = &rest[letter.len_utf8()..];
    }
    text
}

#[cfg(test)]
mod tests {
    use ubimap_protocol::message::TimeRequest;

    use super::*;

    #[test]
    fn wrapped_numbers_are_shown_bare() {
        let shown = plain("Some(Pose { x: Millimetres(-5), heading: Angle(7) }), PoseAngle(3)");
        assert_eq!(shown, "Some(Pose { x: -5, heading: 7 }), PoseAngle(3)");
    }

    /// The examples of SPEC 2.2, 2.4 and 4.1.
    #[test]
    fn a_capture_is_described_frame_by_frame() {
        let hello = "01 10 20 01 08 01 01 01 63 fa 01 64 10 6d 40 45 90 00";
        let datagram = "0a 03 30 02 01 07 35 83 45 72 00";
        let bytes: Vec<u8> = format!("{hello} 00 {datagram} 05 01 00 07")
            .split(' ')
            .map(|byte| u8::from_str_radix(byte, 16).unwrap())
            .collect();
        let described = Describer::new(Some(SessionId(0xA1B2_C3D4)), None).describe(&bytes);
        let lines: Vec<&str> = described.lines().map(str::trim).collect();
        assert_eq!(lines.len(), 6, "{described}");
        assert!(
            lines[0].starts_with("0    18 bytes  to server  handshake 0, version 1"),
            "{described}"
        );
        assert!(lines[1].contains("Hello { version: 1, min_version: 1, robot: 1, nonce: 99"));
        assert!(lines[2].starts_with("19    11 bytes  to server  datagram 3, version 1"));
        assert!(lines[2].ends_with("sealed in session A1B2C3D4"));
        assert_eq!(lines[3], format!("2  {}", plain(&format!("{:?}", TimeRequest { nonce: 7 }))));
        assert!(lines[4].contains("truncated"), "{described}");
        assert!(lines[5].contains("incomplete"), "{described}");
    }
}
