//! Aluckal et al. (2020).

use std::sync::Arc;

use super::{
    super::{Outcome, RunError},
    awareness,
    page::{Has, Page, grouped, row},
    runs::Runs,
};
use crate::report::PointsSummary;

/// Measured instructions of a Cortex-M4 for a row of 640 depths that is drawn, and for one that is skipped
/// (tests/README.md).
const DRAWN: f64 = 21_700.0;
const SKIPPED: f64 = 2_060.0;

const POLICIES: [&str; 5] = ["pilot", "threshold", "omission", "omission-as-printed", "full"];

/// The room with the exposure mask, which all tables but that of the exposure have.
const ROOM: &str = "aluckal-room --exposure mask";
const EXPOSURES: [&str; 3] = ["any", "mask", "normalise"];
/// The policies that are compared for each exposure.
const EXPOSED: [&str; 2] = ["threshold", "full"];

fn policy(policy: &str) -> String {
    format!("{ROOM} --policy {policy}")
}

fn linear() -> String {
    policy("threshold --pixel-model linear")
}

fn by_axis() -> String {
    policy("threshold --gate by-axis")
}

fn exposed(exposure: &str, policy: &str) -> String {
    format!("aluckal-room --exposure {exposure} --policy {policy}")
}

/// The options of all runs.
pub(super) fn lines() -> Vec<String> {
    let policies = POLICIES.into_iter().map(policy);
    let exposures = EXPOSURES.into_iter().filter(|it| *it != "mask");
    let exposures = exposures.flat_map(|it| EXPOSED.map(|policy| exposed(it, policy)));
    let all = policies.chain([linear(), by_axis()]).chain(exposures);
    all.chain(awareness::lines()).collect()
}

pub(super) fn write(page: &mut Page, runs: &mut Runs) -> Result<(), RunError> {
    page.paper(
        "Aluckal et al.",
        "C. Aluckal et al.: Dynamic real-time indoor environment mapping for unmanned autonomous vehicle \
            navigation.",
    );
    page.section("I Introduction", Has::Nothing);
    page.say("The method must work \"in complete isolation, i.e. without communication with a base station\". \
             So the room below has no fixed camera, and the robot draws by its own odometry; the server only \
             collects its map.");
    page.section("II.A Data acquisition", Has::Method);
    page.say("Plane slicing: one row of a 640 x 480 depth image, at the height of the sensor. `replay \
             --slice` also takes the median of a band of rows, or the points at a height whatever the tilt.");
    preprocessing(page, runs)?;
    method(page);
    let policies = policies(runs)?;
    page.section("III.A Comparative study", Has::Experiment);
    comparison(page, &policies);
    page.section("III.B Results", Has::Experiment);
    if let Some((_, run)) = policies.get(1) {
        page.picture_of("aluckal-points", run, "points.png", "Figure 5: the pointset of the threshold \
            policy (blue) over the true surfaces (black); points more than 5 cm beyond a surface in red")?;
    }
    page.say("\"The dotted line shows the extent of the overshoot, i.e. the points further away from the \
             origin than expected\": the paper draws it and gives no figure; ours is in the tables.");
    limits(page, runs)?;
    future(page);
    awareness::write(page, runs)?;
    page.section("IV Conclusion", Has::Claims);
    page.say("\"Fairly accurate\" without a figure. The pointset is a file by `simulate --points FILE.csv`.");
    Ok(())
}

fn preprocessing(page: &mut Page, runs: &mut Runs) -> Result<(), RunError> {
    page.section("II.B Pre-processing", Has::Claims);
    page.say("Equation 2 gives all columns the same angle, 43 * (320 - k) / 320 degrees; a pinhole \
             camera's columns have the same tangent. Halfway between axis and edge the printed angle is \
             3.5 degrees off. `simulate aluckal-room --exposure mask --policy threshold --pixel-model ...`:");
    let rows = [
        policy_row("`linear` (printed)", runs.simulate(&linear())?.as_ref()),
        policy_row("`pinhole`", runs.simulate(&policy("threshold"))?.as_ref()),
    ];
    page.table(&COLUMNS, &rows);
    Ok(())
}

