//! The firmware in the emulator takes its number and its parameters from a provisioned image.
//!
//! The emulator ignores writing to flash: that boots are counted is shown by the agent's own tests, and
//! that a robot with a key refuses to run without is shown here.

use std::{
    fs,
    path::Path,
    time::{Duration, Instant},
};

use clap::Parser;
use ubimap_sim_host::{
    channel::serial::SerialPort,
    run::{
        decode::{self, DecodeOptions},
        keys,
        options::{KeysAction, KeysOptions},
        provision::{self, ProvisionOptions},
    },
};
use ubimap_tests::{
    elf::Image,
    emulator::{Emulator, leave_out, provisionable_firmware},
};

#[derive(Parser)]
struct CommandLine {
    #[command(flatten)]
    options: ProvisionOptions,
}

#[test]
#[ignore = "runs an image in the emulator: cargo real-time"]
fn the_image_says_its_number_and_without_one_moves_nothing() {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("provision");
    let _ = fs::remove_dir_all(&folder);
    fs::create_dir_all(&folder).unwrap();
    let image = match provisionable_firmware(&folder) {
        Ok(image) => image,
        Err(error) => return leave_out("the provisioned firmware", &error),
    };
    let elf = Image::parse(&fs::read(&image).unwrap()).unwrap();
    assert_eq!(elf.panics_and_heap(), [""; 0]);
    println!("flash: {} bytes", elf.flash);

    let [server, wheels] = said(&image);
    assert!(hello(&server, &folder).contains("robot: 0,"), "{}", hello(&server, &folder));
    assert_eq!(wheels, b"");

    let provision = |arguments: &[&str]| {
        let line = ["provision", image.to_str().unwrap()];
        let line = line.into_iter().chain(arguments.iter().copied());
        provision::run(&CommandLine::parse_from(line).options).unwrap()
    };
    provision(&["--id", "1234", "--set", "mounting-x=77"]);
    let [server, wheels] = said(&image);
    assert!(hello(&server, &folder).contains("robot: 1234,"), "{}", hello(&server, &folder));
    assert_ne!(wheels, b"");

    let dir = folder.join("keys");
    keys::run(&KeysOptions { action: KeysAction::Make { robot: 9 }, dir: dir.clone() }).unwrap();
    provision(&["--id", "9", "--key", dir.join("9.key").to_str().unwrap()]);
    assert_eq!(said(&image), [b"", b""], "its flash keeps no boot number");
}

/// What an image says to the server and to the wheels in its first seconds.
fn said(image: &Path) -> [Vec<u8>; 2] {
    let emulator = Emulator::start(image).unwrap();
    let mut ports = [0, 2].map(|port| SerialPort::open(&emulator.ports()[port], 115_200).unwrap());
    let mut said = [Vec::new(), Vec::new()];
    let start = Instant::now();
    while start.elapsed() < Duration::from_secs(6) {
        for (port, said) in ports.iter_mut().zip(&mut said) {
            let mut bytes = [0; 256];
            let count = port.read_within(&mut bytes, Duration::from_millis(50)).unwrap();
            said.extend(&bytes[..count]);
        }
    }
    said
}

/// The bytes to the server in words.
fn hello(bytes: &[u8], folder: &Path) -> String {
    let capture = folder.join("capture");
    fs::write(&capture, bytes).unwrap();
    let capture = vec![capture.display().to_string()];
    decode::run(&DecodeOptions { capture, to_server: true, to_robot: false, session: None })
        .unwrap()
}
