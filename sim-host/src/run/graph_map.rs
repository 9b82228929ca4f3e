//! The map of robots that have only odometry, from the graph of what they saw.
//!
//! The robots' own map is drawn from poses that drift, and nobody corrects them. But the server
//! receives their distance vectors, and finds the poses from which these were seen.

use std::fmt::Write;

use log::info;
use ubimap_protocol::{
    message::DistanceVector,
    time::{Duration, Instant},
    units::RobotId,
};

use super::{fleet::Fleet, options::ReplayOptions};
use crate::{
    grid::{GridError, OccupancyGrid},
    mapping::submaps::{GraphMapper, Motion, View, draw},
    report::{GraphSummary, Marker, MarkerKind},
};

/// The distance vectors of robots, as the server received them.
pub(super) struct Received {
    robots: Vec<(RobotId, Vec<DistanceVector>)>,
}

/// A map drawn from a graph.
pub(super) struct GraphMap {
    pub(super) map: OccupancyGrid,
    pub(super) summary: GraphSummary,
    /// The robots at their last poses.
    pub(super) markers: Vec<Marker>,
    /// `trajectory.csv`: the pose of each distance vector, and the one that odometry gave.
    pub(super) trajectory: String,
}

impl Received {
    /// Nothing from robots 1 to `robots` yet.
    pub(super) fn of(robots: usize) -> Self {
        Self { robots: (1..=robots as u16).map(|id| (RobotId(id), Vec::new())).collect() }
    }

    /// Adds the newest vector of each robot. A vector that arrives after a later one is left out.
    pub(super) fn look(&mut self, fleet: &Fleet<'_>) {
        for (robot, vectors) in &mut self.robots {
            let Some(newest) = fleet.server().distance_vector(*robot) else { continue };
            // One without columns would cut the chain of views.
            if newest.distances.is_empty() {
                continue;
            }
            if vectors.last().is_none_or(|last| last.time < newest.time) {
                vectors.push(newest.clone());
            }
        }
    }

    /// Finds the poses of all vectors, and draws the map. The robots' logs follow each other, so what
    /// the next robot saw continues what the one before did: `starts` has the time in the log and by the
    /// server's clock at which each robot starts.
    ///
    /// # Errors
    /// [`GridError`] if the map is too large.
    pub(super) fn solve(
        self,
        options: &ReplayOptions,
        starts: &[(Duration, Instant)],
    ) -> Result<GraphMap, GridError> {
        let count: usize = self.robots.iter().map(|(_, vectors)| vectors.len()).sum();
        info!("joining {count} distance vectors in a graph of submaps");
        let mut mapper = GraphMapper::default();
        let mut owners = Vec::new();
        for (index, (robot, vectors)) in self.robots.iter().enumerate() {
            for vector in vectors {
                owners.push((index, *robot));
                mapper.add(View::of(vector));
            }
        }
        let (mut views, counts) = mapper.finish();
        // The graph's frame is that of the first view.
        let start = views.first().map_or(Motion::identity(), |(view, _)| view.reported);
        views.iter_mut().for_each(|(_, pose)| *pose = start * *pose);
        let (range, resolution) = (options.max_range.metres(), options.resolution);
        let tiles = draw(views.iter().map(|(view, pose)| (view, pose)), range, resolution);
        let map =
            OccupancyGrid::from_tiles(tiles.iter().map(|(id, tile)| (*id, tile)), resolution)?;
        let mut markers: Vec<Marker> = Vec::new();
        let mut trajectory =
            "robot,time_s,x_m,y_m,heading_rad,odometry_x_m,odometry_y_m,odometry_rad\n".to_owned();
        for ((index, robot), (view, pose)) in owners.into_iter().zip(&views) {
            let logged =
                starts.get(index).map_or(view.time.since(Instant(0)), |&(start, began)| {
                    start + view.time.since(began)
                });
            let line = row(robot, logged, pose, &view.reported);
            let _ = writeln!(trajectory, "{line}");
            let at = [pose.translation.x, pose.translation.y];
            let heading = pose.rotation.angle();
            let path = match markers.last_mut() {
                Some(marker) if marker.label == robot.0.to_string() => {
                    let mut path = core::mem::take(&mut marker.path);
                    markers.pop();
                    path.push(at);
                    path
                }
                _ => vec![at],
            };
            let label = robot.0.to_string();
            markers.push(Marker { label, path, ..Marker::new(MarkerKind::Robot, at, heading) });
        }
        Ok(GraphMap { map, summary: counts.into(), markers, trajectory })
    }
}

fn row(robot: RobotId, logged: Duration, pose: &Motion, reported: &Motion) -> String {
    let numbers = |motion: &Motion| {
        let at = motion.translation;
        format!("{:.4},{:.4},{:.5}", at.x, at.y, motion.rotation.angle())
    };
    let seconds = logged.micros() as f64 / 1e6;
    format!("{},{seconds:.3},{},{}", robot.0, numbers(pose), numbers(reported))
}
