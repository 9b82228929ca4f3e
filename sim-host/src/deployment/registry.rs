//! The robots and their markers: the contents of `robots.toml`.
//!
//! ```toml
//! [[robots]]
//! id = 1
//! tag_id = 5                   # of AprilTag 36h11; default: the robot's id
//! # colours = ["red", "blue"]  # a colour marker instead: head and tail, each red, yellow, green,
//!                              # cyan, blue or magenta
//! marker_size_m = 0.1          # side of the tag's black square, or of the colour marker
//! height_m = 0.3               # height of the marker above the floor: the robot's top
//! box_m = [0.4, 0.3]           # the robot's length and width; with neither of these two: 0.4 by 0.4
//! # diameter_m = 0.34          # instead, of a round robot: it passes narrower doors
//! marker_at_m = [0.0, 0.0]     # the marker's centre, ahead of base_link and to its left
//! marker_turn_deg = 0.0        # yaw of the marker relative to the robot, counter-clockwise
//! # port = "/dev/ttyUSB0"      # for `ubimap serve` alone: the robot's own port
//! ```

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};
use ubimap_protocol::units::{Millimetres, RobotId};

use crate::{
    camera::Calibration,
    perception::{
        Footprint, Observer, Survey,
        markers::{Hue, Identifier, Mount},
        robots::RegistryError,
    },
};

/// Number of tags in the family 36h11.
const TAGS: u16 = 587;
/// Height assumed for the tallest robot if none is registered.
const USUAL_HEIGHT_M: f64 = 0.3;
/// Maximum accepted size of a robot or a marker.
const MAX_SIZE_M: f64 = 10.0;

/// All registered robots.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Registry {
    /// The robots in any order; their ids are unique.
    #[serde(default)]
    pub robots: Vec<RegisteredRobot>,
}

/// A registered robot.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RegisteredRobot {
    /// The robot's id.
    pub id: u16,
    /// The id of its AprilTag; by default the robot's id.
    pub tag_id: Option<u16>,
    /// The colours of the head and the tail of its marker, if it is not a tag.
    pub colours: Option<[Hue; 2]>,
    /// The side of the tag's black square, or of the colour marker.
    pub marker_size_m: f64,
    /// Height of the marker above the floor.
    pub height_m: f64,
    /// The robot's length and width, unless it is round.
    pub box_m: Option<[f64; 2]>,
    /// The diameter of a robot that is round.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub diameter_m: Option<f64>,
    /// The marker's centre, ahead of `base_link` and to its left.
    #[serde(default)]
    pub marker_at_m: [f64; 2],
    /// Yaw of the marker relative to the robot, counter-clockwise.
    #[serde(default)]
    pub marker_turn_deg: f64,
    /// The port of `ubimap serve` at which it is, if it is the only one there: a serial device, or a
    /// socket as `udp:4000`. Nothing else reads it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub port: Option<String>,
}

/// Why a registry was refused, in one line.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct BadRegistry(String);

impl RegisteredRobot {
    /// A robot of the given length and width, with the tag of its own id above `base_link`.
    pub fn new(id: u16, marker_size_m: f64, height_m: f64, box_m: [f64; 2]) -> Self {
        Self {
            id,
            tag_id: None,
            colours: None,
            marker_size_m,
            height_m,
            box_m: Some(box_m),
            diameter_m: None,
            marker_at_m: [0.0; 2],
            marker_turn_deg: 0.0,
            port: None,
        }
    }

    fn identifier(&self) -> Identifier {
        match self.colours {
            Some([head, tail]) => Identifier::Colours { head, tail },
            None => Identifier::Tag(self.tag_id.unwrap_or(self.id)),
        }
    }

    fn mount(&self) -> Mount {
        Mount {
            offset_m: self.marker_at_m,
            turn_rad: self.marker_turn_deg.to_radians(),
            ..Mount::centred(RobotId(self.id), self.marker_size_m, self.height_m)
        }
    }

    fn footprint(&self) -> Footprint {
        let half = |side: f64| (side * 500.0).round() as u16;
        let of_box = |[length, width]: [f64; 2]| Footprint {
            half_length: half(length),
            half_width: half(width),
            is_round: self.diameter_m.is_some(),
        };
        let sides = self.diameter_m.map(|diameter| [diameter; 2]).or(self.box_m);
        sides.map(of_box).unwrap_or_default()
    }

