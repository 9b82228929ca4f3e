//! A drawing of a camera network as UbiSLAM's figure 1 shows it: the map from above, and the room with
//! its cameras in three dimensions.

use std::fmt::Write;

use ubimap_protocol::tile::Cell;

use crate::grid::OccupancyGrid;

/// What a part of the room is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PartKind {
    /// Black.
    Wall,
    /// Red.
    Obstacle,
    /// Green.
    Robot,
}

/// An upright prism.
#[derive(Clone, Debug, PartialEq)]
pub struct NetworkPart {
    /// What it is.
    pub kind: PartKind,
    /// Its label; not drawn if empty.
    pub name: String,
    /// Its outline in `map` in metres, counter-clockwise.
    pub outline_m: Vec<[f64; 2]>,
    /// Heights of its lower and upper side in metres.
    pub heights_m: [f64; 2],
}

/// A camera.
#[derive(Clone, Debug, PartialEq)]
pub struct NetworkCamera {
    /// Its label.
    pub name: String,
    /// Its optical centre in metres.
    pub at_m: [f64; 3],
    /// The points in which the corners of its view meet the floor, or end before it.
    pub view_m: Vec<[f64; 3]>,
}

/// The network with the map that it has drawn.
pub struct Network<'m> {
    /// The fused map.
    pub map: &'m OccupancyGrid,
    /// Walls, obstacles and robots.
    pub parts: Vec<NetworkPart>,
    /// The cameras.
    pub cameras: Vec<NetworkCamera>,
}

/// Pixels per metre.
const SCALE: f64 = 70.0;
/// Distance of obstacles within which occupied cells are theirs, in metres.
const NEAR_M: f64 = 0.08;

