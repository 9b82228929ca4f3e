use super::*;
use ubimap_protocol::{
    message::{Messages, TileDigest},
    tile::{Epoch, Publication, Stamp, TileEncoder, Version},
};

#[test]
fn tiles_too_many_to_list_are_all_requested() {
    let mut places: [FusedTile; 16] = core::array::from_fn(|_| FusedTile::FREE);
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
            assert_eq!(map.update(Layer::Fused, &out[..len], |_| ()), Ok(()));
        }
        let mut buffer = [0u8; 60];
        let mut writer = Writer::new(&mut buffer);
        assert!(map.push_request(&mut writer) && !map.push_request(&mut writer));
        let len = writer.len();
        let message = Messages::<ToServer>::new(&buffer[..len]).next().unwrap().unwrap();
        message.decode::<Request>().unwrap().tiles.len()
    };
    assert_eq!((asked(8), asked(9), asked(3)), (8, 0, 3));
}

/// A restarted server may use the epoch of an earlier run again, and reach the same versions
/// with other cells.
#[test]
fn a_tile_in_any_other_state_than_the_servers_is_replaced() {
    let (old, new) = (Tile::UNKNOWN, Tile { low: [5; TILE_SIDE], ..Tile::UNKNOWN });
    let id = TileId { x: 0, y: -1 };
    for (layer, version) in
        [Layer::Fused, Layer::Coverage].into_iter().flat_map(|it| [3, 7, 9].map(|v| (it, v)))
    {
        let mut places = [FusedTile::FREE; 4];
        let mut map = FusedMap::new(&mut places);
        map.begin_session(Epoch(7));
        map.follow(Pose::default(), Millimetres(50));
        whole_version(layer, id, 7, &old, &mut map);
        // The robot would ignore a lower version as stale.
        let stamp = Stamp { epoch: Epoch(7), version: Version(version) };
        let digest = TileDigest { id, stamp, hash: tile_hash(&new) };
        map.compare(&Digests { layer, tiles: core::iter::once(digest).collect() }, |_| ());
        let mut buffer = [0u8; 60];
        assert!(map.push_request(&mut Writer::new(&mut buffer)), "version {version}");
        whole_version(layer, id, version, &new, &mut map);
        let (_, held) = map.tiles(layer).find(|(held, _)| *held == id).unwrap();
        assert_eq!((held.stamp(), held.tile()), (stamp, &new), "version {version}");
        map.compare(&Digests { layer, tiles: core::iter::once(digest).collect() }, |_| ());
        assert!(!map.push_request(&mut Writer::new(&mut buffer)), "now they agree");
    }
}

const SECOND: u64 = 1_000_000;

fn whole(layer: Layer, id: TileId, cells: &Tile, map: &mut FusedMap<'_>) {
    whole_version(layer, id, 1, cells, map);
}

fn whole_version(layer: Layer, id: TileId, version: u32, cells: &Tile, map: &mut FusedMap<'_>) {
    let mut out = [0u8; 300];
    let mut encoder = TileEncoder::new(&mut out);
    let stamp = Stamp { epoch: Epoch(7), version: Version(version) };
    encoder.push(id, stamp, None, 0, &Tile::UNKNOWN, cells).unwrap();
    let len = encoder.finish().unwrap();
    assert_eq!(map.update(layer, &out[..len], |_| ()), Ok(()));
}

#[test]
fn coverage_is_fresh_for_a_second_after_its_confirmation() {
    let mut places = [FusedTile::FREE; 4];
    let mut map = FusedMap::new(&mut places);
    map.begin_session(Epoch(7));
    map.follow(Pose::default(), Millimetres(50));
    let id = TileId { x: 0, y: -1 };
    let mut cells = Tile::UNKNOWN;
    cells.set(5, 6, ubimap_protocol::tile::Cell::Free);
    whole(Layer::Coverage, id, &cells, &mut map);
    let covered = |map: &FusedMap<'_>, millis: u64| {
        map.around(id, Instant(millis * 1_000)).covered.map(|rows| rows[6])
    };
    assert_eq!(covered(&map, 3_000), None, "not confirmed yet");
    // The window is (-1, -1) to (0, 0).
    let confirm = |map: &mut FusedMap<'_>, interest: u32, tiles: u8, at: u64| {
        let tiles = core::iter::once(tiles).collect();
        let freshness = Freshness { time: Instant(0), interest, first: 0, tiles };
        map.confirm(&freshness, Instant(at));
    };
    confirm(&mut map, 1, 0b1101, 3 * SECOND);
    confirm(&mut map, 2, 0b1111, 3 * SECOND);
    assert_eq!(covered(&map, 3_000), None, "another tile, another window");
    confirm(&mut map, 1, 0b0010, 3 * SECOND);
    confirm(&mut map, 1, 0b0010, 2 * SECOND);
    confirm(&mut map, 1, 0b0000, 4 * SECOND);
    for (millis, expected) in [(3_000, Some(1 << 5)), (3_990, Some(1 << 5)), (4_010, None)] {
        assert_eq!(covered(&map, millis), expected, "at {millis}");
    }
    assert_eq!(map.tile(id), None, "the fused tile is not held");
    confirm(&mut map, 1, 0b0010, 5 * SECOND);
    assert_eq!(covered(&map, 5_900), Some(1 << 5), "confirmed again");
    map.begin_session(Epoch(8));
    assert_eq!(covered(&map, 5_000), None, "another epoch of the server");
}

