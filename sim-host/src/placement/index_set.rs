//! A set of small integers with constant-time access to members by position.

/// A subset of the numbers below a bound. Every operation takes constant time.
#[derive(Clone, Debug)]
pub(super) struct IndexSet {
    members: Vec<u32>,
    /// For each integer its position in `members` plus one; zero if it is not a member.
    places: Vec<u32>,
}

impl IndexSet {
    /// The empty set of numbers below `bound`.
    pub(super) fn new(bound: usize) -> Self {
        Self { members: Vec::new(), places: vec![0; bound] }
    }

    /// The members, in arbitrary order.
    pub(super) fn members(&self) -> &[u32] {
        &self.members
    }

    /// Whether a number is a member.
    pub(super) fn contains(&self, member: u32) -> bool {
        self.places[member as usize] != 0
    }

    /// Adds an integer; no effect if it is already a member.
    pub(super) fn insert(&mut self, member: u32) {
        if !self.contains(member) {
            self.members.push(member);
            self.places[member as usize] = self.members.len() as u32;
        }
    }

    /// Removes an integer; no effect if it is not a member.
    pub(super) fn remove(&mut self, member: u32) {
        let place = std::mem::take(&mut self.places[member as usize]) as usize;
        if place > 0 {
            self.members.swap_remove(place - 1);
            if let Some(&moved) = self.members.get(place - 1) {
                self.places[moved as usize] = place as u32;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn members_come_and_go() {
        let mut set = IndexSet::new(5);
        [4, 0, 2, 4].into_iter().for_each(|it| set.insert(it));
        set.remove(4);
        set.remove(1);
        let mut members = set.members().to_vec();
        members.sort_unstable();
        assert_eq!(members, [0, 2]);
        assert!(set.contains(2) && !set.contains(4));
    }
}
