//! Recorded logs are replayed by robots over bad channels, and the server ends with one map.

use std::{fs::File, io::Read};

use clap::Parser;
use flate2::read::GzDecoder;
use ubimap_protocol::{
    tile::{Cell, TILE_SIDE, Tile, TileId},
    units::Millimetres,
};
use ubimap_sim_host::{
    grid::{OccupancyGrid, compare},
    report::{Report, json_pretty},
    run::{
        Outcome,
        options::{ReplayOptions, SimulateOptions},
        replay, simulate,
    },
    world::{Scenario, World},
};
use ubimap_tests::{data, per_ray};

/// The logs, each with the range in metres from which on readings mean no return.
const LOGS: [(&str, f64); 4] = [
    ("carmen_corrected/intel-corrected.log.gz", 81.0),
    ("carmen_corrected/freiburg-101-corrected.log.gz", 50.0),
    ("carmen_corrected/orebro-corrected.log.gz", 32.0),
    ("carmen_corrected/fhw-corrected.log.gz", 50.0),
];

/// Options for a link that loses, duplicates, reorders and damages frames.
const BAD_LINK: &str = "--loss 0.3 --duplicate 0.05 --reorder 0.1 --corrupt 0.02";

#[derive(Parser)]
struct CommandLine {
    #[command(flatten)]
    options: ReplayOptions,
}

fn run(log: &std::path::Path, options: &str) -> Outcome {
    let words = ["replay"].into_iter().map(Into::into).chain([log.as_os_str().to_owned()]);
    let words = words.chain(options.split_whitespace().map(Into::into));
    replay::run(&CommandLine::parse_from(words).options).unwrap()
}

#[derive(Parser)]
struct SimulateLine {
    #[command(flatten)]
    options: SimulateOptions,
}

/// Two robots with different sensors go round a table and a box.
const ROOM: &str = r#"
duration_s = 40
slice_height_m = 0.2
[room]
height_m = 3.0
outline_m = [[0.0, 0.0], [5.0, 0.0], [5.0, 4.0], [0.0, 4.0]]
[[furniture]]
footprint.box = { centre_m = [2.5, 2.0], size_m = [0.8, 0.6] }
top_m = 1.0
[[cameras]]
position_m = [2.5, 3.8, 2.8]
look_at_m = [2.5, 1.5, 0.0]
[[robots]]
id = 1
start = { x_m = 1.0, y_m = 1.0 }
route.waypoints_m = [[4.0, 1.0], [4.0, 2.4], [4.0, 1.0]]
[[robots]]
id = 2
start = { x_m = 4.0, y_m = 3.2, heading_deg = 180.0 }
route.waypoints_m = [[1.0, 3.2], [1.0, 2.0], [1.0, 3.2]]
sensor = { preset = "depth_row" }
"#;

#[test]
fn the_log_of_a_simulation_is_replayed_to_the_map_of_its_room() {
    let folder = std::path::Path::new(env!("CARGO_TARGET_TMPDIR"));
    let [room, log] = ["logged.toml", "logged.log.gz"].map(|name| folder.join(name));
    std::fs::write(&room, ROOM).unwrap();
    let fixed = ["simulate", "--scripted", "--ideal-cameras", "--log"].map(std::ffi::OsStr::new);
    let words = fixed.into_iter().chain([log.as_os_str(), room.as_os_str()]);
    simulate::run(&SimulateLine::parse_from(words).options).unwrap();
    let outcome = run(&log, "--robots 2");
    assert!(outcome.report.map.converged);
    assert!(outcome.report.robots.iter().all(|robot| robot.scans >= 400));

    let scenario = Scenario::read(&room).unwrap();
    let world = World::new(&scenario, None, Millimetres(50), 1).unwrap();
    let (truth, map) = (world.truth(), &outcome.map);
    let first = map.origin_m().map(|it| (it / map.resolution_m()).round() as i32);
    let cell = |x: i32, y: i32| map.cell((x - first[0]) as usize, (y - first[1]) as usize);
    let is_about = |(x, y): (i32, i32), cells: &dyn Fn(i32, i32) -> bool| {
        (-1..=1).any(|dy| (-1..=1).any(|dx| cells(x + dx, y + dy)))
    };
    let is_surface = |x, y| truth.surfaces.contains(&(x, y));
    let columns = 0..map.width() as i32;
    let cells = columns.flat_map(|x| (0..map.height() as i32).map(move |y| (x, y)));
    let occupied: Vec<_> = cells
        .map(|(x, y)| (x + first[0], y + first[1]))
        .filter(|&(x, y)| cell(x, y) == Cell::Occupied)
        .collect();
    let right = occupied.iter().filter(|&&at| is_about(at, &is_surface)).count();
    let is_drawn = |x, y| cell(x, y) == Cell::Occupied;
    let found = truth.surfaces.iter().filter(|&&at| is_about(at, &is_drawn)).count();
    let precision = right as f64 / occupied.len() as f64;
    let recall = found as f64 / truth.surfaces.len() as f64;
    println!("precision {precision:.3}, recall {recall:.3}");
    assert!(precision > 0.95 && recall > 0.95, "{precision} {recall}");
}

/// Map traffic to the server: bytes per mapped scan, and in total.
fn bytes(report: &Report) -> (f64, f64) {
    let bytes: u64 = report.robots.iter().map(|robot| robot.bytes_up_map).sum();
    let mapped: u64 = report.robots.iter().map(|robot| robot.mapped).sum();
    (bytes as f64 / mapped as f64, bytes as f64)
}