proptest::proptest! {
    /// Wherever the robot goes, exactly the tiles of its window are held.
    #[test]
    fn a_window_holds_exactly_its_tiles(
        places in 0usize..40,
        steps in proptest::collection::vec((-20_000i32..20_000, -20_000i32..20_000), 1..12),
    ) {
        let mut places = std::vec![FusedTile::FREE; places];
        let mut map = FusedMap::new(&mut places);
        map.begin_session(Epoch(7));
        let mut held = std::collections::BTreeSet::new();
        for (x, y) in steps {
            map.follow(Pose { x: Millimetres(x), y: Millimetres(y), ..Pose::default() }, Millimetres(50));
            let Some(interest) = map.interest() else { continue };
            held.retain(|&(_, x, y)| interest.contains(TileId { x, y }));
            let corners = [interest.from, interest.to, TileId { x: 0, y: 0 }];
            for (layer, id) in corners.into_iter().flat_map(|id| [(Layer::Fused, id), (Layer::Coverage, id)]) {
                let mut cells = Tile::UNKNOWN;
                cells.low[3] = id.x as u32;
                cells.low[4] = id.y as u32;
                whole(layer, id, &cells, &mut map);
                if interest.contains(id) {
                    held.insert((layer == Layer::Fused, id.x, id.y));
                }
            }
            let found = [Layer::Fused, Layer::Coverage].into_iter().flat_map(|layer| {
                map.tiles(layer).map(move |(id, replica)| {
                    let tile = replica.tile();
                    assert_eq!((tile.low[3], tile.low[4]), (id.x as u32, id.y as u32));
                    (layer == Layer::Fused, id.x, id.y)
                })
            });
            proptest::prop_assert_eq!(&found.collect::<std::collections::BTreeSet<_>>(), &held);
        }
    }
}

fn update_of(fill: impl FnOnce(&mut TileEncoder<'_>) -> Option<u16>) -> std::vec::Vec<u8> {
    let mut out = [0u8; 60];
    let mut encoder = TileEncoder::new(&mut out);
    fill(&mut encoder).unwrap();
    let len = encoder.finish().unwrap();
    out[..len].to_vec()
}

const fn stamp(epoch: u32, version: u32) -> Stamp {
    Stamp { epoch: Epoch(epoch), version: Version(version) }
}

/// All requests that the map has to send, in frames of `room` bytes.
fn requests(map: &mut FusedMap<'_>, room: usize) -> std::vec::Vec<Request> {
    let mut requests = std::vec::Vec::new();
    loop {
        let mut buffer = [0u8; 60];
        let mut writer = Writer::new(&mut buffer[..room]);
        if !map.push_request(&mut writer) {
            assert!(writer.is_empty());
            return requests;
        }
        let len = writer.len();
        for message in Messages::<ToServer>::new(&buffer[..len]) {
            requests.push(message.unwrap().decode().unwrap());
        }
    }
}

fn request(layer: Layer, tiles: &[TileId]) -> Request {
    Request { layer, tiles: tiles.iter().copied().collect() }
}

const BOTH: [Layer; 2] = [Layer::Fused, Layer::Coverage];
/// The tiles of a window of two by two tiles around the origin.
const WINDOW: [TileId; 4] = [
    TileId { x: -1, y: -1 },
    TileId { x: 0, y: -1 },
    TileId { x: -1, y: 0 },
    TileId { x: 0, y: 0 },
];

/// A map with the window [`WINDOW`], in the server's epoch 7.
fn map_of(places: &mut [FusedTile]) -> FusedMap<'_> {
    let mut map = FusedMap::new(places);
    map.begin_session(Epoch(7));
    map.follow(Pose::default(), Millimetres(50));
    map
}

