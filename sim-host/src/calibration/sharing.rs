//! The landmarks of all edges, weighted so that a landmark seen by many cameras counts once.

use std::collections::BTreeMap;

use super::{graph::Edge, observations::Observations, refine::Link, tie::Tie};

/// The landmarks of each edge, in the order of the edges; none for edges between cameras that are
/// not tied to the reference.
pub(super) fn links(
    observations: &Observations,
    edges: &[Edge],
    is_tied: &dyn Fn(usize) -> bool,
) -> Vec<Link> {
    let mut links: Vec<Link> = edges
        .iter()
        .map(|edge| {
            let [i, j] = edge.cameras;
            let tie = |&[a, b]: &[usize; 2]| {
                let landmarks = [(i, a), (j, b)]
                    .map(|(camera, landmark)| &observations.cameras[camera].landmarks[landmark]);
                Tie::new([a, b], landmarks)
            };
            let pairs = edge.transform.pairs.iter().filter(|_| is_tied(i));
            let ties: Vec<Tie> = pairs.map(tie).collect();
            Link { cameras: edge.cameras, shares: vec![1.0; ties.len()], ties }
        })
        .collect();
    let mut groups = Groups::default();
    for link in &links {
        for tie in &link.ties {
            groups.join([0, 1].map(|side| (link.cameras[side], tie.index[side])));
        }
    }
    let mut ties: BTreeMap<Sighting, f64> = BTreeMap::new();
    for link in &links {
        for tie in &link.ties {
            *ties.entry(groups.root((link.cameras[0], tie.index[0]))).or_default() += 1.0;
        }
    }
    let mut sightings: BTreeMap<Sighting, f64> = BTreeMap::new();
    for &sighting in groups.parents.keys() {
        *sightings.entry(groups.root(sighting)).or_default() += 1.0;
    }
    for link in &mut links {
        for (tie, share) in link.ties.iter().zip(&mut link.shares) {
            let root = groups.root((link.cameras[0], tie.index[0]));
            *share = (sightings[&root] - 1.0) / ties[&root];
        }
    }
    links
}

/// A landmark of a camera, by their indices.
type Sighting = (usize, usize);

/// Which sightings are of one landmark: a union-find structure.
#[derive(Default)]
struct Groups {
    parents: BTreeMap<Sighting, Sighting>,
}

impl Groups {
    fn root(&self, mut of: Sighting) -> Sighting {
        while let Some(&parent) = self.parents.get(&of).filter(|it| **it != of) {
            of = parent;
        }
        of
    }

    fn join(&mut self, pair: [Sighting; 2]) {
        pair.iter().for_each(|&it| {
            self.parents.entry(it).or_insert(it);
        });
        let [one, other] = pair.map(|it| self.root(it));
        self.parents.insert(one.max(other), one.min(other));
    }
}
