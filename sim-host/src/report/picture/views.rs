//! The pictures: a map, its growth, its coverage by cameras, and its errors.

use image::{Rgb, RgbImage};
use ubimap_protocol::tile::Cell;

use super::{
    canvas::{Canvas, scale_of},
    caption::{Caption, Entry, Sample, with_caption, with_title},
    marker::{self, Marker, MarkerKind},
    palette::{
        BLIND, COVERED, EXTRA, FREE, HIDDEN, MISSING, MOVABLE, PAPER, SEEN_BY, UNKNOWN, UNSEEN,
        VOLATILE, WALL,
    },
};
use crate::grid::OccupancyGrid;

/// Number of frames in a row of a time-lapse.
const ABREAST: usize = 3;
/// Space between frames, in pixels.
const GAP: u32 = 4;

/// The legend entries of a map's cells.
const MAP: [Entry; 4] = [
    (Sample::Cell(FREE), "free"),
    (Sample::Cell(WALL), "occupied"),
    (Sample::Cell(MOVABLE), "movable"),
    (Sample::Cell(UNKNOWN), "unknown"),
];

/// The map at one time of a run, with its markers.
#[derive(Clone, Debug, PartialEq)]
pub struct Moment {
    /// Seconds since the start of the run.
    pub time_s: f64,
    /// The map.
    pub grid: OccupancyGrid,
    /// The markers on the map.
    pub markers: Vec<Marker>,
}

/// Draws a map with its markers. Cells are 2 to 8 pixels wide, so that pictures of rooms and of
/// buildings have about the same size. Cells of huge maps are one pixel wide.
pub fn render(grid: &OccupancyGrid, markers: &[Marker], caption: &Caption) -> RgbImage {
    let canvas = Canvas::new(grid, scale_of(grid), map_colour(grid));
    finish(canvas, markers, caption, &MAP)
}

/// Draws a map at several times, with the frames side by side in rows. All frames have the size of
/// `map`.
pub fn render_frames(map: &OccupancyGrid, frames: &[Moment], caption: &Caption) -> RgbImage {
    // Half the scale of a single picture, but at least the two pixels per cell that lines between
    // cells need.
    let scale = (scale_of(map) / 2).max(2);
    let mut pixels_per_m = 1.0;
    let drawn = frames.iter().map(|Moment { time_s, grid, markers }| {
        let mut whole = map.clone();
        for index in 0..map.width() * map.height() {
            let (column, row) = (index % map.width(), index / map.width());
            whole.set(column, row, at(grid, map, column, row));
        }
        let mut canvas = Canvas::new(&whole, scale, map_colour(&whole));
        marker::draw(&mut canvas, markers);
        pixels_per_m = canvas.pixels_per_m();
        with_title(&canvas.image, &format!("{time_s:.1} s"))
    });
    let drawn: Vec<RgbImage> = drawn.collect();
    let Some((width, height)) = drawn.first().map(RgbImage::dimensions) else {
        return RgbImage::default();
    };
    let (across, down) = (width + GAP, height + GAP);
    let rows = drawn.len().div_ceil(ABREAST) as u32;
    let mut all = RgbImage::from_pixel(across * ABREAST as u32, down * rows, PAPER);
    for (index, frame) in drawn.iter().enumerate() {
        let (x, y) = ((index % ABREAST) as u32 * across, (index / ABREAST) as u32 * down);
        image::imageops::replace(&mut all, frame, x.into(), y.into());
    }
    let markers = frames.iter().flat_map(|frame| &frame.markers);
    let legend = legend(&MAP, markers);
    with_caption(&all, pixels_per_m, &caption.to_string(), &legend)
}

/// Draws which cells of a map are in view of cameras, and which are blind.
pub fn render_coverage(
    map: &OccupancyGrid,
    coverage: &OccupancyGrid,
    markers: &[Marker],
    caption: &Caption,
) -> RgbImage {
    let canvas = Canvas::new(map, scale_of(map), |column, row| {
        let is_covered = at(coverage, map, column, row) == Cell::Free;
        match map.cell(column, row) {
            Cell::Occupied | Cell::Movable => WALL,
            _ if is_covered => COVERED,
            Cell::Free => BLIND,
            Cell::Unknown => UNKNOWN,
        }
    });
    let cells = [
        (Sample::Cell(COVERED), "a camera sees it now"),
        (Sample::Cell(BLIND), "known, but no camera sees it now"),
        (Sample::Cell(WALL), "occupied"),
        (Sample::Cell(UNKNOWN), "unknown"),
    ];
    finish(canvas, markers, caption, &cells)
}

