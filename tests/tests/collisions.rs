//! Robots that drive themselves collide with nothing in any built-in scenario.
//!
//! `UBIMAP_SEEDS=20 cargo collisions` prints the table with ideal cameras, and `UBIMAP_SEEDS=5
//! UBIMAP_CAMERAS=filmed cargo collisions` with rendered ones; the default is two seeds.

use std::env;

use clap::Parser;
use ubimap_sim_host::{
    run::{options::SimulateOptions, simulate},
    world::NAMED,
};
use ubimap_tests::{data, seeds::seeds};

#[derive(Parser)]
struct CommandLine {
    #[command(flatten)]
    options: SimulateOptions,
}

#[test]
#[ignore = "takes long: cargo thorough, or cargo collisions for its table"]
fn robots_that_drive_themselves_never_collide() {
    let is_filmed = env::var("UBIMAP_CAMERAS").is_ok_and(|cameras| cameras == "filmed");
    let cameras: &[&str] = if is_filmed { &[] } else { &["--ideal-cameras"] };
    println!("| scenario | seed | collisions | contacts with people |\n|---|---|---|---|");
    let mut collisions = 0;
    // The office's walls come from a map.
    let plan = data::file("maps/ipa/lab_e.yaml").map(|path| path.display().to_string());
    for (scenario, seed) in
        NAMED.iter().flat_map(|(name, _)| seeds(1).map(move |seed| (name, seed)))
    {
        let number = seed.to_string();
        let mut line = vec!["simulate", scenario, "--seed", &number];
        line.extend(cameras);
        if *scenario == "office" {
            let Some(plan) = &plan else { continue };
            line.extend(["--map", plan]);
        }
        let options = CommandLine::parse_from(line).options;
        let report = simulate::run(&options).unwrap().report;
        let driving = report.driving.unwrap();
        println!("| {} | {seed} | {} | {} |", scenario, driving.collisions, driving.touches);
        collisions += driving.collisions;
    }
    assert_eq!(collisions, 0);
}
