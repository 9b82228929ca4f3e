//! What a server writes and says from time to time, and at its end.

use std::{
    path::PathBuf,
    sync::Arc,
    thread,
    time::{SystemTime, UNIX_EPOCH},
};

use ubimap_protocol::{
    tile::Cell,
    time::{Duration, Instant},
    units::Millimetres,
};

use super::{
    cameras::{AWAY, CameraState},
    standing::Standings,
};
use crate::{
    camera::Calibration,
    deployment::Deployment,
    grid::{self, OccupancyGrid, Scores},
    mapping::ServedLayer,
    report::{
        self, Against, Caption, FrameDelays, HexDigest, Marker, MarkerKind, OutputFolder, SeenMap,
        ServeReport, ServedCamera,
    },
    run::{Outcome, RunError, deployment_file::DeployedCamera, markers, volatility},
};

/// Delays longer than this many milliseconds are counted as this one.
const LONGEST_MS: usize = 1_000;

/// The delays from the arrival of frames until what was seen in them was sent to the robots.
#[derive(Clone, Debug)]
pub(super) struct Delays {
    /// How many took this many milliseconds, rounded up.
    counts: Vec<u64>,
}

impl Default for Delays {
    fn default() -> Self {
        Self { counts: vec![0; LONGEST_MS + 1] }
    }
}

impl Delays {
    pub(super) fn add(&mut self, delay: Duration) {
        let millis = delay.micros().div_ceil(1_000) as usize;
        self.counts[millis.min(LONGEST_MS)] += 1;
    }

    /// The distribution; `None` if there are no delays.
    pub(super) fn summary(&self) -> Option<FrameDelays> {
        let frames: u64 = self.counts.iter().sum();
        let of = |percent: u64| {
            let mut sum = 0;
            let reaches = |count: &u64| {
                sum += count;
                sum * 100 >= frames * percent
            };
            self.counts.iter().position(reaches).map(|millis| millis as u64)
        };
        let (median_ms, p90_ms, p99_ms, most_ms) = (of(50)?, of(90)?, of(99)?, of(100)?);
        (frames > 0).then_some(FrameDelays { frames, median_ms, p90_ms, p99_ms, most_ms })
    }
}

/// The report on the cameras.
pub(super) fn cameras(
    cameras: &[DeployedCamera],
    states: &[CameraState],
    standings: &Standings,
    deployment: &Deployment,
    now: Instant,
) -> Vec<ServedCamera> {
    let status = deployment.status();
    // Our clock counts from the start; senders' from 1970 or anything else.
    let since_1970 = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    let began = (since_1970.as_micros() as i64).saturating_sub(now.micros() as i64);
    let summary = |(index, (camera, state)): (usize, (&DeployedCamera, &CameraState))| {
        let seconds = |offset: i64| offset.saturating_add(began) as f64 / 1e6;
        let observed = status.cameras.get(&index).copied().unwrap_or_default();
        ServedCamera {
            name: camera.name.clone(),
            has_pose: camera.is_placed,
            frames: state.frames,
            skipped: state.skipped,
            out_of_order: state.out_of_order,
            age_ms: state.age.micros() as f64 / 1e3,
            observations: observed.observations,
            looks: observed.looks,
            knocked: standings.is_knocked(index),
            disputed: standings.is_disputed(index),
            digest: HexDigest(observed.digest.into()),
            away: state.last.is_none_or(|last| now.since(last) > AWAY),
            clock_offset_s: state.clock.and_then(|it| it.offset_micros()).map(seconds),
            clock_jumps: state.clock.map_or(0, |clock| clock.jumps()),
        }
    };
    cameras.iter().zip(states).enumerate().map(summary).collect()
}

/// The map and what the cameras see of it.
fn grids(deployment: &Deployment) -> Result<[OccupancyGrid; 2], RunError> {
    let server = deployment.server();
    let grid = |layer: &ServedLayer| {
        let tiles = layer.tiles().map(|(id, _, tile)| (id, tile));
        OccupancyGrid::from_tiles(tiles, deployment.resolution())
    };
    Ok([grid(server.fused())?, grid(server.coverage())?])
}

fn seen(map: &OccupancyGrid, coverage: &OccupancyGrid, deployment: &Deployment) -> SeenMap {
    SeenMap::new(map, coverage, HexDigest(deployment.server().fused().digest().0))
}

/// What is known at one time; the pictures are drawn later.
#[derive(Clone, Debug)]
pub(super) struct Snapshot {
    pub(super) report: ServeReport,
    map: OccupancyGrid,
    coverage: OccupancyGrid,
    plan: Option<Arc<OccupancyGrid>>,
    intervals: Vec<Option<(Cell, f64)>>,
    views: Vec<Marker>,
    others: Vec<Marker>,
    caption: Caption,
}

impl Snapshot {
    /// The state at this time. `cameras` are those with a pose, where they hang now, and whether each is in
    /// use.
    ///
    /// # Errors
    /// [`RunError::Grid`].
    pub(super) fn new<'c>(
        mut report: ServeReport,
        deployment: &Deployment,
        cameras: impl IntoIterator<Item = (&'c Calibration, bool)>,
        plan: Option<Arc<OccupancyGrid>>,
        now: Instant,
    ) -> Result<Self, RunError> {
        let server = deployment.server();
        let [map, coverage] = grids(deployment)?;
        report.map = Some(seen(&map, &coverage, deployment));
        report.plan = plan.as_deref().map(|plan| agreement(&map, plan));
        let caption =
            Caption { subject: "live".into(), seed: None, time_s: Some(now.micros() as f64 / 1e6) };
        let robots = server.whereabouts(deployment.server_time(now)).map(|(robot, pose)| Marker {
            radius_m: markers::radius_m(deployment, robot),
            label: robot.0.to_string(),
            ..Marker::new(
                MarkerKind::Robot,
                [pose.x, pose.y].map(Millimetres::metres),
                pose.heading.radians(),
            )
        });
        let others = robots.chain(markers::people(deployment, now)).collect();
        let views = markers::cameras(cameras);
        let intervals = volatility::intervals(deployment, &map, now);
        Ok(Self { report, map, coverage, plan, intervals, views, others, caption })
    }

