//! Checks of a scenario that need only its numbers.

use std::ops::RangeInclusive;

use super::{
    CameraConfig, DoorConfig, FootprintConfig, FurnitureConfig, MarkerConfig, OdometryConfig,
    PersonConfig, PostureConfig, RobotConfig, RouteConfig, Scenario, ScenarioError, SensorConfig,
    SensorPreset,
};
use crate::{rounding::Rounded, world::TAGS};

impl Scenario {
    /// Refuses impossible numbers.
    pub(in super::super) fn check(&self) -> Result<(), ScenarioError> {
        self.number("duration_s", self.duration_s, 0.1..=86_400.0)?;
        self.number("slice_height_m", self.slice_height_m, 0.0..=10.0)?;
        if self.grow.is_some() && self.room.map.is_none() {
            return Err(self.invalid(
                "grow",
                "needs a building: give its ROS map (map.yaml) with --map, or as room.map",
            ));
        }
        self.check_room()?;
        self.check_counts()?;
        for (index, furniture) in self.furniture.iter().enumerate() {
            self.check_furniture(&format!("furniture[{index}]"), furniture)?;
        }
        for (index, glare) in self.glare.iter().enumerate() {
            self.number(&format!("glare[{index}].light"), glare.light, 0.0..=1_000.0)?;
        }
        for (index, door) in self.doors.iter().enumerate() {
            self.check_door(&format!("doors[{index}]"), door)?;
        }
        for (index, camera) in self.cameras.iter().enumerate() {
            self.check_camera(&format!("cameras[{index}]"), camera)?;
        }
        for (index, robot) in self.robots.iter().enumerate() {
            let key = format!("robots[{index}]");
            self.check_robot(&key, robot)?;
            if let Some(first) = self.robots[..index].iter().position(|r| r.id == robot.id) {
                let problem = format!(
                    "is {}, but robots[{first}] already has this id; choose another",
                    robot.id
                );
                return Err(self.invalid(format!("{key}.id"), problem));
            }
        }
        for (index, person) in self.people.iter().enumerate() {
            self.check_person(&format!("people[{index}]"), person)?;
        }
        self.labels()?;
        Ok(())
    }

    /// Refuses counts for which the memory of a usual computer is too small.
    fn check_counts(&self) -> Result<(), ScenarioError> {
        for (key, count, most) in [
            ("cameras", self.cameras.len(), 256),
            ("robots", self.robots.len(), 1_000),
            ("people", self.people.len(), 1_000),
            ("furniture", self.furniture.len(), 10_000),
            ("doors", self.doors.len(), 10_000),
            ("labels", self.labels.len(), 10_000),
            ("room.walls", self.room.walls.len(), 10_000),
        ] {
            if count > most {
                return Err(self.invalid(key, format!("are {count}; give {most} at most")));
            }
        }
        Ok(())
    }

    fn check_room(&self) -> Result<(), ScenarioError> {
        let room = &self.room;
        self.number("room.height_m", room.height_m, 0.1..=100.0)?;
        if let Some(shade) = room.shade {
            self.number("room.shade", shade, 0.0..=1.0)?;
        }
        self.number("room.wall_thickness_m", room.wall_thickness_m, 0.001..=10.0)?;
        match (&room.map, room.outline_m.len()) {
            (None, 0..=2) => {
                let problem = "needs at least three corners (or give room.map)";
                return Err(self.invalid("room.outline_m", problem));
            }
            (Some(_), 1..) => {
                let problem = "is given as well as a map; use --map or room.map with a scenario without an outline of its own, such as office";
                return Err(self.invalid("room.outline_m", problem));
            }
            _ => {}
        }
        self.points("room.outline_m", &room.outline_m)?;
        for (index, wall) in room.walls.iter().enumerate() {
            let key = format!("room.walls[{index}]");
            if wall.points_m.len() < 2 {
                return Err(self.invalid(format!("{key}.points_m"), "needs at least two points"));
            }
            self.points(&format!("{key}.points_m"), &wall.points_m)?;
            if let Some(thickness) = wall.thickness_m {
                self.number(&format!("{key}.thickness_m"), thickness, 0.001..=10.0)?;
            }
            if let Some(height) = wall.height_m {
                self.number(&format!("{key}.height_m"), height, 0.001..=room.height_m)?;
            }
        }
        Ok(())
    }

