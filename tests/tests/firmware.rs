//! The firmware in an emulated STM32F405, over its serial port.

use std::time::{Duration, Instant};

use ubimap_protocol::{
    frame::{Direction, MAX_FRAME},
    link::{Endpoint, Received},
    message::{Hello, ToServerKind, decode},
    time,
    units::RobotId,
};
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
fn the_firmware_says_hello() {
    let (_emulator, mut port) = match start() {
        Ok(started) => started,
        Err(error) => return leave_out("the firmware's hello", &error),
    };
    let mut link = Endpoint::<(), 1, MAX_FRAME>::new(Direction::ToRobot);
    let mut buffer = [0; 4096];
    let start = Instant::now();
    loop {
        assert!(start.elapsed() < PATIENCE, "no hello: {:?}", link.counters());
        let count = port.read_within(&mut buffer, Duration::from_millis(100)).unwrap();
        let mut bytes = &buffer[..count];
        while let Some(received) = link.receive(&mut bytes, time::Instant(0)) {
            let Received::Handshake(message) = received else { continue };
            assert_eq!(message.kind, ToServerKind::Hello as u8);
            let (hello, _) = decode::<Hello>(message.body).unwrap();
            assert_eq!(hello.robot, RobotId(1));
            return;
        }
    }
}
