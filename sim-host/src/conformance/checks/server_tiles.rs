//! Checks of what a server does with a robot's tiles, and of its own (SPEC 7).

use std::collections::BTreeSet;

use ubimap_protocol::{
    message::{Digests, Request, Stored, TileDigest, ToRobot, ToServer},
    tile::{EPOCHS_AHEAD, Epoch, Layer, Stamp, Tile, TileId, Version, tile_hash},
    time::{Duration, Instant},
};

use super::super::{
    check::Check,
    frames::{Note, part_note, tile_note},
    halt::{Halt, fail, skip},
    robot_side::{noise, room},
    talk::{Seen, Talk},
};

/// The server's tiles are looked at here; what is drawn comes back as fused tiles.
const HERE: TileId = TileId { x: -600, y: -600 };
/// Time for the server to fuse and publish what was drawn.
const FUSE_TIME: Duration = Duration::from_secs(15);
/// Time for the server to store what was drawn, and to say so.
const STORE_TIME: Duration = Duration::from_secs(15);

pub(super) const CHECKS: &[Check] = &[
    Check {
        name: "base-missing",
        section: "7.3",
        rule: "a tile whose base is not held is requested",
        run: base_missing,
    },
    Check {
        name: "update-on-base",
        section: "7.3",
        rule: "an update on the version held applies",
        run: update_on_base,
    },
    Check {
        name: "wrong-base",
        section: "8.3",
        rule: "an update on other cells under the same stamp is not applied, but requested",
        run: wrong_base,
    },
    Check {
        name: "old-update",
        section: "7.3",
        rule: "a whole tile that is older than the one held is skipped",
        run: old_update,
    },
    Check {
        name: "tile-in-parts",
        section: "7.3",
        rule: "parts that follow each other are joined; a part after a gap is base missing",
        run: parts,
    },
    Check {
        name: "digest-differs",
        section: "7.5",
        rule: "a tile whose digest differs is requested; one whose digest agrees is not",
        run: digest_differs,
    },
    Check {
        name: "layer-of-the-server",
        section: "5",
        rule: "a robot's update of a layer of the server is malformed",
        run: foreign_layer,
    },
    Check {
        name: "epoch-bound",
        section: "7.2",
        rule: "an update more than 8,192 epochs above `first_epoch` is malformed",
        run: epoch_bound,
    },
    Check {
        name: "interest",
        section: "7.4",
        rule: "tiles of the window are sent, and no others",
        run: interest,
    },
    Check {
        name: "older-interest",
        section: "5",
        rule: "of two Interests the one with the higher number wins",
        run: older_interest,
    },
    Check {
        name: "server-tiles",
        section: "7.3",
        rule: "updates can be read, name bases that were acknowledged, and are of the server's layers",
        run: tiles,
    },
    Check {
        name: "one-update-in-flight",
        section: "7.3",
        rule: "a tile's next update waits until the last one is acknowledged",
        run: one_in_flight,
    },
    Check {
        name: "tile-requested",
        section: "7.3",
        rule: "a tile that is requested is sent whole",
        run: requested,
    },
    Check {
        name: "server-digests",
        section: "7.5",
        rule: "digests of acknowledged tiles come every 10 s, and are right",
        run: digests,
    },
    Check {
        name: "server-frame-size",
        section: "2.7",
        rule: "no frame is longer than agreed, and tiles arrive in parts",
        run: frame_size,
    },
    Check {
        name: "stored",
        section: "7.4",
        rule: "with `stores`, a state on disk is named by Stored, and once more in each session that names it",
        run: stored,
    },
    Check {
        name: "budget",
        section: "7.4",
        rule: "at most 2,000 bytes in any second, plus 2,000 when the session begins",
        run: budget,
    },
];

/// A tile of its own for a check.
fn ground(talk: &mut Talk<'_>) -> TileId {
    talk.asked += 1;
    TileId { x: -1_000 - (talk.asked % 8_000) as i16, y: 900 }
}

