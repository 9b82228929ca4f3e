//! A NOR flash that loses its power at a chosen step.

use std::{vec, vec::Vec};

use super::slots::{NorFlash, Slot};

/// What a step leaves when the power is cut during it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Tear {
    /// Nothing has changed.
    Before,
    /// Some bits have changed, for good.
    Some,
    /// The bits that were to change read differently each time the power comes.
    Weak,
    /// Everything has changed, but the power is gone.
    After,
}

pub(super) const TEARS: [Tear; 4] = [Tear::Before, Tear::Some, Tear::Weak, Tear::After];

/// Two slots with words of `WORD` bytes. A step is the programming of a word, or an erasure.
#[derive(Clone, Debug)]
pub(super) struct Model<const WORD: usize> {
    cells: [Vec<u8>; 2],
    /// Bits that read differently each time the power comes.
    weak: [Vec<u8>; 2],
    /// Steps until the power is cut.
    left: Option<usize>,
    tear: Tear,
    pub(super) steps: usize,
    pub(super) erasures: usize,
    /// Whether writing has no effect, as in the emulator.
    pub(super) is_read_only: bool,
    noise: u32,
}

impl<const WORD: usize> Model<WORD> {
    pub(super) fn new(len: usize, noise: u32) -> Self {
        Self {
            cells: [vec![0xFF; len], vec![0xFF; len]],
            weak: [vec![0; len], vec![0; len]],
            left: None,
            tear: Tear::After,
            steps: 0,
            erasures: 0,
            is_read_only: false,
            noise,
        }
    }

    /// Cuts the power during the step after this number of steps.
    pub(super) fn cut_after(&mut self, steps: usize, tear: Tear) {
        (self.left, self.tear) = (Some(steps), tear);
    }

    pub(super) fn is_off(&self) -> bool {
        self.left == Some(usize::MAX)
    }

    /// The power comes back, and stays.
    pub(super) fn power_on(&mut self) {
        self.left = None;
        for slot in 0..2 {
            // All weak bits are read as 0, or as 1, or each as it likes.
            let as_read = [Some(0), Some(0xFF), None][usize::from(self.noise()) % 3];
            for at in 0..self.cells[slot].len() {
                let (weak, noise) = (self.weak[slot][at], as_read.unwrap_or(self.noise()));
                let cell = &mut self.cells[slot][at];
                *cell = *cell & !weak | noise & weak;
            }
        }
    }

    /// Bits of a slot fail.
    pub(super) fn damage(&mut self, slot: Slot, at: usize) {
        self.cells[slot as usize][at] ^= 0x10;
    }

    fn noise(&mut self) -> u8 {
        self.noise = self.noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (self.noise >> 20) as u8
    }

    /// Changes some bytes to `new` in one step.
    fn step(&mut self, slot: Slot, at: usize, new: &[u8]) {
        if self.is_off() || self.is_read_only {
            return;
        }
        self.steps += 1;
        let tear = match &mut self.left {
            Some(0) => {
                self.left = Some(usize::MAX);
                self.tear
            }
            left => {
                *left = left.map(|left| left - 1);
                Tear::After
            }
        };
        for (at, &new) in (at..).zip(new) {
            let noise = self.noise();
            let (cell, weak) =
                (&mut self.cells[slot as usize][at], &mut self.weak[slot as usize][at]);
            let changing = (*cell ^ new) | *weak;
            match tear {
                Tear::Before => {}
                Tear::Some => *cell ^= changing & noise,
                Tear::Weak => *weak |= changing,
                Tear::After => (*cell, *weak) = (new, 0),
            }
        }
    }
}

impl<const N: usize> NorFlash for Model<N> {
    const WORD: usize = N;

    fn slot_len(&self) -> usize {
        self.cells[0].len()
    }

    fn read(&self, slot: Slot, at: usize, bytes: &mut [u8]) {
        bytes.copy_from_slice(&self.cells[slot as usize][at..at + bytes.len()]);
    }

    fn program(&mut self, slot: Slot, at: usize, bytes: &[u8]) {
        assert!(at.is_multiple_of(N) && bytes.len().is_multiple_of(N), "{at}, {}", bytes.len());
        for (at, word) in (at..).step_by(N).zip(bytes.chunks_exact(N)) {
            let old = &self.cells[slot as usize][at..at + N];
            let is_allowed = self.is_off()
                || self.is_read_only
                || word.iter().all(|&byte| byte == 0)
                || old.iter().all(|&byte| byte == 0xFF);
            assert!(is_allowed, "programmed twice: {old:?}, {word:?}");
            self.step(slot, at, word);
        }
    }

    fn erase(&mut self, slot: Slot) {
        self.erasures += usize::from(!self.is_off());
        let erased = vec![0xFF; self.slot_len()];
        self.step(slot, 0, &erased);
    }
}