    fn check_furniture(&self, key: &str, furniture: &FurnitureConfig) -> Result<(), ScenarioError> {
        match &furniture.footprint {
            FootprintConfig::Box { centre_m, size_m, heading_deg } => {
                self.point(&format!("{key}.footprint.box.centre_m"), centre_m)?;
                for size in size_m {
                    self.number(&format!("{key}.footprint.box.size_m"), *size, 0.001..=1000.0)?;
                }
                self.angle(&format!("{key}.footprint.box.heading_deg"), *heading_deg)?;
            }
            FootprintConfig::Disc { centre_m, radius_m } => {
                self.point(&format!("{key}.footprint.disc.centre_m"), centre_m)?;
                self.number(&format!("{key}.footprint.disc.radius_m"), *radius_m, 0.001..=1000.0)?;
            }
            FootprintConfig::Polygon { points_m } => {
                let key = format!("{key}.footprint.polygon.points_m");
                self.points(&key, points_m)?;
                if !is_convex(points_m) {
                    let problem = "is not a convex polygon; cut it into convex pieces";
                    return Err(self.invalid(key, problem));
                }
            }
        }
        self.number(&format!("{key}.bottom_m"), furniture.bottom_m, 0.0..=100.0)?;
        self.number(&format!("{key}.top_m"), furniture.top_m, 0.0..=self.room.height_m)?;
        if furniture.top_m <= furniture.bottom_m {
            let problem = format!("is not above bottom_m ({} m)", furniture.bottom_m);
            return Err(self.invalid(format!("{key}.top_m"), problem));
        }
        if let Some(legs) = furniture.legs_m {
            let key = format!("{key}.legs_m");
            let FootprintConfig::Box { size_m, .. } = &furniture.footprint else {
                return Err(self.invalid(key, "is only for a box; remove it"));
            };
            if furniture.bottom_m <= 0.0 {
                return Err(self.invalid(key, "needs bottom_m above zero"));
            }
            self.number(&key, legs, 0.001..=size_m[0].min(size_m[1]))?;
        }
        if matches!(furniture.footprint, FootprintConfig::Polygon { .. })
            && !furniture.moved.is_empty()
        {
            return Err(self.invalid(format!("{key}.moved"), "is not for a polygon; remove it"));
        }
        let mut from = 0.0;
        for (index, moved) in furniture.moved.iter().enumerate() {
            let key = format!("{key}.moved[{index}]");
            self.number(&format!("{key}.at_s"), moved.at_s, from..=86_400.0)?;
            self.point(&format!("{key}.centre_m"), &moved.centre_m)?;
            self.angle(&format!("{key}.heading_deg"), moved.heading_deg)?;
            from = moved.at_s;
        }
        Ok(())
    }

    fn check_door(&self, key: &str, door: &DoorConfig) -> Result<(), ScenarioError> {
        self.point(&format!("{key}.hinge_m"), &door.hinge_m)?;
        self.angle(&format!("{key}.heading_deg"), door.heading_deg)?;
        self.number(&format!("{key}.swing_deg"), door.swing_deg, -180.0..=180.0)?;
        self.number(&format!("{key}.width_m"), door.width_m, 0.1..=10.0)?;
        self.number(&format!("{key}.height_m"), door.height_m, 0.1..=self.room.height_m)?;
        self.number(&format!("{key}.thickness_m"), door.thickness_m, 0.001..=1.0)?;
        let mut from = 0.0;
        for (index, &[opens, shuts]) in door.open_s.iter().enumerate() {
            let key = format!("{key}.open_s[{index}]");
            self.number(&key, opens, from..=86_400.0)?;
            self.number(&key, shuts, opens..=86_400.0)?;
            from = shuts;
        }
        Ok(())
    }

