//! The tile updates of a replay: what their senders coded, and what they coded it from.

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
    /// What the update says of it.
    pub header: TileHeader,
    /// What its receiver holds.
    pub old: Tile,
    /// What it is to hold once all parts have arrived.
    pub new: Tile,
}

/// The tile update of one frame.
#[derive(Clone, Debug)]
pub struct Update {
    /// Which way it went.
    pub direction: Direction,
    /// Bytes that there were for it.
    pub room: usize,
    /// Its bytes.
    pub coded: Vec<u8>,
    /// Its tiles.
    pub tiles: Vec<TileChange>,
}

impl Update {
    /// Adds it to the input of the image that counts instructions over updates (its module tells
    /// the format).
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

/// Which rows differ, and these.
fn write_rows(input: &mut Vec<u8>, from: &Tile, to: &Tile) {
    let differ: Vec<_> = (0..TILE_SIDE).filter(|&y| from.row(y) != to.row(y)).collect();
    let rows = differ.iter().fold(0u32, |rows, y| rows | 1 << y);
    input.extend(rows.to_le_bytes());
    for y in differ {
        let Row { low, high } = to.row(y);
        input.extend([low.to_le_bytes(), high.to_le_bytes()].concat());
    }
}

/// Gathers the updates on all links, to which nothing may happen on their way.
#[derive(Debug, Default)]
pub struct Gathering {
    links: BTreeMap<RobotId, Link>,
    updates: Vec<Update>,
}

/// The two ends of a link, as far as they receive.
#[derive(Debug)]
struct Link {
    server: Endpoint<ToRobot, (), 1, MAX_FRAME>,
    robot: Endpoint<ToServer, (), 1, MAX_FRAME>,
    frame: usize,
    tiles: BTreeMap<(Layer, TileId), Held>,
}

/// A tile at its receiver, and the places in `updates` of the parts that wait for the last one.
#[derive(Debug, Default)]
struct Held {
    tile: Tile,
    parts: Vec<(usize, usize)>,
}

impl Gathering {
    /// Hears a frame.
    ///
    /// # Panics
    /// If it is not what an endpoint sends.
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
                Received::Bad => panic!("a bad frame"),
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
                Received::Bad => panic!("a bad frame"),
            },
        }
    }

    /// All that was heard.
    pub fn updates(self) -> Vec<Update> {
        self.updates
    }
}

/// Reads the updates among a frame's messages, of which `capacity` bytes would have fitted.
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
            // Kind and length get three bytes before the body is moved up.
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
