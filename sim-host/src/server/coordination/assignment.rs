//! Assigns robots to frontiers.

/// The cost of a pair that must not be assigned.
pub(super) const NEVER: i64 = 1 << 40;

/// Assigns each row a different column at minimum total cost, by the Hungarian method with
/// potentials (Kuhn 1955; Jonker and Volgenant 1987). The result is exact and takes far less than a
/// millisecond for twenty robots and a hundred frontiers, so an auction or a greedy choice would
/// have no advantage. A row gets no column if every column costs [`NEVER`].
///
/// All rows of `costs` must have the same length, and each cost must be at most [`NEVER`].
pub(super) fn assign(costs: &[Vec<i64>]) -> Vec<Option<usize>> {
    let rows = costs.len();
    let columns = costs.first().map_or(0, Vec::len);
    // `rows` additional columns stand for no assignment. Row and column 0 are auxiliary.
    let cost = |row: usize, column: usize| {
        costs[row - 1].get(column - 1).map_or(NEVER - 1, |cost| (*cost).min(NEVER))
    };
    let all = columns + rows;
    let mut of_row = vec![0i64; rows + 1];
    let mut of_column = vec![0i64; all + 1];
    let mut row_of = vec![0usize; all + 1];
    let mut before = vec![0usize; all + 1];
    for row in 1..=rows {
        row_of[0] = row;
        let mut column = 0;
        let mut least = vec![i64::MAX; all + 1];
        let mut used = vec![false; all + 1];
        // The cheapest chain of exchanges that ends at a free column.
        while row_of[column] != 0 {
            used[column] = true;
            let (row, mut delta, mut next) = (row_of[column], i64::MAX, 0);
            for other in (1..=all).filter(|other| !used[*other]) {
                let reduced = cost(row, other) - of_row[row] - of_column[other];
                if reduced < least[other] {
                    (least[other], before[other]) = (reduced, column);
                }
                if least[other] < delta {
                    (delta, next) = (least[other], other);
                }
            }
            for other in 0..=all {
                if used[other] {
                    of_row[row_of[other]] += delta;
                    of_column[other] -= delta;
                } else {
                    least[other] = least[other].saturating_sub(delta);
                }
            }
            column = next;
        }
        while column != 0 {
            row_of[column] = row_of[before[column]];
            column = before[column];
        }
    }
    let mut taken = vec![None; rows];
    for column in 1..=columns {
        if row_of[column] != 0 && cost(row_of[column], column) < NEVER {
            taken[row_of[column] - 1] = Some(column - 1);
        }
    }
    taken
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The minimum cost of assigning columns that are not taken to the rows from `row` on.
    fn least(costs: &[Vec<i64>], row: usize, taken: &mut Vec<bool>) -> i64 {
        if row == costs.len() {
            return 0;
        }
        let mut best = NEVER - 1 + least(costs, row + 1, taken);
        for column in 0..taken.len() {
            if !taken[column] {
                taken[column] = true;
                best = best.min(costs[row][column] + least(costs, row + 1, taken));
                taken[column] = false;
            }
        }
        best
    }

    proptest! {
        #[test]
        fn no_other_assignment_is_cheaper(
            columns in 0usize..6,
            cells in proptest::collection::vec(
                prop_oneof![4 => -5_000i64..50_000, 1 => Just(NEVER)], 36),
            rows in 0usize..6,
        ) {
            let costs: Vec<Vec<i64>> = cells.chunks(6).take(rows)
                .map(|row| row[..columns].to_vec()).collect();
            let taken = assign(&costs);
            let mut sorted: Vec<usize> = taken.iter().flatten().copied().collect();
            sorted.sort_unstable();
            let count = sorted.len();
            sorted.dedup();
            prop_assert_eq!(sorted.len(), count, "a column is assigned twice");
            let of = |(row, column): (usize, &Option<usize>)| column.map_or(NEVER - 1, |it| costs[row][it]);
            let sum: i64 = taken.iter().enumerate().map(of).sum();
            prop_assert_eq!(sum, least(&costs, 0, &mut vec![false; columns]));
        }
    }
}
