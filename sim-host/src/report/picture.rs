//! The map as a picture, in the colours of UbiSLAM's figure 1: explored light grey, unexplored dark
//! grey, walls black, robots green, obstacles red. North (`map`'s y) is up.

use image::{Rgb, RgbImage};
use ubimap_protocol::tile::Cell;

use crate::grid::OccupancyGrid;

/// Free cells.
const EXPLORED: Rgb<u8> = Rgb([224, 224, 224]);
/// Unknown cells.
const UNEXPLORED: Rgb<u8> = Rgb([104, 104, 104]);
/// Fixed cells.
const WALL: Rgb<u8> = Rgb([0, 0, 0]);
/// Movable cells, people and wrong surfaces.
const OBSTACLE: Rgb<u8> = Rgb([208, 40, 40]);
/// Robots.
const ROBOT: Rgb<u8> = Rgb([24, 140, 52]);
/// Paths of robots.
const ROBOT_PATH: Rgb<u8> = Rgb([120, 190, 132]);
/// Paths of people.
const PERSON_PATH: Rgb<u8> = Rgb([226, 150, 146]);
/// Cells in view of cameras.
const COVERED: Rgb<u8> = Rgb([186, 214, 240]);
/// Missing surfaces.
const MISSING: Rgb<u8> = Rgb([40, 80, 216]);
/// Headings, and lines between time-lapse frames.
const HEADING: Rgb<u8> = Rgb([255, 255, 255]);
const CAMERA: Rgb<u8> = Rgb([214, 120, 0]);
const UNSEEN: Rgb<u8> = Rgb([240, 170, 165]);
const BLIND: Rgb<u8> = Rgb([150, 90, 130]);
/// Floor that one camera sees, two, three, and more.
const SEEN_BY: [Rgb<u8>; 4] =
    [Rgb([206, 226, 246]), Rgb([150, 192, 232]), Rgb([92, 148, 208]), Rgb([44, 96, 168])];

/// Margin around the map, in cells.
const MARGIN: usize = 4;

/// Target for the longer side of a picture in pixels, within the limits of `SCALES`.
const SIDE: usize = 1200;
/// Pixels per cell.
const SCALES: std::ops::RangeInclusive<usize> = 2..=8;

/// Larger maps are drawn with one pixel per cell.
const MAX_SCALED_CELLS: usize = 1 << 22;

/// Number of time-lapse frames per row.
const COLUMNS: usize = 3;

/// Radius of a marker in metres.
const ROBOT_RADIUS_M: f64 = 0.2;
/// Minimum radius of a marker in pixels.
const MIN_RADIUS: f64 = 5.0;

/// What a marker stands for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MarkerKind {
    /// A robot: green.
    Robot,
    /// A person: red, as an obstacle.
    Person,
    /// A camera that looks along its heading: orange.
    Camera,
    /// A camera that looks straight down: orange, without a heading.
    CameraDown,
}

/// A robot or a person in the picture.
#[derive(Clone, Debug, PartialEq)]
pub struct Marker {
    /// Position along `map`'s x, in metres.
    pub x_m: f64,
    /// Position along `map`'s y, in metres.
    pub y_m: f64,
    /// Heading in radians, counter-clockwise from `map`'s x.
    pub heading_rad: f64,
    /// Whether it is a robot or a person.
    pub kind: MarkerKind,
    /// Past positions in `map`, in metres; may be empty.
    pub path: Vec<[f64; 2]>,
}

/// Draws a map with robots and people. A cell is 2 to 8 pixels wide, so that pictures of rooms and
/// of buildings have a similar size; in huge maps it is one pixel.
pub fn render(grid: &OccupancyGrid, markers: &[Marker]) -> RgbImage {
    let (image, scale) = draw(grid, |column, row| match grid.cell(column, row) {
        Cell::Unknown => UNEXPLORED,
        Cell::Free => EXPLORED,
        Cell::Occupied => WALL,
        Cell::Movable => OBSTACLE,
    });
    Canvas { image, grid, scale: scale as f64 }.with(markers)
}