    /// Describes the first invalid value, if any.
    fn fault(&self) -> Option<String> {
        let id = self.id;
        let is_size = |metres: f64| metres > 0.0 && metres <= MAX_SIZE_M;
        let sizes = [("marker_size_m", self.marker_size_m), ("height_m", self.height_m)];
        if let Some((key, metres)) = sizes.into_iter().find(|(_, metres)| !is_size(*metres)) {
            return Some(format!(
                "robot {id}: {key}: {metres} must be above 0 and at most {MAX_SIZE_M}"
            ));
        }
        if self.box_m.is_some_and(|sides| !sides.into_iter().all(is_size)) {
            return Some(format!(
                "robot {id}: box_m: both sides must be above 0 and at most {MAX_SIZE_M}"
            ));
        }
        if self.diameter_m.is_some_and(|diameter| !is_size(diameter)) {
            return Some(format!(
                "robot {id}: diameter_m must be above 0 and at most {MAX_SIZE_M}"
            ));
        }
        if self.diameter_m.is_some() && self.box_m.is_some() {
            return Some(format!("robot {id}: has both box_m and diameter_m; remove one"));
        }
        if self.colours.is_some() && self.tag_id.is_some() {
            return Some(format!("robot {id}: has both tag_id and colours; remove one"));
        }
        match self.identifier() {
            Identifier::Tag(tag @ TAGS..) => {
                let last = TAGS - 1;
                Some(format!(
                    "robot {id}: tag_id: {tag} is not in family 36h11; the last tag is {last}"
                ))
            }
            _ => None,
        }
    }
}

impl Registry {
    /// Parses the contents of `robots.toml`.
    ///
    /// # Errors
    /// [`BadRegistry`], which names the line or the robot.
    pub fn from_toml(text: &str) -> Result<Self, BadRegistry> {
        let registry: Self = toml::from_str(text).map_err(|error| {
            let before = error.span().map_or(0, |span| span.start.min(text.len()));
            let line = 1 + text.as_bytes()[..before].iter().filter(|it| **it == b'\n').count();
            let what = error.message().lines().collect::<Vec<_>>().join(" ");
            BadRegistry(format!("line {line}: {what}"))
        })?;
        registry.checked()
    }

    /// The registry, if its robots can be told apart and their values are possible.
    ///
    /// # Errors
    /// [`BadRegistry`], which names the robot.
    pub fn checked(self) -> Result<Self, BadRegistry> {
        let mut ids = BTreeSet::new();
        for robot in &self.robots {
            if let Some(fault) = robot.fault() {
                return Err(BadRegistry(fault));
            }
            if !ids.insert(robot.id) {
                return Err(BadRegistry(format!("robot {} is registered twice", robot.id)));
            }
        }
        // No cameras are needed to check whether markers are unique.
        match self.observer(&[], Survey::default()) {
            Ok(_) => Ok(self),
            Err(error @ RegistryError::Twice(..)) => {
                Err(BadRegistry(format!("{error}; each needs its own")))
            }
            Err(error) => Err(BadRegistry(error.to_string())),
        }
    }

    /// Serialises the registry.
    pub fn to_toml(&self) -> String {
        // Plain structs: serialising them can't fail.
        toml::to_string(self).unwrap_or_default()
    }

    /// The settings of perception for cells of this side length, and for obstacles between two heights;
    /// `None`: from the default tolerance to the tallest robot, as higher ones do not block robots.
    pub fn survey(&self, side: Millimetres, heights: Option<[Millimetres; 2]>) -> Survey {
        let tallest_m = self.robots.iter().map(|robot| robot.height_m).reduce(f64::max);
        let tallest = Millimetres::from_metres(tallest_m.unwrap_or(USUAL_HEIGHT_M));
        let usual = Survey { side, robot_height: tallest, ..Survey::default() };
        let between = |[floor_tolerance, robot_height]: [Millimetres; 2]| Survey {
            floor_tolerance,
            robot_height,
            ..usual
        };
        heights.map_or(usual, between)
    }

