//! Checks of a robot's tiles, and of what it does with the server's (SPEC 7).

use std::collections::BTreeSet;

use ubimap_protocol::{
    message::{Digests, Interest, Request, TileDigest, ToRobot, ToServer},
    tile::{Epoch, Layer, Stamp, Tile, TileId, Version, tile_hash},
    time::Duration,
};

use super::super::{
    check::Check,
    followed::Update,
    frames::{Note, part_note, tile_note},
    halt::{Halt, fail, skip},
    robot_side::{noise, room},
    talk::{Seen, Talk},
};

pub(super) const CHECKS: &[Check] = &[
    Check {
        name: "robot-tiles",
        section: "7.3",
        rule: "updates can be read, name bases that were acknowledged, and are of the robot's layer",
        run: tiles,
    },
    Check {
        name: "first-epoch",
        section: "4.2",
        rule: "with `renumber`, all tiles are sent in an epoch of at least `first_epoch`",
        run: first_epoch,
    },
    Check {
        name: "another-server",
        section: "4.2",
        rule: "after a Welcome of another server epoch all tiles are sent again, whole",
        run: another_server,
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
        run: tile_requested,
    },
    Check {
        name: "all-tiles-requested",
        section: "7.3",
        rule: "a Request without tiles means all of them",
        run: all_requested,
    },
    Check {
        name: "robot-digests",
        section: "7.5",
        rule: "digests of acknowledged tiles come every 10 s, and are right",
        run: digests,
    },
    Check {
        name: "robot-frame-size",
        section: "2.7",
        rule: "no frame is longer than agreed, and tiles arrive in parts",
        run: frame_size,
    },
    Check {
        name: "base-missing",
        section: "7.3",
        rule: "a tile whose base is not held is requested",
        run: base_missing,
    },
    Check {
        name: "digest-differs",
        section: "7.5",
        rule: "a tile whose digest differs is requested; one whose digest agrees is not",
        run: digest_differs,
    },
    Check {
        name: "tile-in-parts",
        section: "7.3",
        rule: "parts that follow each other are joined; a part after a gap is base missing",
        run: parts,
    },
    Check {
        name: "tile-outside-window",
        section: "7.4",
        rule: "a whole tile outside the window is skipped; any other update of it is base missing",
        run: outside_window,
    },
];

fn tiles(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.welcome_by_another_server(|_| ())?;
    talk.must_publish()?;
    talk.collect_with_fixes(Duration::from_secs(12))?;
    talk.must_be_readable("updates that can be read")?;
    for Update { carrier, layer, header, applied, held } in talk.server.followed.updates.clone() {
        if layer != Layer::Robot {
            return talk.fail_in(&carrier, "updates of layer 0 alone", format!("{layer:?}"));
        }
        if header.stamp.version.0 == 0 || header.stamp.epoch.0 == 0 {
            let found = format!("{:?}", header.stamp);
            return talk.fail_in(&carrier, "epochs and versions from 1 on", found);
        }
        if applied.is_none() {
            let found = format!("{header:?}, held {held:?}");
            return talk.fail_in(&carrier, "a base that was acknowledged before", found);
        }
    }
    Ok(())
}

fn first_epoch(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.welcome_by_another_server(|_| ())?;
    talk.must_publish()?;
    let first = talk.server.first_epoch + 100;
    talk.welcome_by_another_server(|welcome| {
        welcome.first_epoch = first;
        welcome.renumber = true;
    })?;
    talk.must_publish()?;
    let expected = format!("tiles in epochs from {first} on");
    talk.must_publish_none(expected, |it| it.header.stamp.epoch.0 < first)
}

fn published(talk: &Talk<'_>) -> BTreeSet<TileId> {
    talk.server
        .followed
        .updates
        .iter()
        .filter(|it| it.is_last_part())
        .map(|it| it.header.id)
        .collect()
}

