//! Whether a sensor looks down: the floor is a line across at a distance that stays while the robot moves.

use serde::Serialize;
use ubimap_protocol::units::Pose;

use super::{motion::Motion, view::View};

/// A line across is the same if its distance differs by less than this, in metres.
const SAME: f64 = 0.04;
/// Turn and way after which a wall would have changed, in radians and metres.
const TURNED: f64 = 0.17;
const MOVED: f64 = 0.12;
/// Number of views after a motion that must agree.
const ENOUGH: usize = 2;
/// Maximum number of views that are kept.
const KEPT: usize = 60;

/// What limits the view.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// No line across.
    Open,
    /// A line across: a wall, or the floor.
    Line,
    /// A line across that has stayed while the robot moved: the floor.
    Floor,
}

/// The lines across of the newest views.
#[derive(Clone, Debug)]
pub(super) struct Tilt {
    /// The sensor's position ahead of `base_link`, and its height above the floor, in metres.
    mounting_x: f64,
    height: Option<f64>,
    /// The poses of the views, and how far ahead the line is.
    lines: Vec<(Pose, Option<f64>)>,
}

impl Tilt {
    /// No views yet of a sensor there.
    pub(super) fn new(mounting_x: f64, height: Option<f64>) -> Self {
        Self { mounting_x, height, lines: Vec::new() }
    }

    /// Adds a view from a pose by the wheels.
    pub(super) fn add(&mut self, pose: Pose, view: &View) {
        if self.lines.len() >= KEPT {
            self.lines.remove(0);
        }
        self.lines.push((pose, view.flat_m()));
    }

    /// The newest line across.
    fn line(&self) -> Option<(Pose, f64)> {
        let (pose, line) = self.lines.last()?;
        line.map(|line| (*pose, line))
    }

    /// What limits the view.
    pub(super) fn verdict(&self) -> Verdict {
        let Some((pose, line)) = self.line() else { return Verdict::Open };
        let has_moved = |from: Pose| {
            let Motion { ahead, turn } = Motion::between(from, pose);
            ahead.abs() > MOVED || turn.abs() > TURNED
        };
        let before = self.lines.iter().filter(|(from, _)| has_moved(*from));
        let stayed = before.filter(|(_, it)| it.is_some_and(|it| (it - line).abs() < SAME));
        if stayed.count() >= ENOUGH { Verdict::Floor } else { Verdict::Line }
    }

    /// By how much the sensor looks down, in degrees; `None` unless it sees the floor and its height is known.
    pub(super) fn looks_down_deg(&self) -> Option<f64> {
        let (_, line) = self.line().filter(|_| self.verdict() == Verdict::Floor)?;
        self.angle_deg(line)
    }

    /// The angle at which a sensor at this height sees the floor at a line.
    fn angle_deg(&self, line: f64) -> Option<f64> {
        let far = line - self.mounting_x;
        self.height.filter(|_| far > 0.0).map(|height| libm::atan2(height, far).to_degrees())
    }

    /// The same for people, with what to do next; empty without a line.
    pub(super) fn described(&self) -> String {
        let Some((_, line)) = self.line() else { return String::new() };
        match (self.verdict(), self.angle_deg(line)) {
            (Verdict::Open, _) => String::new(),
            (Verdict::Line, _) => format!(
                "a line straight across, {line:.2} m ahead: a wall? Turn the robot by 20 degrees; if the line stays, it is \
                 the floor, and the sensor looks down\n"
            ),
            (Verdict::Floor, Some(degrees)) => format!(
                "the line {line:.2} m ahead moves with the robot: it is the floor. The sensor looks down by \
                 {degrees:.1} degrees: tilt it up by that\n"
            ),
            (Verdict::Floor, None) => format!(
                "the line {line:.2} m ahead moves with the robot: it is the floor, and the sensor looks down (by how \
                 much: --height)\n"
            ),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A view of a line across.
    fn across(x: f64) -> View {
        let seen = (-30..=30).step_by(3).map(|degree| {
            let bearing = f64::from(degree).to_radians();
            (bearing, x / bearing.cos())
        });
        View { seen: seen.collect(), columns: 21, from_to: [-0.5, 0.5] }
    }

    #[test]
    fn a_line_that_moves_with_the_robot_is_the_floor_and_tells_the_angle() {
        let mut tilt = Tilt::new(0.1, Some(0.1));
        let turned = |degrees: f64| Pose::from_metres(0.0, 0.0, degrees.to_radians());
        for degrees in [0.0, 0.0, 1.0] {
            tilt.add(turned(degrees), &across(1.53));
            assert_eq!((tilt.verdict(), tilt.looks_down_deg()), (Verdict::Line, None));
        }
        tilt.add(turned(15.0), &across(1.54));
        let degrees = tilt.looks_down_deg().unwrap();
        assert!((degrees - 4.0).abs() < 0.1, "{degrees}");
        assert!(tilt.described().contains("looks down by 4.0 degrees"));
    }

    #[test]
    fn a_wall_is_left_when_the_robot_turns_or_comes_nearer() {
        for (pose, x) in
            [(Pose::from_metres(0.2, 0.0, 0.0), 1.33), (Pose::from_metres(0.0, 0.0, 0.4), 1.66)]
        {
            let mut tilt = Tilt::new(0.1, None);
            (0..5).for_each(|_| tilt.add(Pose::default(), &across(1.53)));
            tilt.add(pose, &across(x));
            assert_eq!(tilt.verdict(), Verdict::Line);
            tilt.add(pose, &View::default());
            assert_eq!((tilt.verdict(), tilt.described()), (Verdict::Open, String::new()));
        }
    }
}
