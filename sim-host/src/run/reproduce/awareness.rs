//! Extended awareness (Aluckal et al., III.D): what classes with priors do.

use super::{
    super::{Outcome, RunError},
    page::{Page, grouped, row},
    runs::Runs,
};

/// Where robots stand when something changes is luck: several runs.
const SEEDS: std::ops::RangeInclusive<u64> = 1..=4;

/// The run whose volatility layer is shown.
const SHOWN: u64 = 2;

fn line(seed: u64, has_classes: bool) -> String {
    let without = if has_classes { "" } else { " --no-classes" };
    format!("awareness --ideal-cameras --seed {seed}{without}")
}

/// The options of all runs.
pub(super) fn lines() -> impl Iterator<Item = String> {
    SEEDS.flat_map(|seed| [true, false].map(|has_classes| line(seed, has_classes)))
}

pub(super) fn write(page: &mut Page, runs: &mut Runs) -> Result<(), RunError> {
    page.say("**Extended awareness.** \"Classify and assign a weight to it based on the probability that the \
             object is likely to move making its localization in the environment volatile.\" The weight is how soon \
             the server forgets what it knows of the object's place, unless a camera or a robot has looked since: \
             a person's place after 30 s, a door after 60 s, a chair after 120 s, a cabinet never, everything else \
             as before. Forgotten ground is unknown, and robots that explore are sent there. The classes come from \
             the scenario (`class = \"chair\"`), or from a file (`--labels`, and `labels` of a deployment).");
    page.say("`simulate awareness --ideal-cameras --seed ...`, with and without `--no-classes`: three rooms that no \
             camera sees, explored by one robot. After 120 s, when it waits in one of them, a chair is moved; after 200 s \
             a door opens, behind which is a closet. The age of the map after that (at most 240 s and 160 s):");
    let mut rows = Vec::new();
    for seed in SEEDS {
        for has_classes in [true, false] {
            let name = if has_classes { "with classes" } else { "without" };
            let run = runs.simulate(&line(seed, has_classes))?;
            rows.push(aged(&format!("seed {seed}, {name}"), &run));
        }
    }
    page.table(
        &[
            "run",
            "chair's old place: nine of ten cells no longer occupied",
            "half of them free",
            "door: nine of ten cells no longer occupied",
            "closet: half of its walls drawn",
            "F1 at the end",
            "poses, RMS",
            "room known at the end",
            "map bytes up",
        ],
        &rows,
    );
    page.say("0 s: it had been forgotten before it changed. Forgetting has its price: what is forgotten and has not \
             changed is unknown until a robot has looked; a robot can be shut in by what it alone has seen, as it no \
             longer finds a way round it (\"never\" with classes); and every look is a drive on ground where no \
             camera corrects the robot's pose, which F1 and the poses show. Without classes a \
             change is seen only if the robot happens to stand before it.");
    let shown = runs.simulate(&line(SHOWN, true))?;
    page.picture_of(
        "aluckal-volatility",
        &shown,
        "volatility.png",
        "The volatility layer: how soon each cell is expected to change, by its class (a prior that weighs as much \
         as one change) and by the changes observed. simulate, replay, watch and serve write it as volatility.png",
    )
}

/// The age of the map after the changes of a run: first the chair's, then the door's.
fn aged(name: &str, run: &Outcome) -> Vec<String> {
    let time = |time: Option<f64>| time.map_or("never".to_owned(), |it| format!("{it:.0} s"));
    let change = |index: usize| run.report.changes.get(index).copied().unwrap_or_default();
    let (chair, door) = (change(0), change(1));
    let truth = run.report.truth.unwrap_or_default();
    let pose = run.report.pose.unwrap_or_default();
    let bytes = run.report.robots.iter().map(|robot| robot.bytes_up_map).sum();
    row([
        name.to_owned(),
        time(chair.removed_s),
        time(chair.freed_s),
        time(door.removed_s),
        time(door.drawn_s),
        format!("{:.3}", truth.f1_occupied),
        format!("{:.1} cm, {:.1} degrees", 100.0 * pose.rmse_m, pose.rmse_deg),
        format!("{:.0} %", 100.0 * truth.coverage),
        grouped(bytes),
    ])
}
