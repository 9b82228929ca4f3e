//! The main directions of a building's walls, as a compass.
//!
//! The walls of most buildings are along two directions at right angles (Coughlan and Yuille, ICCV 1999). What robots see
//! while cameras see them tells these directions in the map; what they see elsewhere then tells their headings, which so
//! don't drift. Where no direction stands out, or less than half of a view is along it, there is no heading. How well
//! it tells known headings is how far it is trusted with the others: old buildings, and maps that were drawn by SLAM, are
//! bent by a degree or two. A wing that is askew by less than [`ALONG`], and in which cameras see no robot, is taken to be
//! straight.

use core::f64::consts::{FRAC_PI_2, FRAC_PI_4};

use nalgebra::Vector2;

use crate::mapping::{alignment::line, submaps::Surfel};

/// Points in a row to which a line is fitted.
const ROW: usize = 6;
/// Maximum distance of neighbours in a row, in metres.
const APART_M: f64 = 0.3;
/// Classes of directions: half a degree each.
const CLASSES: usize = 180;
/// The main direction is in a class and this many on each side of it.
const BESIDE: i32 = 4;
/// Minimum weight of what was seen, in square metres, to tell the main direction: some metres of walls.
const LEAST_LEARNT: f64 = 20.0;
/// Minimum share of the main direction in what was seen.
const LEAST_SHARE: f64 = 0.5;
/// Maximum distance from the main direction of a line that is along it, in radians.
const ALONG: f64 = 0.08;
/// Minimum weight of lines along it to tell a heading, in square metres, and their minimum share.
const LEAST_ALONG: f64 = 0.5;
const LEAST_SHARE_ALONG: f64 = 0.5;
/// Minimum number of known headings that it has told.
const LEAST_TOLD: u32 = 8;
/// Deviation of a heading by what a view shows of straight walls, in radians.
const BY_VIEW: f64 = 0.01;
/// Factor on the errors with known headings: neighbouring walls share an error, so many views of them are worth no more
/// than one.
const WARY: f64 = 3.0;

/// A direction in which surfaces are.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Direction {
    /// In radians, modulo a half turn.
    pub(super) angle: f64,
    /// How sure it is: the sum of the squared distances of its points from their middle, in square metres.
    pub(super) weight: f64,
}

/// The directions of the surfaces in a view, one for each row of points, in the view's frame.
pub(super) fn directions(surfels: &[Surfel]) -> impl Iterator<Item = Direction> {
    surfels.windows(ROW).filter_map(|row| {
        let points: Vec<Vector2<f64>> = row.iter().map(|it| it.at).collect();
        if points.windows(2).any(|two| (two[1] - two[0]).norm() > APART_M) {
            return None;
        }
        let (middle, normal) = line(&points)?;
        let weight = points.iter().map(|it| (it - middle).norm_squared()).sum();
        Some(Direction { angle: libm::atan2(normal.x, -normal.y), weight })
    })
}

/// The main direction of the walls in the map.
#[derive(Debug)]
pub(super) struct Compass {
    /// Weights by direction, modulo a quarter turn.
    classes: [f64; CLASSES],
    /// In radians.
    main: Option<f64>,
    /// Number of known headings that it has told, and the sum of its squared errors.
    told: (u32, f64),
}

impl Default for Compass {
    fn default() -> Self {
        Self { classes: [0.0; CLASSES], main: None, told: (0, 0.0) }
    }
}

impl Compass {
    /// Learns from what was seen in a known heading.
    pub(super) fn learn(&mut self, directions: &[Direction], heading: f64) {
        if let Some(found) = self.by_walls(directions, heading) {
            let (count, squares) = self.told;
            self.told = (count.saturating_add(1), squares + (found - heading).powi(2));
        }
        for it in directions {
            let part = (it.angle + heading).rem_euclid(FRAC_PI_2) / FRAC_PI_2;
            self.classes[((part * CLASSES as f64) as usize).min(CLASSES - 1)] += it.weight;
        }
        self.main = self.main();
    }

    fn main(&self) -> Option<f64> {
        let about = |class: usize| {
            let at = move |by: i32| {
                self.classes[(class as i32 + by).rem_euclid(CLASSES as i32) as usize]
            };
            (-BESIDE..=BESIDE).map(move |by| (f64::from(by), at(by)))
        };
        let weight = |class: usize| about(class).map(|(_, weight)| weight).sum::<f64>();
        let class = (0..CLASSES).max_by(|a, b| weight(*a).total_cmp(&weight(*b)))?;
        let all: f64 = self.classes.iter().sum();
        let stands_out = all >= LEAST_LEARNT && weight(class) >= LEAST_SHARE * all;
        let mean = about(class).map(|(by, weight)| by * weight).sum::<f64>() / weight(class);
        stands_out.then_some((class as f64 + 0.5 + mean) * FRAC_PI_2 / CLASSES as f64)
    }

    /// The heading of a robot that has seen these directions and has about this heading, and its deviation, in radians.
    pub(super) fn heading(&self, directions: &[Direction], about: f64) -> Option<(f64, f64)> {
        let (count, squares) = self.told;
        let deviation = BY_VIEW.hypot(WARY * (squares / f64::from(count.max(1))).sqrt());
        let found = self.by_walls(directions, about)?;
        (count >= LEAST_TOLD).then_some((found, deviation))
    }

