//! Generates a scenario from a map: places cameras, robots and people on its free floor.
//!
//! Everything is placed as far apart as the map allows, on the largest connected piece of reachable
//! floor. Each robot or person moves to the place of the next one and back.

use std::collections::VecDeque;

use super::{
    room::WallGrid,
    scenario::{CameraConfig, PersonConfig, RobotConfig, Scenario, ScenarioError, StartConfig},
};

/// Minimum distance of a place or path from walls, in metres.
const CLEARANCE: f64 = 0.35;

/// Distance of a camera from the ceiling, in metres.
const BELOW_CEILING: f64 = 0.15;

impl Scenario {
    /// Places what [`Scenario::grow`] asks for in a map; does nothing if that is `None`. `free`
    /// marks the cells of the map that are known to be free.
    pub fn grow_in(&mut self, grid: &WallGrid, free: &[bool]) -> Result<(), ScenarioError> {
        let Some(grow) = self.grow.take() else { return Ok(()) };
        let floor = Floor::of(grid, free);
        let movers = usize::from(grow.robots) + usize::from(grow.people);
        let places = floor.far_apart(movers.max(usize::from(grow.cameras)));
        if places.len() < movers.max(usize::from(grow.cameras)) {
            let problem =
                format!("has free floor for only {} of them; ask for fewer", places.len());
            return Err(self.invalid("grow", problem));
        }
        for &place in &places[..grow.cameras.into()] {
            let [x, y] = floor.metres(place);
            let position = [x, y, self.room.height_m - BELOW_CEILING];
            self.cameras.push(CameraConfig::looking_down(position));
        }
        for (index, &place) in places[..movers].iter().enumerate() {
            let there = places[(index + 1) % movers];
            let mut way = floor.way(place, there);
            // There and back; the start itself is the last stop of every route.
            way.extend(way.clone().into_iter().rev().skip(1));
            let stops: Vec<[f64; 2]> = way.into_iter().map(|cell| floor.metres(cell)).collect();
            let [x_m, y_m] = floor.metres(place);
            if index < usize::from(grow.robots) {
                let start = StartConfig { x_m, y_m, heading_deg: 0.0 };
                let sensor = grow.sensor.clone();
                let robot = RobotConfig::at(index as u16 + 1, start, stops);
                self.robots.push(RobotConfig { sensor, ..robot });
            } else {
                let waypoints = std::iter::once([x_m, y_m]).chain(stops).collect();
                self.people.push(PersonConfig::along(waypoints));
            }
        }
        self.check()
    }
}

/// The connected cells of a map with enough clearance.
struct Floor<'g> {
    grid: &'g WallGrid,
    is_clear: Vec<bool>,
}

impl<'g> Floor<'g> {
    fn of(grid: &'g WallGrid, free: &[bool]) -> Self {
        let reach = (CLEARANCE / grid.resolution_m).ceil() as usize;
        let is_free =
            |index: usize| free.get(index).copied().unwrap_or_default() && !grid.occupied[index];
        // A square is clear if its rows are: checks along the row, then along the column.
        let along_rows: Vec<bool> = (0..grid.width * grid.height)
            .map(|index| {
                let (column, row) = (index % grid.width, index / grid.width);
                column >= reach
                    && column + reach < grid.width
                    && (column - reach..=column + reach)
                        .all(|column| is_free(row * grid.width + column))
            })
            .collect();
        let is_clear: Vec<bool> = (0..grid.width * grid.height)
            .map(|index| {
                let (column, row) = (index % grid.width, index / grid.width);
                row >= reach
                    && row + reach < grid.height
                    && (row - reach..=row + reach).all(|row| along_rows[row * grid.width + column])
            })
            .collect();
        let mut floor = Self { grid, is_clear };
        // Finds the largest connected piece.
        let mut left = floor.is_clear.clone();
        let mut largest = Vec::new();
        for index in 0..left.len() {
            if left[index] {
                let steps = floor.steps([index]);
                let piece: Vec<usize> =
                    (0..left.len()).filter(|&cell| steps[cell] != u32::MAX).collect();
                piece.iter().for_each(|&cell| left[cell] = false);
                if piece.len() > largest.len() {
                    largest = piece;
                }
            }
        }
        floor.is_clear.fill(false);
        largest.into_iter().for_each(|cell| floor.is_clear[cell] = true);
        floor
    }

