use ubimap_protocol::{
    frame::{MIN_VERSION, VERSION},
    message::{Hello, Writer},
    tile::{Cell, Epoch, Stamp, Tile, TileEncoder, TileId, Version},
    units::{Millimetres, Pose, RobotId},
};

use super::*;

const ID: TileId = TileId { x: 1, y: -2 };
const HELD: Stamp = stamp(2, 3);

const fn stamp(epoch: u32, version: u32) -> Stamp {
    Stamp { epoch: Epoch(epoch), version: Version(version) }
}

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

/// The layer of a robot with one tile.
fn layer_with(tile: &Tile) -> RobotLayer {
    let mut layer = RobotLayer::default();
    let mut coded = [0; 100];
    let mut encoder = TileEncoder::new(&mut coded);
    encoder.push(ID, HELD, None, 0, &Tile::UNKNOWN, tile).unwrap();
    let len = encoder.finish().unwrap();
    assert_eq!(layer.update(&coded[..len], 5).1, Ok(()));
    layer
}

/// The server's side of the table in the specification's section 7.5.
#[test]
fn a_digest_that_differs_is_repaired() {
    let mut tile = Tile::UNKNOWN;
    tile.set(3, 3, Cell::Occupied);
    let (hash, other) = (tile_hash(&tile), tile_hash(&Tile::UNKNOWN));
    let there = TileId { x: 9, ..ID };
    // Layer, tile, stamp and hash of the digest, whether the server requests the tile, and whether
    // it keeps its own state of the tile.
    let cases = [
        (Layer::Robot, ID, HELD, hash, false, true),
        (Layer::Robot, ID, HELD, other, true, false),
        (Layer::Robot, ID, stamp(2, 4), hash, true, true),
        (Layer::Robot, ID, stamp(2, 2), other, false, true),
        (Layer::Robot, ID, stamp(1, 9), hash, true, true),
        (Layer::Robot, there, HELD, hash, true, true),
        (Layer::Fused, ID, HELD, other, false, true),
    ];
    for (told, id, stamp, hash, is_requested, is_kept) in cases {
        let (mut session, mut layer) = (new_session(), layer_with(&tile));
        let mut surroundings = Surroundings::default();
        let mut payload = [0; 40];
        let mut writer = Writer::<ToServer>::new(&mut payload);
        let tiles = [TileDigest { id, stamp, hash }].into_iter().collect();
        assert!(writer.push(&Digests { layer: told, tiles }));
        let len = writer.len();
        let inbox = Inbox::new(&mut session, &mut layer, &mut surroundings);
        let taken = inbox.take(Messages::new(&payload[..len]), Instant(9));
        assert_eq!(taken.unread, []);
        let held = layer.held(ID, HELD.epoch).map(|(held, cells)| (held, *cells));
        assert_eq!(
            (session.waiting(), held),
            (usize::from(is_requested), is_kept.then_some((HELD, tile))),
            "{told:?} {id:?} {stamp:?}"
        );
        assert_eq!(layer.seen(ID).unwrap().tile, tile, "the cells stay in the map");
    }
}

#[test]
fn a_robot_that_boots_out_of_view_is_told_where_it_was() {
    let pose = Pose::from_metres(1.0, 2.0, 0.5);
    let at = |millis| Instant(0) + Duration::from_millis(millis);
    let (mut session, mut layer) = (new_session(), RobotLayer::default());
    let mut surroundings = Surroundings::default();
    let mut told = |surroundings: &mut Surroundings, pose: Option<Pose>, now| {
        let mut payload = [0; 40];
        let mut writer = Writer::<ToServer>::new(&mut payload);
        let time = pose.map(|_| now);
        assert!(writer.push(&State { time, pose, odometry: None, cells_refused: 0 }));
        let len = writer.len();
        let inbox = Inbox::new(&mut session, &mut layer, surroundings);
        inbox.take(Messages::new(&payload[..len]), now);
        session.waiting()
    };
    assert_eq!(told(&mut surroundings, None, at(1_000)), 0, "nobody knows");
    assert_eq!(told(&mut surroundings, Some(pose), at(2_000)), 0);
    assert_eq!(told(&mut surroundings, None, at(2_900)), 0, "a camera may see it");
    assert_eq!(told(&mut surroundings, None, at(4_000)), 1);
    let place = surroundings.place(RobotId(1)).unwrap();
    assert_eq!((place.moment, place.pose), (at(4_000), pose));
}