/// Draws the floor, coloured by the number of cameras that see it, and the cameras. For a point of
/// `map` in metres, `floor` returns that number, and whether any camera could see the point; `None`
/// outside the floor. The map's occupied cells are drawn in black over the floor, and its movable
/// cells, which mark things that hang above the floor, as dots.
pub fn render_overlap(
    map: &OccupancyGrid,
    cameras: &[Marker],
    floor: impl Fn([f64; 2]) -> Option<(u16, bool)>,
    caption: &Caption,
) -> RgbImage {
    let canvas = Canvas::new(map, scale_of(map), |column, row| {
        let seen = floor(map.to_map([middle(column), middle(row)]));
        match (map.cell(column, row), seen) {
            (Cell::Occupied, _) => WALL,
            (Cell::Movable, _) if column.wrapping_add(row).is_multiple_of(2) => WALL,
            (_, None) => UNKNOWN,
            (_, Some((0, true))) => UNSEEN,
            (_, Some((0, false))) => HIDDEN,
            (_, Some((count, _))) => SEEN_BY[usize::from(count).min(SEEN_BY.len()) - 1],
        }
    });
    let cells = [
        (Sample::Cell(SEEN_BY[0]), "seen by one camera"),
        (Sample::Cell(SEEN_BY[1]), "by two"),
        (Sample::Cell(SEEN_BY[2]), "by three"),
        (Sample::Cell(SEEN_BY[3]), "by more"),
        (Sample::Cell(UNSEEN), "blind"),
        (Sample::Cell(HIDDEN), "hidden from every place"),
        (Sample::Cell(WALL), "wall or furniture"),
        (Sample::Cell(UNKNOWN), "no floor"),
    ];
    finish(canvas, cameras, caption, &cells)
}

/// Times between changes in seconds below which a cell has the colours of `VOLATILE`.
const VOLATILE_S: [f64; 3] = [3_600.0, 600.0, 120.0];

/// Draws how often the cells of a map are expected to change: for each of them, row by row, the last
/// known code and the time between two changes in seconds; `None` if it was never known.
pub fn render_volatility(
    map: &OccupancyGrid,
    intervals: &[Option<(Cell, f64)>],
    caption: &Caption,
) -> RgbImage {
    let canvas = Canvas::new(map, scale_of(map), |column, row| {
        let is_there = column < map.width() && row < map.height();
        let index = is_there.then(|| row * map.width() + column);
        let Some(&Some((code, seconds))) = index.and_then(|index| intervals.get(index)) else {
            return UNKNOWN;
        };
        let mut colours = VOLATILE_S.iter().zip(VOLATILE).filter(|(below, _)| seconds < **below);
        colours
            .next_back()
            .map_or(if code == Cell::Free { FREE } else { WALL }, |(_, colour)| colour)
    });
    let [hour, minutes, often] = VOLATILE.map(Sample::Cell);
    let cells = [
        (often, "changes within 2 minutes"),
        (minutes, "within 10 minutes"),
        (hour, "within an hour"),
        (Sample::Cell(FREE), "more seldom: free"),
        (Sample::Cell(WALL), "more seldom: occupied"),
        (Sample::Cell(UNKNOWN), "never known"),
    ];
    finish(canvas, &[], caption, &cells)
}

/// What a map is compared with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Against {
    /// The true room.
    Room,
    /// A floor plan.
    Plan,
}

