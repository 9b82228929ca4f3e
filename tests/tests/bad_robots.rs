//! Robots that lie, flood, have jumping clocks, or are reported at impossible places must not
//! disturb the others or degrade the map.

use ubimap_protocol::{
    frame::MAX_FRAME,
    link::Terms,
    message::{DistanceVector, Interest, ToRobotKind},
    tile::{Cell, Digest, TILE_SIDE, Tile, TileId},
    time::{Duration, Instant},
    units::{Angle, Millimetres, Pose, RobotId},
};
use ubimap_sim_host::{
    camera::{Observation, Sighting},
    mapping::Weight,
    perception::robots::SightingEvent,
    server::{Event, MessageCounters, RobotEvent, Server},
};
use ubimap_tests::raw_robot::RawRobot;

/// A tile in view of a camera.
const SEEN: TileId = TileId { x: 0, y: 0 };
/// A tile that two honest robots have mapped, out of the cameras' view.
const BLIND: TileId = TileId { x: 5, y: 0 };
/// A tile without other observers.
const NEW: TileId = TileId { x: 9, y: 0 };
/// The dishonest robot.
const LIAR: RobotId = RobotId(3);

fn server() -> Server {
    let terms = Terms { resolution: Millimetres(50), frame: 250, server_epoch: 1, stores: false };
    Server::new(terms, 3)
}

fn at(millis: u64) -> Instant {
    Instant(millis * 1_000)
}

/// A tile of free cells, with walls in every `apart`-th column from `first` on.
fn walls(first: usize, apart: usize) -> Tile {
    let mut tile = Tile { low: [u32::MAX; TILE_SIDE], high: [0; TILE_SIDE] };
    for x in (first..TILE_SIDE).step_by(apart) {
        (0..TILE_SIDE).for_each(|y| tile.set(x, y, Cell::Occupied));
    }
    tile
}

/// A camera's observation of [`SEEN`]: a wall in the first column, and robots.
fn look(captured: Instant, robots: Vec<Sighting>) -> Observation {
    let seen = walls(0, TILE_SIDE);
    let side = TILE_SIDE as i32;
    let cells = (0..side).flat_map(|y| (0..side).map(move |x| (x, y)));
    let cells = cells.map(|(x, y)| ((x, y), seen.cell(x as usize, y as usize))).collect();
    Observation { captured, robots, cells, ..Observation::default() }
}

/// Lets the server send everything that is due; returns the number of bytes for each port.
fn drain(server: &mut Server, now: Instant) -> [usize; 3] {
    server.timeout(now);
    let mut out = [0; MAX_FRAME];
    [0, 1, 2].map(|port| std::iter::from_fn(|| server.poll_transmit(port, now, &mut out)).sum())
}

fn events(server: &Server) -> Vec<(RobotEvent, u64)> {
    server.robot_events().iter().map(|(event, count, _)| (event, count)).collect()
}

/// Two honest robots map blind ground, while a third one draws something else into each of the
/// tiles `lies` every two seconds, for half a minute.
fn with_lies(in_view: bool, lies: &[TileId]) -> (Digest, [usize; 3], Server) {
    let mut server = server();
    let mut robots: Vec<RawRobot> = (0..3)
        .map(|port| RawRobot::connect(&mut server, port, RobotId(port as u16 + 1), at(0)))
        .collect();
    let (from, to) = (SEEN, TileId { x: 6, y: 1 });
    for robot in &mut robots[..2] {
        let interest = Interest { number: 1, from, to };
        robot.say(&mut server, at(0), &interest);
    }
    let mut sent = [0; 3];
    for millis in (100..32_000).step_by(100) {
        let now = at(millis);
        if in_view && millis % 200 == 0 {
            server.observe(&look(now, Vec::new()));
        }
        if millis == 1_000 || millis == 2_000 {
            robots[millis as usize / 1_000 - 1].draw(&mut server, now, BLIND, &walls(4, 20));
        }
        if millis > 3_000 && millis % 2_000 == 0 {
            for id in lies {
                robots[2].draw(&mut server, now, *id, &walls(2 + millis as usize / 2_000 % 2, 5));
            }
        }
        let bytes = drain(&mut server, now);
        sent.iter_mut().zip(bytes).for_each(|(sum, bytes)| *sum += bytes);
    }
    (server.fused().digest(), sent, server)
}

