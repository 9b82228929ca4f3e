//! Checks of places and paths that need the geometry of the room.

use parry2d_f64::glamx::DVec2;

use super::{
    people,
    room::Room,
    route::Body,
    scenario::{PostureConfig, RobotConfig, Scenario, ScenarioError},
};

/// Refuses cameras, robots and people in impossible places or with blocked paths.
pub(super) fn check(scenario: &Scenario, room: &Room) -> Result<(), ScenarioError> {
    for (index, camera) in scenario.cameras.iter().enumerate() {
        let [x, y, z] = camera.position_m;
        let at = DVec2::new(x, y);
        let key = format!("cameras[{index}].position_m");
        if !room.encloses(at) {
            return Err(scenario.invalid(key, "is outside of the room; move it inside"));
        }
        if room.is_solid(at, z, z + f64::EPSILON) {
            return Err(scenario.invalid(key, "is inside a wall or furniture; move it out"));
        }
    }
    // Everybody placed up to now: starts must not overlap.
    let mut standing: Vec<(String, Body)> = Vec::new();
    for (index, robot) in scenario.robots.iter().enumerate() {
        let key = format!("robots[{index}]");
        let body = Body { centre: start(robot), radius: robot.radius_m, height: robot.height_m };
        check_start(scenario, room, &mut standing, format!("{key}.start"), body)?;
        let waypoints = &robot.route.waypoints_m;
        let stops: Vec<(String, DVec2)> = std::iter::once((format!("{key}.start"), body.centre))
            .chain(stops(&format!("{key}.route.waypoints_m"), waypoints))
            .collect();
        check_ways(scenario, room, &stops, body)?;
    }
    for (index, person) in scenario.people.iter().enumerate() {
        let key = format!("people[{index}].waypoints_m");
        let stops: Vec<(String, DVec2)> = stops(&key, &person.waypoints_m).collect();
        let centre = stops.first().map_or(DVec2::ZERO, |(_, stop)| *stop);
        let body = people::body(person, person.posture, centre);
        check_start(scenario, room, &mut standing, format!("{key}[0]"), body)?;
        check_ways(scenario, room, &stops, people::body(person, PostureConfig::Standing, centre))?;
    }
    Ok(())
}

/// Waypoints, each with its key.
fn stops(key: &str, points: &[[f64; 2]]) -> impl Iterator<Item = (String, DVec2)> {
    points.iter().enumerate().map(move |(index, &point)| (format!("{key}[{index}]"), point.into()))
}

fn check_start(
    scenario: &Scenario,
    room: &Room,
    standing: &mut Vec<(String, Body)>,
    key: String,
    body: Body,
) -> Result<(), ScenarioError> {
    check_stop(scenario, room, &key, body.centre, body)?;
    let touches = |other: &Body| other.centre.distance(body.centre) < other.radius + body.radius;
    if let Some((other, _)) = standing.iter().find(|(_, other)| touches(other)) {
        let problem = format!("overlaps the body that starts at {other}; move one of them");
        return Err(scenario.invalid(key, problem));
    }
    standing.push((key, body));
    Ok(())
}

/// Checks that every stop is free, and every path to the next stop, including the one back to the first.
fn check_ways(
    scenario: &Scenario,
    room: &Room,
    stops: &[(String, DVec2)],
    body: Body,
) -> Result<(), ScenarioError> {
    for (key, stop) in stops {
        check_stop(scenario, room, key, *stop, body)?;
    }
    for (index, (key, to)) in stops.iter().enumerate() {
        let (before, from) = &stops[(index + stops.len() - 1) % stops.len()];
        if let Some(obstacle) = room.obstacle(*from, *to, body.radius, body.height) {
            let problem = format!(
                "can't be reached from {before}: the path touches {obstacle}; add a waypoint \
                 around it"
            );
            return Err(scenario.invalid(key.as_str(), problem));
        }
    }
    Ok(())
}

fn check_stop(
    scenario: &Scenario,
    room: &Room,
    key: &str,
    stop: DVec2,
    body: Body,
) -> Result<(), ScenarioError> {
    if !room.encloses(stop) {
        return Err(scenario.invalid(key, "is outside of the room; move it inside"));
    }
    if let Some(obstacle) = room.obstacle(stop, stop, body.radius, body.height) {
        let problem = format!("overlaps or is too close to {obstacle}; move it away");
        return Err(scenario.invalid(key, problem));
    }
    Ok(())
}

/// The start of a robot in `map`, in metres.
pub(super) fn start(robot: &RobotConfig) -> DVec2 {
    DVec2::new(robot.start.x_m, robot.start.y_m)
}