    fn check_camera(&self, key: &str, camera: &CameraConfig) -> Result<(), ScenarioError> {
        let position = format!("{key}.position_m");
        self.point(&position, &[camera.position_m[0], camera.position_m[1]])?;
        self.number(&position, camera.position_m[2], 0.01..=self.room.height_m)?;
        match (camera.look_at_m, camera.heading_deg, camera.tilt_deg) {
            (Some(look_at), None, None) if camera.roll_deg.is_none() => {
                let key = format!("{key}.look_at_m");
                for coordinate in look_at {
                    self.number(&key, coordinate, -1e4..=1e4)?;
                }
                if look_at == camera.position_m {
                    return Err(self.invalid(key, "equals position_m; choose another point"));
                }
            }
            (None, Some(heading), Some(tilt)) => {
                self.angle(&format!("{key}.heading_deg"), heading)?;
                // A calibrated camera that looks straight down can be slightly beyond 90 degrees.
                self.number(&format!("{key}.tilt_deg"), tilt, -180.0..=180.0)?;
                let roll = camera.roll_deg.unwrap_or(0.0);
                self.number(&format!("{key}.roll_deg"), roll, -180.0..=180.0)?;
            }
            _ => {
                let problem =
                    "needs either look_at_m, or heading_deg and tilt_deg (with them also roll_deg)";
                return Err(self.invalid(key, problem));
            }
        }
        let fov = 1.0..=170.0;
        self.number(&format!("{key}.horizontal_fov_deg"), camera.horizontal_fov_deg, fov.clone())?;
        self.number(&format!("{key}.vertical_fov_deg"), camera.vertical_fov_deg, fov.clone())?;
        self.number(&format!("{key}.range_m"), camera.range_m, 0.01..=1000.0)?;
        self.number(&format!("{key}.rate_hz"), camera.rate_hz, 0.01..=100.0)?;
        self.number(&format!("{key}.cells_rate_hz"), camera.cells_rate_hz, 0.01..=100.0)?;
        self.number(&format!("{key}.latency_ms"), camera.latency_ms, 0.0..=60_000.0)?;
        self.number(&format!("{key}.position_noise_m"), camera.position_noise_m, 0.0..=10.0)?;
        self.number(&format!("{key}.heading_noise_deg"), camera.heading_noise_deg, 0.0..=180.0)?;
        self.number(&format!("{key}.latency_jitter_ms"), camera.latency_jitter_ms, 0.0..=10_000.0)?;
        self.number(&format!("{key}.lost_frames"), camera.lost_frames, 0.0..=1.0)?;
        if let Some(moment) = camera.fails_at_s {
            self.number(&format!("{key}.fails_at_s"), moment, 0.0..=86_400.0)?;
        }
        let mut from = 0.0;
        for (index, knock) in camera.knocks.iter().enumerate() {
            let key = format!("{key}.knocks[{index}]");
            self.number(&format!("{key}.at_s"), knock.at_s, from..=86_400.0)?;
            self.number(&format!("{key}.over_s"), knock.over_s, 0.0..=86_400.0)?;
            for metres in knock.shift_m {
                self.number(&format!("{key}.shift_m"), metres, -10.0..=10.0)?;
            }
            for (name, degrees) in [
                ("heading_deg", knock.heading_deg),
                ("tilt_deg", knock.tilt_deg),
                ("roll_deg", knock.roll_deg),
            ] {
                self.number(&format!("{key}.{name}"), degrees, -180.0..=180.0)?;
            }
            from = knock.at_s;
        }
        let (depth, key_of) = (&camera.depth, |name: &str| format!("{key}.depth.{name}"));
        self.pixels(&key_of("width"), depth.width)?;
        self.pixels(&key_of("height"), depth.height)?;
        self.number(&key_of("min_range_m"), depth.min_range_m, 0.0..=camera.range_m)?;
        self.number(&key_of("baseline_m"), depth.baseline_m, 0.001..=10.0)?;
        self.number(&key_of("noise_px"), depth.noise_px, 0.0..=10.0)?;
        self.number(&key_of("dropout"), depth.dropout, 0.0..=1.0)?;
        let (picture, key_of) = (&camera.picture, |name: &str| format!("{key}.picture.{name}"));
        self.pixels(&key_of("width"), picture.width)?;
        self.pixels(&key_of("height"), picture.height)?;
        self.number(&key_of("horizontal_fov_deg"), picture.horizontal_fov_deg, fov.clone())?;
        self.number(&key_of("vertical_fov_deg"), picture.vertical_fov_deg, fov)?;
        self.number(&key_of("left_m"), picture.left_m, -1.0..=1.0)?;
        self.number(&key_of("noise"), picture.noise, 0.0..=30.0)
    }

    fn check_robot(&self, key: &str, robot: &RobotConfig) -> Result<(), ScenarioError> {
        self.point(&format!("{key}.start"), &[robot.start.x_m, robot.start.y_m])?;
        self.angle(&format!("{key}.start.heading_deg"), robot.start.heading_deg)?;
        self.number(&format!("{key}.radius_m"), robot.radius_m, 0.01..=10.0)?;
        self.number(&format!("{key}.height_m"), robot.height_m, 0.01..=self.room.height_m)?;
        self.check_body(key, robot)?;
        self.check_sensor(&format!("{key}.sensor"), &robot.sensor, robot.radius_m)?;
        self.check_route(&format!("{key}.route"), &robot.route)?;
        self.check_odometry(&format!("{key}.odometry"), &robot.odometry)
    }

