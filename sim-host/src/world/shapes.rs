//! Upright prisms: a convex footprint between two heights.
//!
//! A ray is clipped to the prism's heights and then intersected with the footprint, so that all queries
//! in space reduce to plane geometry, which parry provides.

use libm::{cos, sin};
use parry2d_f64::{
    bounding_volume::Aabb,
    glamx::{DVec2, DVec3},
    math::{Pose2, Rot2},
    query::{self, Ray},
    shape::{Ball, ConvexPolygon, Cuboid, Segment, Shape},
};

/// A convex shape in its own frame.
#[derive(Clone, Debug)]
enum Outline {
    Box(Cuboid),
    Disc(Ball),
    Polygon(ConvexPolygon),
}

/// The boundary of a convex shape in place.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Rim {
    /// A circle.
    Disc {
        /// The centre of the circle.
        centre: DVec2,
        /// The radius of the circle.
        radius: f64,
    },
    /// A polygon's corners, counter-clockwise.
    Corners(Vec<DVec2>),
}

/// A convex footprint in place.
#[derive(Clone, Debug)]
pub(super) struct Footprint {
    outline: Outline,
    place: Pose2,
}

impl Footprint {
    pub(super) fn rectangle(centre: DVec2, size: DVec2, heading: f64) -> Self {
        let turn = Rot2::from_cos_sin_unchecked(cos(heading), sin(heading));
        Self {
            outline: Outline::Box(Cuboid::new(size / 2.0)),
            place: Pose2::from_parts(centre, turn),
        }
    }

    pub(super) fn disc(centre: DVec2, radius: f64) -> Self {
        Self { outline: Outline::Disc(Ball::new(radius)), place: Pose2::from_translation(centre) }
    }

    /// The footprint of a polygon; `None` unless the corners are those of a convex polygon.
    pub(super) fn polygon(corners: &[DVec2]) -> Option<Self> {
        let polygon = ConvexPolygon::from_convex_hull(corners)?;
        Some(Self { outline: Outline::Polygon(polygon), place: Pose2::identity() })
    }

    /// The boundary of the footprint.
    pub(super) fn rim(&self) -> Rim {
        let corners = match &self.outline {
            Outline::Disc(ball) => {
                return Rim::Disc { centre: self.place.translation, radius: ball.radius };
            }
            Outline::Box(cuboid) => {
                let DVec2 { x, y } = cuboid.half_extents;
                [(-x, -y), (x, -y), (x, y), (-x, y)].map(DVec2::from).to_vec()
            }
            Outline::Polygon(polygon) => polygon.points().to_vec(),
        };
        Rim::Corners(corners.into_iter().map(|corner| self.place * corner).collect())
    }

    fn shape(&self) -> &dyn Shape {
        match &self.outline {
            Outline::Box(cuboid) => cuboid,
            Outline::Disc(ball) => ball,
            Outline::Polygon(polygon) => polygon,
        }
    }

    pub(super) fn bounds(&self) -> Aabb {
        self.shape().compute_aabb(&self.place)
    }

    pub(super) fn contains(&self, point: DVec2) -> bool {
        self.shape().contains_point(&self.place, point)
    }

    /// The nearest point of the shape; inside, the point itself.
    pub(super) fn nearest(&self, point: DVec2) -> DVec2 {
        self.shape().project_point(&self.place, point, true).point
    }

    /// Distance of the segment between two points from the shape; zero if they touch.
    pub(super) fn distance_to_way(&self, from: DVec2, to: DVec2) -> f64 {
        // parry has no distance for a segment of zero length.
        if (to - from).length_squared() < 1e-12 {
            return self.shape().distance_to_point(&self.place, from, true);
        }
        let way = Segment::new(from, to);
        query::distance(&Pose2::identity(), &way, &self.place, self.shape())
            .map_or(0.0, |found| found.distance)
    }

    /// Whether the shape and an axis-aligned rectangle overlap by more than an edge.
    pub(super) fn overlaps(&self, rectangle: &Aabb) -> bool {
        let half = rectangle.half_extents() - DVec2::splat(1e-6);
        let place = Pose2::from_translation(rectangle.center());
        query::intersection_test(&place, &Cuboid::new(half), &self.place, self.shape())
            .map_or(true, |found| found.intersecting)
    }

    /// Distance along a unit direction at which a ray enters the shape, if within `length`; zero inside.
    fn enter(&self, origin: DVec2, direction: DVec2, length: f64) -> Option<f64> {
        let ray = Ray::new(origin, direction);
        self.shape().cast_ray(&self.place, &ray, length, true)
    }

    /// Points on the boundary at most `spacing` apart, each with its outward normal.
    pub(super) fn boundary(&self, spacing: f64) -> Vec<(DVec2, DVec2)> {
        let corners = match self.rim() {
            Rim::Disc { centre, radius } => {
                let count = (std::f64::consts::TAU * radius / spacing).ceil().max(8.0);
                return (0..count as usize)
                    .map(|index| {
                        let angle = index as f64 / count * std::f64::consts::TAU;
                        let normal = DVec2::new(cos(angle), sin(angle));
                        (centre + normal * radius, normal)
                    })
                    .collect();
            }
            Rim::Corners(corners) => corners,
        };
        let mut points = Vec::new();
        for (index, &from) in corners.iter().enumerate() {
            let edge = corners[(index + 1) % corners.len()] - from;
            // Corners are counter-clockwise: outward is to the right of an edge.
            let normal = DVec2::new(edge.y, -edge.x).normalize_or_zero();
            let count = (edge.length() / spacing).ceil().max(1.0);
            for step in 0..count as usize {
                points.push((from + edge * ((step as f64 + 0.5) / count), normal));
            }
        }
        points
    }
}

/// An upright prism.
#[derive(Clone, Debug)]
pub(super) struct Prism {
    pub(super) footprint: Footprint,
    /// Height of its lower side above the floor, in metres.
    pub(super) bottom: f64,
    /// Height of its upper side above the floor, in metres.
    pub(super) top: f64,
}

impl Prism {
    /// Whether some part of it lies between two heights.
    pub(super) fn reaches(&self, from: f64, to: f64) -> bool {
        self.bottom < to && self.top > from
    }

    /// Whether it intersects the horizontal plane at a height.
    pub(super) fn spans(&self, height: f64) -> bool {
        self.bottom <= height && height < self.top
    }

    /// The first hit of a ray, as a multiple of `direction` from 0 to `limit`; 0 inside.
    pub(super) fn first_hit(&self, origin: DVec3, direction: DVec3, limit: f64) -> Option<f64> {
        let (mut from, mut to) = (0.0, limit);
        if direction.z == 0.0 {
            if !self.spans(origin.z) {
                return None;
            }
        } else {
            let low = (self.bottom - origin.z) / direction.z;
            let high = (self.top - origin.z) / direction.z;
            from = low.min(high).max(from);
            to = low.max(high).min(to);
            if from > to {
                return None;
            }
        }
        let start = (origin + direction * from).truncate();
        let level = direction.truncate();
        let speed = level.length();
        if speed < 1e-12 {
            return self.footprint.contains(start).then_some(from);
        }
        let way = self.footprint.enter(start, level / speed, (to - from) * speed)?;
        Some(from + way / speed)
    }
}
