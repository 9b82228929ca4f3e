//! What stands out of the empty room, cell by cell, put together.

use std::collections::BTreeMap;

use super::{
    cells::FEWEST,
    evidence::{Figure, LAYER_SHIFT},
};
use crate::{
    camera::{LAYERS, Thing},
    grid::clusters,
};

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