/// A coverage tile with the cells `low` in row `y`, and none elsewhere.
fn row(y: usize, low: u32) -> Tile {
    let mut tile = Tile::UNKNOWN;
    tile.low[y] = low;
    tile
}

fn held(map: &FusedMap<'_>, layer: Layer, id: TileId) -> Option<Replica> {
    map.tiles(layer).find(|(held, _)| *held == id).map(|(_, replica)| replica)
}

#[test]
fn an_update_upon_other_cells_voids_all_tiles_of_its_layer() {
    let upon = |old: &Tile| {
        let base = Some(Version(1));
        update_of(|encoder| encoder.push(WINDOW[1], stamp(7, 2), base, 0, old, &row(3, 7)))
    };
    // Decoded against other cells, the update may read as anything: as its end, as further tiles or
    // as an error.
    for wrong in (0..100).filter(|&wrong| wrong != 5) {
        for (layer, other) in [(BOTH[0], BOTH[1]), (BOTH[1], BOTH[0])] {
            let mut places = [FusedTile::FREE; 4];
            let mut map = map_of(&mut places);
            for id in WINDOW {
                BOTH.iter().for_each(|&layer| whole(layer, id, &row(3, 5), &mut map));
            }
            assert_eq!(map.update(layer, &upon(&row(3, wrong)), |_| ()), Ok(()));
            assert_eq!((map.tiles(layer).count(), map.tiles(other).count()), (0, 4), "{wrong}");
            assert_eq!(requests(&mut map, 60), [request(layer, &[])]);
            whole_version(layer, WINDOW[1], 1, &row(3, 5), &mut map);
            assert_eq!(map.update(layer, &upon(&row(3, 5)), |_| ()), Ok(()));
            assert_eq!(held(&map, layer, WINDOW[1]).unwrap().tile(), &row(3, 7));
            assert_eq!(requests(&mut map, 60), []);
        }
    }
}

#[test]
fn a_tile_without_its_base_is_requested_and_those_before_it_are_kept() {
    let mut places = [FusedTile::FREE; 4];
    let mut map = map_of(&mut places);
    let coded = update_of(|encoder| {
        encoder.push(WINDOW[2], stamp(7, 4), None, 0, &Tile::UNKNOWN, &row(1, 9))?;
        encoder.push(WINDOW[1], stamp(7, 4), Some(Version(3)), 0, &row(3, 1), &row(3, 3))?;
        encoder.push(WINDOW[3], stamp(7, 4), None, 0, &Tile::UNKNOWN, &row(1, 9))
    });
    for layer in BOTH {
        assert_eq!(map.update(layer, &coded, |_| ()), Ok(()));
        assert_eq!(map.tiles(layer).map(|(id, _)| id).collect::<std::vec::Vec<_>>(), [WINDOW[2]]);
        assert_eq!(requests(&mut map, 60), [request(layer, &[WINDOW[1]])]);
    }
    assert_eq!(map.update(Layer::Fused, &[0xFF; 3], |_| ()), Err(TileError::Malformed));
    assert_eq!(map.tiles(Layer::Fused).count(), 1);
}

#[test]
fn whole_tiles_of_another_epoch_or_outside_the_window_are_skipped() {
    let mut places = [FusedTile::FREE; 4];
    let mut map = map_of(&mut places);
    let coded = update_of(|encoder| {
        encoder.push(WINDOW[0], stamp(6, 4), None, 0, &Tile::UNKNOWN, &row(1, 9))?;
        let outside = TileId { x: 1, y: 0 };
        encoder.push(outside, stamp(7, 4), None, 0, &Tile::UNKNOWN, &row(1, 9))?;
        encoder.push(WINDOW[1], stamp(7, 4), None, 0, &Tile::UNKNOWN, &row(1, 9))
    });
    for layer in BOTH {
        assert_eq!(map.update(layer, &coded, |_| ()), Ok(()));
        assert_eq!(map.tiles(layer).map(|(id, _)| id).collect::<std::vec::Vec<_>>(), [WINDOW[1]]);
        assert_eq!(held(&map, layer, WINDOW[1]).unwrap().stamp(), stamp(7, 4));
    }
    assert_eq!(requests(&mut map, 60), []);
    map.begin_session(Epoch(7));
    assert_eq!(map.tiles(Layer::Fused).count(), 1, "the same server still holds them");
    map.begin_session(Epoch(8));
    assert!(BOTH.iter().all(|&layer| map.tiles(layer).count() == 0));
}

