//! Ahmed, Saatchi and Caparrelli (2013).

use super::{
    super::{Outcome, RunError, scale},
    page::{Has, Page, grouped, row},
    runs::Runs,
};
use crate::report::{Report, VisionBand};

/// The first experiment, filmed by the ceiling cameras.
const FIRST: &str = "ahmed-2013 --sensor grey-camera --motion boundary";
const WAITS: &str = "ahmed-2013 --sensor grey-camera --motion stop-and-wait --ideal-cameras";
const RANGE: &str = "ahmed-2013 --sensor range --scripted --ideal-cameras";
const SECOND: &str = "ahmed-2013-b --sensor grey-camera --motion boundary --ideal-cameras";
const MASKS: [&str; 3] = ["none", "square", "footprint"];
const ASKEW: [f64; 2] = [0.0, 5.0];

fn askew(degrees: f64) -> String {
    format!("{FIRST} --ideal-cameras --identifier-askew {degrees}")
}

/// A run with a mask; the footprint is the default.
fn masked(mask: &str) -> String {
    if mask == "footprint" { WAITS.to_owned() } else { format!("{WAITS} --peer-mask {mask}") }
}

/// The options of all runs.
pub(super) fn lines() -> Vec<String> {
    let single = [FIRST, WAITS, SECOND, RANGE].map(str::to_owned);
    let masked = MASKS.into_iter().map(masked).filter(|line| line != WAITS);
    single.into_iter().chain(ASKEW.map(askew)).chain(masked).collect()
}

pub(super) fn write(page: &mut Page, runs: &mut Runs) -> Result<(), RunError> {
    page.paper(
        "Ahmed et al. (2013)",
        "M. S. Ahmed, R. Saatchi, F. Caparrelli: Vision based environment mapping by network connected \
         multi-robotic system. PECCS 2013, 49-54.",
    );
    let first = runs.simulate(FIRST)?;
    page.section("1 Introduction (Ahmed)", Has::Nothing);
    page.say("The paper's robots do no SLAM and send simple features; so do ours.");
    methodology(page, &first.report);
    boundary_detection(page, &first)?;
    localisation(page, &first.report);
    mapping(page, &first.report)?;
    page.section("3 Results", Has::Experiment);
    first_experiment(page, runs, &first)?;
    heading_error(page, runs)?;
    second_experiment(page, runs)?;
    masks(page, runs)?;
    page.section("4 Conclusion (Ahmed)", Has::Claims);
    let seconds = first.report.simulated_s.max(1.0);
    let up: u64 = first.report.robots.iter().map(|robot| robot.bytes_up).sum();
    let down: u64 = first.report.robots.iter().map(|robot| robot.bytes_down).sum();
    page.say(&format!(
        "\"Near by object boundaries can be mapped with higher accuracy\": confirmed, see 2.3. The features do \
         \"not overload the communication network between the robots\": in the first experiment the {} robots send \
         {} bytes per second together, and get {}; a picture of 320 x 240 has 76,800 bytes.",
        first.report.robots.len(),
        grouped((up as f64 / seconds) as u64),
        grouped((down as f64 / seconds) as u64)
    ));
    Ok(())
}

fn methodology(page: &mut Page, report: &Report) {
    page.section("2 Methodology", Has::Claims);
    page.say(&format!(
        "Printed: each robot draws its own map, broadcasts its updates to all others and to the server, and so \
         maintains \"a common map which is built by the contribution of all the robots\". Ours send updates to the \
         server alone, which sends the merged map to each. At the end of experiment 1 all maps {}.",
        if report.map.converged { "are equal, bit by bit" } else { "are NOT equal" }
    ));
}

fn boundary_detection(page: &mut Page, first: &Outcome) -> Result<(), RunError> {
    page.section("2.1 Objects' boundary detection", Has::Experiment);
    page.say(
        "Printed: the image is segmented, the region at the middle of its bottom is the floor, and its \
            height in each of 320 columns \
         is the distance vector. The segmentation itself is not described; ours grows the floor from \
         that region upwards (573,000 \
         instructions on a Cortex-M4). The pictures are rendered, 320 x 240, with texture, vignetting, \
         blur and noise; the arena's blocks are \
         dark on a light floor without joints. On the tiled floor of our other rooms a joint counts as a \
         boundary, and \
         where blocks are as grey as the floor, none is found: the method needs contrast, which the \
         paper does not say.",
    );
    page.picture_of(
        "ahmed-robot-view",
        first,
        "robot-view.png",
        "Figure 1 b to d: a robot's picture, its floor, its distance vector (red)",
    )
}

