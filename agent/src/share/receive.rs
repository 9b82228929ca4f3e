//! The server's tiles on the robot: a window of the merged map around it.

use heapless::Vec;
use ubimap_protocol::{
    message::{Digests, Interest, MAX_REQUESTS, Request, ToServerKind, Writer},
    tile::{
        BaseMissing, Layer, Replica, TILE_SIDE, Tile, TileDecoder, TileError, TileId, tile_hash,
    },
    units::{Millimetres, Pose},
};

/// One place in the pool of fused tiles.
#[derive(Clone, Debug, Default)]
pub struct FusedTile {
    id: Option<TileId>,
    replica: Replica,
}

impl FusedTile {
    /// A free place.
    pub const FREE: Self = Self { id: None, replica: Replica::NOTHING };

    /// Which tile, or `None` if the place is free.
    pub fn id(&self) -> Option<TileId> {
        self.id
    }

    /// Its cells and stamp.
    pub fn replica(&self) -> &Replica {
        &self.replica
    }
}

/// The fused tiles that the robot holds, in the caller's memory.
#[derive(Debug)]
pub struct FusedMap<'b> {
    places: &'b mut [FusedTile],
    interest: Option<Interest>,
    /// The number of the interest that the server is known to have.
    told: u32,
    requests: Vec<TileId, MAX_REQUESTS>,
    /// There were more tiles to ask for than can be listed: all are.
    request_all: bool,
}

impl<'b> FusedMap<'b> {
    /// A window of as many tiles as there are places.
    pub fn new(places: &'b mut [FusedTile]) -> Self {
        places.fill(FusedTile::default());
        Self { places, interest: None, told: 0, requests: Vec::new(), request_all: false }
    }

    /// How many tiles can be held.
    pub fn capacity(&self) -> usize {
        self.places.len()
    }

    /// The tiles that are held.
    pub fn tiles(&self) -> impl Iterator<Item = &FusedTile> {
        self.places.iter().filter(|tile| tile.id.is_some())
    }

    /// The cells of a tile, if it is held whole.
    pub fn tile(&self, id: TileId) -> Option<&Tile> {
        let place = self.places.iter().find(|place| place.id == Some(id))?;
        (!place.replica.is_partial()).then(|| place.replica.tile())
    }

    /// Moves the window when the robot has left its middle third. Tiles outside are dropped.
    pub fn follow(&mut self, pose: Pose, resolution: Millimetres) {
        let side =
            (1..=255u16).take_while(|side| usize::from(side * side) <= self.capacity()).last();
        let Some(side) = side.map(i32::from) else { return };
        let tile_size = resolution.0.saturating_mul(TILE_SIDE as i32).max(1);
        // The south-western tile of a window in whose middle the robot is.
        let first = |coordinate: Millimetres| {
            let half = side * tile_size / 2;
            let first = (coordinate.0.saturating_sub(half)).div_euclid(tile_size);
            // Rounded: the robot is within half a tile of the middle.
            let rest = coordinate.0.saturating_sub(half).rem_euclid(tile_size);
            first + i32::from(2 * i64::from(rest) >= i64::from(tile_size))
        };
        let clamp = |tile: i32| tile.clamp(i32::from(i16::MIN), i32::from(i16::MAX)) as i16;
        let from = TileId { x: clamp(first(pose.x)), y: clamp(first(pose.y)) };
        let to = TileId {
            x: clamp(i32::from(from.x) + side - 1),
            y: clamp(i32::from(from.y) + side - 1),
        };
        let slack = (side / 6).max(1);
        let far = |a: i16, b: i16| (i32::from(a) - i32::from(b)).abs() > slack;
        let moved =
            self.interest.is_none_or(|now| far(now.from.x, from.x) || far(now.from.y, from.y));
        if !moved {
            return;
        }
        let number = self.interest.map_or(0, |now| now.number) + 1;
        let interest = Interest { number, from, to };
        self.interest = Some(interest);
        for place in self.places.iter_mut() {
            if place.id.is_some_and(|id| !interest.contains(id)) {
                *place = FusedTile::default();
            }
        }
    }

    /// The window that the robot wants, once it knows where it is.
    pub fn interest(&self) -> Option<Interest> {
        self.interest
    }

    /// The window, if the server does not know it yet.
    pub fn untold(&self) -> Option<Interest> {
        self.interest.filter(|interest| interest.number > self.told)
    }

    /// The server has been told of a window.
    pub fn told(&mut self, number: u32) {
        self.told = self.told.max(number);
    }

