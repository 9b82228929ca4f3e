//! Digest, request and repair, in both directions.

use serde_json::{Value, json};
use ubimap_agent::share::{FusedMap, FusedTile};
use ubimap_protocol::{
    link::Terms,
    message::{
        Digests, Encoded, Message, Messages, TileDigest, TileUpdateHead, ToRobot, ToRobotMessage,
        ToServer, Writer,
    },
    tile::{Epoch, Layer, Replica, Stamp, Tile, TileId, Version, tile_hash},
    time::Instant,
    units::{Millimetres, Pose, RobotId},
};
use ubimap_sim_host::server::Server;
use ubimap_tests::{raw_robot::RawRobot, vectors::hex};

use super::{message, message_with, room, room_later, stamp, update_of};

const ID: TileId = TileId { x: 0, y: 0 };

/// What arrives at the holder of a replica.
enum Told {
    /// A whole tile.
    Tile(Stamp, Box<Tile>),
    /// A digest.
    Digest(Stamp, u32),
}

fn whole(stamp: Stamp, tile: Tile) -> Told {
    Told::Tile(stamp, Box::new(tile))
}

fn update(stamp: Stamp, tile: &Tile) -> Vec<u8> {
    update_of(900, |encoder| {
        encoder.push(ID, stamp, None, 0, &Tile::UNKNOWN, tile).unwrap();
    })
}

fn digests(layer: Layer, stamp: Stamp, hash: u32) -> Digests {
    Digests { layer, tiles: [TileDigest { id: ID, stamp, hash }].into_iter().collect() }
}

/// The cases.
pub(super) fn repair() -> Value {
    let mut cases = at_a_robot();
    cases.extend(at_a_server());
    Value::Array(cases)
}

/// A robot whose server has epoch 2.
fn at_a_robot() -> Vec<Value> {
    use Told::Digest;
    let (now, later) = (room(), room_later());
    let hash = tile_hash;
    let none = hash(&Tile::UNKNOWN);
    let cases: Vec<(&str, Vec<Told>)> = vec![
        ("both agree", vec![whole(stamp(2, 1), now), Digest(stamp(2, 1), hash(&now))]),
        ("nothing is held", vec![Digest(stamp(2, 3), hash(&now)), whole(stamp(2, 3), now)]),
        (
            "other cells under one stamp",
            vec![
                whole(stamp(2, 1), later),
                Digest(stamp(2, 1), hash(&now)),
                whole(stamp(2, 1), now),
                Digest(stamp(2, 1), hash(&now)),
            ],
        ),
        (
            "a newer state is held, of an earlier life of the server",
            vec![
                whole(stamp(2, 5), later),
                Digest(stamp(2, 2), hash(&now)),
                whole(stamp(2, 2), now),
            ],
        ),
        (
            "an older state is held",
            vec![
                whole(stamp(2, 1), now),
                Digest(stamp(2, 2), hash(&later)),
                whole(stamp(2, 2), later),
            ],
        ),
        ("the server has nothing", vec![whole(stamp(2, 5), later), Digest(stamp(2, 0), none)]),
        ("neither has anything", vec![Digest(stamp(2, 0), none)]),
    ];
    let case = |(name, told): (&str, Vec<Told>)| {
        let mut places = vec![FusedTile::FREE; 9];
        let mut map = FusedMap::new(&mut places);
        map.begin_session(Epoch(2));
        map.follow(Pose::from_metres(0.8, 0.8, 0.0), Millimetres(50));
        let steps: Vec<Value> = told
            .iter()
            .map(|told| {
                let sent = match *told {
                    Told::Tile(stamp, ref tile) => {
                        let coded = update(stamp, tile);
                        map.update(Layer::Fused, &coded, |_| ()).unwrap();
                        let head = TileUpdateHead { layer: Layer::Fused, seconds: 60 };
                        message_with::<ToRobot>(&head, &coded)
                    }
                    Digest(stamp, hash) => {
                        let digests = digests(Layer::Fused, stamp, hash);
                        map.compare(&digests, |_| ());
                        message::<ToRobot>(&digests)
                    }
                };
                let mut buffer = [0; 64];
                let mut writer = Writer::<ToServer>::new(&mut buffer);
                let answers = map.push_request(&mut writer);
                let len = writer.len();
                let answer = answers.then(|| hex(&buffer[..len]));
                let held = map.tiles(Layer::Fused).find(|(id, _)| *id == ID);
                let held = held.map_or(Replica::NOTHING, |(_, held)| held);
                let version = held.stamp().version.0;
                json!({
                    "message": hex(&sent), "answer": answer, "version": version,
                    "hash": tile_hash(held.tile()),
                })
            })
            .collect();
        json!({ "name": name, "direction": "to robot", "server_epoch": 2, "steps": steps })
    };
    cases.into_iter().map(case).collect()
}

