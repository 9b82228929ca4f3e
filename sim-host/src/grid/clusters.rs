//! Connected cells.

use std::collections::BTreeSet;

/// The 8-connected components of a set of cells (joined along sides or at corners), in the order of
/// their first cells.
pub(crate) fn clusters(mut rest: BTreeSet<(i32, i32)>) -> Vec<Vec<(i32, i32)>> {
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