fn localisation(page: &mut Page, report: &Report) {
    page.section("2.2 Robot localisation", Has::Claims);
    let sighted = report.sighted.unwrap_or_default();
    page.say(&format!(
        "Printed: two ceiling cameras, three zones, fused in the middle one; coloured markers with \
            cover, head and tail; no accuracy is \
         given. Ours: the same layout, {} sightings of driving robots, {:.1} mm and {:.2} degrees off (RMS).",
        sighted.count,
        1_000.0 * sighted.rmse_m,
        sighted.rmse_deg
    ));
}

fn mapping(page: &mut Page, report: &Report) -> Result<(), RunError> {
    page.section("2.3 Mapping", Has::Experiment);
    let printed = scale::table_1()?;
    let vision = report.vision.clone().unwrap_or_default();
    page.say(
        "Table 1 and equation 1. The paper's table is in pixels of the ceiling camera; ours was measured \
            by the simulated robot itself before \
         the run, with a board at the same ten ratios of distances, and is in millimetres (`ubimap \
         scale` fits any such table). Equation 1 \
         as printed has rounded coefficients: it lies below its own table throughout.",
    );
    let rows = printed.rows.iter().zip(&printed.as_printed).enumerate().map(
        |(index, (theirs, equation))| {
            let ours = vision.scale.get(index).copied().unwrap_or_default();
            row([
                theirs.pixels.to_string(),
                format!("{:.0}", theirs.distance),
                format!("{:.2}", theirs.distance / f64::from(theirs.pixels)),
                format!("{equation:.1}"),
                format!("{:.1}", theirs.fitted),
                ours.pixels.to_string(),
                format!("{:.0}", ours.distance),
                format!("{:.1}", ours.fitted),
            ])
        },
    );
    page.table(
        &[
            "d_r printed",
            "d_c printed",
            "scale factor printed",
            "by equation 1",
            "by our fit of it",
            "d_r ours",
            "distance ours (mm)",
            "by our fit (mm)",
        ],
        &rows.collect::<Vec<_>>(),
    );
    page.say(
        "\"Objects detected near the robot will be mapped with higher accuracy\": the distance of a \
            boundary's point from its true \
         place. The paper takes distances as ranges along bearings spread evenly over 90 degrees; a line \
         of an image has a constant depth, \
         so that this bends every boundary. Equation 5 also mirrors everything to the robot's left (its \
         slope has no sign); ours keeps the quadrant.",
    );
    let bands = vision.bands.iter().map(|band: &VisionBand| {
        row([
            format!("{:.2} to {:.2}", band.from_m, band.to_m),
            grouped(band.columns),
            format!("{:.0}", band.median_mm),
            format!("{:.0}", band.ninth_mm),
            format!("{:.0}", band.as_ranges_mm),
        ])
    });
    page.table(
        &[
            "distance (m)",
            "columns",
            "median error (mm)",
            "nine of ten within (mm)",
            "median as printed (mm)",
        ],
        &bands.collect::<Vec<_>>(),
    );
    Ok(())
}

/// The table of what a run has mapped.
fn mapped(report: &Report) -> [String; 5] {
    let truth = report.truth.unwrap_or_default();
    let area = report.map.known as f64 * report.map.resolution_m.powi(2);
    let bytes: u64 = report.robots.iter().map(|robot| robot.bytes_up_map).sum();
    [
        format!("{area:.1} m2, {:.0} %", 100.0 * truth.coverage),
        format!("{:.3}", truth.f1_occupied),
        report.drawn_on_standing.map_or("-".to_owned(), |cells| cells.to_string()),
        grouped(report.robots.iter().map(|robot| robot.mapped).sum()),
        grouped(bytes),
    ]
}

const MAPPED: [&str; 7] = [
    "run",
    "time",
    "ground mapped",
    "F1",
    "cells on R3 and R4",
    "pictures or scans mapped",
    "map bytes up",
];