fn stamp(talk: &Talk<'_>, version: u32) -> Stamp {
    Stamp { epoch: talk.epoch(), version: Version(version) }
}

fn send(
    talk: &mut Talk<'_>,
    id: TileId,
    (version, base): (u32, Option<u32>),
    was: &Tile,
    is: &Tile,
) -> Result<(), Halt> {
    let tile = (id, stamp(talk, version), base.map(Version));
    let note = tile_note::<ToServer>(Layer::Robot, tile, was, is);
    talk.reliable(&[note]).map(|_| ())
}

fn digest_of(talk: &mut Talk<'_>, id: TileId, version: u32, hash: u32) -> Result<(), Halt> {
    let tiles = [TileDigest { id, stamp: stamp(talk, version), hash }].into_iter().collect();
    talk.datagram(&[Note::new::<ToServer, _>(&Digests { layer: Layer::Robot, tiles })])
}

fn base_missing(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let id = ground(talk);
    send(talk, id, (5, Some(4)), &room(9), &room(10))?;
    talk.must_request(id, true, "an update of a tile that the server does not hold")?;
    let id = ground(talk);
    send(talk, id, (1, None), &Tile::UNKNOWN, &room(9))?;
    send(talk, id, (5, Some(4)), &room(9), &room(10))?;
    talk.must_request(id, true, "an update on version 4 of a tile held in version 1")
}

fn update_on_base(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let id = ground(talk);
    send(talk, id, (1, None), &Tile::UNKNOWN, &room(9))?;
    talk.must_request(id, false, "a whole tile")?;
    send(talk, id, (4, Some(1)), &room(9), &room(12))?;
    talk.must_request(id, false, "an update on the version held")?;
    digest_of(talk, id, 4, tile_hash(&room(12)))?;
    talk.must_request(id, false, "the digest of the update")
}

fn wrong_base(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let id = ground(talk);
    send(talk, id, (1, None), &Tile::UNKNOWN, &room(9))?;
    talk.must_request(id, false, "a whole tile")?;
    send(talk, id, (2, Some(1)), &room(11), &room(12))?;
    talk.must_request(id, true, "an update on other cells")?;
    digest_of(talk, id, 1, tile_hash(&room(9)))?;
    talk.must_request(id, false, "the digest of the cells before it")
}

fn old_update(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let id = ground(talk);
    send(talk, id, (3, None), &Tile::UNKNOWN, &room(9))?;
    send(talk, id, (2, None), &Tile::UNKNOWN, &room(5))?;
    talk.must_request(id, false, "an older whole tile")?;
    digest_of(talk, id, 3, tile_hash(&room(9)))?;
    talk.must_request(id, false, "the digest of the newer one")
}

fn parts(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let (id, tile) = (ground(talk), noise(3));
    let of = (id, stamp(talk, 1), None);
    let mut start = 0;
    while start < 1_024 {
        let (note, end) =
            part_note::<ToServer>(Layer::Robot, of, start, (&Tile::UNKNOWN, &tile), 60);
        talk.deliver(&[note])?;
        start = end;
    }
    digest_of(talk, id, 1, tile_hash(&tile))?;
    talk.must_request(id, false, "all parts of a tile, and its digest")?;
    let of = (id, stamp(talk, 2), None);
    let (_, end) = part_note::<ToServer>(Layer::Robot, of, 0, (&Tile::UNKNOWN, &tile), 60);
    let (note, _) = part_note::<ToServer>(Layer::Robot, of, end, (&Tile::UNKNOWN, &tile), 60);
    talk.reliable(&[note])?;
    talk.must_request(id, true, "the second part of a state without the first")
}

