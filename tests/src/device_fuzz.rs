//! A fuzz target for the drivers of a robot's devices: arbitrary bytes in arbitrary pieces. It must
//! not panic on any input. The fuzzer's workspace (`fuzz/`) and the corpus test share this file.

use ubimap_agent::{
    device::{
        DepthSensor, Wheels,
        a010::{A010, A010Config},
        create2::Create2,
        ld06::Ld06,
    },
    drive::DriveCommand,
    sense::{Camera, Pick, Slice, Slicer, Validity},
};
use ubimap_protocol::time::{Duration, Instant};

/// Passes bytes to the drivers of a depth camera, a lidar and a mobile base. The first byte is the length
/// of the pieces; between two pieces some milliseconds pass, and commands are sent.
pub fn devices(data: &[u8]) {
    let Some((&length, data)) = data.split_first() else { return };
    let Some(config) = A010Config::for_port(115_200) else { return };
    let side = config.binning.side();
    let slice = Slice::Band { first: 11, rows: 3, pick: Pick::Median };
    let camera = Camera::new((17.9, 17.9), (12.0, 12.0));
    let mut buffer = [0; 75];
    let slicer = Slicer::new(slice, camera, side, Validity::default(), &mut buffer);
    let (Ok(slicer), mut base) = (slicer, Create2::new()) else { return };
    let Ok(mut sensor) = A010::new(config, slicer) else { return };

    let mut sectors = [0; 90];
    let mut lidar = Ld06::new(&mut sectors);

    let (mut now, mut out) = (Instant(1), [0; 32]);
    let (mut scans, mut reports) = (0, 0);
    for piece in data.chunks(usize::from(length).max(1)) {
        now = now + Duration::from_millis(u64::from(piece[0] % 64));
        let mut bytes = piece;
        while let Some(scan) = sensor.receive(&mut bytes, now) {
            assert_eq!(scan.readings.len(), side);
            assert!(scan.taken <= now);
            scans += 1;
        }
        assert!(bytes.is_empty());
        let mut bytes = piece;
        while let Some(scan) = lidar.receive(&mut bytes, now) {
            assert!(scan.taken <= now && scan.readings.len() == 90);
        }
        assert!(bytes.is_empty());
        let mut bytes = piece;
        while let Some(report) = base.receive(&mut bytes, now) {
            assert!(report.moment <= now);
            reports += 1;
        }
        assert!(bytes.is_empty());
        let turn = i16::from(piece[0]) * 20;
        base.drive(DriveCommand { speed: 500, turn }, now);
        while let Some(count) = sensor.poll_transmit(now, &mut out) {
            assert!(out[..count].starts_with(b"AT+") && out[..count].ends_with(b"\r"));
        }
        while base.poll_transmit(now, &mut out).is_some() {}
        assert!(sensor.poll_timeout() > now && base.poll_timeout() > now);
    }
    assert_eq!((sensor.counters().frames, base.counters().frames), (scans, reports));
}