    fn by_walls(&self, directions: &[Direction], about: f64) -> Option<f64> {
        let main = self.main?;
        let (mut sum, mut along, mut all) = (0.0, 0.0, 0.0);
        for it in directions {
            let off = (it.angle + about - main + FRAC_PI_4).rem_euclid(FRAC_PI_2) - FRAC_PI_4;
            all += it.weight;
            if off.abs() <= ALONG {
                sum += it.weight * off;
                along += it.weight;
            }
        }
        (along >= LEAST_ALONG && along >= LEAST_SHARE_ALONG * all).then(|| about - sum / along)
    }
}

#[cfg(test)]
mod tests {
    use core::f64::consts::PI;

    use proptest::prelude::*;

    use super::*;

    /// The points of a wall from `from` on, every 8 cm, as far off the line as a vector's distances may be.
    fn wall(from: Vector2<f64>, angle: f64, points: usize) -> Vec<Surfel> {
        let along = Vector2::new(angle.cos(), angle.sin());
        let off = |index: usize| 0.01 * ((index * 7 % 5) as f64 / 2.0 - 1.0);
        let at = |index| {
            from + along * (0.08 * index as f64) + Vector2::new(-along.y, along.x) * off(index)
        };
        (0..points).map(|index| Surfel { at: at(index), normal: None }).collect()
    }

    /// A room whose walls are turned by an angle, each on its own.
    fn room(turned: f64) -> Vec<Direction> {
        (0..4)
            .flat_map(|side| {
                let side = turned + f64::from(side) * FRAC_PI_2;
                let from = Vector2::new(side.sin(), -side.cos()) * 3.0;
                directions(&wall(from, side, 40)).collect::<Vec<_>>()
            })
            .collect()
    }

    fn learnt(turned: f64) -> Compass {
        let mut compass = Compass::default();
        (0..20).for_each(|_| compass.learn(&room(turned), 0.0));
        compass
    }

    proptest! {
        #[test]
        fn a_robot_finds_its_heading_in_a_building_turned_anyhow(
            turned in -4.0..4.0f64, heading in -4.0..4.0f64, off in -0.06..0.06f64,
        ) {
            let (found, deviation) =
                learnt(turned).heading(&room(turned - heading), heading + off).unwrap();
            prop_assert!((found - heading).abs() < 0.006, "{found} {heading}");
            prop_assert!((BY_VIEW..0.02).contains(&deviation), "{deviation}");
        }
    }

    #[test]
    fn it_says_nothing_before_it_has_learnt_and_where_walls_have_no_direction() {
        assert_eq!(Compass::default().heading(&room(0.1), 0.0), None);
        let mut compass = Compass::default();
        compass.learn(&room(0.1), 0.0);
        assert_eq!(compass.heading(&room(0.1), 0.0), None, "from one view");
        for turned in 0..60 {
            compass.learn(&room(f64::from(turned) * PI / 60.0), 0.0);
        }
        assert_eq!(compass.heading(&room(0.1), 0.0), None, "a round tower");
        // Most of the view is askew, or hardly anything was seen.
        let compass = learnt(0.1);
        let mut askew = room(0.5);
        askew.extend(room(0.6));
        askew.extend(room(0.1));
        assert_eq!(compass.heading(&askew, 0.0), None);
        assert_eq!(compass.heading(&room(0.1)[..2], 0.0), None);
        assert!(compass.heading(&room(0.1), 0.0).is_some());
    }

    #[test]
    fn walls_that_are_a_little_askew_make_it_unsure() {
        let mut compass = Compass::default();
        (0..20).for_each(|part| compass.learn(&room([0.08, 0.12][part % 2]), 0.0));
        let (_, deviation) = compass.heading(&room(0.1), 0.0).unwrap();
        // Two centiradians to both sides.
        assert!((deviation - WARY * 0.02).abs() < 0.01, "{deviation}");
    }

    #[test]
    fn rows_across_a_gap_are_no_directions_and_those_around_a_corner_are_few() {
        let (one, other) = (wall(Vector2::zeros(), 0.0, 12), wall(Vector2::new(1.5, 0.0), 0.0, 12));
        let count = |surfels: &[Surfel]| directions(surfels).count();
        assert_eq!((count(&one), count(&one[..ROW - 1])), (7, 0));
        assert_eq!(count(&[one.clone(), other].concat()), 14, "1.5 m from the first");
        let corner = wall(Vector2::new(0.96, 0.02), FRAC_PI_2, 12);
        let found: Vec<Direction> = directions(&[one, corner].concat()).collect();
        let is_askew = |it: &&Direction| {
            let off = (it.angle + FRAC_PI_4).rem_euclid(FRAC_PI_2) - FRAC_PI_4;
            off.abs() > 2.0 * ALONG
        };
        // Five rows go around the corner.
        let askew = found.iter().filter(is_askew).count();
        assert!(found.len() >= 14 && askew <= 2, "{} of {}", askew, found.len());
    }
}