    /// Checks the box and the marker on it.
    fn check_body(&self, key: &str, robot: &RobotConfig) -> Result<(), ScenarioError> {
        if let Some(sides) = robot.box_m {
            for side in sides {
                self.number(&format!("{key}.box_m"), side, 0.01..=2.0 * robot.radius_m)?;
            }
            if sides[0].hypot(sides[1]) > 2.0 * robot.radius_m + 1e-9 {
                let problem = "exceeds radius_m; increase the radius to half the box's diagonal";
                return Err(self.invalid(format!("{key}.box_m"), problem));
            }
        }
        let width = robot.box_m.map_or(2.0 * robot.radius_m, |[length, width]| length.min(width));
        let most = match robot.marker {
            // The white margin adds a quarter to the square's side.
            MarkerConfig::Tag => width / 1.25,
            MarkerConfig::Colour => width,
        };
        self.number(&format!("{key}.marker_size_m"), robot.marker_size_m, 0.01..=most)?;
        if let Some(id) = robot.tag_id.filter(|&id| usize::from(id) >= TAGS) {
            let problem = format!("is {id}; give a number from 0 to {}", TAGS - 1);
            return Err(self.invalid(format!("{key}.tag_id"), problem));
        }
        self.angle(&format!("{key}.identifier_askew_deg"), robot.identifier_askew_deg)
    }

    fn check_sensor(
        &self,
        key: &str,
        sensor: &SensorConfig,
        robot_radius_m: f64,
    ) -> Result<(), ScenarioError> {
        let key_of = |name: &str| format!("{key}.{name}");
        self.number(&key_of("x_m"), sensor.x_m, -robot_radius_m..=robot_radius_m)?;
        self.number(&key_of("y_m"), sensor.y_m, -robot_radius_m..=robot_radius_m)?;
        self.number(&key_of("height_m"), sensor.height_m, 0.0..=self.room.height_m)?;
        self.angle(&key_of("heading_deg"), sensor.heading_deg)?;
        self.angle(&key_of("askew_deg"), sensor.askew_deg)?;
        self.number(&key_of("tilt_deg"), sensor.tilt_deg, -45.0..=45.0)?;
        let widest = if sensor.preset == SensorPreset::Beams { 360.0 } else { 170.0 };
        self.number(&key_of("fov_deg"), sensor.fov_deg, 0.1..=widest)?;
        if sensor.preset == SensorPreset::GreyCamera && sensor.beams != 320 {
            let problem = format!("is {}; a grey camera has 320", sensor.beams);
            return Err(self.invalid(key_of("beams"), problem));
        }
        if !(2..=4096).contains(&sensor.beams) {
            let problem = format!("is {}; give a number from 2 to 4096", sensor.beams);
            return Err(self.invalid(key_of("beams"), problem));
        }
        // A reading is a 16-bit number of millimetres.
        self.number(&key_of("max_range_m"), sensor.max_range_m, 0.01..=65.5)?;
        self.number(&key_of("min_range_m"), sensor.min_range_m, 0.0..=sensor.max_range_m)?;
        self.number(&key_of("clear_m"), sensor.clear_m, 0.0..=sensor.max_range_m)?;
        self.number(&key_of("rate_hz"), sensor.rate_hz, 0.01..=100.0)?;
        self.number(&key_of("noise_m"), sensor.noise_m, 0.0..=10.0)?;
        self.number(&key_of("noise_ratio"), sensor.noise_ratio, 0.0..=1.0)
    }

    fn check_route(&self, key: &str, route: &RouteConfig) -> Result<(), ScenarioError> {
        let key_of = |name: &str| format!("{key}.{name}");
        self.points(&key_of("waypoints_m"), &route.waypoints_m)?;
        self.number(&key_of("speed_m_s"), route.speed_m_s, 0.001..=10.0)?;
        self.number(&key_of("acceleration_m_s2"), route.acceleration_m_s2, 0.01..=100.0)?;
        self.number(&key_of("turn_rate_deg_s"), route.turn_rate_deg_s, 0.1..=3600.0)
    }

