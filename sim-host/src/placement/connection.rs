//! Whether the views of a placement's cameras overlap enough to calibrate the cameras against each
//! other, and how to connect them if they do not.
//!
//! Two cameras are neighbours if both see a minimum number of common cells, where landmarks can lie
//! (UbiSLAM, section 5). The connected components of the graph of neighbours are called pieces:
//! cameras of different pieces can't be calibrated against each other.

use std::collections::VecDeque;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{
    incidence::Incidence,
    programme::{Goal, Programme},
    selection::Selection,
};

/// Penalty of an additional piece in the first round, in cells.
const PIECE: f64 = 3.0;
/// Maximum penalty of a piece. If coverage is the goal, the penalty doubles with each round, so
/// that no more coverage is given up than necessary.
const MOST_PIECE: f64 = 400.0;
/// The temperatures at which a round begins and ends, in cells.
const HOT: f64 = 2.0;
const COLD: f64 = 0.15;
/// Number of exchanges per round.
const ROUND: usize = 20_000;

/// The cells in which landmarks can be seen, which make cameras neighbours.
#[derive(Clone, Copy, Debug)]
pub struct Views<'a> {
    /// For each candidate the cells that it sees.
    pub sees: &'a Incidence,
    /// For each cell the candidates that see it: the transpose of `sees`.
    pub seen_by: &'a Incidence,
    /// Minimum number of cells that neighbours share.
    pub shared: u16,
}

impl<'a> Views<'a> {
    /// The views are the floor that the candidates cover.
    pub fn of(programme: &'a Programme, shared: u16) -> Self {
        Self { sees: &programme.covers, seen_by: &programme.covered_by, shared }
    }
}

/// The piece of each chosen candidate, numbered from zero in order of appearance. Neighbours are in
/// one piece.
pub fn pieces(views: Views<'_>, chosen: &[u32]) -> Vec<usize> {
    let mut graph = Graph::new(views);
    chosen.iter().for_each(|&candidate| graph.add(candidate));
    graph.pieces(chosen)
}

/// The minimum number of pieces of any placement that covers every cell that has a demand and a
/// candidate, if cameras that cover a common cell were neighbours. It exceeds one if no chain of
/// candidates connects some of these cells.
pub fn fewest_pieces(programme: &Programme) -> usize {
    let mut is_seen = vec![false; programme.demands.len()];
    let mut is_done = vec![false; programme.candidates()];
    let mut count = 0;
    for start in 0..is_seen.len() {
        let is_demanded = programme.demands[start].at_least > 0;
        if !is_demanded || is_seen[start] || programme.covered_by.row(start).is_empty() {
            continue;
        }
        count += 1;
        is_seen[start] = true;
        let mut waiting = vec![start];
        while let Some(cell) = waiting.pop() {
            for &candidate in programme.covered_by.row(cell) {
                if std::mem::replace(&mut is_done[candidate as usize], true) {
                    continue;
                }
                for &next in programme.covers.row(candidate as usize) {
                    if !std::mem::replace(&mut is_seen[next as usize], true) {
                        waiting.push(next as usize);
                    }
                }
            }
        }
    }
    count
}

/// The chosen candidates and their neighbours.
struct Graph<'p> {
    views: Views<'p>,
    /// For each cell the chosen candidates that see it.
    viewers: Vec<Vec<u32>>,
    /// For each chosen candidate its neighbours.
    neighbours: Vec<Vec<u32>>,
    /// Scratch memory: the number of cells shared with each candidate; all zero between calls.
    common: Vec<u16>,
}

impl<'p> Graph<'p> {
    fn new(views: Views<'p>) -> Self {
        let candidates = views.sees.rows();
        Self {
            views,
            viewers: vec![Vec::new(); views.seen_by.rows()],
            neighbours: vec![Vec::new(); candidates],
            common: vec![0; candidates],
        }
    }

    /// The chosen candidates that would be neighbours of `candidate`.
    fn beside(&mut self, candidate: u32) -> Vec<u32> {
        let mut touched = Vec::new();
        for &cell in self.views.sees.row(candidate as usize) {
            for &other in &self.viewers[cell as usize] {
                if self.common[other as usize] == 0 {
                    touched.push(other);
                }
                self.common[other as usize] += 1;
            }
        }
        touched.retain(|&other| {
            std::mem::take(&mut self.common[other as usize]) >= self.views.shared
                && other != candidate
        });
        touched
    }

    fn add(&mut self, candidate: u32) {
        let beside = self.beside(candidate);
        for &other in &beside {
            self.neighbours[other as usize].push(candidate);
        }
        self.neighbours[candidate as usize] = beside;
        for &cell in self.views.sees.row(candidate as usize) {
            self.viewers[cell as usize].push(candidate);
        }
    }

