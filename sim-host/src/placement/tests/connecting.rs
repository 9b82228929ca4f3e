//! Compares the graph of overlapping cameras with a pairwise computation.

use super::{
    super::{
        connection::{self, Connecting, Views, bridge},
        incidence::Incidence,
        programme::{ANY_OVERLAP, Demand, Goal, Programme},
    },
    programmes::{kinds, random},
};

/// The pieces of a placement, computed by joining pairs until nothing changes.
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
                    let pieces = connection::pieces(Views::of(&programme, shared), &chosen);
                    let count = pieces.iter().max().map_or(0, |last| last + 1);
                    assert_eq!(count, plain_pieces(&programme, &chosen, shared));
                }
            }
        }
    }
}

/// A corridor of required cells, each of which may be seen at most `at_most` times. There is a
/// candidate for each run of four cells.
fn corridor(cells: u32, at_most: u16) -> Programme {
    let rows = (0..=cells - 4).map(|first| (first..first + 4).collect::<Vec<u32>>());
    let demand = Demand { at_least: 1, at_most, weight: 1, is_required: true };
    let demands = vec![demand; cells as usize];
    Programme::new(demands, Incidence::from_rows(rows), Goal::Fewest { weight: 0 })
}

#[test]
fn cameras_are_moved_if_that_connects_them() {
    // Five cameras cover 18 cells in four pieces: 0-3, 4-7, 8-11, 12-15, 14-17. If each shared a
    // cell with the next, they would reach only 17 cells; but two pieces are possible.
    let programme = corridor(18, 3);
    let start = [0, 4, 8, 12, 14];
    assert_eq!(plain_pieces(&programme, &start, 1), 4);
    let mut search = Connecting::new(&programme, Views::of(&programme, 1), &start, 0, 1);
    search.run(20_000);
    let (pieces, chosen) = search.best().unwrap();
    assert_eq!((pieces, plain_pieces(&programme, chosen, 1)), (3, 3));
    assert!(programme.is_feasible(chosen) && chosen.len() == 5);
    // Over 16 cells one piece is possible.
    let programme = corridor(16, 3);
    let mut search =
        Connecting::new(&programme, Views::of(&programme, 1), &[0, 4, 8, 11, 12], 0, 1);
    search.run(50_000);
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
        let bridged = bridge(&programme, Views::of(&programme, 1), &start, 1);
        assert_eq!(plain_pieces(&programme, &bridged, 1), 1, "{bridged:?}");
        assert!(programme.is_feasible(&bridged), "{bridged:?}");
        assert!(bridged.len() <= 7, "{bridged:?}");
    }
    // If no overlap is allowed, nothing can be connected, and the placement stays as it is.
    let programme = corridor(16, 1);
    assert_eq!(bridge(&programme, Views::of(&programme, 1), &[0, 4, 8, 12], 1), [0, 4, 8, 12]);
}

#[test]
fn narrower_views_connect_less() {
    let programme = corridor(16, ANY_OVERLAP);
    // Each picture shows the two middle ones of the four cells.
    let rows = (0..=12u32).map(|first| [first + 1, first + 2]);
    let sees = Incidence::from_rows(rows);
    let seen_by = sees.transpose(16);
    let views = Views { sees: &sees, seen_by: &seen_by, shared: 1 };
    let start = [0, 3, 6, 9, 12];
    assert_eq!(plain_pieces(&programme, &start, 1), 1);
    let count = |chosen: &[u32]| connection::pieces(views, chosen).into_iter().max().unwrap() + 1;
    assert_eq!(count(&start), 5);
    let bridged = bridge(&programme, views, &start, 1);
    assert_eq!(count(&bridged), 1, "{bridged:?}");
    // From 0 to 12 in steps of one, as two steps share no cell.
    assert_eq!(bridged.len(), 13);
}

#[test]
fn separate_rooms_stay_separate() {
    let rows = [&[0, 1][..], &[1, 2], &[3], &[3, 4]];
    let demand = Demand { at_least: 1, at_most: ANY_OVERLAP, weight: 1, is_required: true };
    let programme =
        Programme::new(vec![demand; 6], Incidence::from_rows(rows), Goal::Fewest { weight: 0 });
    // Cells 0 to 2 form one room, 3 and 4 another; no candidate sees cell 5.
    assert_eq!(connection::fewest_pieces(&programme), 2);
    let bridged = bridge(&programme, Views::of(&programme, 1), &[0, 1, 3], 1);
    assert_eq!(plain_pieces(&programme, &bridged, 1), 2);
}
