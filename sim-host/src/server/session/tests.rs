use std::collections::BTreeSet;

use ubimap_protocol::{
    frame::{MIN_VERSION, VERSION},
    message::{Digests, Freshness, Messages, TileUpdateHead, ToRobot},
    tile::{Cell, Epoch, Layer, Tile, TileDecoder},
    units::{Millimetres, Pose},
};

use super::*;
use crate::{mapping::ServedLayer, server::surroundings::Surroundings};

const ID: TileId = TileId { x: 1, y: 0 };

fn window(number: u32, west: i16) -> Interest {
    let from = TileId { x: west, y: 0 };
    Interest { number, from, to: TileId { x: west + 1, y: 1 } }
}

/// A snapshot with only a fused layer.
fn snapshot(fused: &ServedLayer) -> Snapshot<'_> {
    let (coverage, surroundings) = Box::leak(Box::default());
    Snapshot { epoch: Epoch(1), fused, coverage, surroundings }
}

/// The session of a robot with room for four tiles.
fn new_session() -> Session {
    let hello = Hello {
        version: VERSION,
        min_version: MIN_VERSION,
        robot: RobotId(1),
        nonce: 7,
        frame: 250,
        resolution: Millimetres(50),
        fused_tiles: 4,
    };
    Session::new(&hello, None, Instant(0))
}

/// Sends the due frame and acknowledges it.
fn tell(session: &mut Session, fused: &ServedLayer, now: Instant) {
    let mut buffer = [0u8; 200];
    let mut writer = Writer::new(&mut buffer);
    let filled = session.fill(&snapshot(fused), now, &mut writer, true);
    let Fill::Reliable(frame) = filled else { panic!("{filled:?}") };
    session.acknowledged(frame);
    assert!(session.is_level(&snapshot(fused)));
}

/// A session whose robot has acknowledged the only fused tile.
fn level(fused: &ServedLayer) -> Session {
    let mut session = new_session();
    session.interested(window(1, 0));
    tell(&mut session, fused, Instant(0));
    session
}

#[test]
fn long_messages_are_cut_to_small_frames() {
    let mut session = new_session();
    let far = Sighting::usual(RobotId(1), Pose::from_metres(-900.0, 900.0, 3.0));
    (0..4).for_each(|hour| session.fix(Instant((hour + 1) * 3_600_000_000), far));
    assert!((0..8).all(|x| session.ask_for(TileId { x: 30_000 + x, y: -30_000 })));
    let fused = ServedLayer::default();
    let mut frames = 0;
    let now = Instant(0);
    while session.poll_timeout(&snapshot(&fused), true, now).is_some_and(|due| due <= now) {
        let mut buffer = [0u8; 24];
        let mut writer = Writer::new(&mut buffer);
        let filled = session.fill(&snapshot(&fused), now, &mut writer, true);
        assert!(!writer.is_empty(), "{filled:?} makes no progress");
        frames += 1;
    }
    assert_eq!(frames, 1 + 3, "one frame with a fix, three with tiles");
}

#[test]
fn digests_rotate_through_all_tiles_in_small_frames() {
    let mut tile = Tile::UNKNOWN;
    tile.set(3, 3, Cell::Free);
    let mut fused = ServedLayer::default();
    let ids = window(1, 0).ids().inspect(|&id| assert!(fused.set(id, tile)));
    let ids: BTreeSet<TileId> = ids.collect();
    let mut session = new_session();
    session.interested(window(1, 0));
    tell(&mut session, &fused, Instant(0));
    let mut told = Vec::new();
    for second in 1..60 {
        let mut buffer = [0u8; 24];
        let mut writer = Writer::new(&mut buffer);
        session.fill(&snapshot(&fused), Instant(second * 1_000_000), &mut writer, true);
        let len = writer.len();
        for message in Messages::<ToRobot>::new(&buffer[..len]).map(Result::unwrap) {
            let digests = message.decode::<Digests>().unwrap();
            told.extend(digests.tiles.iter().map(|told| told.id));
        }
    }
    assert!(told.iter().take(4).eq(&ids), "{told:?}");
}

#[test]
fn a_tile_that_changed_back_is_sent_for_its_version() {
    let mut fused = ServedLayer::default();
    let (mut tile, mut other) = (Tile::UNKNOWN, Tile::UNKNOWN);
    tile.set(3, 3, Cell::Free);
    other.set(3, 3, Cell::Occupied);
    fused.set(ID, tile);
    let mut session = level(&fused);
    fused.set(ID, other);
    fused.set(ID, tile);
    tell(&mut session, &fused, Instant(0) + tiles::FUSED_HOLD);
}

#[test]
fn tiles_are_sent_again_after_a_lost_window() {
    let mut tile = Tile::UNKNOWN;
    tile.set(3, 3, Cell::Free);
    let mut fused = ServedLayer::default();
    fused.set(ID, tile);
    let mut session = level(&fused);
    session.interested(window(2, 1));
    assert!(session.is_level(&snapshot(&fused)), "the robot kept the tile");
    // The message with the third window was lost. That window may have excluded the tile.
    session.interested(window(4, 0));
    assert!(!session.is_level(&snapshot(&fused)));
    assert!(session.poll_timeout(&snapshot(&fused), true, Instant(0)).is_some());
}