#[test]
fn a_tile_in_parts_is_not_used_until_it_is_complete() {
    let mut noise = Tile::UNKNOWN;
    for y in 0..TILE_SIDE {
        noise.low[y] = 0x9E37_79B9u32.wrapping_mul(y as u32 + 1);
    }
    let id = WINDOW[1];
    for layer in BOTH {
        let mut places = [FusedTile::FREE; 4];
        let mut map = map_of(&mut places);
        let mut sender = ubimap_protocol::tile::Publication::NOTHING;
        let mut parts = 0;
        while !sender.is_acknowledged() {
            parts += 1;
            let coded = update_of(|encoder| {
                let mut cells = noise;
                sender.push(encoder, id, Epoch(7), Version(5), &mut cells, 1).then_some(1)
            });
            sender.acknowledge(1);
            assert_eq!(map.update(layer, &coded, |_| ()), Ok(()));
            let freshness = Freshness {
                time: Instant(0),
                interest: 1,
                first: 1,
                tiles: core::iter::once(1).collect(),
            };
            map.confirm(&freshness, Instant(3 * SECOND));
            let is_complete = sender.is_acknowledged();
            assert_eq!(held(&map, layer, id).unwrap().is_partial(), !is_complete);
            let around = map.around(id, Instant(3 * SECOND));
            assert_eq!(around.merged.is_some(), is_complete && layer == Layer::Fused);
            assert_eq!(around.covered.is_some(), is_complete && layer == Layer::Coverage);
            assert!(around.merged.is_none_or(|tile| *tile == noise));
            assert!(around.covered.is_none_or(|rows| *rows == noise.low));
        }
        assert!(parts > 2);
        assert_eq!(requests(&mut map, 60), []);
    }
}

#[test]
fn requests_that_do_not_fit_wait_for_the_next_frame() {
    let mut places = [FusedTile::FREE; 4];
    let mut map = map_of(&mut places);
    for layer in BOTH {
        for id in [WINDOW[0], WINDOW[1], WINDOW[2], WINDOW[0]] {
            let coded = update_of(|encoder| {
                encoder.push(id, stamp(7, 4), Some(Version(3)), 0, &Tile::UNKNOWN, &row(1, 9))
            });
            assert_eq!(map.update(layer, &coded, |_| ()), Ok(()));
        }
    }
    // Three bytes for kind and length, two for layer and count, two for each tile.
    assert_eq!(requests(&mut map, 6), []);
    let expected = BOTH.map(|it| [request(it, &WINDOW[..2]), request(it, &WINDOW[2..3])]).concat();
    assert_eq!(requests(&mut map, 9), expected);
    assert_eq!(requests(&mut map, 60), [], "each tile is requested once");
    map.missing[0].all = true;
    assert_eq!(requests(&mut map, 4), []);
    assert_eq!(requests(&mut map, 5), [request(Layer::Fused, &[])]);
    map.missing[0].all = true;
    map.begin_session(Epoch(7));
    assert_eq!(requests(&mut map, 60), [], "the server sends all of them in a new session");
}

#[test]
fn the_window_moves_by_steps_when_the_robot_nears_its_edge() {
    let mut places = std::vec![FusedTile::FREE; 170];
    // Tiles are 1.6 m wide. A step: the robot's x, then the number and the south-western x of the
    // window. A case: the number of places and its steps.
    type Step = (i32, u32, i16);
    let cases: [(usize, &[Step]); 4] = [
        (16, &[(0, 1, -2), (2_399, 1, -2), (2_400, 2, 0), (800, 2, 0), (799, 3, -2)]),
        (17, &[(800, 1, -1), (-2_400, 2, -3), (799, 2, -3), (800, 3, -1)]),
        (170, &[(0, 1, -6), (4_799, 1, -6), (4_800, 2, -3), (1_600, 2, -3), (1_599, 3, -6)]),
        (4, &[(i32::MAX, 1, i16::MAX), (i32::MIN, 2, i16::MIN)]),
    ];
    for (capacity, steps) in cases {
        for is_y in [false, true] {
            let mut map = FusedMap::new(&mut places[..capacity]);
            assert_eq!(map.capacity(), capacity);
            let side = (1..=13).rfind(|side| side * side <= capacity).unwrap() as i32;
            for &(at, number, from) in steps {
                let (x, y) = if is_y { (0, at) } else { (at, 0) };
                let pose = Pose { x: Millimetres(x), y: Millimetres(y), ..Pose::default() };
                map.follow(pose, Millimetres(50));
                let interest = map.interest().unwrap();
                let (first, last) = match is_y {
                    true => (interest.from.y, interest.to.y),
                    false => (interest.from.x, interest.to.x),
                };
                assert_eq!((interest.number, first), (number, from), "{capacity} {at}");
                let last_expected = (i32::from(from) + side - 1).min(i32::from(i16::MAX));
                assert_eq!(i32::from(last), last_expected);
            }
        }
    }
    let mut none = FusedMap::new(&mut []);
    none.follow(Pose::default(), Millimetres(50));
    assert_eq!(none.interest(), None);
}

