//! The firmware in an emulated STM32F405, over its serial port.

use std::time::{Duration, Instant};

use ubimap_sim_host::channel::serial::SerialPort;
use ubimap_tests::{
    elf::Image,
    emulator::{Emulator, EmulatorError, firmware, leave_out},
};

/// How long the slowest exchange may take on a busy machine.
const PATIENCE: Duration = Duration::from_secs(60);

fn start() -> Result<(Emulator, SerialPort), EmulatorError> {
    let emulator = Emulator::start(&firmware()?)?;
    let port = SerialPort::open(emulator.port(), 115_200)
        .map_err(|error| EmulatorError::Failed(error.to_string()))?;
    Ok((emulator, port))
}

#[test]
fn the_image_fits_and_holds_neither_panics_nor_a_heap() {
    let path = match firmware() {
        Ok(path) => path,
        Err(error) => return leave_out("the firmware's image", &error),
    };
    let image = Image::parse(&std::fs::read(path).unwrap()).unwrap();
    assert!(image.symbols.iter().any(|name| name == "main"), "no symbols: {image:?}");
    let unwanted: Vec<_> = image
        .symbols
        .iter()
        .filter(|name| ["panicking", "_failed", "__rust_alloc"].iter().any(|s| name.contains(s)))
        .collect();
    assert!(unwanted.is_empty(), "{unwanted:?}");
    assert!(image.flash <= 64 * 1024, "{} bytes of flash", image.flash);
    assert!(image.ram <= 24 * 1024, "{} bytes of RAM", image.ram);
}

#[test]
fn no_byte_is_lost_on_its_way_there_and_back() {
    let (_emulator, mut port) = match start() {
        Ok(started) => started,
        Err(error) => return leave_out("the firmware's serial port", &error),
    };
    let mut buffer = [0; 4096];
    let start = Instant::now();
    // What arrives before the firmware has set up its port is lost, as on the chip.
    while port.read_within(&mut buffer, Duration::from_millis(200)).unwrap() == 0 {
        assert!(start.elapsed() < PATIENCE, "no sign of life");
        port.write(b"\n").unwrap();
    }
    while port.read_within(&mut buffer, Duration::from_millis(500)).unwrap() > 0 {}

    let mut state = 1_u32;
    let sent: Vec<u8> = (0..50_000)
        .map(|_| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 24) as u8
        })
        .collect();
    let mut frames = sent.chunks(250).peekable();
    let mut received = Vec::new();
    while received.len() < sent.len() {
        assert!(start.elapsed() < PATIENCE, "{} of {} bytes", received.len(), sent.len());
        // A frame that the port does not take now stays the next one.
        let _ = frames.next_if(|frame| port.write(frame).is_ok());
        let count = port.read_within(&mut buffer, Duration::from_millis(1)).unwrap();
        received.extend_from_slice(&buffer[..count]);
    }
    assert!(received == sent, "bytes changed on the way");
}
