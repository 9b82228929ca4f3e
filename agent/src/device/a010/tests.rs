use super::*;
use crate::sense::{Camera, Pick, Slice, Validity};
use proptest::prelude::*;
use std::{string::String, vec, vec::Vec};

const CONFIG: A010Config = match A010Config::for_port(115_200) {
    Some(config) => config,
    None => panic!("the port carries the coarsest frames"),
};
const SLICE: Slice = Slice::Band { first: 11, rows: 3, pick: Pick::Nearest };
/// Time of a byte at 115,200 baud, in microseconds, rounded down.
const BYTE: u64 = 86;

/// A frame of 25 by 25 pixels of one value, by the table of the module.
fn frame(pixel: u8, number: u16) -> Vec<u8> {
    let [low, high] = (625u16 + 16).to_le_bytes();
    let [number_low, number_high] = number.to_le_bytes();
    let mut bytes = vec![0x00, 0xFF, low, high, 0xFF, 0, 30, 31, 1, 2, 3, 4, 0, 0, 25, 25];
    bytes.extend([number_low, number_high, 9, 0xFF]);
    bytes.extend([pixel; 625]);
    bytes.push(bytes.iter().fold(0, |sum: u8, &byte| sum.wrapping_add(byte)));
    bytes.push(0xDD);
    bytes
}

