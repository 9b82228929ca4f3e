//! Labels: places where things of a class stand, and how soon what is known of them is forgotten
//! (Aluckal III.D, "extended awareness": a weight "based on the probability that the object is likely
//! to move").
//!
//! They come from a file, and from the scenario of a simulation, which may have the same tables:
//!
//! ```toml
//! [[labels]]
//! class = "chair"            # person, door, chair or cabinet
//! name = "by the window"     # for readers
//! box = { centre_m = [4.1, 0.8], size_m = [1.0, 1.0], heading_deg = 15.0 }
//!
//! [[labels]]
//! class = "door"
//! polygon_m = [[2.0, 4.8], [2.9, 4.8], [2.9, 5.7], [2.0, 5.7]]
//! forget_s = 30.0            # instead of the class's time; 10 s to a year
//! ```
//!
//! Positions are in `map`, in metres and degrees. A cell has a label if its middle lies inside; where
//! labels overlap, the one that is forgotten soonest counts.

use std::path::Path;

use serde::Deserialize;

use super::polygon::{is_inside, span};
use crate::files;

/// Maximum extent of a label along an axis in metres.
const WIDEST_M: usize = 100;
/// Minimum and maximum time after which something is forgotten, in seconds. The map ages in steps of
/// ten seconds.
const FORGET_S: [f64; 2] = [10.0, 31_536_000.0];

/// A class of things, by how likely they are to move.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Class {
    /// People stay here for a while: a desk, a bench.
    Person,
    /// A door: the leaf, and the ground over which it swings.
    Door,
    /// Small furniture that is moved often.
    Chair,
    /// Large furniture that stays where it is.
    Cabinet,
}

impl Class {
    /// Mean time between changes that is assumed of the class, in seconds. Older claims about its cells
    /// are forgotten, because they are more likely to be outdated than not. `None`: never.
    pub fn forget_s(self) -> Option<u32> {
        match self {
            Self::Person => Some(30),
            Self::Door => Some(60),
            Self::Chair => Some(120),
            Self::Cabinet => None,
        }
    }
}

/// A rectangle in `map`.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
struct Rectangle {
    centre_m: [f64; 2],
    size_m: [f64; 2],
    #[serde(default)]
    heading_deg: f64,
}

/// A label as a file states it.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LabelConfig {
    class: Class,
    #[serde(default)]
    name: String,
    #[serde(rename = "box")]
    rectangle: Option<Rectangle>,
    polygon_m: Option<Vec<[f64; 2]>>,
    forget_s: Option<f64>,
}

/// An area where things of a class stand.
#[derive(Clone, Debug, PartialEq)]
pub struct Label {
    /// The class.
    pub class: Class,
    /// The corners of a polygon in `map`, in metres.
    pub corners_m: Vec<[f64; 2]>,
    /// Age in whole seconds at which claims are forgotten; `None`: never.
    pub forget_s: Option<u32>,
}

impl Label {
    /// A polygon of a class, with the class's time.
    pub fn new(class: Class, corners_m: Vec<[f64; 2]>) -> Self {
        Self { class, corners_m, forget_s: class.forget_s() }
    }

    /// A rectangle of a class: centre and sides in metres, heading in radians.
    pub fn rectangle(class: Class, centre_m: [f64; 2], size_m: [f64; 2], heading: f64) -> Self {
        let (sin, cos) = (libm::sin(heading), libm::cos(heading));
        let corner = |[along, across]: [f64; 2]| {
            let (x, y) = (along * size_m[0] / 2.0, across * size_m[1] / 2.0);
            [centre_m[0] + x * cos - y * sin, centre_m[1] + x * sin + y * cos]
        };
        let corners = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]];
        Self::new(class, corners.map(corner).to_vec())
    }

    /// Whether a point in `map`, in metres, lies inside.
    pub fn contains(&self, point: [f64; 2]) -> bool {
        is_inside(&self.corners_m, point)
    }
}

