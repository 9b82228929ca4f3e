//! Groups the foreground cells of an image into objects.

use std::collections::BTreeMap;

use super::{
    cells::MIN_EVIDENCE,
    evidence::{Figure, LAYER_SHIFT},
};
use crate::{
    camera::{LAYERS, Thing},
    grid::clusters,
};

/// Minimum number of cells of an object.
const MIN_CELLS: usize = 3;
/// Minimum number of pixels of an object.
const MIN_PIXELS: u32 = 30;
/// Maximum percentage of an object's pixels that may lie above its height, as noise.
const OUTLIERS: u32 = 2;

/// The objects in the figures of an image: clusters of cells that touch by an edge or a corner.
pub(super) fn things<'a>(figures: impl Iterator<Item = ((i32, i32), &'a Figure)>) -> Vec<Thing> {
    let figures: BTreeMap<_, _> =
        figures.filter(|(_, figure)| figure.pixels >= MIN_EVIDENCE).collect();
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
    if cells.len() < MIN_CELLS || pixels < MIN_PIXELS {
        return None;
    }
    // The height ends with the highest layer above noise, except for the open-ended layer.
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