fn at_a_server() -> Vec<Value> {
    use Told::Digest;
    let (now, later) = (room(), room_later());
    let hash = tile_hash;
    let cases: Vec<(&str, Vec<Told>)> = vec![
        ("both agree", vec![whole(stamp(1, 1), now), Digest(stamp(1, 1), hash(&now))]),
        ("nothing is held", vec![Digest(stamp(1, 3), hash(&now)), whole(stamp(1, 3), now)]),
        (
            "other cells under one stamp",
            vec![
                whole(stamp(1, 1), later),
                Digest(stamp(1, 1), hash(&now)),
                whole(stamp(1, 1), now),
                Digest(stamp(1, 1), hash(&now)),
            ],
        ),
        (
            "an older state is held",
            vec![
                whole(stamp(1, 1), now),
                Digest(stamp(1, 2), hash(&later)),
                whole(stamp(1, 2), later),
            ],
        ),
        (
            "a newer state is held: the digest is late",
            vec![whole(stamp(1, 2), now), Digest(stamp(1, 1), hash(&later))],
        ),
        (
            "a closed epoch: the digest is late",
            vec![
                whole(stamp(1, 1), now),
                whole(stamp(2, 1), now),
                whole(stamp(3, 1), later),
                Digest(stamp(1, 9), hash(&later)),
            ],
        ),
    ];
    let case = |(name, told): (&str, Vec<Told>)| {
        let resolution = Millimetres(50);
        let terms = Terms { resolution, frame: 250, server_epoch: 9, stores: false };
        let mut server = Server::new(terms, 1);
        let at = Instant(60_000_000);
        let mut robot = RawRobot::connect(&mut server, 0, RobotId(1), at);
        robot.hear(&mut server, at);
        let steps: Vec<Value> = told
            .iter()
            .map(|told| {
                let sent = match *told {
                    Told::Tile(stamp, ref tile) => {
                        let head = TileUpdateHead { layer: Layer::Robot, seconds: 60 };
                        message_with::<ToServer>(&head, &update(stamp, tile))
                    }
                    Digest(stamp, hash) => message::<ToServer>(&digests(Layer::Robot, stamp, hash)),
                };
                let (Told::Tile(stamp, _) | Digest(stamp, _)) = told;
                let read = Messages::<ToServer>::new(&sent).next().unwrap().unwrap();
                let frame = robot.frame(at, |writer| writer.push_encoded(read));
                server.receive(0, &frame, at).unwrap();
                let answers = robot.hear_messages(&mut server, at);
                let request = answers.iter().find(|(kind, _)| *kind == 6);
                let answer = request.map(|(_, body)| {
                    let parsed = Message::<ToRobot>::new(6, body).by_kind();
                    let Some(ToRobotMessage::Request(request)) = parsed else { panic!() };
                    hex(&message::<ToRobot>(&Encoded::decode(request).unwrap()))
                });
                let held = server.layer(RobotId(1)).unwrap().held(ID, stamp.epoch);
                let (version, hash) = held.map_or((Version(0), tile_hash(&Tile::UNKNOWN)), |it| {
                    (it.0.version, tile_hash(it.1))
                });
                json!({
                    "message": hex(&sent), "epoch": stamp.epoch.0, "answer": answer,
                    "version": version.0, "hash": hash,
                })
            })
            .collect();
        json!({ "name": name, "direction": "to server", "steps": steps })
    };
    cases.into_iter().map(case).collect()
}