fn another_server(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.welcome_by_another_server(|_| ())?;
    talk.must_publish()?;
    talk.collect_with_fixes(Duration::from_secs(5))?;
    let before = published(talk);
    talk.welcome_by_another_server(|_| ())?;
    talk.must_publish()?;
    talk.collect_with_fixes(Duration::from_secs(5))?;
    let after = published(talk);
    talk.must_publish_none("whole tiles for a server that has none", |it| it.applied.is_none())?;
    match before.difference(&after).next() {
        None => Ok(()),
        Some(id) => fail(format!("tile {id:?} is sent again"), "it is not, within 5 s"),
    }
}

fn one_in_flight(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.welcome_by_another_server(|_| ())?;
    talk.withholds = true;
    talk.collect_with_fixes(Duration::from_secs(14))?;
    let updates = &talk.server.followed.updates;
    if updates.is_empty() {
        return skip("the robot published no tile within 14 s of fixes");
    }
    let mut ids = BTreeSet::new();
    talk.must_publish_none("one update of a tile while nothing is acknowledged", |update| {
        !ids.insert((update.header.id, update.header.stamp.epoch))
    })
}

/// Waits for a whole update of a tile with an acknowledged one.
fn must_send_whole(
    talk: &mut Talk<'_>,
    ids: &BTreeSet<TileId>,
    request: Request,
) -> Result<(), Halt> {
    let asked = talk.server.followed.updates.len();
    talk.reliable(&[Note::new::<ToRobot, _>(&request)])?;
    talk.collect_with_fixes(Duration::from_secs(5))?;
    let updates = talk.server.followed.updates.iter().skip(asked);
    let whole: BTreeSet<TileId> =
        updates.filter(|it| it.is_whole()).map(|it| it.header.id).collect();
    match ids.difference(&whole).next() {
        None => Ok(()),
        Some(id) => {
            fail(format!("tile {id:?} is sent whole within 5 s"), format!("whole: {whole:?}"))
        }
    }
}

fn tile_requested(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.welcome_by_another_server(|_| ())?;
    talk.must_publish()?;
    talk.collect_with_fixes(Duration::from_secs(3))?;
    let Some(&id) = published(talk).first() else { return skip("no tile") };
    let request = Request { layer: Layer::Robot, tiles: [id].into_iter().collect() };
    must_send_whole(talk, &BTreeSet::from([id]), request)
}

fn all_requested(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.welcome_by_another_server(|_| ())?;
    talk.must_publish()?;
    talk.collect_with_fixes(Duration::from_secs(3))?;
    let ids = published(talk);
    must_send_whole(talk, &ids, Request { layer: Layer::Robot, tiles: Default::default() })
}

fn digests(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.welcome_by_another_server(|_| ())?;
    talk.must_publish()?;
    let seen = talk.collect_with_fixes(Duration::from_secs(34))?;
    if !seen.iter().any(|it| it.bodies::<ToServer, Digests>().next().is_some()) {
        return fail("Digests within 34 s of the first acknowledged tile", "none");
    }
    // A tile that changes just then is left out.
    match talk.must_agree(&seen)? {
        0 => fail("the Digest of a state that was sent", "Digests of other states alone"),
        _ => Ok(()),
    }
}

fn frame_size(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.hello()?;
    let largest = talk.largest_frame();
    let min = talk.min_frame();
    for frame in [min, min + 1, 64, 250, 1_024].into_iter().filter(|&it| it <= largest) {
        talk.welcome_by_another_server(|welcome| welcome.frame = frame)?;
        let seen = talk.collect_with_fixes(Duration::from_secs(6))?;
        let of_session = |it: &&Seen| it.frame.as_ref().is_ok_and(|it| it.session == talk.session);
        let longest = seen.iter().filter(of_session).map(|it| it.wire.len()).max().unwrap_or(0);
        if longest > usize::from(frame) {
            return fail(format!("frames of at most {frame} bytes"), format!("{longest} bytes"));
        }
        talk.must_be_readable(format!("updates in frames of {frame} bytes that can be read"))?;
        if seen.iter().any(|it| it.is_cut) {
            return fail("whole messages in each frame", "one is cut short");
        }
        talk.must_publish_none("bases and parts that follow each other", |it| {
            it.applied.is_none()
        })?;
    }
    Ok(())
}

