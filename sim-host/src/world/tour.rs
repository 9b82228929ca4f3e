//! A tour of a robot through the overlaps of the cameras' views, as somebody would steer it to
//! calibrate the cameras.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use nalgebra::Point3;
use parry2d_f64::glamx::{DVec2, DVec3};

use super::room::{CellGrid, Room};
use crate::camera::Lens;

/// Number of places in the overlap of two cameras.
const PLACES: usize = 3;
/// Distance in metres within which passing a place in the same overlap is as good.
const NEAR_M: f64 = 0.8;
/// Minimum distance of a marker from the edge of a picture, in pixels.
const MARGIN_PX: f64 = 50.0;

type Cell = (i32, i32);

/// The stops of a tour from `start` along the cells `free`, on which a robot with a marker at
/// `height_m` can stand, through all overlaps of pictures; without the start. It is closed.
pub(super) fn tour(
    room: &Room,
    cells: CellGrid,
    lenses: &[Lens],
    free: &BTreeSet<Cell>,
    start: Cell,
    height_m: f64,
) -> Vec<DVec2> {
    let mut overlaps: BTreeMap<[usize; 2], BTreeSet<Cell>> = BTreeMap::new();
    for &cell in free {
        let at = cells.centre(cell);
        let sees = |lens: &Lens| sees(room, lens, Point3::new(at.x, at.y, height_m));
        let seen: Vec<usize> = (0..lenses.len()).filter(|&index| sees(&lenses[index])).collect();
        for (first, &one) in seen.iter().enumerate() {
            for &other in &seen[first + 1..] {
                overlaps.entry([one, other]).or_default().insert(cell);
            }
        }
    }
    let near = (NEAR_M / cells.side) as i32;
    let mut places: Vec<(&BTreeSet<Cell>, Cell)> = overlaps
        .values()
        .flat_map(|overlap| spread(overlap).into_iter().map(move |place| (overlap, place)))
        .collect();
    let mut stops = Vec::new();
    let mut here = start;
    loop {
        let goals = places.iter().map(|(_, place)| *place).collect();
        let Some(path) = nearest(free, here, &goals) else { break };
        here = *path.last().unwrap_or(&here);
        places.retain(|(overlap, place)| {
            let is_near = |cell: &&Cell| apart(**cell, *place) <= near * near;
            !path.iter().filter(is_near).any(|cell| overlap.contains(cell))
        });
        straighten(&path, free, &mut stops);
    }
    if let Some(home) = nearest(free, here, &BTreeSet::from([start])) {
        straighten(&home, free, &mut stops);
        stops.pop();
    }
    stops.dedup();
    stops.into_iter().map(|cell| cells.centre(cell)).collect()
}

fn sees(room: &Room, lens: &Lens, marker: Point3<f64>) -> bool {
    let intrinsics = lens.intrinsics();
    let is_inside = |at: f64, size: u32| at > MARGIN_PX && at < f64::from(size) - MARGIN_PX;
    let centre = lens.centre();
    lens.project(&marker).is_some_and(|[column, row]| {
        is_inside(column, intrinsics.width) && is_inside(row, intrinsics.height)
    }) && room
        .sees(DVec3::new(centre.x, centre.y, centre.z), DVec3::new(marker.x, marker.y, marker.z))
}

/// A few cells far from each other.
fn spread(cells: &BTreeSet<Cell>) -> Vec<Cell> {
    let mut chosen: Vec<Cell> = cells.first().copied().into_iter().collect();
    while chosen.len() < PLACES {
        let gap = |cell: &Cell| chosen.iter().map(|it| apart(*it, *cell)).min();
        match cells.iter().max_by_key(|cell| gap(cell)) {
            Some(cell) if !chosen.contains(cell) => chosen.push(*cell),
            _ => break,
        }
    }
    chosen
}

/// The squared distance in cells.
fn apart(a: Cell, b: Cell) -> i32 {
    (a.0 - b.0).pow(2) + (a.1 - b.1).pow(2)
}

/// The shortest path along free cells to the nearest of `goals`, without its start.
fn nearest(free: &BTreeSet<Cell>, from: Cell, goals: &BTreeSet<Cell>) -> Option<Vec<Cell>> {
    let mut before: BTreeMap<Cell, Cell> = BTreeMap::from([(from, from)]);
    let mut queue = VecDeque::from([from]);
    while let Some(cell) = queue.pop_front() {
        if goals.contains(&cell) {
            let mut path = vec![cell];
            let mut here = cell;
            while let Some(&previous) = before.get(&here).filter(|it| **it != here) {
                path.push(previous);
                here = previous;
            }
            path.reverse();
            return Some(path);
        }
        let (x, y) = cell;
        for next in [(x + 1, y), (x - 1, y), (x, y + 1), (x, y - 1)] {
            if free.contains(&next) && !before.contains_key(&next) {
                before.insert(next, cell);
                queue.push_back(next);
            }
        }
    }
    None
}

/// Adds the corners of a path that remain if straight lines replace its steps.
fn straighten(path: &[Cell], free: &BTreeSet<Cell>, stops: &mut Vec<Cell>) {
    let mut from = 0;
    while from + 1 < path.len() {
        let clear = |to: &usize| is_clear(path[from], path[*to], free);
        let to = (from + 1..path.len()).rev().find(clear).unwrap_or(from + 1);
        stops.push(path[to]);
        from = to;
    }
}

/// Whether a straight line runs over free cells.
fn is_clear(from: Cell, to: Cell, free: &BTreeSet<Cell>) -> bool {
    let (dx, dy) = (to.0 - from.0, to.1 - from.1);
    let steps = 2 * dx.abs().max(dy.abs());
    (0..=steps).all(|step| {
        let part = f64::from(step) / f64::from(steps.max(1));
        let at = |from: i32, way: i32| from + (f64::from(way) * part).round() as i32;
        free.contains(&(at(from.0, dx), at(from.1, dy)))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_go_round_corners_in_straight_lines() {
        let mut free: BTreeSet<Cell> = (0..20).flat_map(|x| (0..20).map(move |y| (x, y))).collect();
        free.retain(|&(x, y)| !(x == 10 && y < 15));
        let path = nearest(&free, (2, 2), &BTreeSet::from([(18, 2), (19, 19)])).unwrap();
        assert_eq!(path.last(), Some(&(19, 19)));
        let path = nearest(&free, (2, 2), &BTreeSet::from([(18, 2)])).unwrap();
        let mut stops = Vec::new();
        straighten(&path, &free, &mut stops);
        assert_eq!(stops.last(), Some(&(18, 2)));
        assert!(stops.len() <= 4, "{stops:?}");
        let line: Vec<Cell> = std::iter::once((2, 2)).chain(stops).collect();
        assert!(line.windows(2).all(|pair| is_clear(pair[0], pair[1], &free)));
        assert_eq!(nearest(&free, (2, 2), &BTreeSet::from([(10, 3)])), None);
    }

    #[test]
    fn places_are_far_apart() {
        let cells: BTreeSet<Cell> = (0..10).flat_map(|x| (0..5).map(move |y| (x, y))).collect();
        let places = spread(&cells);
        assert_eq!(places.len(), PLACES);
        assert!(
            places.iter().all(|&it| places.iter().filter(|&&on| apart(it, on) < 16).count() == 1)
        );
        assert_eq!(spread(&BTreeSet::from([(3, 3)])), [(3, 3)]);
        assert!(spread(&BTreeSet::new()).is_empty());
    }
}