    fn remove(&mut self, candidate: u32) {
        for other in std::mem::take(&mut self.neighbours[candidate as usize]) {
            self.neighbours[other as usize].retain(|&it| it != candidate);
        }
        for &cell in self.views.sees.row(candidate as usize) {
            self.viewers[cell as usize].retain(|&it| it != candidate);
        }
    }

    /// The piece of each of these chosen candidates.
    fn pieces(&mut self, chosen: &[u32]) -> Vec<usize> {
        // Meanwhile `common` holds the number of each candidate's piece, plus one.
        let mut count = 0;
        for &start in chosen {
            if self.common[start as usize] != 0 {
                continue;
            }
            count += 1;
            self.common[start as usize] = count;
            let mut waiting = vec![start];
            while let Some(candidate) = waiting.pop() {
                for &next in &self.neighbours[candidate as usize] {
                    if self.common[next as usize] == 0 {
                        self.common[next as usize] = count;
                        waiting.push(next);
                    }
                }
            }
        }
        chosen
            .iter()
            .map(|&it| usize::from(std::mem::take(&mut self.common[it as usize])) - 1)
            .collect()
    }

    fn count_pieces(&mut self, chosen: &[u32]) -> usize {
        self.pieces(chosen).into_iter().max().map_or(0, |last| last + 1)
    }
}

/// A search for a placement in fewer pieces with the same number of cameras: simulated annealing by
/// exchanges, in which an additional piece costs as much as a number of uncovered cells.
pub(super) struct Connecting<'p> {
    programme: &'p Programme,
    selection: Selection<'p>,
    graph: Graph<'p>,
    dice: ChaCha8Rng,
    pieces: usize,
    /// Penalty of one more piece, in cells.
    price: f64,
    /// Minimum optional weight that an accepted placement must cover.
    least_weight: u64,
    best: Option<(usize, u64, Vec<u32>)>,
    step: usize,
}

impl<'p> Connecting<'p> {
    /// A search that starts from a placement, feasible or not. Placements that cover less optional
    /// weight than `least_weight` are not accepted.
    pub(super) fn new(
        programme: &'p Programme,
        views: Views<'p>,
        start: &[u32],
        least_weight: u64,
        seed: u64,
    ) -> Self {
        let mut search = Self {
            programme,
            selection: Selection::new(programme, 1),
            graph: Graph::new(views),
            dice: ChaCha8Rng::seed_from_u64(seed),
            pieces: 0,
            price: PIECE,
            least_weight,
            best: None,
            step: 0,
        };
        start.iter().for_each(|&candidate| search.add(candidate));
        search.pieces = search.graph.count_pieces(search.selection.chosen());
        search.note();
        search
    }

    /// The number of pieces of the best placement so far, and that placement, ascending.
    pub(super) fn best(&self) -> Option<(usize, &[u32])> {
        self.best.as_ref().map(|(pieces, _, chosen)| (*pieces, &chosen[..]))
    }

    /// Tries `steps` exchanges.
    pub(super) fn run(&mut self, steps: usize) {
        for _ in 0..steps {
            let done = (self.step % ROUND) as f64 / ROUND as f64;
            self.step += 1;
            if self.step.is_multiple_of(ROUND) {
                // Constraints that stay violated get more weight.
                self.selection.weigh_violations();
                if matches!(self.programme.goal, Goal::Best { .. }) {
                    self.price = (2.0 * self.price).min(MOST_PIECE);
                }
            }
            self.try_exchange(HOT * libm::pow(COLD / HOT, done));
        }
    }

    fn add(&mut self, candidate: u32) {
        self.selection.add(candidate);
        self.graph.add(candidate);
    }

    fn remove(&mut self, candidate: u32) {
        self.selection.remove(candidate);
        self.graph.remove(candidate);
    }

    fn try_exchange(&mut self, temperature: f64) {
        let Some((old, new)) = self.pick() else { return };
        let loss = self.selection.loss(old);
        self.selection.remove(old);
        let change = (self.selection.gain(new) - loss) as f64;
        self.selection.add(old);
        // Fewer pieces may compensate for lost coverage, but only up to a limit.
        let most = change + self.price * self.pieces.saturating_sub(1).min(4) as f64;
        let chance = self.dice.random::<f64>();
        if most < temperature * libm::log(chance) {
            return;
        }
        self.remove(old);
        self.add(new);
        let pieces = self.graph.count_pieces(self.selection.chosen());
        let change = change - self.price * (pieces as f64 - self.pieces as f64);
        if change >= temperature * libm::log(chance) {
            self.pieces = pieces;
            self.note();
        } else {
            self.remove(new);
            self.add(old);
        }
    }