fn digest_differs(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let id = ground(talk);
    digest_of(talk, id, 2, tile_hash(&room(9)))?;
    talk.must_request(id, true, "the digest of a tile that the server does not hold")?;
    send(talk, id, (2, None), &Tile::UNKNOWN, &room(9))?;
    digest_of(talk, id, 2, tile_hash(&room(9)))?;
    talk.must_request(id, false, "the right digest")?;
    digest_of(talk, id, 1, tile_hash(&room(4)))?;
    talk.must_request(id, false, "the digest of an older version")?;
    digest_of(talk, id, 3, tile_hash(&room(9)))?;
    talk.must_request(id, true, "the digest of a newer version")?;
    digest_of(talk, id, 2, tile_hash(&room(9)) ^ 1)?;
    talk.must_request(id, true, "a digest with another hash")
}

fn foreign_layer(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let id = ground(talk);
    for layer in [Layer::Coverage, Layer::Fused] {
        let stamp = Stamp { epoch: talk.epoch(), version: Version(5) };
        let tile = (id, stamp, Some(Version(4)));
        let note = tile_note::<ToServer>(layer, tile, &room(9), &room(10));
        talk.reliable(&[note])?;
        let asked = talk
            .find(talk.patience(), |_, seen| seen.bodies::<ToRobot, Request>().next().is_some())?;
        if asked.is_some() {
            return fail(format!("no Request after an update of layer {layer:?}"), "a Request");
        }
    }
    talk.must_answer("after updates of the server's layers")
}

fn epoch_bound(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let first = talk.epoch().0;
    for (epoch, wanted) in [
        (first.saturating_add(EPOCHS_AHEAD + 1), false),
        (u32::MAX, false),
        (first.saturating_add(EPOCHS_AHEAD), true),
    ] {
        let id = ground(talk);
        let stamp = Stamp { epoch: Epoch(epoch), version: Version(5) };
        let note =
            tile_note::<ToServer>(Layer::Robot, (id, stamp, Some(Version(4))), &room(9), &room(10));
        talk.reliable(&[note])?;
        let what =
            format!("an update on a missing base in epoch {epoch}, `first_epoch` being {first}");
        talk.must_request(id, wanted, &what)?;
    }
    Ok(())
}

/// A session with a window on a tile that the runner has drawn, and that the server has published.
fn published(talk: &mut Talk<'_>, tile: &Tile) -> Result<(), Halt> {
    talk.open()?;
    talk.draw(HERE, tile)?;
    talk.robot.followed.clear();
    talk.interest(HERE, HERE)?;
    if talk.is_published(HERE, FUSE_TIME)? {
        return Ok(());
    }
    skip("the server publishes no fused tile of what the runner has drawn within 15 s")
}

fn interest(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let beside = TileId { x: HERE.x + 5, y: HERE.y };
    talk.draw(HERE, &room(20))?;
    talk.draw(beside, &room(22))?;
    talk.robot.followed.clear();
    talk.wait(Duration::from_secs(12))?;
    talk.must_publish_none("no tiles before the session's first Interest", |_| true)?;
    talk.interest(HERE, HERE)?;
    if !talk.is_published(HERE, FUSE_TIME)? {
        return skip("the server publishes no fused tile of what the runner has drawn within 15 s");
    }
    talk.wait(Duration::from_secs(5))?;
    talk.must_publish_none(format!("tile {HERE:?} alone"), |it| it.header.id != HERE)
}

fn older_interest(talk: &mut Talk<'_>) -> Result<(), Halt> {
    let beside = TileId { x: HERE.x + 5, y: HERE.y };
    talk.open()?;
    talk.draw(HERE, &room(20))?;
    talk.draw(beside, &room(22))?;
    talk.robot.followed.clear();
    let (old, new) = (talk.interest_note(HERE, HERE), talk.interest_note(beside, beside));
    talk.reliable(&[new])?;
    talk.reliable(&[old])?;
    let published = talk.is_published(beside, FUSE_TIME)?;
    if !published && talk.robot.followed.updates.is_empty() {
        return skip("the server publishes no fused tile of what the runner has drawn within 15 s");
    }
    // Its tiles would come within a second.
    talk.wait(Duration::from_secs(4))?;
    let expected = "no tile of the window of the Interest with the lower number";
    talk.must_publish_none(expected, |it| it.header.id == HERE)
}