/// Draws the floor by the number of cameras that see it, and the cameras. `floor` gives for a point of
/// `map`, in metres, that number and whether any camera could see it; `None` beside the floor. What
/// is occupied on the map is drawn over it: walls and what stands there black, what hangs over the
/// floor as a pattern of dots.
pub fn render_overlap(
    map: &OccupancyGrid,
    cameras: &[Marker],
    floor: impl Fn([f64; 2]) -> Option<(u16, bool)>,
) -> RgbImage {
    let (image, scale) = draw(map, |column, row| {
        let seen = floor(map.to_map([column as f64 + 0.5, row as f64 + 0.5]));
        match (map.cell(column, row), seen) {
            (Cell::Occupied, _) => WALL,
            (Cell::Movable, _) if (column + row).is_multiple_of(2) => WALL,
            (_, None) => UNEXPLORED,
            (_, Some((0, true))) => UNSEEN,
            (_, Some((0, false))) => BLIND,
            (_, Some((count, _))) => SEEN_BY[usize::from(count).min(SEEN_BY.len()) - 1],
        }
    });
    Canvas { image, grid: map, scale: scale as f64 }.with(cameras)
}

/// Draws a map at several times with its markers, as frames of the size of the last map, row by
/// row.
pub fn render_frames(map: &OccupancyGrid, frames: &[(OccupancyGrid, Vec<Marker>)]) -> RgbImage {
    let drawn = frames.iter().map(|(earlier, markers)| {
        let mut grid = map.clone();
        for index in 0..map.width() * map.height() {
            let (column, row) = (index % map.width(), index / map.width());
            grid.set(column, row, at(earlier, map, column, row));
        }
        render(&grid, markers)
    });
    let drawn: Vec<RgbImage> = drawn.collect();
    let Some((width, height)) = drawn.first().map(RgbImage::dimensions) else {
        return RgbImage::default();
    };
    let rows = drawn.len().div_ceil(COLUMNS) as u32;
    // Every second pixel of every second row, with a white line between frames.
    let (across, down) = (width / 2 + 2, height / 2 + 2);
    RgbImage::from_fn(across * COLUMNS as u32, down * rows, |x, y| {
        let frame = drawn.get((y / down) as usize * COLUMNS + (x / across) as usize);
        let (x, y) = (2 * (x % across), 2 * (y % down));
        let pixel = frame.and_then(|frame| frame.get_pixel_checked(x, y));
        pixel.copied().unwrap_or(HEADING)
    })
}

/// Draws the cells that cameras see in light blue; all others as in the map.
pub fn render_coverage(map: &OccupancyGrid, coverage: &OccupancyGrid) -> RgbImage {
    let (image, _) = draw(map, |column, row| {
        let is_covered = at(coverage, map, column, row) == Cell::Free;
        match map.cell(column, row) {
            Cell::Occupied | Cell::Movable => WALL,
            _ if is_covered => COVERED,
            Cell::Free => EXPLORED,
            Cell::Unknown => UNEXPLORED,
        }
    });
    image
}

/// Draws the error of a map against the truth: surfaces within one cell of a true one in black,
/// wrong ones in red, and in blue the missing ones among those in `seen`.
pub fn render_error(map: &OccupancyGrid, truth: &OccupancyGrid, seen: &OccupancyGrid) -> RgbImage {
    let is_occupied = |grid: &OccupancyGrid, column: usize, row: usize| {
        matches!(at(grid, map, column, row), Cell::Occupied | Cell::Movable)
    };
    let is_by = |grid: &OccupancyGrid, column: usize, row: usize| {
        let neighbours = [(0, 0), (1, 0), (usize::MAX, 0), (0, 1), (0, usize::MAX)];
        neighbours
            .into_iter()
            .any(|(x, y)| is_occupied(grid, column.wrapping_add(x), row.wrapping_add(y)))
    };
    let (image, _) = draw(map, |column, row| match map.cell(column, row) {
        Cell::Occupied | Cell::Movable if is_by(truth, column, row) => WALL,
        Cell::Occupied | Cell::Movable => OBSTACLE,
        _ if is_occupied(seen, column, row) && !is_by(map, column, row) => MISSING,
        Cell::Free => EXPLORED,
        Cell::Unknown => UNEXPLORED,
    });
    image
}

