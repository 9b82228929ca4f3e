use super::*;
use crate::{
    map::{LocalMap, MappingConfig, Policy, RowSighting},
    sense::Validity,
    share::FusedTile,
};
use ubimap_protocol::{
    message::Messages,
    tile::{Applied, Replica, TileDecoder},
    units::{Millimetres, Pose},
};

/// Sends version 1 of an empty tile in a frame, and acknowledges it.
fn acknowledge(pool: &mut Pool<'_>, id: TileId, frame: u16) {
    let tile = pool.find_or_begin(id, 1).unwrap();
    let mut buffer = [0; 64];
    let mut encoder = TileEncoder::new(&mut buffer);
    let mut cells = Tile::UNKNOWN;
    let version = Version(1);
    assert!(tile.publication.push(&mut encoder, id, Epoch(1), version, &mut cells, frame));
    assert!(tile.publication.acknowledge(frame));
}

/// A pool of tiles that the server has acknowledged.
fn acknowledged(places: &mut [OwnTile]) -> Pool<'_> {
    let mut pool = Pool::new(places);
    [1, 2, 3].into_iter().for_each(|x| acknowledge(&mut pool, TileId { x, y: 0 }, 7));
    pool
}

#[test]
fn the_digests_of_all_tiles_take_turns_in_small_frames() {
    let mut places = [OwnTile::FREE; 3];
    let pool = acknowledged(&mut places);
    let mut publisher = Publisher::new(Duration(0));
    let mut tell = |room: usize, alone: bool, now: Instant| {
        let mut buffer = [0u8; 60];
        let mut writer = Writer::new(&mut buffer[..room]);
        publisher.push_digests(&pool, &mut writer, alone, now);
        let len = writer.len();
        let message = Messages::<ToServer>::new(&buffer[..len]).next()?.unwrap();
        let digests = message.decode::<Digests>().unwrap();
        Some(digests.tiles.iter().map(|it| it.id.x).collect::<std::vec::Vec<_>>())
    };
    let mut now = Instant(0);
    assert_eq!(tell(60, true, now), Some(std::vec![1, 2]));
    assert_eq!(tell(60, true, now), None);
    for x in [3, 1, 2, 3] {
        now = now + DIGEST_INTERVAL;
        assert_eq!(tell(8, false, now), None, "there is no room beside others");
        assert_eq!(tell(16, true, now), Some(std::vec![x]));
    }
}

#[test]
fn a_request_for_one_tile_sends_all_tiles_of_its_frame_again() {
    let mut places = [OwnTile::FREE; 5];
    let mut pool = acknowledged(&mut places);
    acknowledge(&mut pool, TileId { x: 4, y: 0 }, 8);
    // Tile 5 is in the pool, but agreed with the server's map and was never sent.
    pool.find_or_begin(TileId { x: 5, y: 0 }, 1).unwrap();
    let mut publisher = Publisher::new(Duration(0));
    let mut requested = |id: Option<TileId>| {
        pool.tiles_mut().for_each(|tile| tile.dirty = false);
        publisher.waiting_since = None;
        publisher.requested(&mut pool, id, Instant(9));
        let again = pool.tiles().filter(|tile| tile.dirty);
        let again: std::vec::Vec<_> = again
            .inspect(|tile| assert!(tile.publication.differs(&Tile::UNKNOWN)))
            .map(|tile| tile.id.unwrap().x)
            .collect();
        assert_eq!(publisher.poll_timeout(), (!again.is_empty()).then_some(Instant(9)));
        again
    };
    let named = |x: i16| Some(TileId { x, y: 0 });
    assert_eq!(requested(named(2)), [1, 2, 3]);
    assert_eq!(requested(named(4)), [4]);
    assert_eq!(requested(named(5)), [5]);
    assert_eq!(requested(named(6)), [], "a tile that is not in the pool");
    assert_eq!(requested(None), [1, 2, 3, 4, 5]);
}

