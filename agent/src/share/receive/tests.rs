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

/// A restarted server may use the epoch of an earlier run again and cut its tiles: the first part is
/// skipped as stale, so the second one has no base.
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
