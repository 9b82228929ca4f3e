//! The tile updates of a replay, with the states that their senders coded.

use std::collections::BTreeMap;

use ubimap_protocol::{
    frame::{Direction, MAX_FRAME, payload_capacity},
    link::{Endpoint, Received},
    message::{Body, Messages, TileUpdateHead, ToRobot, ToServer, Traffic, Welcome},
    tile::{Layer, Row, TILE_CELLS, TILE_SIDE, Tile, TileDecoder, TileHeader, TileId},
    time::Instant,
    units::RobotId,
};

/// One tile of an update.
#[derive(Clone, Debug)]
pub struct TileChange {
    /// The tile's header in the update.
    pub header: TileHeader,
    /// The cells at the receiver before the update.
    pub old: Tile,
    /// The cells at the receiver after all parts of the update have arrived.
    pub new: Tile,
}

/// The tile update of one frame.
#[derive(Clone, Debug)]
pub struct Update {
    /// Direction of the frame.
    pub direction: Direction,
    /// Space for the update in the frame, in bytes.
    pub room: usize,
    /// The coded update.
    pub coded: Vec<u8>,
    /// The tiles of the update.
    pub tiles: Vec<TileChange>,
}

impl Update {
    /// Appends the update to the input of the image that counts instructions over updates; the
    /// image's source describes the format.
    pub fn write(&self, input: &mut Vec<u8>) {
        input.push(self.direction as u8);
        input.extend((self.room as u16).to_le_bytes());
        input.extend((self.coded.len() as u16).to_le_bytes());
        input.extend(&self.coded);
        for TileChange { header, old, new } in &self.tiles {
            write_rows(input, &Tile::UNKNOWN, old);
            let mut part = *old;
            for cell in usize::from(header.start)..usize::from(header.end) {
                let (x, y) = (cell % TILE_SIDE, cell / TILE_SIDE);
                part.set(x, y, new.cell(x, y));
            }
            write_rows(input, &part, new);
        }
    }
}

/// Writes a mask of the rows that differ, followed by these rows.
fn write_rows(input: &mut Vec<u8>, from: &Tile, to: &Tile) {
    let differ: Vec<_> = (0..TILE_SIDE).filter(|&y| from.row(y) != to.row(y)).collect();
    let rows = differ.iter().fold(0u32, |rows, y| rows | 1 << y);
    input.extend(rows.to_le_bytes());
    for y in differ {
        let Row { low, high } = to.row(y);
        input.extend([low.to_le_bytes(), high.to_le_bytes()].concat());
    }
}

/// Collects the updates on all links. The links must not lose frames.
#[derive(Debug, Default)]
pub struct Gathering {
    links: BTreeMap<RobotId, Link>,
    updates: Vec<Update>,
}

/// The receiving side of both ends of a link.
#[derive(Debug)]
struct Link {
    server: Endpoint<ToRobot, (), 1, MAX_FRAME>,
    robot: Endpoint<ToServer, (), 1, MAX_FRAME>,
    frame: usize,
    tiles: BTreeMap<(Layer, TileId), Held>,
}

/// A tile at its receiver, and the indices in `updates` of the parts that wait for the last part.
#[derive(Debug, Default)]
struct Held {
    tile: Tile,
    parts: Vec<(usize, usize)>,
}

impl Gathering {
    /// Adds a frame.
    ///
    /// # Panics
    /// If an endpoint could not have sent it.
    pub fn hear(&mut self, robot: RobotId, direction: Direction, mut frame: &[u8]) {
        let link = self.links.entry(robot).or_insert_with(|| Link {
            server: Endpoint::new(),
            robot: Endpoint::new(),
            frame: 0,
            tiles: BTreeMap::new(),
        });
        let Link { server, robot, frame: size, tiles } = link;
        match direction {
            Direction::ToServer => match server.receive(&mut frame, Instant(0)).unwrap() {
                Received::Session(messages) => {
                    gather(messages, payload_capacity(*size), tiles, &mut self.updates);
                }
                Received::Handshake(_) => {}
                Received::Bad(fault) | Received::Stray(_, fault) => panic!("a bad frame: {fault}"),
                Received::Sealed(_) => panic!("a sealed frame"),
            },
            Direction::ToRobot => match robot.receive(&mut frame, Instant(0)).unwrap() {
                Received::Session(messages) => {
                    gather(messages, payload_capacity(*size), tiles, &mut self.updates);
                }
                Received::Handshake(message) => {
                    if let Ok(welcome) = message.decode::<Welcome>() {
                        *size = usize::from(welcome.frame);
                        server.begin(welcome.session, *size);
                        robot.begin(welcome.session, *size);
                    }
                }
                Received::Bad(fault) | Received::Stray(_, fault) => panic!("a bad frame: {fault}"),
                Received::Sealed(_) => panic!("a sealed frame"),
            },
        }
    }

    /// All collected updates.
    pub fn updates(self) -> Vec<Update> {
        self.updates
    }
}

/// Decodes the updates among the messages of a frame, which had space for `capacity` bytes.
fn gather<D: Traffic>(
    messages: Messages<'_, D>,
    capacity: usize,
    held: &mut BTreeMap<(Layer, TileId), Held>,
    updates: &mut Vec<Update>,
) where
    TileUpdateHead: Body<D>,
{
    let mut before = 0;
    for message in messages.map(Result::unwrap) {
        let body = message.body;
        if let Ok((head, coded)) = message.split::<TileUpdateHead>() {
            let mut decoder = TileDecoder::new(coded);
            let mut tiles = Vec::new();
            while let Some(header) = decoder.header().unwrap() {
                let held = held.entry((head.layer, header.id)).or_default();
                tiles.push(held.take(header, &mut decoder));
                if header.end < TILE_CELLS {
                    held.parts.push((updates.len(), tiles.len() - 1));
                    continue;
                }
                for (update, tile) in held.parts.drain(..) {
                    let earlier: &mut Update = &mut updates[update];
                    earlier.tiles[tile].new = held.tile;
                }
            }
            // The writer reserves three bytes for kind and length before it writes a body.
            let room = capacity - before - 3 - (body.len() - coded.len());
            updates.push(Update { direction: D::DIRECTION, room, coded: coded.to_vec(), tiles });
        }
        before += if body.len() < 128 { 2 } else { 3 } + body.len();
    }
}

impl Held {
    fn take(&mut self, header: TileHeader, decoder: &mut TileDecoder<'_>) -> TileChange {
        if header.start == 0 {
            self.parts.clear();
            if header.base.is_none() {
                self.tile = Tile::UNKNOWN;
            }
        }
        let old = self.tile;
        decoder.cells(&header, &mut self.tile);
        TileChange { header, old, new: self.tile }
    }
}