/// Requests tiles of one layer in a session whose robot has all tiles of both layers.
fn request_tiles(layer: Layer) {
    let mut tile = Tile::UNKNOWN;
    tile.set(3, 3, Cell::Free);
    let (mut fused, mut coverage) = (ServedLayer::default(), ServedLayer::default());
    let ids = [ID, TileId { y: 1, ..ID }];
    ids.iter().for_each(|&id| assert!(fused.set(id, tile) && coverage.set(id, tile)));
    let surroundings = Surroundings::default();
    let snapshot = Snapshot {
        epoch: Epoch(1),
        fused: &fused,
        coverage: &coverage,
        surroundings: &surroundings,
    };
    let mut session = new_session();
    session.interested(window(1, 0));
    let mut now = Instant(0);
    // All updates that are due within five seconds; each is acknowledged.
    let mut updates = |session: &mut Session| {
        let until = now + Duration::from_secs(5);
        let mut sent = BTreeSet::new();
        while let Some(due) = session.poll_timeout(&snapshot, true, now).filter(|&it| it <= until) {
            now = due.max(now);
            let mut buffer = [0u8; 60];
            let mut writer = Writer::new(&mut buffer);
            let filled = session.fill(&snapshot, now, &mut writer, true);
            let len = writer.len();
            if let Fill::Reliable(frame) = filled {
                session.acknowledged(frame);
            }
            for message in Messages::<ToRobot>::new(&buffer[..len]).map(Result::unwrap) {
                let Ok((head, coded)) = message.split::<TileUpdateHead>() else { continue };
                let header = TileDecoder::new(coded).header().unwrap().unwrap();
                assert_eq!((header.start, header.base), (0, None), "a whole tile");
                assert!(sent.insert((u8::from(head.layer == Layer::Coverage), header.id)));
            }
        }
        now = until;
        sent
    };
    let all: BTreeSet<_> = ids.into_iter().flat_map(|id| [(0, id), (1, id)]).collect();
    assert_eq!(updates(&mut session), all);
    assert_eq!(updates(&mut session), BTreeSet::new());
    // Both tiles travelled in one frame, so a request for one of them concerns the other too.
    for asked in [&ids[..1], &ids[1..], &[]] {
        session.requested(&Request { layer, tiles: asked.iter().copied().collect() });
        let number = u8::from(layer == Layer::Coverage);
        let expected: BTreeSet<_> = ids.into_iter().map(|id| (number, id)).collect();
        assert_eq!(updates(&mut session), expected, "{asked:?}");
    }
    session.requested(&Request { layer: Layer::Robot, tiles: Default::default() });
    assert_eq!(updates(&mut session), BTreeSet::new());
}

#[test]
fn requested_fused_tiles_are_sent_whole_again() {
    request_tiles(Layer::Fused);
}

#[test]
fn requested_coverage_tiles_are_sent_whole_again() {
    request_tiles(Layer::Coverage);
}

#[test]
fn more_cameras_cause_no_more_messages() {
    let mut session = new_session();
    let fused = ServedLayer::default();
    let mut sent = Vec::new();
    for step in 0..200u64 {
        let now = Instant(step * 5_000);
        // Four cameras, each at 12.5 Hz.
        if step % 4 == 0 {
            session.fix(now, Sighting::usual(RobotId(1), Pose::default()));
        }
        let mut buffer = [0u8; 200];
        let mut writer = Writer::new(&mut buffer);
        session.fill(&snapshot(&fused), now, &mut writer, true);
        let len = writer.len();
        for message in Messages::<ToRobot>::new(&buffer[..len]) {
            let fix = message.unwrap().decode::<PoseFix>().unwrap();
            sent.push(fix.fixes().map(|(moment, _)| moment).collect::<Vec<_>>());
        }
    }
    assert!(sent.len() <= 17, "{}", sent.len());
    let told: BTreeSet<Instant> = sent.into_iter().flatten().collect();
    assert_eq!(told.len(), 49, "all of the fifty except the newest");
}

#[test]
fn coverage_is_confirmed_while_the_robot_has_it() {
    let mut tile = Tile::UNKNOWN;
    tile.set(3, 3, Cell::Free);
    let (fused, mut coverage) = (ServedLayer::default(), ServedLayer::default());
    coverage.set(ID, tile);
    let surroundings = Surroundings::default();
    let mut session = new_session();
    session.interested(window(1, 0));
    // Runs to `until` (ms). Returns the time of the last confirmation. If `lost`, all frames with
    // tiles are lost.
    let mut confirmed = |coverage: &ServedLayer, until: u64, lost: bool| {
        let snapshot =
            Snapshot { epoch: Epoch(1), fused: &fused, coverage, surroundings: &surroundings };
        let until = Instant(until * 1_000);
        let mut newest = None;
        while let Some(due) = session.poll_timeout(&snapshot, true, until).filter(|it| *it <= until)
        {
            let mut buffer = [0u8; 200];
            let mut writer = Writer::new(&mut buffer);
            let filled = session.fill(&snapshot, due, &mut writer, true);
            let len = writer.len();
            if let (Fill::Reliable(frame), false) = (filled, lost) {
                session.acknowledged(frame);
            }
            for message in Messages::<ToRobot>::new(&buffer[..len]).map(Result::unwrap) {
                if let Ok(freshness) = message.decode::<Freshness>() {
                    assert_eq!((freshness.interest, freshness.first), (1, 0));
                    assert_eq!(&freshness.tiles[..], [0b10], "only the second tile of the window");
                    newest = Some(freshness.time.0 / 1_000);
                }
            }
        }
        newest
    };
    assert_eq!(confirmed(&coverage, 3_000, false), Some(2_500));
    tile.set(4, 3, Cell::Free);
    coverage.set(ID, tile);
    // The robot had the newest state until the tile changed at 3 s.
    assert_eq!(confirmed(&coverage, 6_000, true), Some(3_000));
}
