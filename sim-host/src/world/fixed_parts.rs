//! The walls and furniture of a scenario's room as plain geometry, for users that know nothing of
//! the simulation and only ask what hides what.

use super::{
    room::Room,
    scenario::{Scenario, ScenarioError},
    shapes::Rim,
};

/// A shape from above, in `map`, metres.
#[derive(Clone, Debug, PartialEq)]
pub enum FixedOutline {
    /// A circle.
    Disc {
        /// The centre of the circle.
        centre_m: [f64; 2],
        /// The radius of the circle.
        radius_m: f64,
    },
    /// A convex polygon by its corners, counter-clockwise.
    Polygon(Vec<[f64; 2]>),
}

/// An upright prism: a wall, a closed door, or a piece of furniture or part of one.
#[derive(Clone, Debug, PartialEq)]
pub struct FixedPart {
    /// The name of a piece of furniture; `None` for walls and doors.
    pub name: Option<String>,
    /// The shape seen from above.
    pub outline: FixedOutline,
    /// Height of its lower side above the floor, in metres.
    pub bottom_m: f64,
    /// Height of its upper side above the floor, in metres.
    pub top_m: f64,
}

impl Scenario {
    /// Walls, closed doors and furniture in their initial places, without the walls of a map.
    ///
    /// # Errors
    /// [`ScenarioError::Invalid`] for furniture that has no area.
    pub fn fixed_parts(&self) -> Result<Vec<FixedPart>, ScenarioError> {
        let mut drawn = self.clone();
        drawn.room.map = None;
        Ok(parts(&Room::new(&drawn, None, &[])?, self))
    }
}

/// The parts of a scenario's room as they stand in it.
pub(super) fn parts(room: &Room, scenario: &Scenario) -> Vec<FixedPart> {
    let name = |key: &str| {
        let index = key.strip_prefix("furniture[")?.strip_suffix(']')?.parse::<usize>().ok()?;
        Some(scenario.furniture.get(index)?.name.clone())
    };
    let part = |(prism, key): (&super::shapes::Prism, &String)| FixedPart {
        name: name(key),
        outline: match prism.footprint.rim() {
            Rim::Disc { centre, radius } => {
                FixedOutline::Disc { centre_m: centre.to_array(), radius_m: radius }
            }
            Rim::Corners(corners) => {
                FixedOutline::Polygon(corners.iter().map(|it| it.to_array()).collect())
            }
        },
        bottom_m: prism.bottom,
        top_m: prism.top,
    };
    room.prisms().iter().zip(room.keys()).map(part).collect()
}
