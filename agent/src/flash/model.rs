//! A NOR flash that loses its power at a chosen step.

use core::ops::{Deref, DerefMut};
use std::{vec, vec::Vec};

use super::{
    paged::{PAGE, Paged, PagedFlash},
    slots::{NorFlash, Slot},
};

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

/// Two slots. A step is the programming of a word or a page, or an erasure.
#[derive(Clone, Debug)]
pub(super) struct Model {
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
    pub(super) noise: u32,
}

impl Model {
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
                let weak = self.weak[slot][at];
                if weak == 0 {
                    continue;
                }
                let noise = as_read.unwrap_or_else(|| self.noise());
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

    /// Programs words of `N` bytes that follow each other, in one step. Words of ones are left alone.
    fn program<const N: usize>(&mut self, slot: Slot, at: usize, words: &[u8]) {
        let (words, rest) = words.as_chunks::<N>();
        assert!(at.is_multiple_of(N) && rest.is_empty(), "{at}, {words:?}, {rest:?}");
        let mut new = Vec::new();
        for (at, word) in (at..).step_by(N).zip(words) {
            let old = &self.cells[slot as usize][at..at + N];
            let is_left = word.iter().all(|&byte| byte == 0xFF);
            let is_allowed = self.is_off()
                || self.is_read_only
                || is_left
                || word.iter().all(|&byte| byte == 0)
                || old.iter().all(|&byte| byte == 0xFF);
            assert!(is_allowed, "programmed twice: {old:?}, {word:?}");
            new.extend(word.map(|byte| (!is_left).then_some(byte)));
        }
        self.step(slot, at, &new);
    }

    /// Changes some bytes in one step: those that are `Some`.
    fn step(&mut self, slot: Slot, at: usize, new: &[Option<u8>]) {
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
        for (at, new) in (at..).zip(new) {
            let &Some(new) = new else { continue };
            let noise = if tear == Tear::Some { self.noise() } else { 0 };
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

impl PagedFlash for Model {
    fn slot_len(&self) -> usize {
        self.cells[0].len()
    }

    fn read(&self, slot: Slot, at: usize, bytes: &mut [u8]) {
        bytes.copy_from_slice(&self.cells[slot as usize][at..at + bytes.len()]);
    }

    fn program(&mut self, slot: Slot, at: usize, page: &[u8; PAGE]) {
        assert!(at.is_multiple_of(PAGE), "{at}");
        self.program::<{ Paged::<Self>::WORD }>(slot, at, page);
    }

    fn erase(&mut self, slot: Slot) {
        self.erasures += usize::from(!self.is_off());
        let erased = vec![Some(0xFF); self.slot_len()];
        self.step(slot, 0, &erased);
    }
}

/// The model with words of `N` bytes.
#[derive(Clone, Debug)]
pub(super) struct Words<const N: usize>(pub(super) Model);

impl<const N: usize> NorFlash for Words<N> {
    const WORD: usize = N;

    fn slot_len(&self) -> usize {
        self.0.slot_len()
    }

    fn read(&self, slot: Slot, at: usize, bytes: &mut [u8]) {
        self.0.read(slot, at, bytes);
    }

    fn program(&mut self, slot: Slot, at: usize, bytes: &[u8]) {
        for (at, word) in (at..).step_by(N).zip(bytes.chunks(N)) {
            self.0.program::<N>(slot, at, word);
        }
    }

    fn erase(&mut self, slot: Slot) {
        self.0.erase(slot);
    }
}

/// A flash that is a model.
pub(super) trait Modelled: NorFlash + DerefMut<Target = Model> + Clone {
    fn of(model: Model) -> Self;
}

/// Makes a flash of a model.
macro_rules! modelled {
    ($flash:ty, $($generic:tt)*) => {
        impl<$($generic)*> Deref for $flash {
            type Target = Model;

            fn deref(&self) -> &Model {
                &self.0
            }
        }

        impl<$($generic)*> DerefMut for $flash {
            fn deref_mut(&mut self) -> &mut Model {
                &mut self.0
            }
        }

        impl<$($generic)*> Modelled for $flash {
            fn of(model: Model) -> Self {
                Self(model)
            }
        }
    };
}
modelled!(Words<N>, const N: usize);
modelled!(Paged<Model>,);
