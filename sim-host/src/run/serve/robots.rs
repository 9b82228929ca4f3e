//! The state of the robots, for reports and `ubimap status`.

use std::collections::{BTreeMap, BTreeSet};

use ubimap_protocol::{
    time::{Duration, Instant},
    units::{Millimetres, RobotId},
};

use super::links::Links;
use crate::{deployment::Deployment, report::ServedRobot};

/// A connected robot that is silent for this long is not doing what it was sent to do: it reports its state
/// every 2 s, and takes part in the traffic of the link all the time.
const SILENT: Duration = Duration::from_secs(3);

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
    let robot = |robot: RobotId| {
        let session = in_session.contains(&robot);
        let newest = server.last_pose(robot);
        let age = heard.get(&robot).map(|(_, at)| now.since(*at));
        let doing = match (age, server.errand(robot)) {
            _ if !session => "is not connected".to_owned(),
            (Some(age), _) if age >= SILENT => {
                format!("silent for {:.0} s (is it on, and in reach?)", seconds(age))
            }
            _ if stopped.contains(&robot) => "was told to stop".to_owned(),
            (_, None) => "has no known position".to_owned(),
            (_, Some(errand)) => errand.to_string(),
        };
        ServedRobot {
            robot: robot.0,
            session,
            port: heard.get(&robot).map(|(name, _)| (*name).to_owned()),
            heard_s_ago: age.map(seconds),
            pose: newest.map(|(_, pose)| {
                let [x, y] = [pose.x, pose.y].map(Millimetres::metres);
                [x, y, pose.heading.degrees()]
            }),
            is_sought: session && server.is_sought(robot),
            map_moved_m: server.farthest_moved(robot),
            pose_s_ago: newest.map(|(at, _)| seconds(moment.since(at))),
            doing,
        }
    };
    all.into_iter().map(robot).collect()
}

fn seconds(age: Duration) -> f64 {
    age.micros() as f64 / 1e6
}

/// Whether a robot can be commanded.
///
/// # Errors
/// The reason, with the robots that there are.
pub(super) fn commandable(robots: &[ServedRobot], robot: RobotId) -> Result<(), String> {
    let state = |it: &ServedRobot| match it.heard_s_ago {
        _ if !it.session => "not connected".to_owned(),
        Some(age) if age >= seconds(SILENT) => format!("silent for {age:.0} s"),
        _ => "connected".to_owned(),
    };
    let what = match robots.iter().find(|it| it.robot == robot.0) {
        Some(it) if it.session => return Ok(()),
        Some(_) => format!("robot {} is not connected", robot.0),
        None => format!("there is no robot {}", robot.0),
    };
    let all: Vec<_> = robots.iter().map(|it| format!("{} ({})", it.robot, state(it))).collect();
    Err(match all.is_empty() {
        true => format!("{what}; no robot is registered, and none has connected"),
        false => format!("{what}; the robots are {}", all.join(", ")),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_can_not_be_commanded_is_told_with_those_who_can() {
        let robot = |robot, session| ServedRobot { robot, session, ..ServedRobot::default() };
        let silent = ServedRobot { heard_s_ago: Some(6.2), ..robot(2, true) };
        let robots = [robot(1, true), silent, robot(3, false)];
        let refused = |it| commandable(&robots, RobotId(it)).unwrap_err();
        assert_eq!(commandable(&robots, RobotId(1)), Ok(()));
        assert_eq!(
            refused(3),
            "robot 3 is not connected; the robots are 1 (connected), 2 (silent for 6 s), 3 (not connected)"
        );
        assert_eq!(
            refused(9),
            "there is no robot 9; the robots are 1 (connected), 2 (silent for 6 s), 3 (not connected)"
        );
        assert!(commandable(&[], RobotId(9)).unwrap_err().contains("no robot is registered"));
    }
}