/// A session in which the robot has a window. Returns it.
fn with_window(talk: &mut Talk<'_>) -> Result<Interest, Halt> {
    talk.welcome_by_another_server(|_| ())?;
    if talk.server.hello.is_some_and(|hello| hello.fused_tiles == 0) {
        return skip("the robot holds no tiles of the server");
    }
    let seen = talk.collect_with_fixes(Duration::from_secs(8))?;
    match seen.iter().flat_map(|it| it.bodies::<ToServer, Interest>()).last() {
        Some(interest) => Ok(interest),
        None => skip("the robot sent no Interest within 8 s of fixes"),
    }
}

fn stamp(talk: &Talk<'_>, version: u32) -> Stamp {
    Stamp { epoch: Epoch(talk.server.epoch), version: Version(version) }
}

fn send_tile(
    talk: &mut Talk<'_>,
    id: TileId,
    version: u32,
    base: Option<u32>,
    tile: &Tile,
) -> Result<(), Halt> {
    let was = if base.is_some() { room(9) } else { Tile::UNKNOWN };
    let tile_of = (id, stamp(talk, version), base.map(Version));
    let note = tile_note::<ToRobot>(Layer::Fused, tile_of, &was, tile);
    talk.reliable(&[note]).map(|_| ())
}

fn base_missing(talk: &mut Talk<'_>) -> Result<(), Halt> {
    let window = with_window(talk)?;
    send_tile(talk, window.from, 5, Some(4), &room(10))?;
    talk.must_request(window.from, true, "an update on a base that the robot does not hold")
}

fn digest_of(talk: &mut Talk<'_>, id: TileId, version: u32, hash: u32) -> Result<(), Halt> {
    let tiles = [TileDigest { id, stamp: stamp(talk, version), hash }].into_iter().collect();
    talk.datagram(&[Note::new::<ToRobot, _>(&Digests { layer: Layer::Fused, tiles })])
}

fn digest_differs(talk: &mut Talk<'_>) -> Result<(), Halt> {
    let window = with_window(talk)?;
    let (id, tile) = (window.from, room(9));
    send_tile(talk, id, 1, None, &tile)?;
    talk.must_request(id, false, "a whole tile")?;
    digest_of(talk, id, 1, tile_hash(&tile))?;
    talk.must_request(id, false, "the right digest")?;
    send_tile(talk, id, 2, Some(1), &room(12))?;
    talk.must_request(id, false, "an update on the version held")?;
    digest_of(talk, id, 2, tile_hash(&room(12)))?;
    talk.must_request(id, false, "the right digest of the update")?;
    digest_of(talk, id, 2, tile_hash(&room(12)) ^ 1)?;
    talk.must_request(id, true, "a digest with another hash")
}

fn parts(talk: &mut Talk<'_>) -> Result<(), Halt> {
    let window = with_window(talk)?;
    let (id, tile) = (window.from, noise(7));
    let of = (id, stamp(talk, 1), None);
    let mut start = 0;
    while start < 1_024 {
        let (note, end) =
            part_note::<ToRobot>(Layer::Fused, of, start, (&Tile::UNKNOWN, &tile), 60);
        talk.deliver(&[note])?;
        start = end;
    }
    digest_of(talk, id, 1, tile_hash(&tile))?;
    talk.must_request(id, false, "all parts of a tile, and its digest")?;
    let of = (id, stamp(talk, 2), None);
    let (_, end) = part_note::<ToRobot>(Layer::Fused, of, 0, (&Tile::UNKNOWN, &tile), 60);
    let (note, _) = part_note::<ToRobot>(Layer::Fused, of, end, (&Tile::UNKNOWN, &tile), 60);
    talk.reliable(&[note])?;
    talk.must_request(id, true, "the second part of a state without the first")
}

fn outside_window(talk: &mut Talk<'_>) -> Result<(), Halt> {
    let window = with_window(talk)?;
    let id = TileId { x: window.to.x.saturating_add(40), y: window.to.y };
    send_tile(talk, id, 1, None, &room(9))?;
    talk.must_request(id, false, "a whole tile outside the window")?;
    send_tile(talk, id, 2, Some(1), &room(10))?;
    talk.must_request(id, true, "an update of a tile outside the window")
}