#[test]
fn a_robot_that_contradicts_the_cameras_loses_its_weight_everywhere() {
    let (truth, undisturbed, server) = with_lies(true, &[]);
    assert_eq!(events(&server), []);
    let (map, _, server) = with_lies(true, &[SEEN, NEW]);
    assert_eq!(map, truth, "the lies must not appear in view or in ground only the liar has seen");
    assert_eq!(events(&server), [(RobotEvent::Disagrees(LIAR), 1)]);
    let weights = [1, 2, 3].map(|id| server.weight(RobotId(id)));
    assert_eq!(weights, [Weight::FULL, Weight::FULL, Weight::NONE]);
    // If cameras see the tile, the lies never cause traffic to the other robots.
    let (map, sent, _) = with_lies(true, &[SEEN]);
    assert_eq!((map, sent[..2].to_vec()), (truth, undisturbed[..2].to_vec()));
}

#[test]
fn in_blind_ground_a_lie_lasts_one_map_step_against_two_witnesses() {
    let (truth, _, _) = with_lies(false, &[]);
    let (map, _, server) = with_lies(false, &[BLIND]);
    assert_eq!(map, truth);
    assert_eq!(events(&server), [(RobotEvent::Disagrees(LIAR), 1)]);
    // Some of its walls are next to the true ones.
    assert!(server.weight(LIAR) < Weight::FULL);
    assert_eq!([1, 2].map(|id| server.weight(RobotId(id))), [Weight::FULL; 2]);
}

/// The liar's distance vector, with a reading of `metres` in every direction.
fn sees(time: Instant, pose: Pose, metres: f64) -> DistanceVector {
    let distances = (0..64).map(|_| (metres * 50.0) as u8).collect();
    DistanceVector { time, pose, first: Angle(0), step: 1_024, distances, odometry: None }
}

#[test]
fn false_distance_vectors_in_view_cost_the_weight_in_blind_ground() {
    let pose = Pose::from_metres(0.9, 0.8, 0.3);
    let mut server = server();
    let mut robot = RawRobot::connect(&mut server, 2, LIAR, at(0));
    robot.draw(&mut server, at(0), NEW, &walls(4, 20));
    assert!(server.fused().get(NEW).is_some_and(|(_, tile)| *tile == walls(4, 20)));
    for millis in (100..25_000).step_by(100) {
        server.observe(&look(at(millis), vec![Sighting::usual(LIAR, pose)]));
        if millis % 1_000 == 0 {
            let vector = sees(at(millis - 50), pose, 0.5);
            robot.say(&mut server, at(millis), &vector);
        }
        drain(&mut server, at(millis));
    }
    assert_eq!(events(&server), [(RobotEvent::Disagrees(LIAR), 1)]);
    assert!(server.fused().get(NEW).is_some_and(|(_, tile)| *tile == Tile::UNKNOWN));
}

