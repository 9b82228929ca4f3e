//! Replays the fuzzer's corpus and a few thousand reproducible mutations of it.

use std::{
    fs,
    panic::{AssertUnwindSafe, catch_unwind},
    path::Path,
    time::{Duration, Instant},
};

use ubimap_tests::{
    device_fuzz::devices,
    fuzz::{frames, links, messages, tiles},
    port_fuzz::{overheard, parameters},
    vectors::hex,
};

/// Number of mutated inputs per target.
const CHANGED: usize = 3_000;
/// Maximum length of a mutated input.
const MAX_LEN: usize = 1_500;
/// Timeout per input, even on a busy machine: most take less than a millisecond.
const TIMEOUT: Duration = Duration::from_secs(10);

#[test]
fn frames_do_not_panic() {
    run("frames", frames);
}

#[test]
fn messages_do_not_panic() {
    run("messages", messages);
}

#[test]
fn tiles_do_not_panic() {
    run("tiles", tiles);
}

#[test]
fn links_do_not_panic() {
    run("links", links);
}

#[test]
fn devices_do_not_panic() {
    run("devices", devices);
}

#[test]
fn what_comes_from_a_port_does_not_panic() {
    run("overheard", overheard);
}

#[test]
fn words_for_parameters_do_not_panic() {
    run("parameters", parameters);
}

fn run(name: &str, target: fn(&[u8])) {
    let kept = kept(name);
    kept.iter().for_each(|input| check(target, input));
    let mut dice = Dice(name.len() as u64);
    for _ in 0..CHANGED {
        let mut input = kept[dice.below(kept.len())].clone();
        for _ in 0..1 + dice.below(6) {
            change(&mut input, &kept, &mut dice);
        }
        input.truncate(MAX_LEN);
        check(target, &input);
    }
}

fn kept(name: &str) -> Vec<Vec<u8>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/kept").join(name);
    let mut paths: Vec<_> =
        fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    paths.sort();
    assert!(paths.len() >= 5, "{name}: {} inputs", paths.len());
    paths.iter().map(|path| fs::read(path).unwrap()).collect()
}

fn check(target: fn(&[u8]), input: &[u8]) {
    let start = Instant::now();
    let result = catch_unwind(AssertUnwindSafe(|| target(input)));
    // The panic's own message was printed above.
    assert!(result.is_ok(), "the input was {}", hex(input));
    assert!(start.elapsed() < TIMEOUT, "too slow: {}", hex(input));
}

fn change(input: &mut Vec<u8>, kept: &[Vec<u8>], dice: &mut Dice) {
    let at = dice.below(input.len() + 1);
    let end = (at + 1 + dice.below(8)).min(input.len());
    match dice.below(7) {
        0 => input.insert(at, dice.byte()),
        1 => input.truncate(at),
        2 if at < end => drop(input.drain(at..end)),
        3 if at < end => {
            let again = input[at..end].to_vec();
            input.splice(at..at, again);
        }
        4 => {
            let other = &kept[dice.below(kept.len())];
            let from = dice.below(other.len() + 1);
            input.truncate(at);
            input.extend(&other[from..]);
        }
        5 if at < end => input[at] = [0, 1, 0x7F, 0x80, 0xFF][dice.below(5)],
        _ if at < end => input[at] ^= 1 << dice.below(8),
        _ => input.push(dice.byte()),
    }
}

/// SplitMix64.
struct Dice(u64);

impl Dice {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mixed = (self.0 ^ self.0 >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let mixed = (mixed ^ mixed >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
        mixed ^ mixed >> 31
    }

    fn below(&mut self, bound: usize) -> usize {
        (self.next() % bound as u64) as usize
    }

    fn byte(&mut self) -> u8 {
        self.next() as u8
    }
}