fn tiles(talk: &mut Talk<'_>) -> Result<(), Halt> {
    published(talk, &room(15))?;
    for column in [18, 21] {
        talk.wait(Duration::from_secs(11))?;
        talk.draw(HERE, &room(column))?;
    }
    talk.wait(Duration::from_secs(12))?;
    let epoch = talk.server_epoch();
    talk.must_be_readable("updates that can be read")?;
    talk.must_publish_none(format!("layers 1 and 2 in epoch {}", epoch.0), |it| {
        it.layer == Layer::Robot || it.header.stamp.epoch != epoch
    })?;
    talk.must_publish_none("a base that was acknowledged before", |it| it.applied.is_none())
}

fn one_in_flight(talk: &mut Talk<'_>) -> Result<(), Halt> {
    published(talk, &room(8))?;
    talk.withholds = true;
    let known = talk.robot.followed.updates.len();
    for column in [10, 14, 18] {
        talk.draw(HERE, &room(column))?;
        talk.wait(Duration::from_secs(11))?;
    }
    let mut ids = BTreeSet::new();
    let mut number = 0..;
    talk.must_publish_none("one update of a tile while nothing is acknowledged", |it| {
        number.next() >= Some(known) && !ids.insert((it.layer as u8, it.header.id))
    })
}

fn requested(talk: &mut Talk<'_>) -> Result<(), Halt> {
    published(talk, &room(13))?;
    for tiles in [vec![HERE], vec![]] {
        let known = talk.robot.followed.updates.len();
        let request = Request { layer: Layer::Fused, tiles: tiles.iter().copied().collect() };
        talk.reliable(&[Note::new::<ToServer, _>(&request)])?;
        talk.wait(Duration::from_secs(3))?;
        let updates = &talk.robot.followed.updates[known..];
        if !updates.iter().any(|it| it.header.id == HERE && it.is_whole()) {
            return fail(
                format!("tile {HERE:?} whole, after a Request for {tiles:?}"),
                format!("{:?}", updates.iter().map(|it| it.header).collect::<Vec<_>>()),
            );
        }
    }
    Ok(())
}

fn digests(talk: &mut Talk<'_>) -> Result<(), Halt> {
    published(talk, &room(16))?;
    let seen = talk.collect(Duration::from_secs(24))?;
    let digests = seen.iter().flat_map(|it| it.bodies::<ToRobot, Digests>());
    let fused: Vec<TileDigest> =
        digests.filter(|it| it.layer == Layer::Fused).flat_map(|it| it.tiles).collect();
    if !fused.iter().any(|it| it.id == HERE) {
        return fail("a Digest of the acknowledged tile within 24 s", format!("{fused:?}"));
    }
    talk.must_agree(&seen).map(|_| ())
}

fn frame_size(talk: &mut Talk<'_>) -> Result<(), Halt> {
    let min = talk.min_frame();
    for frame in [min, min + 1, 64, 250, 1_024] {
        talk.join_server(|hello| hello.frame = frame)?;
        let (id, tile) = (ground(talk), noise(u32::from(frame)));
        // Framing takes 8 bytes, or 24; kind, length, layer and seconds take 4.
        let framing = usize::from(min) - 24;
        let room = usize::from(frame).min(64) - framing - 4;
        let (of, mut start) = ((id, stamp(talk, 1), None), 0);
        while start < 1_024 {
            let (note, end) =
                part_note::<ToServer>(Layer::Robot, of, start, (&Tile::UNKNOWN, &tile), room);
            talk.deliver(&[note])?;
            if end == start {
                return skip("no cell fits a frame");
            }
            start = end;
        }
        talk.robot.followed.clear();
        talk.interest(id, id)?;
        let mut seen = Vec::new();
        for _ in 0..20 {
            seen.extend(talk.collect(Duration::from_secs(1))?);
            if talk.is_published(id, Duration(0))? {
                break;
            }
        }
        let of_session = |it: &&Seen| it.frame.as_ref().is_ok_and(|it| it.session == talk.session);
        let longest = seen.iter().filter(of_session).map(|it| it.wire.len()).max().unwrap_or(0);
        if longest > usize::from(frame) {
            return fail(format!("frames of at most {frame} bytes"), format!("{longest} bytes"));
        }
        talk.must_be_readable(format!("updates in frames of {frame} bytes that can be read"))?;
        if !talk.is_published(id, Duration(0))? {
            return skip(
                "the server publishes no fused tile of what the runner has drawn within 20 s",
            );
        }
    }
    Ok(())
}