/// Compares a map with the truth, or with a plan. Correct surfaces (within one cell) are black and false ones
/// magenta; missing ones are blue, but only in cells that have been `seen`.
pub fn render_error(
    map: &OccupancyGrid,
    truth: &OccupancyGrid,
    seen: &OccupancyGrid,
    against: Against,
    caption: &Caption,
) -> RgbImage {
    let is_occupied = |grid: &OccupancyGrid, column: usize, row: usize| {
        matches!(at(grid, map, column, row), Cell::Occupied | Cell::Movable)
    };
    let is_by = |grid: &OccupancyGrid, column: usize, row: usize| {
        let neighbours = [(0, 0), (1, 0), (usize::MAX, 0), (0, 1), (0, usize::MAX)];
        neighbours
            .into_iter()
            .any(|(x, y)| is_occupied(grid, column.wrapping_add(x), row.wrapping_add(y)))
    };
    let canvas = Canvas::new(map, scale_of(map), |column, row| match map.cell(column, row) {
        Cell::Occupied | Cell::Movable if is_by(truth, column, row) => WALL,
        Cell::Occupied | Cell::Movable => EXTRA,
        _ if is_occupied(seen, column, row) && !is_by(map, column, row) => MISSING,
        Cell::Free => FREE,
        Cell::Unknown => UNKNOWN,
    });
    let (extra, missing) = match against {
        Against::Room => ("on the map, not in the room", "in the room, not on the map"),
        Against::Plan => ("on the map, not on the plan", "on the plan, not on the map"),
    };
    let cells = [
        (Sample::Cell(WALL), "right, within a cell"),
        (Sample::Cell(EXTRA), extra),
        (Sample::Cell(MISSING), missing),
        (Sample::Cell(FREE), "free"),
        (Sample::Cell(UNKNOWN), "unknown"),
    ];
    finish(canvas, &[], caption, &cells)
}

fn map_colour(grid: &OccupancyGrid) -> impl Fn(usize, usize) -> Rgb<u8> {
    |column, row| match grid.cell(column, row) {
        Cell::Unknown => UNKNOWN,
        Cell::Free => FREE,
        Cell::Occupied => WALL,
        Cell::Movable => MOVABLE,
    }
}

/// Draws the markers and the caption.
fn finish(
    mut canvas: Canvas<'_>,
    markers: &[Marker],
    caption: &Caption,
    cells: &[Entry],
) -> RgbImage {
    marker::draw(&mut canvas, markers);
    let legend = legend(cells, markers.iter());
    with_caption(&canvas.image, canvas.pixels_per_m(), &caption.to_string(), &legend)
}

/// The legend entries of the cells and of the markers present.
fn legend<'m>(cells: &[Entry], markers: impl Iterator<Item = &'m Marker> + Clone) -> Vec<Entry> {
    let is_there = |kind: MarkerKind| markers.clone().any(|marker| marker.kind == kind);
    let kinds = [
        (MarkerKind::Robot, "robot"),
        (MarkerKind::Person, "person, as tracked"),
        (MarkerKind::Camera, "camera, looks to the tip"),
        (MarkerKind::CameraDown, "camera that looks down"),
        (MarkerKind::CameraOut, "camera out of use: knocked, or away"),
    ];
    let kinds = kinds.into_iter().filter(|(kind, _)| is_there(*kind));
    let mut entries = cells.to_vec();
    entries.extend(kinds.map(|(kind, text)| (Sample::Marker(kind), text)));
    if markers.clone().any(|marker| !marker.path.is_empty()) {
        entries.push((Sample::Path, "path of a robot"));
    }
    if markers.clone().any(|marker| !marker.view.is_empty()) {
        entries.push((Sample::View, "edge of a camera's view of the floor"));
    }
    entries
}

/// The cell of `grid` that contains the centre of the cell (`column`, `row`) of the grid `other`;
/// unknown outside of `grid`.
fn at(grid: &OccupancyGrid, other: &OccupancyGrid, column: usize, row: usize) -> Cell {
    let [x, y] = grid.from_map(other.to_map([middle(column), middle(row)]));
    if x < 0.0 || y < 0.0 { Cell::Unknown } else { grid.cell(x as usize, y as usize) }
}