/// The cell of `grid` that contains the centre of a cell of `other`, which may lie outside of
/// `other`.
fn at(grid: &OccupancyGrid, other: &OccupancyGrid, column: usize, row: usize) -> Cell {
    let middle = |index: usize| index as isize as f64 + 0.5;
    let [x, y] = grid.from_map(other.to_map([middle(column), middle(row)]));
    if x < 0.0 || y < 0.0 { Cell::Unknown } else { grid.cell(x as usize, y as usize) }
}

/// Draws a grid with a margin; `colour` gives the colour of each cell, also outside of the grid.
/// Returns the picture and the pixels per cell.
fn draw(grid: &OccupancyGrid, colour: impl Fn(usize, usize) -> Rgb<u8>) -> (RgbImage, usize) {
    let (columns, rows) = (grid.width() + 2 * MARGIN, grid.height() + 2 * MARGIN);
    let scale = if grid.width() * grid.height() > MAX_SCALED_CELLS {
        1
    } else {
        (SIDE / columns.max(rows)).clamp(*SCALES.start(), *SCALES.end())
    };
    let image = RgbImage::from_fn((columns * scale) as u32, (rows * scale) as u32, |x, y| {
        // West and south of the grid the subtraction wraps to cells outside of it, which are
        // unknown.
        let column = (x as usize / scale).wrapping_sub(MARGIN);
        let row = (rows - 1 - y as usize / scale).wrapping_sub(MARGIN);
        colour(column, row)
    });
    (image, scale)
}

/// Encodes a picture as PNG.
pub fn png(image: &RgbImage) -> Result<Vec<u8>, image::ImageError> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    image.write_to(&mut bytes, image::ImageFormat::Png)?;
    Ok(bytes.into_inner())
}

/// A picture being drawn.
struct Canvas<'a> {
    image: RgbImage,
    grid: &'a OccupancyGrid,
    /// Pixels per cell.
    scale: f64,
}

impl Canvas<'_> {
    /// The picture with these on it, their ways below them.
    fn with(mut self, markers: &[Marker]) -> RgbImage {
        for marker in markers {
            self.path(marker);
        }
        for marker in markers {
            self.marker(marker);
        }
        self.image
    }

    fn path(&mut self, marker: &Marker) {
        let colour = match marker.kind {
            MarkerKind::Robot => ROBOT_PATH,
            MarkerKind::Person => PERSON_PATH,
            MarkerKind::Camera | MarkerKind::CameraDown => CAMERA,
        };
        for step in marker.path.windows(2) {
            self.line(self.pixel(step[0]), self.pixel(step[1]), self.scale * 0.35, colour);
        }
    }

    fn marker(&mut self, marker: &Marker) {
        let centre = self.pixel([marker.x_m, marker.y_m]);
        let radius = (ROBOT_RADIUS_M / self.grid.resolution_m() * self.scale).max(MIN_RADIUS);
        let colour = match marker.kind {
            MarkerKind::Robot => ROBOT,
            MarkerKind::Person => OBSTACLE,
            MarkerKind::Camera | MarkerKind::CameraDown => CAMERA,
        };
        self.line(centre, centre, radius, colour);
        if marker.kind == MarkerKind::CameraDown {
            return;
        }
        let (sin, cos) = (marker.heading_rad - self.grid.yaw_rad()).sin_cos();
        let nose = [centre[0] + 0.9 * radius * cos, centre[1] - 0.9 * radius * sin];
        self.line(centre, nose, radius * 0.15, HEADING);
    }

    /// The pixel coordinates of a point in `map`.
    fn pixel(&self, point: [f64; 2]) -> [f64; 2] {
        let [column, row] = self.grid.from_map(point);
        let margin = MARGIN as f64;
        let height = f64::from(self.image.height());
        [(column + margin) * self.scale, height - (row + margin) * self.scale]
    }

    /// Draws an anti-aliased line with round ends; a disc if its length is zero.
    fn line(&mut self, from: [f64; 2], to: [f64; 2], half_width: f64, colour: Rgb<u8>) {
        let reach = half_width + 1.0;
        let range = |axis: usize, end: u32| {
            let least = from[axis].min(to[axis]) - reach;
            let most = from[axis].max(to[axis]) + reach;
            // NaN becomes zero: the range has at most one pixel, and nothing is drawn there.
            least.clamp(0.0, f64::from(end)) as u32..most.ceil().clamp(0.0, f64::from(end)) as u32
        };
        let (columns, rows) = (range(0, self.image.width()), range(1, self.image.height()));
        for y in rows {
            for x in columns.clone() {
                let away = distance([f64::from(x) + 0.5, f64::from(y) + 0.5], from, to);
                let cover = (half_width + 0.5 - away).clamp(0.0, 1.0);
                if cover > 0.0 {
                    let pixel = self.image.get_pixel_mut(x, y);
                    for (old, new) in pixel.0.iter_mut().zip(colour.0) {
                        *old = (f64::from(*old) * (1.0 - cover) + f64::from(new) * cover).round()
                            as u8;
                    }
                }
            }
        }
    }
}