#[test]
fn a_change_made_while_the_tile_is_in_flight_is_sent_after_the_acknowledgement() {
    const ID: TileId = TileId { x: 0, y: 0 };
    let mut places = [OwnTile::FREE; 1];
    let mut pool = Pool::new(&mut places);
    let merged = FusedMap::new(&mut []);
    let mut publisher = Publisher::new(Duration(100));
    let mut server = Replica::default();
    let see = |pool: &mut Pool<'_>, publisher: &mut Publisher, y: usize, now: Instant| {
        let tile = pool.find_or_begin(ID, 1).unwrap();
        tile.evidence.add(y, [RowSighting { free: 1 << y, hit: 0 }].into_iter());
        tile.dirty = true;
        publisher.changed(now, None);
    };
    let mut send = |pool: &mut Pool<'_>, publisher: &mut Publisher, now: Instant| {
        let mut buffer = [0u8; 100];
        let mut writer = Writer::new(&mut buffer);
        let frame = publisher.fill(pool, &merged, &mut writer, now)?;
        let len = writer.len();
        let message = Messages::<ToServer>::new(&buffer[..len]).next().unwrap().unwrap();
        let (_, coded) = message.split::<TileUpdateHead>().unwrap();
        let mut decoder = TileDecoder::new(coded);
        let header = decoder.header().unwrap().unwrap();
        assert_eq!(server.apply(&header, &mut decoder), Ok(Applied::Complete));
        assert_eq!(decoder.header(), Ok(None));
        Some((frame, *server.tile()))
    };
    see(&mut pool, &mut publisher, 0, Instant(0));
    assert_eq!(send(&mut pool, &mut publisher, Instant(99)), None, "changes are gathered");
    let (first, _) = send(&mut pool, &mut publisher, Instant(100)).unwrap();
    see(&mut pool, &mut publisher, 1, Instant(110));
    assert_eq!(send(&mut pool, &mut publisher, Instant(300)), None, "one update is in flight");
    publisher.acknowledged(&mut pool, &merged, first, Instant(400));
    assert_eq!(publisher.poll_timeout(), Some(Instant(500)));
    let (second, cells) = send(&mut pool, &mut publisher, Instant(500)).unwrap();
    assert_eq!(cells, pool.find(ID).unwrap().cells());
    publisher.acknowledged(&mut pool, &merged, second, Instant(600));
    assert!(!pool.find(ID).unwrap().dirty, "its place may be used for another tile");
    assert_eq!(send(&mut pool, &mut publisher, Instant(900)), None, "nothing is left");
    assert_eq!(publisher.poll_timeout(), None);
}

#[test]
fn times_of_one_servers_clock_are_not_sent_to_another() {
    let mut places = [OwnTile::FREE; 1];
    let mut pool = Pool::new(&mut places);
    let merged = FusedMap::new(&mut []);
    let mut publisher = Publisher::new(Duration(0));
    let tile = pool.find_or_begin(TileId { x: 0, y: 0 }, 1).unwrap();
    tile.evidence.add(0, [RowSighting { free: 1, hit: 0 }].into_iter());
    tile.dirty = true;
    publisher.changed(Instant(0), Some(7_000));
    let told = |publisher: &mut Publisher, pool: &mut Pool<'_>| {
        let mut buffer = [0u8; 100];
        let mut writer = Writer::new(&mut buffer);
        publisher.fill(pool, &merged, &mut writer, Instant(9)).unwrap();
        let len = writer.len();
        let message = Messages::<ToServer>::new(&buffer[..len]).next().unwrap().unwrap();
        message.decode::<TileUpdateHead>().unwrap().seconds
    };
    assert_eq!(told(&mut publisher, &mut pool), 7_000);
    publisher.begin_session(&mut pool, true, Instant(9));
    assert_eq!(told(&mut publisher, &mut pool), 7_000);
    publisher.begin_session(&mut pool, false, Instant(9));
    assert_eq!(told(&mut publisher, &mut pool), 0);
}

