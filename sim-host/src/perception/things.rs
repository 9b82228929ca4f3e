//! What stands out of the empty room, cell by cell, put together.

use std::collections::{BTreeMap, BTreeSet};

use ubimap_protocol::tile::Cell;

use super::{
    cells::FEWEST,
    evidence::{Figure, LAYER_SHIFT},
};
use crate::camera::{LAYERS, Thing};

/// Fewer cells or pixels are no thing.
const FEWEST_CELLS: usize = 3;
const FEWEST_PIXELS: u32 = 30;
/// So many pixels of a thing in a hundred may be higher than it is: noise.
const OUTLIERS: u32 = 2;

/// The things that figures make: cells that touch each other, also by a corner.
pub(super) fn things<'a>(figures: impl Iterator<Item = ((i32, i32), &'a Figure)>) -> Vec<Thing> {
    let figures: BTreeMap<_, _> = figures.filter(|(_, figure)| figure.pixels >= FEWEST).collect();
    let clusters = clusters(figures.keys().copied().collect());
    clusters.into_iter().filter_map(|cells| thing(cells, &figures)).collect()
}

/// What the movable cells of a frame are, where its source says no more of them.
pub fn things_of_cells(cells: &[((i32, i32), Cell)]) -> Vec<Thing> {
    let movable = cells.iter().filter(|(_, code)| *code == Cell::Movable);
    let clusters = clusters(movable.map(|&(cell, _)| cell).collect());
    clusters.into_iter().map(|cells| Thing { cells, ..Thing::default() }).collect()
}

fn thing(cells: Vec<(i32, i32)>, figures: &BTreeMap<(i32, i32), &Figure>) -> Option<Thing> {
    let mut layers = [0_u32; LAYERS];
    let mut top_mm = 0;
    for figure in cells.iter().filter_map(|cell| figures.get(cell)) {
        top_mm = top_mm.max(figure.top);
        for (sum, layer) in layers.iter_mut().zip(figure.layers) {
            *sum += u32::from(layer);
        }
    }
    let pixels: u32 = layers.iter().sum();
    if cells.len() < FEWEST_CELLS || pixels < FEWEST_PIXELS {
        return None;
    }
    // The end of the highest layer that is more than noise, unless that is the one without end.
    let mut higher = 0;
    let highest = (0..LAYERS).rev().find(|&layer| {
        higher += layers[layer];
        100 * higher > OUTLIERS * pixels
    });
    let end = |layer: usize| (layer as u16 + 1) << LAYER_SHIFT;
    if let Some(layer) = highest.filter(|layer| *layer < LAYERS - 1) {
        top_mm = top_mm.min(end(layer));
    }
    Some(Thing { cells, top_mm, layers, label: None })
}

/// Cells that touch each other, also by a corner.
fn clusters(mut rest: BTreeSet<(i32, i32)>) -> Vec<Vec<(i32, i32)>> {
    let mut found = Vec::new();
    while let Some(first) = rest.pop_first() {
        let mut cluster = vec![first];
        let mut next = 0;
        while let Some(&(x, y)) = cluster.get(next) {
            next += 1;
            let around = (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (x + dx, y + dy)));
            cluster.extend(around.filter(|cell| rest.remove(cell)));
        }
        found.push(cluster);
    }
    found
}
