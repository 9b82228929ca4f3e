//! The graph of overlapping cameras, against finding it pair by pair.

use super::{
    super::{
        connection::{self, Connecting, bridge},
        incidence::Incidence,
        programme::{ANY_OVERLAP, Demand, Goal, Programme},
    },
    programmes::{kinds, random},
};

/// Pieces of a placement, by joining pairs until nothing changes.
fn plain_pieces(programme: &Programme, chosen: &[u32], shared: u16) -> usize {
    let mut pieces: Vec<usize> = (0..chosen.len()).collect();
    loop {
        let mut has_changed = false;
        for (a, &one) in chosen.iter().enumerate() {
            for (b, &other) in chosen.iter().enumerate() {
                let others = programme.covers.row(other as usize);
                let cells = programme.covers.row(one as usize).iter();
                let common = cells.filter(|cell| others.contains(cell)).count();
                if common >= usize::from(shared) && pieces[a] < pieces[b] {
                    pieces[b] = pieces[a];
                    has_changed = true;
                }
            }
        }
        if !has_changed {
            break;
        }
    }
    pieces.sort_unstable();
    pieces.dedup();
    pieces.len()
}

#[test]
fn pieces_are_those_found_pair_by_pair() {
    for kind in kinds() {
        for seed in 0..50 {
            let programme = random(kind, seed);
            for bits in [0b1111_1111_1111u32, 0b101_0101_0101, 0b110_1101_1011] {
                let all = 0..programme.candidates() as u32;
                let chosen: Vec<u32> = all.filter(|it| bits & 1 << it != 0).collect();
                for shared in [1, 2] {
                    let pieces = connection::pieces(&programme, &chosen, shared);
                    let count = pieces.iter().max().map_or(0, |last| last + 1);
                    assert_eq!(count, plain_pieces(&programme, &chosen, shared));
                }
            }
        }
    }
}

/// A corridor of cells, all required, with a candidate for each run of four of them, covering no cell
/// more often than `at_most`.
fn corridor(cells: u32, at_most: u16) -> Programme {
    let rows = (0..=cells - 4).map(|first| (first..first + 4).collect::<Vec<u32>>());
    let demand = Demand { at_least: 1, at_most, weight: 1, is_required: true };
    let demands = vec![demand; cells as usize];
    Programme::new(demands, Incidence::from_rows(rows), Goal::Fewest { weight: 0 })
}

#[test]
fn cameras_are_moved_if_that_connects_them() {
    // Five cameras for 18 cells: 0-3, 4-7, 8-11, 12-15, 14-17 cover them in four pieces; moved so
    // that each shares a cell with the next, they reach 17 cells only; but two pieces are possible.
    let programme = corridor(18, 3);
    let start = [0, 4, 8, 12, 14];
    assert_eq!(plain_pieces(&programme, &start, 1), 4);
    let mut search = Connecting::new(&programme, &start, 1, 0, 1);
    search.run(20_000, 1);
    let (pieces, chosen) = search.best().unwrap();
    assert_eq!((pieces, plain_pieces(&programme, chosen, 1)), (3, 3));
    assert!(programme.is_feasible(chosen) && chosen.len() == 5);
    // With 16 cells there is room for all.
    let programme = corridor(16, 3);
    let mut search = Connecting::new(&programme, &[0, 4, 8, 11, 12], 1, 0, 1);
    search.run(50_000, 1);
    let (pieces, chosen) = search.best().unwrap();
    assert_eq!((pieces, plain_pieces(&programme, chosen, 1)), (1, 1), "{chosen:?}");
    assert!(programme.is_feasible(chosen));
}

#[test]
fn cameras_are_added_if_moving_is_not_enough() {
    for at_most in [2, ANY_OVERLAP] {
        let programme = corridor(16, at_most);
        let start = [0, 4, 8, 12];
        assert_eq!(plain_pieces(&programme, &start, 1), 4);
        let bridged = bridge(&programme, &start, 1, 1);
        assert_eq!(plain_pieces(&programme, &bridged, 1), 1, "{bridged:?}");
        assert!(programme.is_feasible(&bridged), "{bridged:?}");
        assert!(bridged.len() <= 7, "{bridged:?}");
    }
    // Nothing may overlap: nothing can be done, and nothing is broken.
    let programme = corridor(16, 1);
    assert_eq!(bridge(&programme, &[0, 4, 8, 12], 1, 1), [0, 4, 8, 12]);
}

#[test]
fn separate_rooms_stay_separate() {
    let rows = [&[0, 1][..], &[1, 2], &[3], &[3, 4]];
    let demand = Demand { at_least: 1, at_most: ANY_OVERLAP, weight: 1, is_required: true };
    let programme =
        Programme::new(vec![demand; 6], Incidence::from_rows(rows), Goal::Fewest { weight: 0 });
    // Cells 0 to 2, and 3 and 4; nobody sees cell 5.
    assert_eq!(connection::fewest_pieces(&programme), 2);
    let bridged = bridge(&programme, &[0, 1, 3], 1, 1);
    assert_eq!(plain_pieces(&programme, &bridged, 1), 2);
}