/// Distance of a point from a line segment.
fn distance(point: [f64; 2], from: [f64; 2], to: [f64; 2]) -> f64 {
    let (x, y) = (to[0] - from[0], to[1] - from[1]);
    let length_squared = x * x + y * y;
    let along = if length_squared > 0.0 {
        (((point[0] - from[0]) * x + (point[1] - from[1]) * y) / length_squared).clamp(0.0, 1.0)
    } else {
        0.0
    };
    (point[0] - from[0] - along * x).hypot(point[1] - from[1] - along * y)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn room() -> OccupancyGrid {
        let mut grid = OccupancyGrid::new(0.05, [-1.0, 2.0], 100, 60).unwrap();
        for y in 0..60 {
            for x in 0..100 {
                let is_wall = x == 0 || y == 0 || x == 99 || y == 59;
                grid.set(x, y, if is_wall { Cell::Occupied } else { Cell::Free });
            }
        }
        grid.set(50, 57, Cell::Movable);
        grid
    }

    fn robot(x_m: f64, y_m: f64, path: Vec<[f64; 2]>) -> Marker {
        Marker { x_m, y_m, heading_rad: 0.0, kind: MarkerKind::Robot, path }
    }

    #[test]
    fn north_is_up_and_colours_match_the_paper() {
        let picture = render(&room(), &[robot(0.0, 3.0, vec![[0.0, 3.0], [3.0, 4.0]])]);
        assert_eq!(picture.dimensions(), (108 * 8, 68 * 8));
        let cell = |x: u32, y: u32| *picture.get_pixel((x + 4) * 8 + 4, (67 - 4 - y) * 8 + 4);
        assert_eq!(cell(0, 0), WALL);
        assert_eq!(cell(50, 57), OBSTACLE);
        assert_eq!(cell(50, 2), EXPLORED);
        assert_eq!(*picture.get_pixel(0, 0), UNEXPLORED);
        // The robot at (0, 3) m is in the cell (20, 20); its disc extends three cells to the west.
        assert_eq!(cell(17, 20), ROBOT);
        assert_eq!(cell(14, 20), EXPLORED);
        assert_eq!(cell(50, 30), ROBOT_PATH);
    }

    #[test]
    fn frames_are_side_by_side_and_show_the_map_at_their_time() {
        let earlier = OccupancyGrid::new(0.05, [0.0, 3.0], 20, 20).unwrap();
        let frames = [(earlier, vec![]), (room(), vec![robot(0.0, 3.0, vec![])])];
        let picture = render_frames(&room(), &frames);
        assert_eq!(picture.dimensions(), (3 * (108 * 4 + 2), 68 * 4 + 2));
        let cell = |frame: u32, x: u32, y: u32| {
            *picture.get_pixel(frame * (108 * 4 + 2) + (x + 4) * 4 + 2, (67 - 4 - y) * 4 + 2)
        };
        assert_eq!([cell(0, 50, 2), cell(1, 50, 2)], [UNEXPLORED, EXPLORED]);
        assert_eq!([cell(0, 17, 20), cell(1, 17, 20)], [UNEXPLORED, ROBOT]);
    }

    #[test]
    fn markers_outside_the_map_are_left_out() {
        let plain = render(&room(), &[]);
        for place in [f64::NAN, f64::INFINITY, -1e300, 1e9] {
            let markers = [robot(place, 3.0, vec![[place, place], [place, 0.0]])];
            assert_eq!(render(&room(), &markers), plain);
        }
        let unknown = OccupancyGrid::new(0.05, [0.0, 0.0], 0, 0).unwrap();
        assert!(png(&render(&unknown, &[])).unwrap().starts_with(b"\x89PNG"));
    }
}