/// A third robot sends `frames` frames with tiles in every tenth of a second. Returns the bytes
/// sent to the two others, their part of the map, the number of frames read, and the events.
fn with_flood(frames: usize) -> (Vec<usize>, Tile, u32, Vec<(RobotEvent, u64)>) {
    let mut server = server();
    let mut robots: Vec<RawRobot> = (0..3)
        .map(|port| RawRobot::connect(&mut server, port, RobotId(port as u16 + 1), at(0)))
        .collect();
    let interest = Interest { number: 1, from: BLIND, to: BLIND };
    let mut sent = Vec::new();
    let mut tiles = (0..).map(|x| TileId { x: 100 + x % 50, y: x / 50 % 50 });
    for millis in (100..4_000).step_by(100) {
        let now = at(millis);
        for robot in &mut robots[..2] {
            robot.say(&mut server, now, &interest);
            robot.draw(&mut server, now, BLIND, &walls(millis as usize / 500, 20));
        }
        let flood: Vec<u8> = (0..frames)
            .zip(&mut tiles)
            .flat_map(|(_, id)| robots[2].drawn(now, 0, id, &walls(3, 7)))
            .collect();
        server.receive(2, &flood, now).unwrap();
        sent.extend_from_slice(&drain(&mut server, now)[..2]);
    }
    let map = *server.fused().get(BLIND).unwrap().1;
    (sent, map, server.link_counters(2).received, events(&server))
}

#[test]
fn a_flood_is_dropped_without_effect_on_others() {
    let (alone, map, _, none) = with_flood(0);
    assert_eq!(none, []);
    let (sent, same, read, events) = with_flood(200);
    assert!(sent == alone && map == same, "the others are disturbed");
    assert_eq!(events, [(RobotEvent::Floods(RobotId(3)), 1)]);
    // A burst of 80 kB, and then 40 kB/s.
    println!("{read} of 7,800 frames read");
    assert!((1_000..6_000).contains(&read), "{read} of 7,800");
}

/// A robot whose observations are in the future must not be believed longer than the others.
#[test]
fn observations_from_the_future_count_as_now() {
    let mut server = server();
    let mut robots =
        [0, 1].map(|port| RawRobot::connect(&mut server, port, RobotId(port as u16), at(0)));
    let frame = robots[0].drawn(at(5_000), u32::MAX, BLIND, &walls(3, 20));
    server.receive(0, &frame, at(5_000)).unwrap();
    assert_eq!(server.fused().get(BLIND).unwrap().1, &walls(3, 20));
    robots[1].draw(&mut server, at(6_000), BLIND, &walls(4, 20));
    assert_eq!(server.fused().get(BLIND).unwrap().1, &walls(4, 20));
}

/// The server's clock is set back by an hour: sessions and the map must continue.
#[test]
fn a_server_continues_after_its_clock_is_set_back() {
    let mut server = server();
    let hour = 3_600_000;
    let mut robot = RawRobot::connect(&mut server, 0, RobotId(1), at(hour));
    robot.draw(&mut server, at(hour), BLIND, &walls(3, 20));
    drain(&mut server, at(hour));
    robot.draw(&mut server, at(1_000), NEW, &walls(4, 20));
    drain(&mut server, at(1_000));
    assert_eq!(server.fused().get(NEW).unwrap().1, &walls(4, 20));
    assert_eq!((server.message_counters(0), events(&server)), (MessageCounters::default(), vec![]));
}

#[test]
fn an_impossible_sighting_is_an_event_but_not_a_pose() {
    let mut server = server();
    let mut robot = RawRobot::connect(&mut server, 0, RobotId(1), at(0));
    robot.draw(&mut server, at(100), BLIND, &walls(3, 20));
    drain(&mut server, at(100));
    let map = server.fused().digest();
    let jumped = SightingEvent::Jumped(RobotId(1));
    server.sighting_event(at(900), jumped);
    server.sighting_event(at(300), SightingEvent::ClockAhead { camera: 2 });
    server.sighting_event(at(400), jumped);
    let told: Vec<_> = server.sighting_events().iter().collect();
    let ahead = SightingEvent::ClockAhead { camera: 2 };
    assert_eq!(told, [(jumped, 2, at(900)), (ahead, 1, at(300))]);
    assert_eq!(drain(&mut server, at(1_000)), [0; 3], "no message to any robot");
    assert_eq!(server.whereabouts(at(1_000)).count(), 0);
    assert_eq!(server.fused().digest(), map);
}