impl Network<'_> {
    /// The drawing in SVG: the map on the left, the network on the right.
    pub fn svg(&self) -> String {
        let (low, high) = self.bounds();
        let size = [0, 1].map(|axis| (high[axis] - low[axis]) * SCALE);
        let view = View { low, high };
        let corners = [[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]];
        let top = self.parts.iter().map(|part| part.heights_m[1]).fold(2.0, f64::max);
        let ends = corners
            .iter()
            .flat_map(|&[x, y]| [view.slanted([x, y, 0.0]), view.slanted([x, y, top])]);
        let (mut least, mut most) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for end in ends {
            for axis in 0..2 {
                least[axis] = least[axis].min(end[axis]);
                most[axis] = most[axis].max(end[axis]);
            }
        }
        let gap = 40.0;
        let right = [size[0] + 2.0 * gap - least[0], gap - least[1]];
        let width = right[0] + most[0] + gap;
        let height = (size[1]).max(most[1] - least[1]) + 2.0 * gap + 20.0;
        let mut svg = String::new();
        // Writing to a string can't fail.
        let _ = write!(
            svg,
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width:.0}\" height=\"{height:.0}\" \
             viewBox=\"0 0 {width:.0} {height:.0}\" font-family=\"sans-serif\" font-size=\"14\">\n\
             <rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n<g transform=\"translate({gap},{gap})\">\n"
        );
        self.draw_map(&mut svg, view);
        let _ = write!(svg, "</g>\n<g transform=\"translate({:.1},{:.1})\">\n", right[0], right[1]);
        self.draw_network(&mut svg, view, corners);
        let _ = write!(
            svg,
            "</g>\n<text x=\"{gap}\" y=\"{:.0}\">light: explored; dark: unexplored; black: walls; green: robots; \
             red: obstacles; blue: cameras with their views of the floor</text>\n</svg>\n",
            height - 14.0
        );
        svg
    }

    /// The outline of all walls.
    fn bounds(&self) -> ([f64; 2], [f64; 2]) {
        let points = || self.parts.iter().flat_map(|part| &part.outline_m);
        let fold = |axis: usize, fold: fn(f64, f64) -> f64, from: f64| {
            points().map(|point| point[axis]).fold(from, fold)
        };
        (
            [0, 1].map(|axis| fold(axis, f64::min, f64::INFINITY)),
            [0, 1].map(|axis| fold(axis, f64::max, f64::NEG_INFINITY)),
        )
    }

    fn draw_map(&self, svg: &mut String, view: View) {
        let [width, height] = [0, 1].map(|axis| (view.high[axis] - view.low[axis]) * SCALE);
        let _ = writeln!(
            svg,
            "<rect width=\"{width:.1}\" height=\"{height:.1}\" fill=\"#6e6e6e\"/><g shape-rendering=\"crispEdges\">"
        );
        let side = self.map.resolution_m();
        for row in 0..self.map.height() {
            let mut column = 0;
            while column < self.map.width() {
                let colour = self.colour(column, row);
                let from = column;
                while column < self.map.width() && self.colour(column, row) == colour {
                    column += 1;
                }
                let Some(colour) = colour else { continue };
                let [x, y] = view.flat(self.map.to_map([from as f64, row as f64 + 1.0]));
                let (wide, high) = ((column - from) as f64 * side * SCALE, side * SCALE);
                let _ = writeln!(
                    svg,
                    "<rect x=\"{x:.1}\" y=\"{y:.1}\" width=\"{wide:.1}\" height=\"{high:.1}\" fill=\"{colour}\"/>"
                );
            }
        }
        svg.push_str("</g>\n");
        for part in self.parts.iter().filter(|part| part.kind != PartKind::Wall) {
            let points: Vec<[f64; 2]> = part.outline_m.iter().map(|&at| view.flat(at)).collect();
            if part.kind == PartKind::Robot {
                polygon(svg, &points, "#2fb34a", 1.0);
            }
            label(svg, &points, &part.name);
        }
    }

    /// The colour of a cell; `None` if it is unexplored.
    fn colour(&self, column: usize, row: usize) -> Option<&'static str> {
        match self.map.cell(column, row) {
            Cell::Unknown => None,
            Cell::Free => Some("#dcdcdc"),
            Cell::Occupied | Cell::Movable => {
                let at = self.map.to_map([column as f64 + 0.5, row as f64 + 0.5]);
                let of_obstacle = |part: &NetworkPart| {
                    part.kind == PartKind::Obstacle && is_near(&part.outline_m, at)
                };
                Some(if self.parts.iter().any(of_obstacle) { "#d62728" } else { "#000000" })
            }
        }
    }

    fn draw_network(&self, svg: &mut String, view: View, floor: [[f64; 2]; 4]) {
        polygon(svg, &floor.map(|[x, y]| view.slanted([x, y, 0.0])), "#ececec", 1.0);
        for camera in &self.cameras {
            let floor: Vec<[f64; 2]> = camera.view_m.iter().map(|&at| view.slanted(at)).collect();
            polygon(svg, &floor, "#4a90d9", 0.22);
        }
        // From the farthest to the nearest.
        let mut parts: Vec<&NetworkPart> = self.parts.iter().collect();
        let depth = |part: &NetworkPart| {
            part.outline_m.iter().map(|[x, y]| y - 0.4 * x).sum::<f64>()
                / part.outline_m.len() as f64
        };
        parts.sort_by(|a, b| depth(b).total_cmp(&depth(a)));
        for part in parts {
            let (colour, alpha) = match part.kind {
                PartKind::Wall => ("#555555", 0.18),
                PartKind::Obstacle => ("#d62728", 0.85),
                PartKind::Robot => ("#2fb34a", 0.95),
            };
            let at = |height: f64| {
                part.outline_m
                    .iter()
                    .map(|&[x, y]| view.slanted([x, y, height]))
                    .collect::<Vec<_>>()
            };
            let (low, high) = (at(part.heights_m[0]), at(part.heights_m[1]));
            for index in 0..low.len() {
                let next = (index + 1) % low.len();
                polygon(svg, &[low[index], low[next], high[next], high[index]], colour, alpha);
            }
            polygon(svg, &high, colour, alpha);
            label(svg, &high, &part.name);
        }
        for camera in &self.cameras {
            let [x, y] = view.slanted(camera.at_m);
            for &corner in &camera.view_m {
                let [to_x, to_y] = view.slanted(corner);
                let _ = writeln!(
                    svg,
                    "<line x1=\"{x:.1}\" y1=\"{y:.1}\" x2=\"{to_x:.1}\" y2=\"{to_y:.1}\" stroke=\"#1f5fa8\" stroke-width=\"0.8\"/>"
                );
            }
            let _ = writeln!(
                svg,
                "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"6\" fill=\"#1f5fa8\"/>\n\
                 <text x=\"{:.1}\" y=\"{:.1}\" fill=\"#1f5fa8\" font-weight=\"bold\">{}</text>",
                x + 8.0,
                y - 6.0,
                escaped(&camera.name)
            );
        }
    }
}

