use super::*;
use crate::sense::{Columns, fill_beams};
use proptest::prelude::*;
use std::{vec, vec::Vec};
use ubimap_protocol::units::Pose;

/// Points per turn at ten turns per second.
const PER_TURN: usize = 450;

/// A packet by the table of the module, of points with an angle in degrees, a distance and a
/// confidence.
fn packet(points: &[(f64, u16, u8); POINTS]) -> Vec<u8> {
    let angle = |degrees: f64| ((degrees * 100.0).round() as i32).rem_euclid(36_000) as u16;
    let mut bytes = vec![0x54, 0x2C, 0x10, 0x0E];
    bytes.extend(angle(points[0].0).to_le_bytes());
    for (_, distance, confidence) in points {
        bytes.extend(distance.to_le_bytes());
        bytes.push(*confidence);
    }
    bytes.extend(angle(points[11].0).to_le_bytes());
    bytes.extend([0x12, 0x34]);
    bytes.push(crc_by_division(&bytes));
    bytes
}

/// The remainder of a long division, bit by bit.
fn crc_by_division(bytes: &[u8]) -> u8 {
    let bits = bytes.iter().chain(&[0]).flat_map(|byte| (0..8).rev().map(move |i| byte >> i & 1));
    let remainder = bits.fold(0_u32, |remainder, bit| {
        let next = remainder << 1 | u32::from(bit);
        if next & 0x100 != 0 { next ^ 0x14D } else { next }
    });
    remainder as u8
}

/// Packets that begin at an angle in degrees, of what stands at each counter-clockwise bearing.
fn packets(from: f64, count: usize, seen: impl Fn(f64) -> (u16, u8)) -> Vec<Vec<u8>> {
    let point = |index: usize| {
        let clockwise = from + index as f64 * 360.0 / PER_TURN as f64;
        let (distance, confidence) = seen(180.0 - (clockwise - 180.0).rem_euclid(360.0));
        (clockwise, distance, confidence)
    };
    (0..count).map(|number| packet(&std::array::from_fn(|i| point(number * POINTS + i)))).collect()
}

/// The scans in `bytes`, which arrive in chunks of this size at the speed of the line.
fn scans(driver: &mut Ld06<'_>, bytes: &[u8], chunk: usize) -> Vec<(u64, Vec<u16>)> {
    let (mut found, mut arrived) = (Vec::new(), 0);
    for mut bytes in bytes.chunks(chunk) {
        arrived += bytes.len() as u64;
        let now = Instant(1_000_000 + arrived * 10_000_000 / u64::from(BAUD));
        while let Some(scan) = driver.receive(&mut bytes, now) {
            found.push((scan.taken.0, scan.readings.to_vec()));
        }
    }
    found
}

/// A different distance at each bearing.
fn spiral(bearing: f64) -> (u16, u8) {
    ((3_000.0 + 10.0 * bearing) as u16, 200)
}

#[test]
fn the_packet_of_the_manufacturers_manual_is_read() {
    // Its checksum is the manual's own, an oracle for both polynomials here.
    let bytes = [
        0x54, 0x2C, 0x68, 0x08, 0xAB, 0x7E, 0xE0, 0x00, 0xE4, 0xDC, 0x00, 0xE2, 0xD9, 0x00, 0xE5,
        0xD5, 0x00, 0xE3, 0xD3, 0x00, 0xE4, 0xD0, 0x00, 0xE9, 0xCD, 0x00, 0xE4, 0xCA, 0x00, 0xE2,
        0xC7, 0x00, 0xE9, 0xC5, 0x00, 0xE5, 0xC2, 0x00, 0xE5, 0xC0, 0x00, 0xE5, 0xBE, 0x82, 0x3A,
        0x1A, 0x50,
    ];
    assert_eq!([crc8(&bytes[..46]), crc_by_division(&bytes[..46])], [0x50; 2]);
    let packet = Packet::parse(&bytes[..46]).unwrap();
    // From 324.27 to 334.70 degrees: 144.27 degrees clockwise from behind.
    assert_eq!((packet.first, packet.span), (14_427, 1_043));
    assert_eq!((packet.distances[0], packet.distances[11]), (224, 192));
}

#[test]
fn a_turn_becomes_a_scan_by_rep_103_in_any_chunks() {
    let bytes = packets(100.0, 120, spiral).concat();
    for chunk in [1, 7, 46, 47, 300, 10_000] {
        let mut sectors = [9; 360];
        let mut driver = Ld06::new(&mut sectors);
        let found = scans(&mut driver, &bytes, chunk);
        // 120 packets are 3.2 turns; the first turn is not whole.
        assert_eq!(found.len(), 2, "chunks of {chunk} bytes");
        assert_eq!(driver.counters(), SensorCounters { frames: 2, torn: 0, restarts: 0 });
        let SensorModel::Radial { first, step } = Ld06::sensor(360) else { panic!() };
        for (_, scan) in &found {
            for (index, &reading) in scan.iter().enumerate() {
                let bearing = (f64::from(first) + index as f64 * f64::from(step)).to_degrees();
                // The nearest point of a sector of one degree: half a degree is 5 mm here.
                let expected = 3_000.0 + 10.0 * bearing;
                assert!((f64::from(reading) - expected).abs() <= 6.5, "{bearing}: {reading}");
            }
        }
        // When the bytes ahead of the sensor arrived, except that the line is faster than the sensor.
        assert!(chunk > 300 || found[0].0 < found[1].0);
    }
}

