//! The appearance of surfaces: procedural textures, and lamps under the ceiling.

use parry2d_f64::glamx::{DVec2, Vec2, Vec3};

use super::{
    super::marker::{Colour, MarkerPlate},
    solid::Face,
};

/// Brightness of a white horizontal surface, on a scale of 255.
const EXPOSURE: f32 = 290.0;

/// Distance between lamps in metres.
const LAMPS: f32 = 3.0;

/// The paint of a part.
#[derive(Clone, Debug)]
pub(in super::super) enum Paint {
    /// A colour with a slight grain; the number selects the grain.
    Grained(Colour, u32),
    /// A robot: a plain body with a marker on top.
    Robot {
        /// Colour of the body.
        colour: Colour,
        /// Marker on its top.
        marker: MarkerPlate,
        /// Centre in `map`.
        middle: DVec2,
        /// Cosine and sine of its heading.
        facing: Vec2,
    },
}

/// Plaster.
pub(super) const WALL: Paint = Paint::Grained([0.62, 0.61, 0.58], 0);

impl Paint {
    /// Grey with this mean reflectance.
    pub(in super::super) const fn grey(shade: f32) -> Self {
        Self::Grained([shade; 3], 0)
    }

    /// Paint for furniture and people: each number has its own colour.
    pub(in super::super) fn numbered(number: u32) -> Self {
        let part = |salt: u32| 0.16 + 0.44 * unit(hash(number, salt, 77));
        let (wood, tint) = (part(1), part(2));
        Self::Grained([wood, 0.8 * wood + 0.15 * tint, 0.6 * wood + 0.25 * tint], number)
    }

    /// The unlit colour at a point of `map`.
    pub(super) fn colour(&self, point: Vec3, face: Face) -> Colour {
        match self {
            Self::Grained(colour, number) => {
                let (u, v) = match face {
                    Face::Top | Face::Bottom => (point.x, point.y),
                    Face::Side(normal) => (Vec2::new(point.x, point.y).perp_dot(normal), point.z),
                };
                let grain = 0.86
                    + 0.2 * noise(u * 3.0, v * 3.0, *number)
                    + 0.08 * noise(u * 40.0, v * 40.0, *number);
                colour.map(|part| part * grain)
            }
            Self::Robot { colour, marker, .. } => {
                let on_top = (face == Face::Top).then(|| self.on_top(point)).flatten();
                on_top.and_then(|at| marker.colour(at.x, at.y)).unwrap_or(*colour)
            }
        }
    }

    /// Whether a point is close enough to a marker that a pixel of this size shows some of it.
    pub(super) fn is_fine(&self, point: Vec3, face: Face, pixel: f32) -> bool {
        let Self::Robot { marker, .. } = self else { return false };
        let reach = marker.reach() + pixel;
        face == Face::Top
            && self.on_top(point).is_some_and(|at| at.length_squared() < reach * reach)
    }

    /// The coordinates of a point ahead and to the left of a robot's centre.
    fn on_top(&self, point: Vec3) -> Option<Vec2> {
        let Self::Robot { middle, facing, .. } = self else { return None };
        let offset = Vec2::new(point.x - middle.x as f32, point.y - middle.y as f32);
        Some(Vec2::new(offset.dot(*facing), facing.perp_dot(offset)))
    }
}

/// The colour of the floor: worn spots on tiles of 0.6 m, with joints unless it is seamless.
pub(super) fn floor(point: Vec3, is_seamless: bool) -> Colour {
    let tile = Vec2::new(point.x, point.y) / 0.6;
    let (column, row) = (floor_of(tile.x), floor_of(tile.y));
    let joint = !is_seamless && (tile.x - column as f32).min(tile.y - row as f32) < 0.012;
    let own = unit(hash(column as u32, row as u32, 5));
    let worn = noise(point.x * 1.3, point.y * 1.3, 6);
    let speck = noise(point.x * 60.0, point.y * 60.0, 7);
    let shade = if joint { 0.22 } else { 0.34 + 0.05 * own + 0.12 * worn + 0.07 * speck };
    [shade, shade * 0.98, shade * 0.93]
}

/// The ceiling.
pub(super) const CEILING: Colour = [0.75; 3];

/// The brightness at a point of a face; lamps hang in a square grid under the ceiling.
pub(super) fn light(point: Vec3, face: Face) -> f32 {
    // A smooth bump of height one under each lamp.
    let hill = |at: f32| {
        let part = (at / LAMPS - floor_of(at / LAMPS) as f32 - 0.5) * 2.0;
        let slope = 1.0 - part * part;
        slope * slope
    };
    let lamps = 0.84 + 0.16 * hill(point.x) * hill(point.y);
    let facing = match face {
        Face::Top => 1.0,
        Face::Bottom => 0.55,
        Face::Side(normal) => 0.68 + 0.1 * normal.dot(Vec2::new(0.8, 0.6)),
    };
    EXPOSURE * lamps * facing
}

/// Smooth noise from 0 to 1 with about one bump per unit of length.
fn noise(x: f32, y: f32, salt: u32) -> f32 {
    let (column, row) = (floor_of(x), floor_of(y));
    let (right, up) = (x - column as f32, y - row as f32);
    let (column, row) = (column as u32, row as u32);
    let at = |dx: u32, dy: u32| unit(hash(column.wrapping_add(dx), row.wrapping_add(dy), salt));
    let low = at(0, 0) + (at(1, 0) - at(0, 0)) * right;
    let high = at(0, 1) + (at(1, 1) - at(0, 1)) * right;
    low + (high - low) * up
}

/// The largest integer not above a number; faster than `floor`, which is a call without SSE 4.1.
fn floor_of(number: f32) -> i32 {
    let whole = number as i32;
    whole - i32::from(whole as f32 > number)
}

/// The upper bits of a hash, scaled to 0..1.
fn unit(bits: u32) -> f32 {
    (bits >> 8) as f32 / (1 << 24) as f32
}

fn hash(x: u32, y: u32, salt: u32) -> u32 {
    let mut bits = x
        .wrapping_mul(0x9e37_79b1)
        .wrapping_add(y.wrapping_mul(0x85eb_ca6b))
        .wrapping_add(salt.wrapping_mul(0xc2b2_ae35));
    bits = (bits ^ bits >> 15).wrapping_mul(0x2c1b_3c6d);
    bits = (bits ^ bits >> 12).wrapping_mul(0x297a_2d39);
    bits ^ bits >> 15
}
