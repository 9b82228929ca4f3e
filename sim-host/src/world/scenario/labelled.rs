//! The labels of a scenario: those it states, and those of its furniture and doors that have a class.

use super::{DoorConfig, FootprintConfig, FurnitureConfig, Scenario, ScenarioError};
use crate::grid::{Label, labels};

/// Ground around a piece of furniture that has its label, too, in metres: its surfaces are drawn in the
/// cells there.
const MARGIN_M: f64 = 0.1;
/// Number of corners of a disc's label.
const CORNERS: u32 = 12;

impl Scenario {
    /// All labels.
    ///
    /// # Errors
    /// [`ScenarioError::Invalid`].
    pub fn labels(&self) -> Result<Vec<Label>, ScenarioError> {
        let mut all = labels(&self.labels).map_err(|problem| {
            let (key, problem) = problem.split_once(": ").unwrap_or(("labels", &problem));
            self.invalid(key, problem)
        })?;
        all.extend(self.furniture.iter().filter_map(of_furniture));
        all.extend(self.doors.iter().filter_map(of_door));
        Ok(all)
    }
}

/// The label of a piece of furniture where it stands first.
fn of_furniture(furniture: &FurnitureConfig) -> Option<Label> {
    let class = furniture.class?;
    Some(match &furniture.footprint {
        FootprintConfig::Box { centre_m, size_m, heading_deg } => {
            let size_m = size_m.map(|side| side + 2.0 * MARGIN_M);
            Label::rectangle(class, *centre_m, size_m, heading_deg.to_radians())
        }
        FootprintConfig::Disc { centre_m: [x, y], radius_m } => {
            let corners = (0..CORNERS).map(|corner| {
                let angle = std::f64::consts::TAU * f64::from(corner) / f64::from(CORNERS);
                let radius = radius_m + MARGIN_M;
                [x + radius * libm::cos(angle), y + radius * libm::sin(angle)]
            });
            Label::new(class, corners.collect())
        }
        FootprintConfig::Polygon { points_m } => Label::new(class, points_m.clone()),
    })
}

/// The label of a door: the places of its leaf, and the ground between.
fn of_door(door: &DoorConfig) -> Option<Label> {
    let class = door.class?;
    let [closed, open] = [0.0, door.swing_deg].map(|turn| {
        let heading = (door.heading_deg + turn).to_radians();
        [libm::cos(heading), libm::sin(heading)]
    });
    let reach = door.width_m + 2.0 * MARGIN_M;
    let [x, y] = [0, 1].map(|axis| door.hinge_m[axis] - MARGIN_M * (closed[axis] + open[axis]));
    let corner = |along: f64, across: f64| {
        [0, 1].map(|axis| [x, y][axis] + reach * (along * closed[axis] + across * open[axis]))
    };
    let corners = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
    let corners = corners.map(|[along, across]| corner(along, across)).to_vec();
    Some(Label::new(class, corners))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::Class;

    #[test]
    fn furniture_and_doors_with_a_class_have_labels() {
        let scenario = Scenario::read(std::path::Path::new("awareness")).unwrap();
        let labels = scenario.labels().unwrap();
        let class_at = |point| -> Vec<Class> {
            labels.iter().filter(|label| label.contains(point)).map(|it| it.class).collect()
        };
        let FootprintConfig::Box { centre_m: [x, y], size_m, .. } = scenario.furniture[0].footprint
        else {
            unreachable!("the chair is a box")
        };
        assert_eq!(class_at([x, y]), [Class::Chair]);
        assert_eq!(class_at([x + size_m[0] / 2.0 + 0.09, y]), [Class::Chair]);
        let [x, y] = scenario.doors[0].hinge_m;
        let width = scenario.doors[0].width_m;
        for (east, north) in [(0.0, 0.0), (width, 0.0), (0.0, width), (width / 2.0, width / 2.0)] {
            assert_eq!(class_at([x + east, y + north]), [Class::Door], "{east} {north}");
        }
        assert_eq!(class_at([x + width / 2.0, y - 0.15]), []);
    }
}