fn mapped_row(name: &str, run: &Outcome) -> Vec<String> {
    let time = run.caption.time_s.unwrap_or_default();
    let time = format!("{} min {:.0} s", (time / 60.0) as u32, time % 60.0);
    let mut row = vec![name.to_owned(), time];
    row.extend(mapped(&run.report));
    row
}

fn first_experiment(page: &mut Page, runs: &mut Runs, first: &Outcome) -> Result<(), RunError> {
    let waits = runs.simulate(WAITS)?;
    let range = runs.simulate(RANGE)?;
    page.say(&format!(
        "Experiment 1, `simulate {FIRST}`: R1 and R2 follow boundaries and stop for each picture until \
            the ceiling cameras have \
         localised them; R3 and R4 stand. Printed: 4 min 21 s, \"sufficient\" map, parts unmapped, no \
         figures. Ours ran for \
         the same time. The second row is led by the server to unmapped ground (\"a path planning \
         strategy can be used\"), the third has a \
         range sensor and drives a fixed route; both with ideal ceiling cameras."
    ));
    page.table(
        &MAPPED,
        &[
            row([
                "printed".to_owned(),
                "4 min 21 s".to_owned(),
                "not given".to_owned(),
                "not given".to_owned(),
                "some".to_owned(),
                "not given".to_owned(),
                "not given".to_owned(),
            ]),
            mapped_row("boundary following", first),
            mapped_row("stop and wait, led by the server", &waits),
            mapped_row("range sensor, fixed route", &range),
        ],
    );
    page.map("ahmed-1-map", first, "Figure 5 c: the map after the first experiment")?;
    page.picture_of("ahmed-1-error", first, "error.png", "Wrong and missing surfaces in it")
}

fn heading_error(page: &mut Page, runs: &mut Runs) -> Result<(), RunError> {
    let rows = ASKEW.map(|degrees| {
        let run = runs.simulate(&askew(degrees))?;
        let mut row = mapped_row(&format!("marker askew by {degrees} degrees"), &run);
        let pose = run.report.pose.unwrap_or_default();
        row.push(format!("{:.2}", pose.rmse_deg));
        Ok(row)
    });
    let rows = rows.into_iter().collect::<Result<Vec<_>, RunError>>()?;
    page.say(
        "The blue arrow: \"a small error in the detected robot orientation can generate considerable \
            error in the mapped boundaries\". \
         At 0.6 m, the far end of table 1, an error of 5 degrees moves a boundary by 52 mm, one cell of \
         ours. A server can find \
         a marker that was glued on askew by the robot's course over ground. The last column is what is left of the \
         error: all of it where robots move by 3.5 cm between stops, which gives no course.",
    );
    let mut columns = MAPPED.to_vec();
    columns.push("heading error of the robots (degrees RMS)");
    page.table(&columns, &rows);
    Ok(())
}

fn second_experiment(page: &mut Page, runs: &mut Runs) -> Result<(), RunError> {
    let second = runs.simulate(SECOND)?;
    page.say("Experiment 2, `simulate ahmed-2013-b --sensor grey-camera --motion boundary \
             --ideal-cameras`: the blocks in another order (ours are guessed, as the paper gives no \
             measures). Printed: \"sufficient environmental map\".");
    page.table(&MAPPED, &[mapped_row("boundary following", &second)]);
    page.map("ahmed-2-map", &second, "Figure 6 c: the map after the second experiment")
}

fn masks(page: &mut Page, runs: &mut Runs) -> Result<(), RunError> {
    page.say(
        "\"Some of the boundaries resulted from the surfaces of static robots R3 and R4 were erroneously \
            mapped\", because the window around \
         a robot was square. The same experiment with each mask, led by the server so that the robots \
         pass R3 and R4, with ideal ceiling cameras:",
    );
    let rows = MASKS.map(|mask| {
        Ok(mapped_row(&format!("`--peer-mask {mask}`"), runs.simulate(&masked(mask))?.as_ref()))
    });
    page.table(&MAPPED, &rows.into_iter().collect::<Result<Vec<_>, RunError>>()?);
    page.say("Our square contains the footprint at any heading with a margin for all uncertainties, so \
             that nothing is drawn: the paper's was too small. What a square costs is walls beside a \
             robot; the test `peers` measures it.");
    Ok(())
}