#[test]
fn only_hits_close_in_time_contradict_the_map() {
    let mut places = [FusedTile::FREE; 4];
    let mut merged = FusedMap::new(&mut places);
    merged.begin_session(Epoch(7));
    merged.follow(Pose::default(), Millimetres(50));
    let id = TileId { x: 0, y: 0 };
    let free = Tile { low: [u32::MAX; TILE_SIDE], ..Tile::UNKNOWN };
    let mut out = [0; 60];
    let mut encoder = TileEncoder::new(&mut out);
    let stamp = Stamp { epoch: Epoch(7), version: Version(1) };
    encoder.push(id, stamp, None, 0, &Tile::UNKNOWN, &free).unwrap();
    let len = encoder.finish().unwrap();
    assert_eq!(merged.update(Layer::Fused, &out[..len], |_| ()), Ok(()));

    let mut places = [OwnTile::FREE; 1];
    let config = MappingConfig {
        resolution: Millimetres(50),
        max_range: 4_000,
        near: 700,
        mounting: Pose::default(),
        validity: Validity::default(),
        policy: Policy::default(),
    };
    let mut map = LocalMap::new(config, &[], &mut [], Pool::new(&mut places));
    // The number of cells to send after ten hits.
    let mut told = |apart: Duration| {
        map.pool.begin_anew(Epoch(0));
        for hit in 1..=10 {
            let tile = map.pool.find_or_begin(id, 1).unwrap();
            let sighting = RowSighting { free: 0, hit: 1 };
            tile.evidence.add_beside(3, [sighting].into_iter(), merged.tile(id).unwrap());
            map.timeout(Instant(hit * apart.micros()), |id| merged.tile(id));
        }
        news(map.pool.find(id).unwrap(), merged.tile(id)).row(3).high
    };
    assert_eq!(told(Duration::from_millis(100)), 1);
    assert_eq!(told(Duration::from_secs(60)), 0);
}

/// Observes the cells `free` in one row of a tile, and reports the change at `now`.
fn see(pool: &mut Pool<'_>, publisher: &mut Publisher, id: TileId, free: u32, now: Instant) {
    let tile = pool.find_or_begin(id, 1).unwrap();
    tile.evidence.add(7, [RowSighting { free, hit: 0 }].into_iter());
    tile.dirty = true;
    publisher.changed(now, None);
}

/// The tiles that a server holds.
type Held = std::collections::BTreeMap<TileId, Replica>;

/// Fills a frame of `room` bytes and applies it to `server`. Returns the number of the frame and
/// the ids of its tiles.
fn sent(
    pool: &mut Pool<'_>,
    publisher: &mut Publisher,
    server: &mut Held,
    room: usize,
    now: Instant,
) -> Option<(u16, std::vec::Vec<TileId>)> {
    let mut buffer = [0u8; 100];
    let mut writer = Writer::new(&mut buffer[..room]);
    let frame = publisher.fill(pool, &FusedMap::new(&mut []), &mut writer, now);
    let len = writer.len();
    assert_eq!(frame.is_some(), len > 0);
    let message = Messages::<ToServer>::new(&buffer[..len]).next()?.unwrap();
    let (head, coded) = message.split::<TileUpdateHead>().unwrap();
    assert_eq!(head.layer, Layer::Robot);
    let mut decoder = TileDecoder::new(coded);
    let mut ids = std::vec::Vec::new();
    while let Some(header) = decoder.header().unwrap() {
        server.entry(header.id).or_default().apply(&header, &mut decoder).unwrap();
        ids.push(header.id);
    }
    Some((frame?, ids))
}

#[test]
fn changes_are_gathered_unless_an_event_hurries_them() {
    let mut publisher = Publisher::new(Duration(100));
    assert_eq!(publisher.poll_timeout(), None);
    publisher.changed(Instant(40), Some(5));
    publisher.changed(Instant(60), None);
    assert_eq!((publisher.poll_timeout(), publisher.newest_scan), (Some(Instant(140)), 5));
    publisher.set_hold(Duration(30));
    assert_eq!(publisher.poll_timeout(), Some(Instant(70)));
    publisher.hurry(Instant(40));
    assert_eq!(publisher.poll_timeout(), Some(Instant(70)), "the change was not before it");
    publisher.hurry(Instant(41));
    assert_eq!(publisher.poll_timeout(), Some(Instant(40)));
}

