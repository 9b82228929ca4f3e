//! Djerroud et al. (2025).

use super::{
    super::RunError,
    page::{Has, Page, grouped, row},
    runs::Runs,
};
use crate::report::Report;

/// Instructions of one distance computed by scan matching, as compiled: two differences, two squares, a
/// comparison, and the loads.
const DISTANCE: f64 = 12.0;
/// Measured instructions of a drawn row, of a fix (tests/README.md).
const DRAWN: f64 = 21_700.0;
const FIX: f64 = 6_240.0;
/// Energy of an instruction and of a byte sent by radio, in microjoules: 165 mW at 150 MIPS, and a cheap
/// 2.4 GHz radio at 100 mW and 250 kbit/s net.
const INSTRUCTION_UJ: f64 = 0.0011;
const BYTE_UJ: f64 = 3.2;

const FIGURE: &str = "ubislam-figure-1 --baselines";
const SCRIPTED: &str = "ubislam-figure-1 --baselines --scripted --ideal-cameras";

/// The options of all runs.
pub(super) fn lines() -> Vec<String> {
    [FIGURE, SCRIPTED].map(str::to_owned).to_vec()
}

pub(super) fn write(page: &mut Page, runs: &mut Runs) -> Result<(), RunError> {
    page.paper(
        "UbiSLAM (2025)",
        "H. Djerroud, N. Steyn, O. Rabreau, P. Bonnin, A. Benali: Towards ubiquitous mapping and \
            localization for dynamic indoor environments. ICAART 2025, 537-548.",
    );
    let run = runs.simulate(FIGURE)?;
    page.section("1 Introduction (UbiSLAM)", Has::Experiment);
    page.say("Figure 1, `simulate ubislam-figure-1 --baselines`: four RGB-D cameras, R1 to R3, OB1 and \
             OB2; measures are ours, as the figure has none. The robots explore what no camera sees.");
    if let Some((_, svg)) = run.tables.iter().find(|(name, _)| *name == "network.svg") {
        page.file(
            "ubislam-figure-1.svg",
            svg.clone().into_bytes(),
            "Figure 1: the map, and the network in three dimensions",
        );
    }
    page.section("2 Limitations of SLAM in indoor environments", Has::Nothing);
    page.section("2.1 Review of SLAM methods", Has::Nothing);
    page.section("2.2 Limitations of SLAM methods", Has::Claims);
    errors(page, &run.report, &runs.simulate(SCRIPTED)?.report);
    page.section("3 Ubiquitous mapping approach", Has::Claims);
    load(page, &run.report);
    page.section("3.1 Challenges inherent to UbiSLAM", Has::Claims);
    changes(page, &run.report);
    page.section("4 Camera placement optimization", Has::Method);
    page.say("No experiment is printed. `ubimap place` solves the printed integer programme (coverage, m \
             and k) for a map, with shadows, and says how far from optimal its answer can be; \
             tests/README.md has its figures.");
    page.section("5 Cameras on the same plane", Has::Method);
    page.say(
        "No experiment is printed. `ubimap calibrate` and `simulate --calibrate`: landmarks, \
             pairwise transformations, graph, Levenberg-Marquardt; figures in tests/README.md.",
    );
    page.section("6 Localization", Has::Claims);
    let sighted = run.report.sighted.unwrap_or_default();
    page.say(&format!(
        "No figure is printed (\"the robot's exact position\"). Ours in this run: {} sightings of \
            driving robots, {:.1} mm and {:.2} degrees off (RMS). People and things are told by their \
         shape against the learnt room, without a trained detector such as YOLO. Specialised items are not \
         told from other things, and there is no history of where things were: the server keeps the map, and how \
         often each cell has changed.",
        sighted.count,
        1_000.0 * sighted.rmse_m,
        sighted.rmse_deg
    ));
    page.section("7 Discussion", Has::Claims);
    let driving = run.report.driving.unwrap_or_default();
    page.say(&format!(
        "Blind spots \"require data from the robots\": of {:.1} m2 of reachable blind ground the robots \
            mapped {:.0} %. Collisions: {}.",
        driving.blind_m2,
        100.0 * driving.blind_mapped,
        driving.collisions
    ));
    people(page, &run.report);
    page.section("8 Conclusion", Has::Nothing);
    Ok(())
}

fn people(page: &mut Page, report: &Report) {
    page.say(
        "Robots are told of each person with the posture (standing, sitting, lying: two bits), from the height. \
             Whoever sits or lies from the first frame on is furniture to the cameras until they rise.",
    );
    let time = |time: Option<f64>| time.map_or("never".to_owned(), |it| format!("after {it:.1} s"));
    for rising in &report.risings {
        page.say(&format!(
            "In this run one gets up at {:.0} s: robots are told of a person {}, and nine of ten of the {} cells \
                 drawn at the seat are free {}, the time to walk away included.",
            rising.at_s,
            time(rising.told_s),
            rising.cells,
            time(rising.freed_s)
        ));
    }
}