/// Calls `test` with a driver.
fn with_driver<T>(config: A010Config, test: impl FnOnce(&mut A010<'_>) -> T) -> T {
    let side = config.binning.side();
    let camera = Camera::new((15.4, 15.4), (12.0, 12.0));
    let mut buffer = vec![0; SLICE.buffer_len(side)];
    let slicer = Slicer::new(SLICE, camera, side, Validity::default(), &mut buffer).unwrap();
    test(&mut A010::new(config, slicer).unwrap())
}

/// The first reading of each scan in `bytes`, which arrive in chunks of these sizes.
fn scans(driver: &mut A010<'_>, bytes: &[u8], chunk: usize) -> Vec<u16> {
    let mut found = Vec::new();
    for mut bytes in bytes.chunks(chunk) {
        while let Some(scan) = driver.receive(&mut bytes, Instant(1_000_000)) {
            assert_eq!(scan.readings.len(), 25);
            assert!(scan.readings.iter().all(|reading| *reading == scan.readings[0]));
            found.push(scan.readings[0]);
        }
    }
    found
}

#[test]
fn a_frame_becomes_a_scan_in_any_chunks() {
    for chunk in [1, 7, 20, 300, 1_000] {
        let bytes: Vec<u8> = (1..4).flat_map(|pixel| frame(pixel, 0)).collect();
        let found = with_driver(CONFIG, |driver| scans(driver, &bytes, chunk));
        assert_eq!(found, [10, 20, 30], "chunks of {chunk} bytes");
    }
}

#[test]
fn a_frame_cut_at_any_byte_costs_that_scan_alone() {
    let (first, second) = (frame(50, 1), frame(60, 2));
    for cut in 0..first.len() {
        let bytes = [&first[..cut], &second, &frame(70, 3)].concat();
        with_driver(CONFIG, |driver| {
            assert_eq!(scans(driver, &bytes, 64), [600, 700], "cut after {cut} bytes");
            // After 18 bytes the start of the second frame completes the first one's header.
            let torn = u32::from(cut >= HEADER || cut == 18);
            assert_eq!(driver.counters(), SensorCounters { frames: 2, torn, restarts: 0 });
            // The beginning is lost instead of the end.
            let bytes = [&first[first.len() - cut..], &second].concat();
            assert_eq!(scans(driver, &bytes, 64), [600], "the last {cut} bytes");
        });
    }
}

#[test]
fn a_damaged_byte_costs_one_scan_at_most() {
    let frames: Vec<_> = [50, 60, 70].map(|pixel| frame(pixel, 1)).concat();
    for place in 0..frame(0, 0).len() {
        let mut bytes = frames.clone();
        bytes[place] ^= 0x10;
        let found = with_driver(CONFIG, |driver| scans(driver, &bytes, 100));
        assert_eq!(found, [600, 700], "byte {place}");
    }
}

#[test]
fn depths_are_in_steps_or_grow_quadratically() {
    assert_eq!([0, 1, 254, 255].map(|pixel| depth(pixel, 10)), [0, 10, 2_540, 0]);
    // (p / 5.1)^2
    assert_eq!([0, 51, 102, 254].map(|pixel| depth(pixel, 0)), [0, 100, 400, 2_480]);
}

#[test]
fn a_scan_was_taken_before_its_first_byte() {
    let bytes = frame(9, 0);
    let latency = CONFIG.latency.micros();
    let length = bytes.len() as u64;
    // All bytes at once, long after they have arrived: the sum of their times is the bound.
    let taken = with_driver(CONFIG, |driver| {
        driver.receive(&mut &bytes[..], Instant(5_000_000)).unwrap().taken
    });
    assert!(taken.0.abs_diff(5_000_000 - latency - length * BYTE) < length, "{taken:?}");
    // A late chunk does not delay the scan, because the earlier ones show when it began.
    let taken = with_driver(CONFIG, |driver| {
        let (early, late) = bytes.split_at(300);
        assert_eq!(driver.receive(&mut &early[..], Instant(5_000_000)), None);
        driver.receive(&mut &late[..], Instant(6_000_000)).unwrap().taken
    });
    assert!(taken.0.abs_diff(5_000_000 - latency - 300 * BYTE) < length, "{taken:?}");
}

#[test]
fn the_port_decides_on_the_binning() {
    let binning = |baud, rate| Binning::for_port(baud, rate);
    assert_eq!(binning(115_200, 10), Some(Binning::Four));
    assert_eq!(binning(115_200, 4), Some(Binning::Two));
    assert_eq!(binning(115_200, 1), Some(Binning::One));
    assert_eq!(binning(3_000_000, 19), Some(Binning::One));
    assert_eq!(binning(9_600, 10), None);
}

/// The commands sent until the sensor should stream, when `answers` says which are answered.
fn commands(driver: &mut A010<'_>, answers: impl Fn(&str) -> bool) -> Vec<String> {
    let mut sent = Vec::new();
    let mut out = [0; 32];
    for millis in 0..10_000 {
        let now = Instant(millis * 1_000);
        while let Some(length) = driver.poll_transmit(now, &mut out) {
            let command = String::from_utf8(out[..length].to_vec()).unwrap();
            if answers(&command) {
                assert_eq!(driver.receive(&mut &b"OK\r\n"[..], now), None);
            }
            sent.push(command);
        }
        if matches!(driver.setup, Setup::Done { .. }) {
            break;
        }
    }
    sent
}

#[test]
fn the_sensor_is_configured_and_configured_again_after_silence() {
    let all =
        ["AT+DISP=0\r", "AT+ISP=1\r", "AT+BINN=4\r", "AT+UNIT=10\r", "AT+FPS=10\r", "AT+DISP=4\r"];
    with_driver(CONFIG, |driver| {
        assert_eq!(commands(driver, |_| true), all);
        let mut out = [0; 32];
        let silent = driver.poll_timeout();
        assert_eq!(driver.poll_transmit(Instant(silent.0 - 1), &mut out), None);
        assert_eq!(driver.poll_transmit(silent, &mut out), Some(10));
        assert_eq!(driver.counters().restarts, 1);
    });
    // A command without an answer is repeated, and then left.
    with_driver(CONFIG, |driver| {
        let sent = commands(driver, |command| command != "AT+UNIT=10\r");
        assert_eq!(sent.iter().filter(|it| *it == "AT+UNIT=10\r").count(), 3);
        assert_eq!(sent.len(), 8);
    });
}

#[test]
fn a_slicer_of_another_width_is_refused() {
    let camera = Camera::new((15.4, 15.4), (12.0, 12.0));
    let mut buffer = [0; 50];
    let slicer = Slicer::new(SLICE, camera, 50, Validity::default(), &mut buffer).unwrap();
    let refused = A010::new(CONFIG, slicer).err();
    assert_eq!(refused, Some(SliceError::Width { expected: 25, found: 50 }));
}

proptest! {
    /// Whole frames after any noise are read; noise alone never makes a panic.
    #[test]
    fn noise_costs_no_later_frame(
        noise in prop::collection::vec(any::<u8>(), 0..2_000), chunk in 1usize..200,
    ) {
        with_driver(CONFIG, |driver| {
            scans(driver, &noise, chunk);
            let found = scans(driver, &[frame(8, 1), frame(9, 2)].concat(), chunk);
            prop_assert_eq!(found, [80, 90]);
            Ok(())
        })?;
    }
}