/// Fails unless the server says within 15 s that a state is on disk.
fn must_be_stored(
    talk: &mut Talk<'_>,
    (id, stamp): (TileId, Stamp),
    when: &str,
) -> Result<(), Halt> {
    let names = |stored: Stored| {
        let mut tiles = stored.tiles.iter();
        tiles.any(|(tile, named)| {
            *tile == id && named.epoch == stamp.epoch && named.version >= stamp.version
        })
    };
    let said = talk.find(STORE_TIME, |_, seen| seen.bodies::<ToRobot, Stored>().any(names))?;
    match said {
        Some(_) => Ok(()),
        None => fail(format!("{when}: Stored of {id:?} {stamp:?} within 15 s"), "none"),
    }
}

fn stored(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    if talk.robot.welcome.is_none_or(|welcome| !welcome.stores) {
        return skip("the server stores nothing: its Welcome says so");
    }
    let (id, tile) = (ground(talk), room(9));
    let state = (id, stamp(talk, 1));
    send(talk, id, (1, None), &Tile::UNKNOWN, &tile)?;
    must_be_stored(talk, state, "after a tile")?;
    // The first one may have been lost with its session.
    talk.open()?;
    let tiles = [TileDigest { id, stamp: state.1, hash: tile_hash(&tile) }].into_iter().collect();
    talk.datagram(&[Note::new::<ToServer, _>(&Digests { layer: Layer::Robot, tiles })])?;
    must_be_stored(talk, state, "after its Digest in the next session")
}

fn budget(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let from = TileId { x: HERE.x + 20, y: HERE.y };
    let to = TileId { x: from.x + 6, y: from.y + 6 };
    for y in from.y..=to.y {
        for x in from.x..=to.x {
            talk.draw(TileId { x, y }, &noise((x as u32).wrapping_mul(77) ^ (y as u32)))?;
        }
    }
    talk.wait(FUSE_TIME)?;
    talk.open()?;
    let began = talk.now();
    talk.interest(from, to)?;
    let seen = talk.collect(Duration::from_secs(8))?;
    let sent: Vec<(Instant, usize)> = seen.iter().map(|it| (it.at, it.wire.len())).collect();
    let total: usize = sent.iter().map(|it| it.1).sum();
    if total < 4_500 {
        return skip(format!("the server has no more than {total} bytes to send of 49 tiles"));
    }
    // A frame may be written just before its second is over, and the wire delays some.
    let spare = 300 + talk.slack().micros() as usize / 100;
    let mut so_far = 0;
    for (index, &(at, len)) in sent.iter().enumerate() {
        so_far += len;
        let bound = 4_000 + 2_000 * at.since(began).micros() as usize / 1_000_000 + spare;
        let second: usize = sent[..=index]
            .iter()
            .filter(|it| at.since(it.0) < Duration::from_secs(1))
            .map(|it| it.1)
            .sum();
        let is_later = at.since(began) > Duration::from_secs(2);
        if so_far > bound || is_later && second > 2_000 + spare {
            return fail(
                "at most 2,000 bytes in any second, plus 2,000 when the session begins",
                format!(
                    "{so_far} bytes in the first {} ms, {second} of them in the last second",
                    at.since(began).micros() / 1_000
                ),
            );
        }
    }
    Ok(())
}