#[test]
fn tiles_travel_in_order_of_their_ids_and_the_rest_in_the_next_frame() {
    let mut places = [OwnTile::FREE; 5];
    let mut pool = Pool::new(&mut places);
    let mut publisher = Publisher::new(Duration(0));
    let mut server = Held::default();
    let id = |x: i16, y: i16| TileId { x, y };
    for id in [id(2, 1), id(-3, 5), id(2, 0), id(-3, 4)] {
        see(&mut pool, &mut publisher, id, 0x5A5A_0F33, Instant(5));
    }
    assert_eq!(
        sent(&mut pool, &mut publisher, &mut server, 9, Instant(5)),
        None,
        "no room beside others"
    );
    assert_eq!(publisher.poll_timeout(), Some(Instant(5)), "so it stays due");
    let mut order: std::vec::Vec<TileId> = pool.tiles().filter_map(|tile| tile.id).collect();
    order.sort_unstable();
    let (first, ids) = sent(&mut pool, &mut publisher, &mut server, 30, Instant(5)).unwrap();
    assert!((1..4).contains(&ids.len()), "{ids:?}");
    assert_eq!(ids, order[..ids.len()]);
    let (second, rest) = sent(&mut pool, &mut publisher, &mut server, 100, Instant(5)).unwrap();
    assert_eq!(rest, order[ids.len()..]);
    assert_eq!(second, first + 1);
    assert_eq!(
        sent(&mut pool, &mut publisher, &mut server, 100, Instant(5)),
        None,
        "all are in flight"
    );
    let merged = FusedMap::new(&mut []);
    publisher.acknowledged(&mut pool, &merged, second, Instant(6));
    let safe = |pool: &Pool<'_>| pool.tiles().filter(|tile| !tile.dirty).count();
    assert_eq!(safe(&pool), rest.len());
    publisher.acknowledged(&mut pool, &merged, first, Instant(6));
    assert_eq!((safe(&pool), publisher.poll_timeout()), (4, None));
}

#[test]
fn parts_follow_each_other_without_delay() {
    const ID: TileId = TileId { x: 0, y: 0 };
    let mut places = [OwnTile::FREE; 1];
    let mut pool = Pool::new(&mut places);
    let merged = FusedMap::new(&mut []);
    let mut publisher = Publisher::new(Duration(1_000));
    let mut server = Held::default();
    let rows = (1..=32u32).map(|y| RowSighting { free: 0x9E37_79B9u32.wrapping_mul(y), hit: 0 });
    let tile = pool.find_or_begin(ID, 1).unwrap();
    tile.evidence.add(0, rows);
    tile.dirty = true;
    publisher.changed(Instant(0), None);
    let mut now = Instant(1_000);
    let mut parts = 0;
    while let Some((frame, ids)) = sent(&mut pool, &mut publisher, &mut server, 60, now) {
        assert_eq!(ids, [ID]);
        parts += 1;
        now = now + Duration(50);
        assert_eq!(
            sent(&mut pool, &mut publisher, &mut server, 60, now),
            None,
            "one part is in flight"
        );
        publisher.acknowledged(&mut pool, &merged, frame, now);
        let is_last = pool.find(ID).unwrap().publication.is_acknowledged();
        assert_eq!(publisher.poll_timeout(), (!is_last).then_some(now));
    }
    assert!(parts > 2);
    assert_eq!(server[&ID].tile(), &pool.find(ID).unwrap().cells());
}

#[test]
fn a_session_sends_again_what_the_server_may_lack() {
    for same_server in [true, false] {
        let mut places = [OwnTile::FREE; 5];
        let mut pool = acknowledged(&mut places);
        let mut publisher = Publisher::new(Duration(0));
        let mut server = Held::default();
        publisher.begin_session(&mut pool, same_server, Instant(3));
        let again = pool.tiles().filter(|tile| tile.dirty).count();
        assert_eq!(again, if same_server { 0 } else { 3 });
        assert_eq!(publisher.poll_timeout(), (!same_server).then_some(Instant(3)));
        let id = TileId { x: 9, y: 0 };
        see(&mut pool, &mut publisher, id, 1, Instant(4));
        assert!(sent(&mut pool, &mut publisher, &mut server, 100, Instant(4)).is_some());
        assert_eq!(
            sent(&mut pool, &mut publisher, &mut server, 100, Instant(4)),
            None,
            "it is in flight"
        );
        publisher.begin_session(&mut pool, same_server, Instant(5));
        assert_eq!(publisher.poll_timeout(), Some(Instant(5)));
        let (_, ids) = sent(&mut pool, &mut publisher, &mut server, 100, Instant(5)).unwrap();
        assert_eq!(ids.last(), Some(&id), "it was lost with its session");
    }
}

