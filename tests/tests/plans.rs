//! Robots map real floor plans, of which cameras see little.
//!
//! `cargo plans` prints the table, first with eight robots and sixteen cameras, then with four and six; `UBIMAP_PLANS=office_b,lab_c`
//! chooses plans, `UBIMAP_SEEDS=3` more seeds, and `UBIMAP_ROBOTS=4` four robots only. A run takes some minutes; there are
//! as many at a time as processors.

use std::{
    env,
    io::Write,
    sync::{
        atomic::{AtomicUsize, Ordering},
        mpsc,
    },
    thread,
};

use clap::Parser;
use ubimap_sim_host::run::{options::SimulateOptions, simulate};
use ubimap_tests::{data, seeds::seeds};

/// The plans of `maps/ipa`.
const PLANS: [&str; 8] = [
    "lab_c",
    "lab_e",
    "office_a",
    "office_b",
    "office_b_furnitures",
    "office_c",
    "office_d",
    "office_d_furnitures",
];

/// The places of cameras, robots and people follow from the plan.
const SCENARIOS: [(&str, &str); 2] = [
    ("8", concat!(env!("CARGO_MANIFEST_DIR"), "/plans/eight.toml")),
    ("4", concat!(env!("CARGO_MANIFEST_DIR"), "/plans/four.toml")),
];

#[derive(Parser)]
struct CommandLine {
    #[command(flatten)]
    options: SimulateOptions,
}

#[test]
#[ignore = "takes more than an hour: cargo plans"]
fn robots_map_floor_plans() {
    let only = env::var("UBIMAP_ROBOTS").ok();
    let is_chosen = |robots: &str| only.as_ref().is_none_or(|only| only == robots);
    assert!(SCENARIOS.iter().any(|(robots, _)| is_chosen(robots)), "UBIMAP_ROBOTS: 4 or 8");
    let chosen = env::var("UBIMAP_PLANS").unwrap_or_else(|_| PLANS.join(","));
    let plans = chosen.split(',');
    for plan in plans.clone() {
        assert!(PLANS.contains(&plan), "UBIMAP_PLANS: no plan {plan}; there are {PLANS:?}");
    }
    println!(
        "| robots, plan, seed | F1 | poses RMS | blind ground mapped | all of it after | stood at most | collisions |\n\
         |---|---|---|---|---|---|---|"
    );
    let scenarios = SCENARIOS.into_iter().filter(|(robots, _)| is_chosen(robots));
    let runs: Vec<Run<'_>> = scenarios
        .flat_map(|(robots, scenario)| {
            let plans = plans.clone().flat_map(|plan| seeds(1).map(move |seed| (plan, seed)));
            plans.map(move |(plan, seed)| Run { robots, scenario, plan, seed })
        })
        .collect();
    if data::file("maps/ipa").is_none() {
        return;
    }
    let (next, threads) =
        (AtomicUsize::new(0), thread::available_parallelism().map_or(1, |it| it.get()));
    let (sender, receiver) = mpsc::channel();
    let mut collisions = 0;
    thread::scope(|scope| {
        for sender in vec![sender; threads] {
            let (runs, next) = (&runs, &next);
            scope.spawn(move || {
                while let Some(run) = runs.get(next.fetch_add(1, Ordering::Relaxed)) {
                    sender.send(run.row()).unwrap();
                }
            });
        }
        // As they end, so not quite in the order of the runs.
        for (row, its) in receiver {
            println!("{row}");
            let _ = std::io::stdout().flush();
            collisions += its;
        }
    });
    assert_eq!(collisions, 0);
}

struct Run<'a> {
    robots: &'a str,
    scenario: &'a str,
    plan: &'a str,
    seed: u64,
}

impl Run<'_> {
    /// Simulates it: its row of the table, and the number of collisions.
    fn row(&self) -> (String, u64) {
        let Self { robots, scenario, plan, seed } = self;
        let map = data::file(&format!("maps/ipa/{plan}.yaml")).unwrap();
        let (map, text) = (map.display().to_string(), seed.to_string());
        let line = ["simulate", scenario, "--map", &map, "--ideal-cameras", "--seed", &text];
        let report = simulate::run(&CommandLine::parse_from(line).options).unwrap().report;
        let (pose, driving) = (report.pose.unwrap(), report.driving.unwrap());
        let after = driving.mapped_s.map_or("-".to_owned(), |seconds| format!("{seconds:.0} s"));
        let row = format!(
            "| {robots}, {plan}, {seed} | {:.3} | {:.0} cm, {:.1} degrees | {:.1} % of {:.0} m2 | {after} | {:.0} s | {} |",
            report.truth.unwrap().f1_occupied,
            100.0 * pose.rmse_m,
            pose.rmse_deg,
            100.0 * driving.blind_mapped,
            driving.blind_m2,
            driving.stood_s,
            driving.collisions,
        );
        (row, driving.collisions)
    }
}