/// The two projections.
#[derive(Clone, Copy)]
struct View {
    low: [f64; 2],
    high: [f64; 2],
}

impl View {
    /// From above, north up.
    fn flat(self, [x, y]: [f64; 2]) -> [f64; 2] {
        [(x - self.low[0]) * SCALE, (self.high[1] - y) * SCALE]
    }

    /// From the south and above, slightly turned.
    fn slanted(self, [x, y, z]: [f64; 3]) -> [f64; 2] {
        let (x, y) = (x - self.low[0], y - self.low[1]);
        [(0.92 * x + 0.38 * y) * SCALE, (0.16 * x - 0.42 * y - 0.78 * z) * SCALE]
    }
}

fn polygon(svg: &mut String, points: &[[f64; 2]], colour: &str, alpha: f64) {
    let points = points.iter().fold(String::new(), |mut text, [x, y]| {
        let _ = write!(text, "{x:.1},{y:.1} ");
        text
    });
    let _ = writeln!(
        svg,
        "<polygon points=\"{}\" fill=\"{colour}\" fill-opacity=\"{alpha}\" stroke=\"{colour}\" stroke-width=\"0.8\" stroke-opacity=\"{:.2}\"/>",
        points.trim_end(),
        (alpha + 0.2).min(1.0)
    );
}

/// A label in the middle of some points.
fn label(svg: &mut String, points: &[[f64; 2]], name: &str) {
    if name.is_empty() || points.is_empty() {
        return;
    }
    let mean = |axis: usize| points.iter().map(|at| at[axis]).sum::<f64>() / points.len() as f64;
    let _ = writeln!(
        svg,
        "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\" font-weight=\"bold\">{}</text>",
        mean(0),
        mean(1) - 12.0,
        escaped(name)
    );
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

/// Whether a point is in a convex outline or near it.
fn is_near(outline: &[[f64; 2]], [x, y]: [f64; 2]) -> bool {
    (0..outline.len()).all(|index| {
        let ([ax, ay], [bx, by]) = (outline[index], outline[(index + 1) % outline.len()]);
        let (dx, dy) = (bx - ax, by - ay);
        let left = (dx * (y - ay) - dy * (x - ax)) / dx.hypot(dy).max(1e-9);
        left >= -NEAR_M
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_of_obstacles_are_red_and_names_are_escaped() {
        let mut map = OccupancyGrid::new(0.5, [0.0, 0.0], 4, 2).unwrap();
        (0..8).for_each(|cell| map.set(cell % 4, cell / 4, Cell::Free));
        map.set(1, 1, Cell::Occupied);
        map.set(3, 0, Cell::Occupied);
        map.set(0, 0, Cell::Unknown);
        let square = |x: f64, y: f64, side: f64| {
            vec![[x, y], [x + side, y], [x + side, y + side], [x, y + side]]
        };
        let part = |kind, name: &str, outline_m| NetworkPart {
            kind,
            name: name.to_owned(),
            outline_m,
            heights_m: [0.0, 1.0],
        };
        let parts = vec![
            part(PartKind::Wall, "", square(0.0, 0.0, 2.0)),
            part(PartKind::Obstacle, "A<B", square(0.5, 0.5, 0.5)),
        ];
        let network = Network { map: &map, parts, cameras: Vec::new() };
        assert_eq!(network.colour(1, 1), Some("#d62728"));
        assert_eq!(network.colour(3, 0), Some("#000000"));
        assert_eq!((network.colour(0, 0), network.colour(1, 0)), (None, Some("#dcdcdc")));
        let svg = network.svg();
        assert!(svg.contains("A&lt;B") && svg.ends_with("</svg>\n"));
    }
}
