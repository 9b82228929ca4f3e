//! Bit planes of any size, and the number of cells in which two of them agree.

/// Cells in a word.
const WORD: i32 = 32;

/// A rectangle of cells, one bit each; a word holds 32 cells of a row. Cells outside are clear.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct BitPlane {
    /// The south-western cell.
    corner: (i32, i32),
    /// Words in a row, and rows.
    size: (i32, i32),
    words: Vec<u32>,
}

/// The set cells of a shape as non-empty words, for comparing it with a [`BitPlane`].
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Shape {
    /// First column, row, and 32 cells.
    words: Vec<(i32, i32, u32)>,
    /// Number of set cells.
    count: u32,
}

impl BitPlane {
    /// The plane in which exactly these cells are set.
    pub fn of(cells: &[(i32, i32)]) -> Self {
        let Some(&first) = cells.first() else { return Self::default() };
        let (low, high) = cells.iter().fold((first, first), |(low, high), &(x, y)| {
            ((low.0.min(x), low.1.min(y)), (high.0.max(x), high.1.max(y)))
        });
        let mut plane = Self::covering(low, high);
        cells.iter().for_each(|&cell| plane.set(cell));
        plane
    }

    /// A clear plane that covers the rectangle between two cells, both included.
    fn covering(low: (i32, i32), high: (i32, i32)) -> Self {
        let size = ((high.0 - low.0) / WORD + 1, high.1 - low.1 + 1);
        Self { corner: low, size, words: vec![0; (size.0 * size.1) as usize] }
    }

    fn set(&mut self, (x, y): (i32, i32)) {
        let (x, y) = (x - self.corner.0, y - self.corner.1);
        if let Some(word) = self.words.get_mut((y * self.size.0 + x / WORD) as usize) {
            *word |= 1 << (x % WORD);
        }
    }

    /// Whether a cell is set.
    pub fn has(&self, (x, y): (i32, i32)) -> bool {
        self.window(x, y) & 1 != 0
    }

    /// The 32 cells of row `y` from column `x` on, the first in the lowest bit.
    fn window(&self, x: i32, y: i32) -> u32 {
        let (x, y) = (x - self.corner.0, y - self.corner.1);
        if y < 0 || y >= self.size.1 {
            return 0;
        }
        let (column, shift) = (x.div_euclid(WORD), x.rem_euclid(WORD));
        let word = |column: i32| {
            let within = column >= 0 && column < self.size.0;
            if within { u64::from(self.words[(y * self.size.0 + column) as usize]) } else { 0 }
        };
        (word(column) >> shift | (word(column + 1) << (WORD - shift))) as u32
    }

    /// The plane in which a cell is set if any cell of the rectangle from it by `from` to it by
    /// `to` (both included) is set here.
    pub fn spread(&self, from: (i32, i32), to: (i32, i32)) -> Self {
        if self.words.is_empty() {
            return Self::default();
        }
        let (x, y) = self.corner;
        let low = (x - to.0, y - to.1);
        let high = (x + self.size.0 * WORD - 1 - from.0, y + self.size.1 - 1 - from.1);
        let mut across = Self::covering((low.0, y), (high.0, y + self.size.1 - 1));
        across.fill(|x, y| (from.0..=to.0).fold(0, |any, by| any | self.window(x + by, y)));
        let mut spread = Self::covering(low, high);
        spread.fill(|x, y| (from.1..=to.1).fold(0, |any, by| any | across.window(x, y + by)));
        spread
    }

    fn fill(&mut self, cells: impl Fn(i32, i32) -> u32) {
        for row in 0..self.size.1 {
            for column in 0..self.size.0 {
                let (x, y) = (self.corner.0 + column * WORD, self.corner.1 + row);
                self.words[(row * self.size.0 + column) as usize] = cells(x, y);
            }
        }
    }

    /// Number of cells of a shape that are set here after the shape is moved by `(x, y)` cells.
    pub fn agreement(&self, shape: &Shape, (x, y): (i32, i32)) -> u32 {
        let agree = |&(column, row, cells): &(i32, i32, u32)| {
            (cells & self.window(column + x, row + y)).count_ones()
        };
        shape.words.iter().map(agree).sum()
    }
}

impl Shape {
    /// The shape of these cells; cells that occur several times count once.
    pub fn of(mut cells: Vec<(i32, i32)>) -> Self {
        cells.sort_unstable_by_key(|&(x, y)| (y, x));
        cells.dedup();
        let mut words: Vec<(i32, i32, u32)> = Vec::new();
        for &(x, y) in &cells {
            match words.last_mut() {
                Some((column, row, word)) if *row == y && x - *column < WORD => {
                    *word |= 1 << (x - *column);
                }
                _ => words.push((x, y, 1)),
            }
        }
        Self { words, count: cells.len() as u32 }
    }

    /// Number of set cells.
    pub fn count(&self) -> u32 {
        self.count
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use proptest::prelude::*;

    use super::*;

    fn cells() -> impl Strategy<Value = Vec<(i32, i32)>> {
        proptest::collection::vec((-70..70, -50..50), 0..60)
    }

    proptest! {
        #[test]
        fn planes_are_sets_of_cells(
            cells in cells(), other in cells(), by in (-40..40, -40..40),
            from in (-9..=0, -9..=0), to in (0..9, 0..9),
        ) {
            let set: BTreeSet<_> = cells.iter().copied().collect();
            let plane = BitPlane::of(&cells);
            let spread = plane.spread(from, to);
            for cell in (-90..90).flat_map(|x| (-70..70).map(move |y| (x, y))) {
                prop_assert_eq!(plane.has(cell), set.contains(&cell));
                let near = |&(x, y): &(i32, i32)| {
                    (cell.0 + from.0..=cell.0 + to.0).contains(&x)
                        && (cell.1 + from.1..=cell.1 + to.1).contains(&y)
                };
                prop_assert_eq!(spread.has(cell), set.iter().any(near));
            }
            let moved: BTreeSet<_> = other.iter().map(|&(x, y)| (x + by.0, y + by.1)).collect();
            let shape = Shape::of(other);
            prop_assert_eq!(shape.count() as usize, moved.len());
            prop_assert_eq!(plane.agreement(&shape, by) as usize, moved.intersection(&set).count());
        }
    }
}