    /// A random chosen candidate and its replacement: a candidate that covers a random short cell,
    /// or any cell that is already seen.
    fn pick(&mut self) -> Option<(u32, u32)> {
        let chosen = self.selection.chosen();
        let short = self.selection.short();
        if chosen.is_empty() {
            return None;
        }
        let old = chosen[self.dice.random_range(0..chosen.len())];
        let cell = if !short.is_empty() && self.dice.random_range(0..2) == 0 {
            short[self.dice.random_range(0..short.len())]
        } else {
            let near = chosen[self.dice.random_range(0..chosen.len())];
            let cells = self.programme.covers.row(near as usize);
            if cells.is_empty() {
                return None;
            }
            cells[self.dice.random_range(0..cells.len())]
        };
        let there = self.programme.covered_by.row(cell as usize);
        if there.is_empty() {
            return None;
        }
        let new = there[self.dice.random_range(0..there.len())];
        (!self.selection.is_chosen(new)).then_some((old, new))
    }

    fn note(&mut self) {
        let weight = self.selection.optional_weight();
        if !self.selection.is_feasible() || weight < self.least_weight {
            return;
        }
        let is_better = self.best.as_ref().is_none_or(|(pieces, best_weight, _)| {
            self.pieces < *pieces || (self.pieces == *pieces && weight > *best_weight)
        });
        if is_better {
            self.best = Some((self.pieces, weight, self.selection.sorted()));
        }
    }
}

/// Adds cameras to a placement until it has at most `enough` pieces, or no further pieces can be
/// connected. Each time it adds the shortest chain of candidates between two pieces. Then it
/// removes the cameras that are no longer needed. Upper bounds are kept.
pub(super) fn bridge(
    programme: &Programme,
    views: Views<'_>,
    start: &[u32],
    enough: usize,
) -> Vec<u32> {
    let mut selection = Selection::new(programme, 1);
    let mut graph = Graph::new(views);
    for &candidate in start {
        selection.add(candidate);
        graph.add(candidate);
    }
    while graph.count_pieces(selection.chosen()) > enough {
        let Some(chain) = chain(&selection, &mut graph) else { break };
        for candidate in chain {
            // Earlier candidates of the chain may have filled up a cell.
            if selection.crowds(candidate) {
                break;
            }
            selection.add(candidate);
            graph.add(candidate);
        }
    }
    // In reverse order, because later cameras may have made earlier ones unnecessary.
    let pieces = graph.count_pieces(selection.chosen());
    for candidate in selection.sorted().into_iter().rev() {
        selection.remove(candidate);
        graph.remove(candidate);
        if !selection.is_feasible() || graph.count_pieces(selection.chosen()) > pieces {
            selection.add(candidate);
            graph.add(candidate);
        }
    }
    selection.sorted()
}

/// The shortest chain of candidates from the smallest piece that can be connected to another piece.
fn chain(selection: &Selection<'_>, graph: &mut Graph<'_>) -> Option<Vec<u32>> {
    let chosen = selection.chosen().to_vec();
    let pieces = graph.pieces(&chosen);
    let mut sizes = vec![0; pieces.iter().max().map_or(0, |last| last + 1)];
    pieces.iter().for_each(|&piece| sizes[piece] += 1);
    let mut order: Vec<usize> = (0..sizes.len()).collect();
    order.sort_by_key(|&piece| (sizes[piece], piece));
    order.into_iter().find_map(|piece| {
        let members = chosen.iter().zip(&pieces).filter(|(_, other)| **other == piece);
        chain_from(members.map(|(&candidate, _)| candidate).collect(), selection, graph)
    })
}

/// The shortest chain of candidates, none of them chosen, from a piece to a chosen candidate of
/// another piece.
fn chain_from(
    piece: Vec<u32>,
    selection: &Selection<'_>,
    graph: &mut Graph<'_>,
) -> Option<Vec<u32>> {
    let views = graph.views;
    let mut before: Vec<Option<u32>> = vec![None; views.sees.rows()];
    let mut is_seen = vec![false; views.sees.rows()];
    piece.iter().for_each(|&candidate| is_seen[candidate as usize] = true);
    let mut waiting: VecDeque<u32> = piece.into();
    let mut common = vec![0u16; views.sees.rows()];
    while let Some(candidate) = waiting.pop_front() {
        let mut touched = Vec::new();
        for &cell in views.sees.row(candidate as usize) {
            for &next in views.seen_by.row(cell as usize) {
                if common[next as usize] == 0 {
                    touched.push(next);
                }
                common[next as usize] += 1;
            }
        }
        touched.sort_unstable();
        for next in touched {
            let is_neighbour = std::mem::take(&mut common[next as usize]) >= views.shared;
            if !is_neighbour || is_seen[next as usize] {
                continue;
            }
            if !selection.is_chosen(next) && selection.crowds(next) {
                continue;
            }
            is_seen[next as usize] = true;
            before[next as usize] = Some(candidate);
            if selection.is_chosen(next) {
                let links = std::iter::successors(before[next as usize], |&it| before[it as usize]);
                return Some(links.filter(|&it| !selection.is_chosen(it)).collect());
            }
            waiting.push_back(next);
        }
    }
    None
}
