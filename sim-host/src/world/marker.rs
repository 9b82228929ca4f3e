//! The marker on top of a robot, by which cameras identify it and see its heading.

use libm::{cos, sin};

use super::{
    scenario::{MarkerConfig, RobotConfig},
    tag,
};

/// Reflectance of a surface in red, green and blue, from 0 to 1.
pub(super) type Colour = [f32; 3];

const WHITE: Colour = [0.85; 3];
const BLACK: Colour = [0.05; 3];

/// The colours of heads and tails: red, yellow, green, cyan, blue, magenta.
const HUES: [Colour; 6] = [
    [0.8, 0.06, 0.06],
    [0.8, 0.75, 0.06],
    [0.06, 0.65, 0.1],
    [0.06, 0.7, 0.8],
    [0.08, 0.12, 0.8],
    [0.75, 0.08, 0.7],
];

/// A marker centred on a robot's top.
#[derive(Clone, Debug)]
pub(super) struct MarkerPlate {
    pattern: Pattern,
    /// Half its side including margins, in metres.
    half: f32,
    /// Sine and cosine of its rotation on the robot.
    askew: (f32, f32),
}

#[derive(Clone, Debug)]
enum Pattern {
    Tag([[bool; tag::SIDE]; tag::SIDE]),
    Colours { head: Colour, tail: Colour },
    Blank,
}

impl MarkerPlate {
    pub(super) fn new(config: &RobotConfig) -> Self {
        let askew = config.identifier_askew_deg.to_radians();
        let size = config.marker_size_m as f32;
        let (pattern, side) = match config.marker {
            MarkerConfig::Tag => {
                let id = config.tag_id.unwrap_or(config.id);
                let pattern = tag::pattern(id.into()).map_or(Pattern::Blank, Pattern::Tag);
                (pattern, size * tag::SIDE as f32 / tag::SQUARE as f32)
            }
            MarkerConfig::Colour => {
                let [head, tail] = config.colours();
                (Pattern::Colours { head: HUES[head], tail: HUES[tail] }, size)
            }
        };
        Self { pattern, half: side / 2.0, askew: (sin(askew) as f32, cos(askew) as f32) }
    }

    /// Distance from the centre to the corners, in metres.
    pub(super) fn reach(&self) -> f32 {
        self.half * std::f32::consts::SQRT_2
    }

    /// The colour at a point of the robot's top, in metres ahead and to the left of the centre; `None`
    /// beside the marker.
    pub(super) fn colour(&self, ahead: f32, left: f32) -> Option<Colour> {
        let (sin, cos) = self.askew;
        let (ahead, left) = (ahead * cos + left * sin, left * cos - ahead * sin);
        // Fractions of the side from the left and from the top edge, which is ahead.
        let across = 0.5 - left / (2.0 * self.half);
        let down = 0.5 - ahead / (2.0 * self.half);
        if !(0.0..1.0).contains(&across) || !(0.0..1.0).contains(&down) {
            return None;
        }
        Some(match &self.pattern {
            Pattern::Blank => WHITE,
            Pattern::Tag(white) => {
                let module = |part: f32| (part * tag::SIDE as f32) as usize;
                if white[module(down)][module(across)] { WHITE } else { BLACK }
            }
            Pattern::Colours { head, tail } => {
                // Two discs, a quarter of the side ahead of and behind the centre.
                let within = |disc: f32| (across - 0.5).hypot(down - disc) < 0.2;
                match () {
                    () if within(0.25) => *head,
                    () if within(0.75) => *tail,
                    () => WHITE,
                }
            }
        })
    }
}
