//! The greedy start: always the candidate that helps most.

use std::collections::BinaryHeap;

use super::{
    programme::{Goal, Programme},
    selection::Selection,
};

/// A placement to start from, ascending: it may miss the goal where upper bounds are in the way.
///
/// The gain of a candidate only falls as others are chosen, so the last known gains are upper bounds
/// and few candidates are evaluated again (Minoux, "Accelerated greedy algorithms", 1978).
pub(super) fn greedy(programme: &Programme) -> Vec<u32> {
    // Keeping an upper bound is worth more than covering any one cell.
    let cells = programme.demands.len() as i64;
    let mut selection = Selection::new(programme, cells.max(1));
    let most = match programme.goal {
        Goal::Fewest { .. } => usize::MAX,
        Goal::Best { cameras } => cameras,
    };
    let mut heap: BinaryHeap<(i64, std::cmp::Reverse<u32>)> = (0..programme.candidates() as u32)
        .map(|candidate| (selection.gain(candidate), std::cmp::Reverse(candidate)))
        .collect();
    while selection.chosen().len() < most {
        let is_done = matches!(programme.goal, Goal::Fewest { .. }) && selection.is_feasible();
        let Some((known, std::cmp::Reverse(candidate))) = heap.pop() else { break };
        if is_done || known <= 0 {
            break;
        }
        let gain = selection.gain(candidate);
        if heap.peek().is_none_or(|&(next, _)| gain >= next) {
            selection.add(candidate);
        } else {
            heap.push((gain, std::cmp::Reverse(candidate)));
        }
    }
    selection.sorted()
}