#[test]
fn cells_below_a_robot_are_not_occupied() {
    let mut server = server();
    let mut robot = RawRobot::connect(&mut server, 0, RobotId(1), at(0));
    let mut chair = Tile { low: [u32::MAX; TILE_SIDE], ..Tile::UNKNOWN };
    chair.set(16, 16, Cell::Occupied);
    robot.draw(&mut server, at(0), BLIND, &chair);
    let code = |server: &Server| server.fused().get(BLIND).unwrap().1.cell(16, 16);
    assert_eq!(code(&server), Cell::Occupied);
    let tile_m = 1.6;
    let upon = Pose::from_metres(5.5 * tile_m, 0.5 * tile_m, 0.0);
    let see = |server: &mut Server, millis, pose| {
        let robots = vec![Sighting::usual(RobotId(2), pose)];
        let captured = at(millis);
        server.observe(&Observation { captured, robots, ..Observation::default() });
    };
    see(&mut server, 1_000, upon);
    assert_eq!(code(&server), Cell::Free);
    see(&mut server, 1_100, Pose::from_metres(5.5 * tile_m, 3.0 * tile_m, 0.0));
    assert_eq!(code(&server), Cell::Occupied);
    see(&mut server, 900, upon);
    assert_eq!(code(&server), Cell::Occupied, "a late frame");
    see(&mut server, 1_200, upon);
    drain(&mut server, at(9_000));
    assert_eq!(code(&server), Cell::Free);
    let later = server
        .poll_timeout(0, at(9_000))
        .expect("a deadline at which the robot's position expires");
    assert!(later <= at(10_000));
    for step in 1..3 {
        drain(&mut server, at(9_000) + Duration::from_secs(10 * step));
    }
    assert_eq!(code(&server), Cell::Occupied);
}

/// For 40 s a robot sends tiles and a camera sees it. If `replayed`, an old Hello with its number
/// arrives every second. Returns the digest of the map; the number of pose fixes that the robot
/// got, and in how many steps it got tile updates; the number of bad frames; and how often a robot
/// joined.
fn with_old_hellos(replayed: bool) -> (Digest, [usize; 2], u32, usize) {
    let mut server = server();
    let mut robot = RawRobot::connect(&mut server, 0, RobotId(1), at(0));
    robot.say(&mut server, at(0), &Interest { number: 1, from: SEEN, to: BLIND });
    let mut heard = [0; 2];
    for step in 1..400_u64 {
        let now = at(step * 100);
        if replayed && step % 10 == 5 {
            // Two Hellos of earlier boots in turn, and new ones.
            let nonce = if step % 20 == 5 { 1 } else { 100 + step as u32 };
            server.receive(0, &RawRobot::hello(RobotId(1), nonce), now).unwrap();
        }
        if step % 5 == 0 {
            let apart = 3 + step as usize / 5 % 7;
            robot.draw(&mut server, now, if step % 2 == 0 { BLIND } else { NEW }, &walls(2, apart));
            let pose = Pose { x: Millimetres(step as i32), ..Pose::default() };
            server.observe(&look(now, vec![Sighting::usual(RobotId(1), pose)]));
        }
        server.timeout(now);
        let kinds = robot.hear(&mut server, now);
        let count = |kind: ToRobotKind| kinds.iter().filter(|&&it| it == u8::from(kind)).count();
        heard[0] += count(ToRobotKind::PoseFix);
        heard[1] += count(ToRobotKind::TileUpdate).min(1);
    }
    let joined = std::iter::from_fn(|| server.poll_event());
    let joined = joined.filter(|(_, event)| matches!(event, Event::Joined(..))).count();
    (server.fused().digest(), heard, server.link_counters(0).bad, joined)
}

#[test]
fn old_hellos_do_not_disturb_a_connected_robot() {
    let undisturbed = with_old_hellos(false);
    let (_, heard, bad, joined) = undisturbed;
    assert!(heard[0] >= 70 && heard[1] > 0, "{heard:?}");
    assert_eq!((bad, joined), (0, 1));
    assert_eq!(with_old_hellos(true), undisturbed);
}
