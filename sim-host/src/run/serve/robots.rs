//! The state of the robots, for reports and `ubimap status`.

use std::collections::{BTreeMap, BTreeSet};

use ubimap_protocol::{
    time::{Duration, Instant},
    units::{Millimetres, RobotId},
};

use super::links::Links;
use crate::{deployment::Deployment, report::ServedRobot};

/// The state of all robots that are registered or were met, by number. `stopped` are those that a user has
/// stopped.
pub(super) fn robots(
    deployment: &Deployment,
    links: &Links,
    registered: &[RobotId],
    stopped: &BTreeSet<RobotId>,
    now: Instant,
) -> Vec<ServedRobot> {
    let mut heard: BTreeMap<RobotId, (&str, Instant)> = BTreeMap::new();
    for (robot, name, at) in links.robots() {
        let newest = heard.entry(robot).or_insert((name, at));
        if newest.1 < at {
            *newest = (name, at);
        }
    }
    let server = deployment.server();
    let in_session: BTreeSet<RobotId> =
        server.ports().filter_map(|port| server.robot_at(port)).collect();
    let all: BTreeSet<RobotId> = registered.iter().chain(heard.keys()).copied().collect();
    let moment = deployment.server_time(now);
    let seconds = |age: Duration| age.micros() as f64 / 1e6;
    let robot = |robot: RobotId| {
        let session = in_session.contains(&robot);
        let newest = server.last_pose(robot);
        let doing = match server.errand(robot) {
            _ if !session => "has no session".to_owned(),
            _ if stopped.contains(&robot) => "was told to stop".to_owned(),
            None => "has no known position".to_owned(),
            Some(errand) => errand.to_string(),
        };
        ServedRobot {
            robot: robot.0,
            session,
            port: heard.get(&robot).map(|(name, _)| (*name).to_owned()),
            heard_s_ago: heard.get(&robot).map(|(_, at)| seconds(now.since(*at))),
            pose: newest.map(|(_, pose)| {
                let [x, y] = [pose.x, pose.y].map(Millimetres::metres);
                [x, y, pose.heading.degrees()]
            }),
            is_sought: session && server.is_sought(robot),
            pose_s_ago: newest.map(|(at, _)| seconds(moment.since(at))),
            doing,
        }
    };
    all.into_iter().map(robot).collect()
}