#[test]
#[ignore = "long: cargo thorough"]
fn a_bad_link_leads_to_the_map_of_a_perfect_one() {
    for (name, _) in LOGS {
        let Some(log) = data::file(name) else { return };
        let perfect = run(&log, "--robots 3");
        let bad = run(&log, &format!("--robots 3 {BAD_LINK}"));
        for outcome in [&perfect, &bad] {
            assert!(outcome.report.map.converged, "{name}");
            let refused: u64 = outcome.report.robots.iter().map(|it| it.cells_refused).sum();
            assert_eq!(refused, 0, "{name}");
        }
        let f1 = compare(&bad.map, &perfect.map, None).f1;
        let (clean, paid) = (bytes(&perfect.report), bytes(&bad.report));
        println!(
            "{name}: {:.1} bytes a scan and {:.2} bits a cell; bad link {:.1} bytes, {:.2} times as \
             many, F1 {f1:.4} against the perfect one",
            clean.0,
            perfect.report.map.bits_per_known,
            paid.0,
            paid.1 / clean.1,
        );
        assert!(f1 >= 0.98, "{name}: F1 {f1}");
        assert!(paid.1 <= 1.6 * clean.1, "{name}: {} bytes for {}", paid.1, clean.1);
        if name.contains("intel") {
            assert!(clean.0 <= 100.0 && perfect.report.map.bits_per_known <= 3.5);
            let others = perfect.report.comparison;
            println!("{name}: {} updates, {}", others.updates, perfect.report);
            let scans: u64 = perfect.report.robots.iter().map(|robot| robot.mapped).sum();
            assert_eq!(others.obstacle_distance_bytes, scans * 3 * 179, "of 180 beams");
            let bytes = [others.zlib_tiles_bytes, others.occupancy_grid_update_bytes];
            assert!(bytes.iter().all(|&bytes| bytes as f64 > clean.1), "{others:?}");
        }
    }
}

#[test]
fn the_seed_determines_the_report() {
    let Some(log) = data::file(LOGS[1].0) else { return };
    let report = |seed: u32| {
        let mut outcome = run(&log, &format!("--robots 2 {BAD_LINK} --seed {seed}"));
        outcome.report.elapsed_s = 0.0;
        (json_pretty(&outcome.report), outcome.map)
    };
    assert_eq!(report(7), report(7));
    assert_ne!(report(7).0, report(8).0);
}

/// The map of a log, drawn ray by ray.
fn oracle(log: &std::path::Path, no_return: f64) -> OccupancyGrid {
    let mut text = String::new();
    GzDecoder::new(File::open(log).unwrap()).read_to_string(&mut text).unwrap();
    let rays = per_ray::map(&text, 0.05, 4.0, no_return);
    let mut tiles = std::collections::BTreeMap::<TileId, Tile>::new();
    for (&(x, y), &odds) in &rays {
        let within = |cell: i32| cell.rem_euclid(TILE_SIDE as i32) as usize;
        let cell = if odds > 0.0 { Cell::Occupied } else { Cell::Free };
        let tile = tiles.entry(TileId::of_cell(x, y).unwrap()).or_default();
        tile.set(within(x), within(y), cell);
    }
    let tiles = tiles.iter().map(|(&id, tile)| (id, tile));
    OccupancyGrid::from_tiles(tiles, Millimetres(50)).unwrap()
}

#[test]
fn the_map_agrees_with_one_drawn_ray_by_ray() {
    for (name, no_return) in LOGS {
        let Some(log) = data::file(name) else { return };
        let oracle = oracle(&log, no_return);
        for robots in [1, 3] {
            let outcome = run(&log, &format!("--robots {robots}"));
            let scores = compare(&outcome.map, &oracle, None);
            println!("{name}, {robots} robots: F1 {:.4} against the ray-by-ray map", scores.f1);
            assert!(scores.f1 >= 0.98, "{name}, {robots} robots: {scores:?}");
        }
    }
}

/// The comparison of Aluckal III.A on public logs: cells kept, traffic and map quality of each
/// policy.
#[test]
#[ignore = "long: cargo thorough"]
fn the_papers_policies_are_compared() {
    for (name, no_return) in [LOGS[0], LOGS[3]] {
        let Some(log) = data::file(name) else { return };
        let oracle = oracle(&log, no_return);
        let mut before = u64::MAX;
        for policy in ["pilot", "threshold", "omission", "full"] {
            let outcome = run(&log, &format!("--policy {policy}"));
            let [robot] = &outcome.report.robots[..] else { panic!("one robot") };
            let f1 = compare(&outcome.map, &oracle, None).f1;
            println!(
                "{name}, {policy}: {} of {} points kept, {} scans, {} bytes up, F1 {f1:.4} against the ray-by-ray map",
                robot.pixels.kept, robot.pixels.seen, robot.mapped, robot.bytes_up_map
            );
            assert!(outcome.report.map.converged);
            // Each policy keeps fewer points than the one before, without loss of quality. The
            // exception is the paper's omission: when a robot drives straight, it considers little
            // more than the edge of the view.
            let kept = robot.pixels.kept;
            assert!(if policy == "full" { kept < robot.pixels.seen } else { kept <= before });
            assert!(f1 >= 0.98 || policy == "omission", "{policy}: {f1}");
            before = kept;
        }
    }
}