fn errors(page: &mut Page, report: &Report, scripted: &Report) {
    page.say("Claimed, not measured: SLAM onboard accumulates drift, fixed cameras do not. The same \
             three robots in the same run: with fixes of the cameras; by odometry alone (each with \
             errors of its own, some 1 % and half a degree per metre); and with scan matching of their own (point to line, with odometry as prior, \
             without loop closure; a full SLAM would be better than that). Mean position errors:");
    let Some(baselines) = &report.baselines else { return };
    let rows = baselines.errors.iter().map(|errors| {
        row([
            format!("until {:.0} s", errors.until_s),
            format!("{:.3} m", errors.cameras_m),
            format!("{:.3} m", errors.odometry_m),
            format!("{:.3} m", errors.matching_m),
        ])
    });
    page.table(
        &["time", "with cameras", "odometry alone", "own scan matching"],
        &rows.collect::<Vec<_>>(),
    );
    let scripted = scripted.baselines.as_ref().and_then(|it| it.errors.last());
    let scripted = scripted.copied().unwrap_or_default();
    page.say(&format!(
        "The baseline \"own scan matching\" is fragile: it depends on what a route shows. Above the robots explore. On \
         the scripted routes of the same room (`--scripted --ideal-cameras`) the errors in the last interval are \
         {:.3} m with cameras, {:.3} m by odometry alone and {:.3} m with own scan matching.",
        scripted.cameras_m, scripted.odometry_m, scripted.matching_m
    ));
}

fn load(page: &mut Page, report: &Report) {
    page.say(
        "Claimed, not measured: the load of the robots falls. Per robot and second, from counts of \
             this run and measured costs of a Cortex-M4 (a drawn row 21,700 instructions for 640 \
             columns, ours have 160; a fix 6,240); matching at 12 instructions for each distance \
             computed. Energy is estimated at 1.1 nJ an instruction and 3.2 uJ a byte by radio.",
    );
    let robots = report.robots.len().max(1) as f64;
    let seconds = report.simulated_s.max(1.0);
    let each = |sum: u64| sum as f64 / robots / seconds;
    let mapped = each(report.robots.iter().map(|robot| robot.mapped).sum());
    let up = each(report.robots.iter().map(|robot| robot.bytes_up).sum());
    let down = each(report.robots.iter().map(|robot| robot.bytes_down).sum());
    let baselines = report.baselines.clone().unwrap_or_default();
    let matching = each(baselines.matched) * baselines.distances_per_scan * DISTANCE;
    let drawing = mapped * DRAWN / 4.0;
    let energy =
        |instructions: f64, bytes: f64| (instructions * INSTRUCTION_UJ + bytes * BYTE_UJ) / 1_000.0;
    // Fixes come at the cameras' 10 Hz.
    let ours = drawing + 10.0 * FIX;
    let line = |name: &str, instructions: f64, up: f64, down: f64| {
        row([
            name.to_owned(),
            grouped(1_000 * (instructions / 1_000.0).round() as u64),
            grouped(up as u64),
            grouped(down as u64),
            format!("{:.2} mJ", energy(instructions, up + down)),
        ])
    };
    page.table(
        &["robot", "instructions", "bytes up", "bytes down", "energy (estimate)"],
        &[
            line("with the cameras", ours, up, down),
            line("own scan matching and drawing, alone", drawing + matching, 0.0, 0.0),
        ],
    );
    page.say(&format!(
        "By this estimate the instructions fall by a factor of {:.1}. The energy does not fall: by a cheap radio the \
         bytes, most of them down, cost more than the arithmetic that they save. Not in it: path planning, which both \
         need, and a loop closure, which only the second needs.",
        (drawing + matching) / ours.max(1.0)
    ));
}

fn changes(page: &mut Page, report: &Report) {
    page.say(
        "\"The map is continuously updated\": OB2 is moved in the cameras' view. Age of the map \
             after it:",
    );
    let time = |time: Option<f64>| time.map_or("never".to_owned(), |it| format!("{it:.1} s"));
    let rows = report.changes.iter().map(|change| {
        row([
            format!("{:.0} s", change.at_s),
            format!("{} new, {} old", change.cells[0], change.cells[1]),
            time(change.drawn_s),
            time(change.removed_s),
        ])
    });
    page.table(
        &[
            "change at",
            "cells",
            "half of the new drawn after",
            "nine of ten of the old removed after",
        ],
        &rows.collect::<Vec<_>>(),
    );
    page.say("Placement, calibration, communication and merging, the challenges a to d: sections 4 and \
             5, `protocol/SPEC.md`, and the fused layer, in which robots fill what the cameras do not see.");
}
