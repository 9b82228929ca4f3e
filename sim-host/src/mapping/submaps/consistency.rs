//! Mutual consistency of loop closures: the largest set in which each two agree (pairwise consistent
//! measurement set maximisation; Mangelsen et al., ICRA 2018).

/// Sets of up to a few thousand members, as bits.
type Bits = Vec<u64>;

/// Maximum number of branches of the search; then the best set found is returned.
const BRANCHES: usize = 20_000;

/// The members of the largest set in which each two are consistent, in rising order. `consistent`
/// tells whether two of `count` members are; it must be symmetric. The search begins with `known`, a
/// consistent set, and what can be added to it. Exact for a few dozen members, and for some hundred if
/// most belong together; after 20,000 branches the best set found is returned.
pub fn largest_consistent(
    count: usize,
    known: &[usize],
    consistent: impl Fn(usize, usize) -> bool,
) -> Vec<usize> {
    let words = count.div_ceil(64);
    let mut adjacent = vec![vec![0u64; words]; count];
    for first in 0..count {
        for second in first + 1..count {
            if consistent(first, second) {
                adjacent[first][second / 64] |= 1 << (second % 64);
                adjacent[second][first / 64] |= 1 << (first % 64);
            }
        }
    }
    let mut best = known.to_vec();
    for (member, near) in adjacent.iter().enumerate() {
        let fits = |&other: &usize| near[other / 64] >> (other % 64) & 1 == 1;
        if best.iter().all(fits) {
            best.push(member);
        }
    }
    let mut search = Search { adjacent, best, branches: 0 };
    let mut all = vec![0u64; words];
    (0..count).for_each(|member| all[member / 64] |= 1 << (member % 64));
    search.grow(&mut Vec::new(), all);
    search.best.sort_unstable();
    search.best
}

/// The search of Tomita and Seki (2003): a colouring bounds the size of the set that candidates can
/// form.
struct Search {
    adjacent: Vec<Bits>,
    best: Vec<usize>,
    branches: usize,
}

impl Search {
    fn grow(&mut self, set: &mut Vec<usize>, mut candidates: Bits) {
        self.branches += 1;
        let coloured = self.coloured(&candidates);
        if coloured.is_empty() && set.len() > self.best.len() {
            self.best.clone_from(set);
        }
        for &(member, colours) in coloured.iter().rev() {
            if set.len() + colours <= self.best.len() || self.branches > BRANCHES {
                return;
            }
            set.push(member);
            let mut rest = candidates.clone();
            rest.iter_mut().zip(&self.adjacent[member]).for_each(|(word, mask)| *word &= mask);
            self.grow(set, rest);
            set.pop();
            candidates[member / 64] &= !(1 << (member % 64));
        }
    }

    /// The candidates with the number of colours up to each: no two neighbours have the same colour.
    fn coloured(&self, candidates: &Bits) -> Vec<(usize, usize)> {
        let mut coloured = Vec::new();
        let mut left = candidates.clone();
        let mut colour = 0;
        while left.iter().any(|word| *word != 0) {
            colour += 1;
            let mut open = left.clone();
            while let Some(word) = open.iter().position(|word| *word != 0) {
                let member = word * 64 + open[word].trailing_zeros() as usize;
                left[word] &= !(1 << (member % 64));
                open[word] &= !(1 << (member % 64));
                open.iter_mut().zip(&self.adjacent[member]).for_each(|(it, mask)| *it &= !mask);
                coloured.push((member, colour));
            }
        }
        coloured
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        /// Against all subsets.
        #[test]
        fn the_largest_set_is_found(count in 0usize..12, pairs in any::<[u16; 12]>()) {
            let consistent = |a: usize, b: usize| pairs[a.min(b)] >> a.max(b) & 1 == 1;
            let found = largest_consistent(count, &[], consistent);
            let is_set = |members: &[usize]| {
                members.iter().all(|&a| members.iter().all(|&b| a == b || consistent(a, b)))
            };
            prop_assert!(is_set(&found));
            let known = &found[..found.len() / 2];
            prop_assert_eq!(largest_consistent(count, known, consistent).len(), found.len());
            for subset in 0u32..1 << count {
                let members: Vec<usize> = (0..count).filter(|&it| subset >> it & 1 == 1).collect();
                prop_assert!(members.len() <= found.len() || !is_set(&members));
            }
        }
    }
}