impl LabelConfig {
    /// The label.
    ///
    /// # Errors
    /// The problem, on one line.
    pub fn label(&self) -> Result<Label, String> {
        let mut label = match (&self.rectangle, &self.polygon_m) {
            (Some(Rectangle { centre_m, size_m, heading_deg }), None) => {
                if !size_m.iter().all(|it| *it > 0.0) {
                    return Err("box: size_m must be above 0".into());
                }
                Label::rectangle(self.class, *centre_m, *size_m, heading_deg.to_radians())
            }
            (None, Some(corners)) if corners.len() < 3 => {
                return Err(format!(
                    "polygon_m has {} corners; at least 3 are needed",
                    corners.len()
                ));
            }
            (None, Some(corners)) => Label::new(self.class, corners.clone()),
            _ => return Err("needs either box or polygon_m".into()),
        };
        for axis in [0, 1] {
            let metres = span(&label.corners_m, axis, 1.0);
            let metres = metres.ok_or("must lie within 10 km of the origin")?;
            if metres.len() > WIDEST_M {
                return Err(format!("is more than {WIDEST_M} m across"));
            }
        }
        if let Some(seconds) = self.forget_s {
            let [least, most] = FORGET_S;
            if !(least..=most).contains(&seconds) {
                return Err(format!("forget_s must be from {least} to {most} seconds"));
            }
            // The bounds fit.
            label.forget_s = Some(seconds as u32);
        }
        Ok(label)
    }
}

/// Checks the labels of a file. A problem names the label by its number, from 0, and its name.
///
/// # Errors
/// The problem, on one line.
pub fn labels(configs: &[LabelConfig]) -> Result<Vec<Label>, String> {
    let label = |(index, config): (usize, &LabelConfig)| {
        let named = match config.name.as_str() {
            "" => format!("labels[{index}]"),
            name => format!("labels[{index}] ({name})"),
        };
        config.label().map_err(|problem| format!("{named}: {problem}"))
    };
    configs.iter().enumerate().map(label).collect()
}

/// Reads a file of labels.
///
/// # Errors
/// The problem, on one line, without the name of the file.
pub fn read_labels(path: &Path) -> Result<Vec<Label>, String> {
    #[derive(Deserialize)]
    #[serde(deny_unknown_fields)]
    struct File {
        labels: Vec<LabelConfig>,
    }
    let text = files::read_settings(path).map_err(|error| error.to_string())?;
    let file: File = toml::from_str(&text).map_err(|error| files::toml_fault(&error, &text))?;
    labels(&file.labels)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Folder;

    fn read(text: &str) -> Result<Vec<Label>, String> {
        let folder = Folder::new("labels");
        read_labels(&folder.file("labels.toml", text.as_bytes()))
    }

    #[test]
    fn the_documented_file_is_read() {
        let documented = include_str!("labels.rs").lines().skip_while(|it| !it.contains("```toml"));
        let example: Vec<&str> =
            documented.skip(1).map_while(|line| line.strip_prefix("//!")).collect();
        let example = example.join("\n");
        let (text, _) = example.split_once("```").unwrap();
        let labels = read(text).unwrap();
        assert_eq!(labels[0].class, Class::Chair);
        assert_eq!([labels[0].forget_s, labels[1].forget_s], [Some(120), Some(30)]);
        // Half a metre and a bit from the centre along the turned side, but not along x.
        assert!(labels[0].contains([4.1 + 0.45, 0.8 + 0.12]));
        assert!(!labels[0].contains([4.1 + 0.52, 0.8]));
        assert!(labels[1].contains([2.45, 5.0]) && !labels[1].contains([1.9, 5.0]));
        assert_eq!(Class::Cabinet.forget_s(), None);
    }

    #[test]
    fn mistakes_are_named() {
        let label =
            |rest: &str| read(&format!("[[labels]]\nclass = \"chair\"\n{rest}")).unwrap_err();
        for (rest, expected) in [
            ("", "labels[0]: needs either box or polygon_m"),
            (
                "name = \"a\"\npolygon_m = [[0, 0], [1, 1]]",
                "labels[0] (a): polygon_m has 2 corners",
            ),
            ("box = { centre_m = [0, 0], size_m = [1, 0] }", "size_m must be above 0"),
            ("box = { centre_m = [0, nan], size_m = [1, 1] }", "within 10 km"),
            (
                "box = { centre_m = [0, 0], size_m = [1, 1] }\nforget_s = 5",
                "forget_s must be from 10",
            ),
            ("colour = 3", "line 3: unknown field `colour`"),
        ] {
            let error = label(rest);
            assert!(error.contains(expected), "{error}");
        }
        let error = read("[[labels]]\nclass = \"sofa\"\n").unwrap_err();
        assert!(error.contains("line 2") && error.contains("`cabinet`"), "{error}");
    }
}