#[test]
fn a_scan_gives_a_distance_vector_of_all_directions() {
    let mut sectors = [0; 360];
    let mut driver = Ld06::new(&mut sectors);
    let found = scans(&mut driver, &packets(180.0, 80, spiral).concat(), 100);
    let mut beams = [crate::sense::Beam::default(); 360];
    fill_beams(&mut beams, Ld06::sensor(360), Pose::default());
    let columns = Columns::of_scan(&beams, &found[0].1, Pose::default(), 36).unwrap();
    assert_eq!((columns.distances.len(), columns.step), (36, 1_821));
    // To the right, ahead and to the left: 2.1 m, 3 m and 3.9 m in units of 2 cm, at the near end of a
    // column of ten degrees.
    for (column, expected) in [(9, 105), (18, 150), (27, 195)] {
        assert!(columns.distances[column].abs_diff(expected) <= 5, "{columns:?}");
    }
}

#[test]
fn zeros_are_nothing_in_range_weak_points_invalid_and_the_nearest_point_counts() {
    let seen = |bearing: f64| match bearing {
        // A point between two sectors belongs to the one on its right.
        ..=-90.0 => (0, 200),
        ..=0.0 => (700, 14),
        ..=90.0 => (700, 15),
        _ => (800, if bearing as i32 % 2 == 0 { 255 } else { 0 }),
    };
    let mut sectors = [0; 36];
    let found = scans(&mut Ld06::new(&mut sectors), &packets(180.0, 80, seen).concat(), 47);
    let quarters = [[NOTHING_IN_RANGE; 9], [0; 9], [700; 9], [800; 9]].concat();
    assert_eq!(found[0].1[1..], quarters[1..]);
}

#[test]
fn damage_at_any_byte_costs_the_points_of_one_packet() {
    let good = packets(180.0, 40, |_| (500, 99));
    for place in 0..PACKET {
        for cut in [false, true] {
            let mut damaged = good.clone();
            match cut {
                true => damaged[20].truncate(place),
                false => damaged[20][place] ^= 0x10,
            }
            let mut sectors = [0; 180];
            let found = scans(&mut Ld06::new(&mut sectors), &damaged.concat(), 64);
            let lost = found[0].1.iter().filter(|reading| **reading == 0).count();
            // 12 of 450 points are 9.6 degrees.
            assert!(found.len() == 1 && (4..=5).contains(&lost), "byte {place}: {lost} lost");
        }
    }
}

#[test]
fn a_turn_that_is_interrupted_is_dropped() {
    let turn = packets(180.0, 38, |_| (500, 99));
    let rest = packets(180.0 + 9.6, 50, |_| (600, 99));
    let mut sectors = [0; 180];
    let mut driver = Ld06::new(&mut sectors);
    // Ten packets, a pause, and whole turns: no reading is from before the pause.
    assert_eq!(scans(&mut driver, &turn[..10].concat(), 47), []);
    let (bytes, now) = (rest.concat(), Instant(5_000_000));
    let scan = driver.receive(&mut &bytes[..], now).unwrap();
    assert!(scan.readings.iter().all(|it| *it != 500), "{scan:?}");
    // Half of the packets of a turn are too few.
    let mut driver = Ld06::new(&mut sectors);
    let half: Vec<_> = packets(180.0, 80, |_| (500, 99)).into_iter().step_by(2).collect();
    assert_eq!(scans(&mut driver, &half.concat(), 47), []);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(100))]

    /// Whole turns after any noise are read; noise alone never makes a panic.
    #[test]
    fn noise_costs_no_later_turn(
        noise in prop::collection::vec(prop_oneof![any::<u8>(), Just(0x54), Just(0x2C)], 0..500),
        sectors in 0_usize..400, chunk in 1_usize..200,
    ) {
        let mut sectors = vec![0; sectors];
        let mut driver = Ld06::new(&mut sectors);
        scans(&mut driver, &noise, chunk);
        let bytes = packets(170.0, 80, |_| (777, 99)).concat();
        let found = scans(&mut driver, &bytes, chunk);
        prop_assert_eq!(found.len(), 2);
        prop_assert!(found[1].1.iter().all(|reading| *reading == 777));
    }

    /// Packets with a right checksum and any content never make a panic.
    #[test]
    fn any_content_is_taken(contents in prop::collection::vec(any::<[u8; 44]>(), 0..60)) {
        let mut sectors = [0; 100];
        let mut driver = Ld06::new(&mut sectors);
        for content in contents {
            let mut bytes = [&START[..], &content].concat();
            bytes.push(crc_by_division(&bytes));
            scans(&mut driver, &bytes, 47);
        }
    }
}