#[test]
fn digests_are_due_every_ten_seconds() {
    let mut places = [OwnTile::FREE; 3];
    let pool = acknowledged(&mut places);
    let mut nothing = [OwnTile::FREE; 1];
    let nothing = Pool::new(&mut nothing);
    let later = Instant(5) + DIGEST_INTERVAL;
    // Each case: the tiles, the room, and whether the frame is otherwise empty; then whether
    // digests are sent, and whether the next ones are due an interval later.
    for (pool, room, alone, is_sent, is_done) in [
        (&pool, 60, true, true, true),
        (&pool, 60, false, true, true),
        (&pool, 4, false, false, false),
        (&pool, 4, true, false, true),
        (&nothing, 60, false, false, true),
    ] {
        let mut publisher = Publisher::new(Duration(0));
        assert_eq!(publisher.digest_timeout(), Instant(0));
        let mut push = |room: usize, now: Instant| {
            let mut buffer = [0u8; 60];
            let mut writer = Writer::new(&mut buffer[..room]);
            publisher.push_digests(pool, &mut writer, alone, now);
            (!writer.is_empty(), publisher.digest_timeout())
        };
        let next = if is_done { later } else { Instant(0) };
        assert_eq!(push(room, Instant(5)), (is_sent, next), "{room} {alone}");
        if is_sent {
            assert_eq!(push(60, Instant(later.0 - 1)), (false, later));
            assert_eq!(push(60, later), (true, later + DIGEST_INTERVAL));
        }
    }
}

#[test]
fn digests_name_only_tiles_that_the_server_has() {
    let mut places = [OwnTile::FREE; 4];
    let mut pool = acknowledged(&mut places);
    // The first tile has changed since it was acknowledged; the last one was never sent.
    pool.tiles_mut().next().unwrap().dirty = true;
    pool.find_or_begin(TileId { x: 4, y: 0 }, 1).unwrap();
    let mut publisher = Publisher::new(Duration(0));
    let mut named = std::vec::Vec::new();
    for round in 0..3 {
        let mut buffer = [0u8; 60];
        let mut writer = Writer::new(&mut buffer);
        let now = Instant(round * DIGEST_INTERVAL.0);
        publisher.push_digests(&pool, &mut writer, true, now);
        let len = writer.len();
        for message in Messages::<ToServer>::new(&buffer[..len]) {
            let digests = message.unwrap().decode::<Digests>().unwrap();
            assert_eq!(digests.layer, Layer::Robot);
            named.extend(digests.tiles.iter().map(|digest| digest.id.x));
        }
    }
    assert_eq!(named, [2, 3, 2, 3]);
}

#[test]
fn cells_that_the_server_knows_are_left_out_until_they_were_sent() {
    let id = TileId { x: 0, y: 0 };
    let mut tile = OwnTile::FREE;
    tile.id = Some(id);
    // Free in columns 0 to 3, occupied in 4 to 7.
    for _ in 0..20 {
        tile.evidence.add(2, [RowSighting { free: 0x0F, hit: 0xF0 }].into_iter());
    }
    let own = tile.cells().row(2);
    assert_eq!((own.low, own.high), (0x0F, 0xF0));
    assert_eq!(news(&tile, None), tile.cells());
    let mut merged = Tile::UNKNOWN;
    // In the server's map, columns 0 and 4 agree, 1 and 5 are the opposite, 6 is movable, and 2, 3
    // and 7 are unknown.
    merged.set_row(2, Row { low: 0b0110_0001, high: 0b0101_0010 });
    let expected = Row { low: 0b0000_1110, high: 0b1010_0000 };
    assert_eq!(news(&tile, Some(&merged)).row(2), expected);
    // Cells that were sent before are sent again, whatever their state is now.
    let mut cells = Tile::UNKNOWN;
    // Columns 0 and 4 agree with the map, 1 and 5 do not.
    cells.set_row(2, Row { low: 0x03, high: 0x30 });
    let mut buffer = [0; 60];
    let mut encoder = TileEncoder::new(&mut buffer);
    assert!(tile.publication.push(&mut encoder, id, Epoch(1), Version(1), &mut cells, 1));
    let expected = Row { low: 0b0000_1111, high: 0b1011_0000 };
    assert_eq!(news(&tile, Some(&merged)).row(2), expected);
}