    /// Asks for the tiles that are to be asked for, as many as there is room for, once. `false`
    /// if there are none.
    pub fn push_request(&mut self, writer: &mut Writer<'_>) -> bool {
        if self.request_all {
            let request = Request { layer: Layer::Fused, tiles: Vec::new() };
            self.request_all = !writer.push(ToServerKind::Request as u8, &request);
            return !self.request_all;
        }
        for count in (1..=self.requests.len()).rev() {
            let mut request = Request { layer: Layer::Fused, tiles: self.requests.clone() };
            request.tiles.truncate(count);
            if writer.push(ToServerKind::Request as u8, &request) {
                let mut rest = Vec::new();
                for &id in self.requests.iter().skip(count) {
                    let _ = rest.push(id);
                }
                self.requests = rest;
                return true;
            }
        }
        false
    }

    /// A session has begun: the server knows no window. Tiles of another epoch of the server
    /// are void.
    pub fn begin_session(&mut self, same_server: bool) {
        self.told = 0;
        self.requests.clear();
        self.request_all = false;
        if !same_server {
            self.places.fill(FusedTile::default());
        }
    }

    /// Takes the coded tiles of an update.
    ///
    /// # Errors
    /// What follows a [`TileError`] is not read; what came before it holds.
    pub fn update(&mut self, coded: &[u8]) -> Result<(), TileError> {
        let mut decoder = TileDecoder::new(coded);
        while let Some(header) = decoder.header()? {
            let wanted = self.interest.is_some_and(|interest| interest.contains(header.id));
            let held = self.places.iter().position(|place| place.id == Some(header.id));
            let place = held.or_else(|| self.places.iter().position(|place| place.id.is_none()));
            let (true, Some(place)) = (wanted, place.and_then(|index| self.places.get_mut(index)))
            else {
                // It was sent before the window moved. A whole tile is read past; else the rest
                // of the message is lost, and asking for the tile brings back what it held.
                if header.base.is_some() || header.start != 0 {
                    self.request(header.id);
                    return Ok(());
                }
                decoder.cells(&header, &mut Tile::default());
                continue;
            };
            if place.id.is_none() {
                *place = FusedTile { id: Some(header.id), replica: Replica::default() };
            }
            if place.replica.apply(&header, &mut decoder) == Err(BaseMissing) {
                if place.replica.stamp().version.0 == 0 && !place.replica.is_partial() {
                    place.id = None;
                }
                self.request(header.id);
                return Ok(());
            }
        }
        Ok(())
    }

    /// Takes the states of some tiles of the server's: those of which an older state or other
    /// cells are held are asked for.
    pub fn compare(&mut self, digests: &Digests) {
        for digest in &digests.tiles {
            let place = self.places.iter_mut().find(|place| place.id == Some(digest.id));
            let level = place.is_some_and(|place| {
                let (held, told) = (place.replica.stamp(), digest.stamp);
                let other = held == told && tile_hash(place.replica.tile()) != digest.hash;
                if other {
                    // It must be dropped: the same state would be taken for an old one.
                    *place = FusedTile::FREE;
                }
                held >= told && !other
            });
            let wanted = self.interest.is_some_and(|interest| interest.contains(digest.id));
            if wanted && !level {
                self.request(digest.id);
            }
        }
    }

    fn request(&mut self, id: TileId) {
        if !self.requests.contains(&id) && self.requests.push(id).is_err() {
            // No other update may come to ask for this one again.
            self.requests.clear();
            self.request_all = true;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ubimap_protocol::{
        message::{Messages, decode},
        tile::{Epoch, Stamp, TileEncoder, Version},
    };

    #[test]
    fn more_tiles_than_a_request_names_are_asked_for_all_at_once() {
        let mut places: [FusedTile; 16] = core::array::from_fn(|_| FusedTile::default());
        let mut map = FusedMap::new(&mut places);
        map.follow(Pose::default(), Millimetres(50));
        let mut asked = |missing: i16| {
            for x in 0..missing {
                let mut out = [0u8; 60];
                let mut encoder = TileEncoder::new(&mut out);
                let id = TileId { x: x % 4 - 2, y: x / 4 - 2 };
                let stamp = Stamp { epoch: Epoch(1), version: Version(2) };
                encoder.push(id, stamp, Some(Version(1)), 0, &Tile::UNKNOWN, &Tile::UNKNOWN);
                let len = encoder.finish().unwrap();
                assert_eq!(map.update(&out[..len]), Ok(()));
            }
            let mut buffer = [0u8; 60];
            let mut writer = Writer::new(&mut buffer);
            assert!(map.push_request(&mut writer) && !map.push_request(&mut writer));
            let len = writer.len();
            let message = Messages::new(&buffer[..len]).next().unwrap().unwrap();
            decode::<Request>(message.body).unwrap().0.tiles.len()
        };
        assert_eq!((asked(8), asked(9), asked(3)), (8, 0, 3));
    }
}