/// The centre of a cell along an axis, in cells. An index west or south of the grid is a wrapped
/// negative number.
fn middle(index: usize) -> f64 {
    index as isize as f64 + 0.5
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::report::{
        picture::palette::{ALL, CAMERA, INK, PERSON, ROBOT, are_alike},
        png,
    };

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
        Marker { path, ..Marker::new(MarkerKind::Robot, [x_m, y_m], 0.0) }
    }

    /// The colour in the middle of a cell of the room.
    fn cell(picture: &RgbImage, x: u32, y: u32) -> Rgb<u8> {
        *picture.get_pixel((x + 4) * 8 + 4, (67 - 4 - y) * 8 + 4)
    }

    #[test]
    fn north_is_up_and_every_cell_has_the_colour_of_its_kind() {
        let markers = [robot(0.0, 3.0, vec![[0.0, 3.525], [3.0, 3.525]])];
        let picture = render(&room(), &markers, &Caption::default());
        assert_eq!(picture.width(), 108 * 8);
        assert!(picture.height() > 68 * 8 + 24, "no caption");
        let at = |picture: &RgbImage| cell(picture, 17, 20);
        let cell = |x, y| cell(&picture, x, y);
        assert_eq!(cell(0, 0), WALL);
        assert_eq!(cell(50, 57), MOVABLE);
        assert_eq!(cell(50, 2), FREE);
        assert_eq!(*picture.get_pixel(0, 0), UNKNOWN);
        // The robot at (0, 3) m is in cell (20, 20); its disc reaches three cells to the west.
        assert_eq!(cell(17, 20), ROBOT);
        assert_eq!(cell(14, 20), FREE);
        assert_eq!(cell(50, 30), ROBOT);
        let person = [Marker::new(MarkerKind::Person, [0.0, 3.0], 0.0)];
        assert_eq!(at(&render(&room(), &person, &Caption::default())), PERSON);
    }

    #[test]
    fn coverage_shows_what_is_seen_and_what_is_blind() {
        let mut coverage = room();
        for index in 0..100 * 60 {
            let (x, y) = (index % 100, index / 100);
            coverage.set(x, y, if x < 40 { Cell::Free } else { Cell::Unknown });
        }
        let picture = render_coverage(&room(), &coverage, &[], &Caption::default());
        let cell = |x, y| cell(&picture, x, y);
        assert_eq!([cell(0, 20), cell(20, 20), cell(60, 20)], [WALL, COVERED, BLIND]);
    }

    #[test]
    fn errors_have_colours_of_their_own() {
        let (mut map, truth) = (room(), room());
        map.set(50, 57, Cell::Free);
        map.set(20, 20, Cell::Occupied);
        let picture = render_error(&map, &truth, &truth, Against::Room, &Caption::default());
        let cell = |x, y| cell(&picture, x, y);
        assert_eq!([cell(0, 20), cell(20, 20), cell(50, 57)], [WALL, EXTRA, MISSING]);
    }

    #[test]
    fn frames_lie_beside_one_another_and_show_the_map_of_their_moment() {
        let earlier = OccupancyGrid::new(0.05, [0.0, 3.0], 20, 20).unwrap();
        let moment = |grid, markers| Moment { time_s: 0.0, grid, markers };
        let frames = [moment(earlier, vec![]), moment(room(), vec![robot(0.0, 3.0, vec![])])];
        let picture = render_frames(&room(), &frames, &Caption::default());
        let across = 108 * 4 + GAP;
        assert_eq!(picture.width(), 3 * across);
        let cell = |frame: u32, x: u32, y: u32| {
            *picture.get_pixel(frame * across + (x + 4) * 4 + 2, (67 - 4 - y) * 4 + 2)
        };
        assert_eq!([cell(0, 50, 2), cell(1, 50, 2)], [UNKNOWN, FREE]);
        assert_eq!([cell(0, 17, 20), cell(1, 17, 20)], [UNKNOWN, ROBOT]);
    }

    /// Draws pictures of cells in every order and of markers, and checks every pair of colours that
    /// touch.
    #[test]
    fn colours_that_touch_can_be_told_apart() {
        let kinds = [Cell::Unknown, Cell::Free, Cell::Occupied, Cell::Movable];
        let mut state = 1_u32;
        let mut random = || {
            let mut grid = OccupancyGrid::new(0.05, [0.0, 0.0], 60, 40).unwrap();
            for index in 0..60 * 40 {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                grid.set(index % 60, index / 60, kinds[(state >> 29) as usize % 4]);
            }
            grid
        };
        let (map, other) = (random(), random());
        let mut markers = vec![robot(1.0, 1.0, vec![[0.2, 0.3], [2.0, 1.2], [0.4, 1.8]])];
        markers[0].label = "1".into();
        let kinds =
            [MarkerKind::Person, MarkerKind::Camera, MarkerKind::CameraDown, MarkerKind::CameraOut];
        for (index, kind) in kinds.into_iter().enumerate() {
            // The markers overlap.
            let mut marker = Marker::new(kind, [1.1 + 0.2 * index as f64, 1.1], 1.0);
            marker.view = vec![[0.1, 0.1], [2.5, 0.4], [2.0, 1.9]];
            markers.push(marker);
        }
        let caption = Caption::default();
        let mut touching = BTreeSet::new();
        for markers in [&markers[..], &[]] {
            for picture in [
                render(&map, markers, &caption),
                render_coverage(&map, &other, markers, &caption),
                render_error(&map, &other, &random(), Against::Plan, &caption),
                render_overlap(
                    &map,
                    markers,
                    |[x, y]| {
                        let is_floor = (0.0..3.0).contains(&x) && (0.0..2.0).contains(&y);
                        let count = ((20.0 * x) as u16 + 3 * (20.0 * y) as u16) % 6;
                        is_floor.then_some((count, x > y))
                    },
                    &caption,
                ),
            ] {
                let mut pairs = pairs(&picture);
                // The edge of a stroke is blended: black over free floor may become as grey as
                // unknown cells. But no blend has the colour of a marker.
                pairs.retain(|(a, b)| {
                    markers.is_empty() || [a, b].iter().any(|it| OF_MARKERS.contains(&Rgb(**it)))
                });
                touching.extend(pairs);
            }
        }
        assert!(touching.contains(&(INK.0, ROBOT.0)) && touching.contains(&(UNKNOWN.0, FREE.0)));
        assert!(touching.contains(&(INK.0, MOVABLE.0)) && touching.contains(&(INK.0, EXTRA.0)));
        let alike: Vec<_> = touching.iter().filter(|(a, b)| are_alike(Rgb(*a), Rgb(*b))).collect();
        assert!(alike.is_empty(), "{alike:?}");
    }

    const OF_MARKERS: [Rgb<u8>; 3] = [ROBOT, PERSON, CAMERA];

    /// The colours of the palette that touch on a picture.
    fn pairs(picture: &RgbImage) -> BTreeSet<([u8; 3], [u8; 3])> {
        let mut touching = BTreeSet::new();
        for (x, y, own) in picture.enumerate_pixels() {
            let beside = [(x + 1, y), (x, y + 1), (x + 1, y + 1), (x.wrapping_sub(1), y + 1)];
            for (x, y) in beside {
                let other = picture.get_pixel_checked(x, y).filter(|other| *other != own);
                touching.extend(other.map(|other| (own.0, other.0)));
            }
        }
        let is_named = |colour: &[u8; 3]| ALL.contains(&Rgb(*colour));
        touching.retain(|(a, b)| is_named(a) && is_named(b));
        touching
    }

    #[test]
    fn markers_anywhere_are_drawn_or_left_out() {
        let render = |grid: &OccupancyGrid, markers: &[Marker]| {
            let mut canvas = Canvas::new(grid, scale_of(grid), map_colour(grid));
            marker::draw(&mut canvas, markers);
            canvas.image
        };
        let plain = render(&room(), &[]);
        for place in [f64::NAN, f64::INFINITY, -1e300, 1e9] {
            let mut marker = robot(place, 3.0, vec![[place, place], [place, 0.0]]);
            marker.label = "1".into();
            marker.view = vec![[place, 0.0], [place, place], [0.0, place]];
            assert_eq!(render(&room(), &[marker]), plain);
        }
        let unknown = OccupancyGrid::new(0.05, [0.0, 0.0], 0, 0).unwrap();
        let picture = super::render(&unknown, &[], &Caption::default());
        assert!(png(&picture).unwrap().starts_with(b"\x89PNG"));
    }
}