    /// Creates perception for these cameras and robots.
    ///
    /// # Errors
    /// Every [`RegistryError`].
    pub fn observer(
        &self,
        cameras: &[Calibration],
        survey: Survey,
    ) -> Result<Observer, RegistryError> {
        let known: Vec<_> = self
            .robots
            .iter()
            .map(|robot| (robot.identifier(), robot.mount(), robot.footprint()))
            .collect();
        Observer::new(cameras, &known, survey)
    }

    /// The markers of the robots.
    pub fn markers(&self) -> impl Iterator<Item = (Identifier, Mount)> {
        self.robots.iter().map(|robot| (robot.identifier(), robot.mount()))
    }

    /// The footprint of each robot.
    pub fn footprints(&self) -> impl Iterator<Item = (RobotId, Footprint)> {
        self.robots.iter().map(|robot| (RobotId(robot.id), robot.footprint()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TWO: &str = "[[robots]]\nid = 1\nmarker_size_m = 0.1\nheight_m = 0.3\n\
                       [[robots]]\nid = 2\ncolours = [\"red\", \"blue\"]\nmarker_size_m = 0.2\n\
                       height_m = 0.25\nbox_m = [0.5, 0.3]\nmarker_turn_deg = 90\n";

    #[test]
    fn a_registry_survives_a_round_trip() {
        let registry = Registry::from_toml(TWO).unwrap();
        let [tagged, coloured] = &registry.robots[..] else { panic!("two robots") };
        assert_eq!(tagged.identifier(), Identifier::Tag(1));
        let (head, tail) = (Hue::Red, Hue::Blue);
        assert_eq!(coloured.identifier(), Identifier::Colours { head, tail });
        assert_eq!(coloured.mount().turn_rad, std::f64::consts::FRAC_PI_2);
        let half = Footprint { half_length: 250, half_width: 150, is_round: false };
        let footprints: Vec<_> = registry.footprints().collect();
        assert_eq!(footprints, [(RobotId(1), Footprint::default()), (RobotId(2), half)]);
        assert_eq!(Registry::from_toml(&registry.to_toml()).unwrap(), registry);
        let round =
            Registry::from_toml(&TWO.replace("box_m = [0.5, 0.3]", "diameter_m = 0.34")).unwrap();
        assert_eq!(round.robots[1].footprint().radius_m(), 0.17);
        assert_eq!(Registry::from_toml(&round.to_toml()).unwrap(), round);
        assert_eq!(Registry::from_toml("").unwrap(), Registry::default());
    }

    #[test]
    fn errors_name_the_place_and_the_remedy() {
        for (from, to, expected) in [
            (
                "id = 2\ncolours = [\"red\", \"blue\"]",
                "id = 2\ntag_id = 1",
                "robots 1 and 2 carry the same identifier; each needs its own",
            ),
            ("id = 2", "id = 1", "robot 1 is registered twice"),
            ("\"blue\"", "\"red\"", "robot 2 has a head and a tail of one colour"),
            ("\"blue\"", "\"pink\"", "line 7: unknown variant `pink`"),
            ("height_m = 0.25\n", "", "line 5: missing field `height_m`"),
            ("height_m = 0.25", "height_m = nan", "robot 2: height_m: NaN must be above 0"),
            ("marker_size_m = 0.1", "marker_size_m = 100", "robot 1: marker_size_m: 100 must be"),
            ("[0.5, 0.3]", "[0.5, 0]", "robot 2: box_m"),
            ("[0.5, 0.3]", "[0.5, 0.3]\ndiameter_m = 0.3", "both box_m and diameter_m; remove one"),
            ("box_m = [0.5, 0.3]", "diameter_m = -1", "robot 2: diameter_m must be above 0"),
            ("id = 2", "id = 2\ntag_id = 3", "tag_id and colours; remove one"),
            ("id = 1", "id = 1\ntag_id = 587", "is not in family 36h11"),
            (
                "id = 1",
                "id = 1\nmarker_at_m = [nan, 0]",
                "needs a positive size and a finite position",
            ),
            ("id = 1", "id = 1\nsize = 2", "line 3: unknown field `size`"),
        ] {
            let error = Registry::from_toml(&TWO.replacen(from, to, 1)).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
            assert_eq!(error.lines().count(), 1, "{error}");
            assert_eq!(error.contains("needs its own"), error.contains("the same"), "{error}");
        }
    }
}