    fn check_odometry(&self, key: &str, odometry: &OdometryConfig) -> Result<(), ScenarioError> {
        let key_of = |name: &str| format!("{key}.{name}");
        let OdometryConfig { slip, turn_slip, drift_deg_per_m, .. } = odometry;
        self.number(&key_of("slip"), slip.unwrap_or(0.0), -0.9..=10.0)?;
        self.number(&key_of("turn_slip"), turn_slip.unwrap_or(0.0), -0.9..=10.0)?;
        let drift = drift_deg_per_m.unwrap_or(0.0);
        self.number(&key_of("drift_deg_per_m"), drift, -360.0..=360.0)?;
        self.number(&key_of("noise_m"), odometry.noise_m, 0.0..=10.0)?;
        self.number(&key_of("heading_noise_deg"), odometry.heading_noise_deg, 0.0..=180.0)
    }

    fn check_person(&self, key: &str, person: &PersonConfig) -> Result<(), ScenarioError> {
        let waypoints = format!("{key}.waypoints_m");
        if person.waypoints_m.is_empty() {
            return Err(self.invalid(waypoints, "needs at least one point"));
        }
        self.points(&waypoints, &person.waypoints_m)?;
        self.number(&format!("{key}.speed_m_s"), person.speed_m_s, 0.001..=10.0)?;
        self.number(&format!("{key}.pause_s"), person.pause_s, 0.0..=3600.0)?;
        self.number(&format!("{key}.radius_m"), person.radius_m, 0.01..=10.0)?;
        self.number(&format!("{key}.height_m"), person.height_m, 0.01..=self.room.height_m)?;
        self.angle(&format!("{key}.heading_deg"), person.heading_deg)?;
        let stands = person.posture == PostureConfig::Standing;
        let rises_s = format!("{key}.rises_s");
        match person.rises_s {
            Some(_) if stands => {
                let problem = "is for a person who sits or lies; set posture, or leave it out";
                return Err(self.invalid(rises_s, problem));
            }
            Some(seconds) => self.number(&rises_s, seconds, 0.0..=86_400.0)?,
            None if !stands && person.waypoints_m.len() > 1 => {
                let problem =
                    "must be a single point unless the person stands or rises; add rises_s";
                return Err(self.invalid(waypoints, problem));
            }
            None => {}
        }
        Ok(())
    }

    fn pixels(&self, key: &str, count: u32) -> Result<(), ScenarioError> {
        self.number(key, f64::from(count), 2.0..=4096.0)
    }

    fn points(&self, key: &str, points: &[[f64; 2]]) -> Result<(), ScenarioError> {
        points
            .iter()
            .enumerate()
            .try_for_each(|(index, point)| self.point(&format!("{key}[{index}]"), point))
    }

    fn point(&self, key: &str, point: &[f64; 2]) -> Result<(), ScenarioError> {
        point.iter().try_for_each(|&coordinate| self.number(key, coordinate, -1e4..=1e4))
    }

    fn angle(&self, key: &str, degrees: f64) -> Result<(), ScenarioError> {
        self.number(key, degrees, -3600.0..=3600.0)
    }

    /// Refuses a number outside of a range; NaN is outside of any.
    fn number(
        &self,
        key: &str,
        value: f64,
        range: RangeInclusive<f64>,
    ) -> Result<(), ScenarioError> {
        if range.contains(&value) {
            return Ok(());
        }
        let problem = format!(
            "is {}; give a number from {} to {}",
            Rounded(value),
            range.start(),
            range.end()
        );
        Err(self.invalid(key, problem))
    }
}

/// Whether the corners go once round a convex polygon, in either direction, without three on a line.
fn is_convex(points: &[[f64; 2]]) -> bool {
    let count = points.len();
    let corner = |index: usize| points[index % count];
    let turn = |index: usize| {
        let ([ax, ay], [bx, by], [cx, cy]) = (corner(index), corner(index + 1), corner(index + 2));
        (bx - ax) * (cy - by) - (by - ay) * (cx - bx)
    };
    // In a convex polygon all corners turn the same way, and no corner lies beyond any edge. The
    // first condition alone also holds for a star, which goes round twice.
    let beyond = |index: usize, other: usize| {
        let ([ax, ay], [bx, by], [cx, cy]) = (corner(index), corner(index + 1), corner(other));
        (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    };
    count >= 3
        && [1.0, -1.0].iter().any(|sense| {
            (0..count).all(|index| {
                turn(index) * sense > 1e-9
                    && (0..count).all(|other| beyond(index, other) * sense >= -1e-9)
            })
        })
}