fn method(page: &mut Page) {
    page.section("II.C Proposed method", Has::Method);
    page.say("Thresholding and offsetting are as printed. Selective omission as printed applies to turns \
             only; in `full` it applies to any motion (the paper's future work), by what the map knows.");
    page.section("II.D Implementation details", Has::Method);
    page.say(
        "Printed: 86 / 640 = 0.134 degrees a pixel; 3.5 cm or 5 degrees. A turn of 10 degrees leaves 10 \
            / 0.134 = 74.6, so 75 pixels; with \
         86 / 640 = 0.134375 unrounded it is 74. Tests hold both (`the_papers_pixels`). Two misprints: \
         the listing's yaw is clockwise, and after a turn \
         to the right `640 - inter_p` is 640 + 75 = 715, beyond the last pixel, so that nothing is mapped: \
         `--policy omission-as-printed` does just that, `--policy omission` what is meant. The gate by \
         axis as printed is `--gate by-axis`.",
    );
}

fn policies(runs: &mut Runs) -> Result<Vec<(&'static str, Arc<Outcome>)>, RunError> {
    let run = |name| Ok((name, runs.simulate(&policy(name))?));
    POLICIES.into_iter().map(run).collect()
}

const COLUMNS: [&str; 10] = [
    "run",
    "scans mapped",
    "points kept",
    "redundant",
    "roughness (mm)",
    "beyond 5 cm",
    "overshoot, 99 % (mm)",
    "F1",
    "map bytes up",
    "instructions per second (estimate)",
];

fn points(run: &Outcome) -> PointsSummary {
    run.report.points.unwrap_or_default()
}

fn policy_row(name: &str, run: &Outcome) -> Vec<String> {
    let points = points(run);
    let truth = run.report.truth.unwrap_or_default();
    let bytes: u64 = run.report.robots.iter().map(|robot| robot.bytes_up_map).sum();
    // A row of which a part is drawn costs that part, and the look that every row costs.
    let whole = points.kept as f64 / (640.0 * points.mapped.max(1) as f64);
    let drawn = points.mapped as f64 * whole.min(1.0) * DRAWN;
    let seconds = run.report.simulated_s.max(1.0);
    row([
        name.to_owned(),
        format!("{} of {}", points.mapped, points.scans),
        grouped(points.kept),
        grouped(points.redundant),
        format!("{:.1}", points.rough_mm),
        format!(
            "{} ({:.1} %)",
            grouped(points.beyond),
            100.0 * points.beyond as f64 / points.kept.max(1) as f64
        ),
        format!("{:.0}", points.overshoot_mm),
        format!("{:.3}", truth.f1_occupied),
        grouped(bytes),
        grouped(
            1_000 * ((drawn + points.scans as f64 * SKIPPED) / seconds / 1_000.0).round() as u64,
        ),
    ])
}