    /// The area that the map knows, in square metres.
    pub(super) fn known_m2(&self) -> f64 {
        self.map.counts().known as f64 * self.map.resolution_m().powi(2)
    }

    /// Draws the pictures.
    fn outcome(self) -> Outcome<ServeReport> {
        let Self { report, map, coverage, plan, intervals, views, others, caption } = self;
        let coverage = report::render_coverage(&map, &coverage, &views, &caption);
        let plan = plan.map(|plan| {
            let plan = plan.on_cells_of(&map);
            report::render_error(&map, &plan, &plan, Against::Plan, &caption)
        });
        let changes = report::render_volatility(&map, &intervals, &caption);
        let markers = others.into_iter().chain(views).collect();
        let pictures = [
            ("coverage.png", Some(coverage)),
            ("volatility.png", Some(changes)),
            ("plan.png", plan),
        ];
        let pictures = pictures.into_iter().filter_map(|(name, it)| Some((name, it?))).collect();
        Outcome { report, map, markers, caption, pictures, tables: Vec::new() }
    }
}

/// The agreement of a map with a plan, within a cell of the coarser one.
pub(super) fn agreement(map: &OccupancyGrid, plan: &OccupancyGrid) -> Scores {
    grid::compare(map, plan, Some(map.resolution_m().max(plan.resolution_m())))
}

/// Writes results into a folder, now and then in a thread, whole or not at all.
#[derive(Debug)]
pub(super) struct Writer {
    out: PathBuf,
    interval: Duration,
    next: Instant,
    writing: Option<thread::JoinHandle<()>>,
}

impl Writer {
    /// A writer that is due after each interval.
    ///
    /// # Errors
    /// [`RunError::Output`] if the folder can't be written.
    pub(super) fn new(out: PathBuf, interval: Duration) -> Result<Self, RunError> {
        // Dropped at once: only to fail early.
        OutputFolder::create(&out)?;
        Ok(Self { out, interval, next: Instant(0) + interval, writing: None })
    }

    /// Whether results are due.
    pub(super) fn is_due(&self, now: Instant) -> bool {
        now >= self.next && self.writing.as_ref().is_none_or(thread::JoinHandle::is_finished)
    }

    /// Writes results in a thread.
    pub(super) fn write(&mut self, snapshot: Snapshot, now: Instant) {
        self.next = now + self.interval;
        let out = self.out.clone();
        let work = move || {
            let written = OutputFolder::create(&out).map_err(RunError::from);
            if let Err(error) = written.and_then(|folder| snapshot.outcome().write(folder)) {
                log::error!("{error}; trying again when the next results are due");
            }
        };
        match thread::Builder::new().name("results".into()).spawn(work) {
            Ok(thread) => self.writing = Some(thread),
            Err(error) => log::error!("results can't be written: {error}"),
        }
    }

    /// Writes the last results.
    ///
    /// # Errors
    /// [`RunError`].
    pub(super) fn finish(mut self, snapshot: Snapshot) -> Result<ServeReport, RunError> {
        if let Some(thread) = self.writing.take() {
            // A panic in it has been reported.
            let _ = thread.join();
        }
        let outcome = snapshot.outcome();
        outcome.write(OutputFolder::create(&self.out)?)?;
        Ok(outcome.report)
    }
}

/// One line about the state, for the log.
pub(super) fn summary(report: &ServeReport, known_m2: f64) -> String {
    let robots = report.ports.iter().filter(|port| port.session).count();
    let there = report.cameras.iter().filter(|camera| !camera.away && !camera.knocked).count();
    let skipped: u64 = report.cameras.iter().map(|camera| camera.skipped).sum();
    let frames: u64 = report.cameras.iter().map(|camera| camera.frames).sum();
    let delays = report.delays.map_or(String::new(), |delays| format!("; {delays}"));
    let slow = match skipped * 10 > frames {
        true => "; perception can't keep up with the cameras: give them fewer frames or pixels",
        false => "",
    };
    format!(
        "{robots} robots, {there} of {} cameras, {known_m2:.1} m2 known; {frames} frames, {skipped} \
         skipped{delays}{slow}",
        report.cameras.len(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_distribution_of_delays() {
        let mut delays = Delays::default();
        assert_eq!(delays.summary(), None);
        (1..=98).for_each(|_| delays.add(Duration::from_micros(4_001)));
        delays.add(Duration::from_millis(80));
        delays.add(Duration::from_secs(60));
        let summary = delays.summary().unwrap();
        assert_eq!((summary.frames, summary.median_ms, summary.p90_ms), (100, 5, 5));
        assert_eq!((summary.p99_ms, summary.most_ms), (80, 1_000));
        (0..2).for_each(|_| delays.add(Duration::from_secs(60)));
        assert_eq!(delays.summary().unwrap().p99_ms, 1_000);
    }
}
