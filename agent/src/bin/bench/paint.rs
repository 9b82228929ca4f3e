//! Measures the stack's depth by painting it: filling it with a known value, and looking for the
//! deepest word that was overwritten.
#![allow(unsafe_code, reason = "it reads and writes memory that nobody owns")]

use core::ptr::{read_volatile, with_exposed_provenance_mut, write_volatile};

use cortex_m::register::msp;

/// A value unlikely to appear on a stack.
const PAINT: u32 = 0xC5A3_5CCA;

/// Depth to which the stack is painted, in bytes; no stage goes as deep.
const DEPTH: usize = 32 * 1_024;

/// Paints the memory below the stack in use.
#[inline(never)]
pub(crate) fn paint() {
    words().for_each(|word| {
        // SAFETY: the word lies below the stack pointer and above the static memory, and no
        // interrupt is enabled.
        unsafe { write_volatile(word, PAINT) }
    });
}

/// Depth of the deepest word written since the stack was painted, in bytes.
#[inline(never)]
pub(crate) fn depth() -> usize {
    let written = |word: &*mut u32| {
        // SAFETY: as in `paint`.
        unsafe { read_volatile(*word) != PAINT }
    };
    let deepest = words().find(written).map_or(msp::read() as usize, |word| word.addr());
    top().saturating_sub(deepest)
}

/// The start of the stack: the first word of the vector table.
fn top() -> usize {
    unsafe extern "C" {
        safe static _stack_start: u32;
    }
    (&raw const _stack_start).addr()
}

/// The words below the stack in use, deepest first.
#[inline(always)]
fn words() -> impl Iterator<Item = *mut u32> {
    let start = top().saturating_sub(DEPTH).max(cortex_m_rt::heap_start().addr());
    (start..msp::read() as usize).step_by(size_of::<u32>()).map(with_exposed_provenance_mut)
}