fn comparison(page: &mut Page, policies: &[(&'static str, Arc<Outcome>)]) {
    page.say("`simulate aluckal-room --exposure mask --policy ...`: a D435 (86 degrees, 30 frames per \
             second) on a robot with the odometry of a T265 on a fixed route through a furnished room. \
             The paper gives no figures, only an order: thresholding prevents redundant entries, \
             omission also overlapping points, \"this results in a smoother output\".");
    let rows: Vec<_> =
        policies.iter().map(|(name, run)| policy_row(&format!("`{name}`"), run)).collect();
    page.table(&COLUMNS, &rows);
    let [pilot, threshold, omission, printed, full] = [0, 1, 2, 3, 4]
        .map(|index| policies.get(index).map(|(_, run)| points(run)).unwrap_or_default());
    let holds = |it: bool| if it { "holds" } else { "does NOT hold" };
    page.say(&format!(
        "- \"Thresholding prevents redundant entries\": {} ({} redundant points against {}).\n\
         - \"Selective omission omits overlapping points\": {} ({} against {}).\n\
         - \"This results in a smoother output\": {} ({:.1} mm roughness against {:.1} mm).\n\
         - The printed listing, which maps nothing after turns to the right: {} points against {} with \
         the meaning corrected.\n\
         - `full` keeps {} points, of which {} are redundant; the points that are left are not smoother, \
         because an outlier is \
         never known already.",
        holds(threshold.redundant < pilot.redundant),
        grouped(threshold.redundant),
        grouped(pilot.redundant),
        holds(omission.redundant < threshold.redundant),
        grouped(omission.redundant),
        grouped(threshold.redundant),
        holds(omission.rough_mm < threshold.rough_mm),
        omission.rough_mm,
        threshold.rough_mm,
        grouped(printed.kept),
        grouped(omission.kept),
        grouped(full.kept),
        grouped(full.redundant)
    ));
    let f1 = |index: usize| {
        let run = policies.get(index).map(|(_, run)| run);
        run.and_then(|run| run.report.truth).unwrap_or_default().f1_occupied
    };
    page.say(&format!(
        "Where omission can lose the map: what came into view by a turn is drawn once. A reading that was wrong \
         then is never corrected, and what appears later in ground that is in view already is never seen. In this \
         static room F1 is {:.3} with omission, {:.3} by the letter of the listing, and {:.3} with thresholding alone.",
        f1(2),
        f1(3),
        f1(1)
    ));
}

fn limits(page: &mut Page, runs: &mut Runs) -> Result<(), RunError> {
    page.section("III.C Constraints and limitations", Has::Claims);
    page.say("\"Extreme differences in exposure can result in discontinuities\": the room has a sunlit \
             wall and a dark niche. The camera exposes for the mean of its picture, so that the wall makes the rest \
             dark where it fills the view; where a pixel is clipped, or darker than 3 of 255, there is no depth \
             or a wrong one (a model of ours). `mask` ignores what is outside of 8 to 250 of 255. `normalise` \
             brightens each picture first, until the median of what is not clipped is 128; that recovers dark \
             pictures, and nothing that is clipped. Both exist for recordings, too (`replay` and `watch \
             --exposure`), where a picture comes with the depth. Vibrations: scans from jolted moments are not mapped (`Steadiness`). Distortions: \
             the lens model of OpenCV is applied before slicing.");
    let mut rows = Vec::new();
    for exposure in EXPOSURES {
        for name in EXPOSED {
            let line = if exposure == "mask" { policy(name) } else { exposed(exposure, name) };
            let run = runs.simulate(&line)?;
            let mut row = policy_row(&format!("`--policy {name} --exposure {exposure}`"), &run);
            row.push(grouped(points(&run).masked));
            rows.push(row);
        }
    }
    let mut columns = COLUMNS.to_vec();
    columns.push("readings masked");
    page.table(&columns, &rows);
    let [masked, normalised] = ["mask", "normalise"].map(|exposure| {
        let line = if exposure == "mask" { policy("full") } else { exposed(exposure, "full") };
        runs.simulate(&line).map(|run| points(&run).masked)
    });
    let (masked, normalised) = (masked?, normalised?);
    page.say(&format!(
        "Of the {} readings that the mask leaves out, normalising gets back {}: here nearly all are clipped, and it \
         makes no difference to the map. It does for recorded pictures that are dark as a whole (tests/README.md).",
        grouped(masked),
        grouped(masked.saturating_sub(normalised))
    ));
    let rows = [
        policy_row("`--gate euclidean`", runs.simulate(&policy("threshold"))?.as_ref()),
        policy_row("`--gate by-axis`", runs.simulate(&by_axis())?.as_ref()),
    ];
    page.say("The gate of II.D by axis, as printed, beside the Euclidean one:");
    page.table(&COLUMNS, &rows);
    Ok(())
}

fn future(page: &mut Page) {
    page.section("III.D Future work", Has::Claims);
    page.table(
        &["of the paper", "here"],
        &[
            row([
                "exposure correction: ignoring the region".to_owned(),
                "`--exposure mask`, in III.C".to_owned(),
            ]),
            row([
                "exposure correction: normalising".to_owned(),
                "`--exposure normalise`, in III.C".to_owned(),
            ]),
            row(["selective omission for translation".to_owned(), "`--policy full`".to_owned()]),
            row([
                "selective removal of pixels".to_owned(),
                "by distance, pixels and bearings, also at \
                run time (`Removal`, `Validity`)"
                    .to_owned(),
            ]),
            row([
                "extended awareness: classes with weights".to_owned(),
                "classes with priors, by labels: below. What a thing is must be told; no detector classifies it. Cells \
                that keep changing become movable and are forgotten after five minutes"
                    .to_owned(),
            ]),
        ],
    );
}