#[test]
fn a_window_is_told_once_in_each_session() {
    let mut places = [FusedTile::FREE; 4];
    let mut map = FusedMap::new(&mut places);
    assert_eq!(map.untold(), None);
    map.follow(Pose::default(), Millimetres(50));
    assert_eq!(map.untold(), map.interest());
    map.told(1);
    assert_eq!(map.untold(), None);
    map.follow(Pose { x: Millimetres(9_000), ..Pose::default() }, Millimetres(50));
    assert_eq!(map.untold().map(|interest| interest.number), Some(2));
    map.told(2);
    map.told(1);
    assert_eq!(map.untold(), None, "an older window was acknowledged late");
    map.begin_session(Epoch(7));
    assert_eq!(map.untold(), map.interest());
}

#[test]
fn only_tiles_that_differ_are_dropped() {
    let mut places = [FusedTile::FREE; 4];
    let mut map = map_of(&mut places);
    for layer in BOTH {
        WINDOW[..2].iter().for_each(|&id| whole(layer, id, &row(3, 5), &mut map));
        let digest =
            |id: TileId, tile: &Tile| TileDigest { id, stamp: stamp(7, 1), hash: tile_hash(tile) };
        let outside = TileId { x: 5, y: 5 };
        let told = [(WINDOW[0], 5), (WINDOW[1], 6), (WINDOW[2], 5), (outside, 5)];
        let tiles = told.into_iter().map(|(id, low)| digest(id, &row(3, low))).collect();
        let mut dropped = std::vec::Vec::new();
        map.compare(&Digests { layer, tiles }, |id| dropped.push(id));
        assert_eq!(dropped, WINDOW[1..3]);
        assert_eq!(requests(&mut map, 60), [request(layer, &WINDOW[1..3])]);
        assert!(held(&map, layer, WINDOW[0]).is_some() && held(&map, layer, WINDOW[1]).is_none());
    }
    assert_eq!(map.tile(WINDOW[0]), Some(&row(3, 5)), "the other layer is kept");
}

/// A restarted server may use the epoch of an earlier run again and send a tile in parts: the first
/// part is skipped as stale, so the second one has no base.
#[test]
fn a_tile_of_an_earlier_life_does_not_shut_out_one_that_comes_in_parts() {
    let of = |seed: u32| {
        let row = |y: usize| (y as u32 + seed).wrapping_mul(0x9E37_79B9);
        Tile { low: core::array::from_fn(row), ..Tile::UNKNOWN }
    };
    let id = TileId { x: 0, y: -1 };
    let mut places = [FusedTile::FREE; 4];
    let mut map = FusedMap::new(&mut places);
    map.begin_session(Epoch(7));
    map.follow(Pose::default(), Millimetres(50));
    let mut out = [0u8; 600];
    let mut dropped = 0;
    let mut send = |publication: &mut Publication, version: u32, frame: u16, room: usize| {
        let mut encoder = TileEncoder::new(&mut out[..room]);
        let mut new = of(version);
        assert!(publication.push(&mut encoder, id, Epoch(7), Version(version), &mut new, frame));
        publication.acknowledge(frame);
        let len = encoder.finish().unwrap();
        assert_eq!(map.update(Layer::Fused, &out[..len], |_| dropped += 1), Ok(()));
        map.missing.iter_mut().any(|missing| !core::mem::take(&mut missing.tiles).is_empty())
    };
    assert!(!send(&mut Publication::default(), 9, 1, 600));
    let mut publication = Publication::NOTHING;
    let mut requests = 0;
    for frame in 2..100 {
        if publication.is_acknowledged() {
            break;
        }
        if send(&mut publication, 2, frame, 60) {
            requests += 1;
            publication.forget();
        }
    }
    assert!(publication.is_acknowledged());
    assert_eq!((requests, dropped), (1, 1));
    assert_eq!(map.tile(id), Some(&of(2)));
}
