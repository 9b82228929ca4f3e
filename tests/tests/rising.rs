//! People who sat there from the beginning, as rendered cameras see them and robots are told of them,
//! against the true room.

use ubimap_agent::Memory;
use ubimap_protocol::{
    message::{ObstacleClass, Posture},
    tile::{Cell, TILE_SIDE, TileId},
    time::Instant,
};
use ubimap_sim_host::{
    channel::fault::Faults,
    run::{
        fleet::Fleet,
        room_stage::RoomStage,
        simulate::{RESOLUTION, config, deployment_config},
    },
    world::{Scenario, World},
};
use ubimap_tests::deployments::deployed;

/// When the person rises, and the walk: 2 m, in two seconds, and a long pause.
const RISES_S: f64 = 9.0;
const SEAT_M: [f64; 2] = [1.4, 1.9];
const ROOM: &str = "
    duration_s = 20.0
    slice_height_m = 0.2
    [room]
    height_m = 2.8
    outline_m = [[0.0, 0.0], [4.4, 0.0], [4.4, 3.0], [0.0, 3.0]]
    [[cameras]]
    position_m = [0.2, 0.2, 2.6]
    look_at_m = [1.9, 1.6, 0.0]
    rate_hz = 5.0
    depth = { width = 320, height = 240 }
    picture = { width = 640, height = 480 }
    [[cameras]]
    position_m = [4.2, 0.2, 2.6]
    look_at_m = [2.3, 1.6, 0.0]
    rate_hz = 5.0
    depth = { width = 320, height = 240 }
    picture = { width = 640, height = 480 }
    [[robots]]
    id = 1
    start = { x_m = 2.2, y_m = 0.9, heading_deg = 90.0 }
    marker_size_m = 0.16
    [[people]]
    waypoints_m = [[1.4, 1.9], [3.4, 1.9]]
    speed_m_s = 1.0
    pause_s = 60.0
    posture = \"sitting\"
    heading_deg = -90.0
    rises_s = 9.0
";

/// What the robot and the map knew of the person.
#[derive(Debug, Default)]
struct Known {
    /// Of the free cells under the seated person: how many are occupied when they rise, and at the end.
    seated: usize,
    left: usize,
    /// When the robot was first told of a person near the true place, and of the first other one.
    told_s: Option<f64>,
    wrong: Option<(f64, f64, f64)>,
    postures: Vec<Posture>,
}

/// The person's true place.
fn truth(now_s: f64) -> [f64; 2] {
    [SEAT_M[0] + (now_s - RISES_S).clamp(0.0, 2.0), SEAT_M[1]]
}

#[test]
fn robots_are_told_of_a_person_who_rises_and_the_place_becomes_free() {
    let scenario = Scenario::from_toml(ROOM, "rising.toml").unwrap();
    let world = World::new(&scenario, None, RESOLUTION, 1).unwrap();
    let side = RESOLUTION.metres();
    let ground: Vec<(i32, i32)> = world.truth().free.clone();
    let is_seat = |&&(x, y): &&(i32, i32)| {
        let [x, y] = [x, y].map(|cell| (f64::from(cell) + 0.5) * side);
        (x - SEAT_M[0]).hypot(y - SEAT_M[1]) < 0.6
    };
    let seat: Vec<(i32, i32)> = ground.iter().filter(is_seat).copied().collect();
    let configs: Vec<_> = world.robots().iter().map(|it| config(it, 1).with_drive(None)).collect();
    let mut memory: Vec<_> = configs.iter().map(|it| Memory::new(&it.bounds)).collect();
    let deployment = deployed(deployment_config(&scenario, &world, true));
    let faults = Faults::default();
    let mut fleet = Fleet::new(&configs, &mut memory, faults, 1, deployment).unwrap();
    let mut known = Known::default();
    let mut stage = RoomStage::filmed(world, Instant(20_000_000));
    fleet
        .run(&mut stage, |fleet| {
            let now_s = fleet.now().micros() as f64 / 1e6;
            let is_occupied = |&&(x, y): &&(i32, i32)| {
                let within = |cell: i32| cell.rem_euclid(TILE_SIDE as i32) as usize;
                let tile = TileId::of_cell(x, y).and_then(|id| fleet.server().fused().get(id));
                tile.is_some_and(|(_, tile)| {
                    matches!(tile.cell(within(x), within(y)), Cell::Occupied | Cell::Movable)
                })
            };
            let occupied = seat.iter().filter(is_occupied).count();
            if now_s < RISES_S {
                known.seated = occupied
            } else {
                known.left = occupied
            }
            let Some(told) = fleet.robots()[0].robot().commands().obstacles() else { return };
            for (it, posture) in told.told() {
                if it.class != ObstacleClass::Person || now_s > 19.9 {
                    continue;
                }
                // News is up to half a second old.
                let (x, y) = (it.x.metres(), it.y.metres());
                let [at, early] = [now_s, now_s - 0.5].map(truth);
                if (early[0] - 0.5..at[0] + 0.5).contains(&x) && (y - at[1]).abs() < 0.5 {
                    known.told_s.get_or_insert(now_s);
                    known.postures.push(posture);
                } else {
                    known.wrong.get_or_insert((now_s, x, y));
                }
            }
        })
        .unwrap();
    let after = known.told_s.map(|told| told - RISES_S);
    println!(
        "a person who rises: told as a person after {after:?} s; of {} cells drawn at the seat {} are left",
        known.seated, known.left
    );
    assert!(after.is_some_and(|after| (0.0..1.0).contains(&after)), "{after:?}");
    assert_eq!(known.wrong, None);
    assert!(known.seated > 20 && known.left <= known.seated / 20, "{known:?}");
    let standing = known.postures.iter().filter(|it| **it == Posture::Standing).count();
    assert!(10 * standing >= 9 * known.postures.len(), "{known:?}");
}