    /// The number of steps from each cell to the nearest cell of `from`; `u32::MAX` for unreachable
    /// cells.
    fn steps(&self, from: impl IntoIterator<Item = usize>) -> Vec<u32> {
        let mut steps = vec![u32::MAX; self.is_clear.len()];
        let mut queue: VecDeque<usize> = from.into_iter().collect();
        queue.iter().for_each(|&cell| steps[cell] = 0);
        while let Some(cell) = queue.pop_front() {
            for next in self.neighbours(cell) {
                if steps[next] == u32::MAX {
                    steps[next] = steps[cell] + 1;
                    queue.push_back(next);
                }
            }
        }
        steps
    }

    /// The clear neighbours of a cell; a clear cell is never at the map's edge.
    fn neighbours(&self, cell: usize) -> impl Iterator<Item = usize> + '_ {
        let width = self.grid.width;
        let beside = [cell + 1, cell + width, cell.wrapping_sub(1), cell.wrapping_sub(width)];
        beside.into_iter().filter(|&cell| self.is_clear.get(cell) == Some(&true))
    }

    /// `count` places, each as far as possible from the previous ones; fewer if there is no room.
    fn far_apart(&self, count: usize) -> Vec<usize> {
        let first = self.is_clear.iter().position(|&is_clear| is_clear);
        let mut places: Vec<usize> = Vec::new();
        let mut steps = match first {
            Some(cell) => self.steps([cell]),
            None => return places,
        };
        while places.len() < count {
            let reached = (0..steps.len()).filter(|&cell| steps[cell] != u32::MAX);
            match reached.max_by_key(|&cell| (steps[cell], std::cmp::Reverse(cell))) {
                // Places are at least one metre apart.
                Some(cell) if f64::from(steps[cell]) * self.grid.resolution_m >= 1.0 => {
                    places.push(cell);
                }
                _ => break,
            }
            steps = self.steps(places.iter().copied());
        }
        places
    }

    /// The corners of a short path, without the first cell.
    fn way(&self, from: usize, to: usize) -> Vec<usize> {
        let steps = self.steps([to]);
        let mut cells = vec![from];
        let mut cell = from;
        while let Some(next) = self.neighbours(cell).min_by_key(|&next| steps[next]) {
            if cell == to {
                break;
            }
            cells.push(next);
            cell = next;
        }
        // From each corner, goes straight to the last cell in sight.
        let mut corners = Vec::new();
        let mut here = 0;
        while here + 1 < cells.len() {
            let later = (here + 2..cells.len()).rev();
            here = later
                .filter(|&later| self.is_straight(cells[here], cells[later]))
                .chain([here + 1])
                .next()
                .unwrap_or(here + 1);
            corners.push(cells[here]);
        }
        corners
    }

    /// Whether the straight line between two cells is clear.
    fn is_straight(&self, from: usize, to: usize) -> bool {
        let place =
            |cell: usize| ((cell % self.grid.width) as f64, (cell / self.grid.width) as f64);
        let ((x, y), (to_x, to_y)) = (place(from), place(to));
        let count = ((to_x - x).abs().max((to_y - y).abs()) * 2.0).ceil().max(1.0);
        (0..=count as usize).all(|step| {
            let part = step as f64 / count;
            let (column, row) = ((x + (to_x - x) * part).round(), (y + (to_y - y) * part).round());
            self.is_clear[row as usize * self.grid.width + column as usize]
        })
    }

    /// The centre of a cell in `map`, in metres.
    fn metres(&self, cell: usize) -> [f64; 2] {
        let at = |first: f64, index: usize| first + (index as f64 + 0.5) * self.grid.resolution_m;
        let [x, y] = self.grid.origin_m;
        [at(x, cell % self.grid.width), at(y, cell / self.grid.width)]
    }
}
