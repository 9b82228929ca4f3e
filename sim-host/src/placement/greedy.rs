//! The greedy initial placement: repeatedly adds the candidate with the greatest gain.

use std::collections::BinaryHeap;

use super::{
    programme::{Goal, Programme},
    selection::Selection,
};

/// An initial placement, ascending. It may miss the goal where upper bounds prevent it.
///
/// The gain of a candidate can only fall as others are chosen, so its last known gain is an upper
/// bound, and few candidates must be evaluated again (Minoux, "Accelerated greedy algorithms",
/// 1978).
pub(super) fn greedy(programme: &Programme) -> Vec<u32> {
    // Violating an upper bound costs more than covering any cell gains.
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
