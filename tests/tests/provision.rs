//! The firmware in the emulator takes its number and its parameters from a provisioned image.
//!
//! The emulator ignores writing to flash: that boots are counted is shown by the agent's own tests, and
//! that a robot with a key refuses to run without is shown here.

use std::{
    fs,
    path::Path,
    time::{Duration, Instant},
};

use ubimap_agent::flash::{MAGIC, Seed};
use ubimap_sim_host::{
    channel::serial::SerialPort,
    run::{
        decode::{self, DecodeOptions},
        keys,
        options::{KeysAction, KeysOptions},
    },
};
use ubimap_tests::{
    elf::Image,
    emulator::{self, Core, Emulator, leave_out, pico_firmware, provisionable_firmware},
};

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
        emulator::provision(&[&[image.to_str().unwrap()], arguments].concat());
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

#[test]
#[ignore = "builds images: cargo real-time"]
fn the_images_for_picos_become_uf2_files_that_their_roms_take() {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("picos");
    fs::create_dir_all(&folder).unwrap();
    // By the chips' data sheets: the family, where the vector table is, and the end of the RAM. By the boards': the end
    // of the flash.
    for (core, family, vectors, stack, end) in [
        (Core::M0, 0xE48B_FF56, 256, 0x2004_0000, 0x1020_0000),
        (Core::M33, 0xE48B_FF59, 0, 0x2008_0000, 0x1040_0000),
    ] {
        let image = match pico_firmware(core) {
            Ok(image) => image,
            Err(error) => return leave_out("the images for Picos", &error),
        };
        let elf = Image::parse(&fs::read(&image).unwrap()).unwrap();
        let slots = end - 2 * 4096;
        assert_eq!(elf.value("SLOTS"), Some(slots));
        let out = folder.join("robot.uf2");
        for (image, id) in [(&image, "7"), (&out, "8")] {
            let [image, out] = [image, &out].map(|path| path.to_str().unwrap());
            emulator::provision(&[image, "--id", id, "--out", out]);
        }
        let file = fs::read(&out).unwrap();
        let (blocks, rest) = file.as_chunks::<512>();
        assert!(rest.is_empty());
        let mut flash = Vec::new();
        for (index, block) in blocks.iter().enumerate() {
            let word = |at: usize| u32::from_le_bytes(block[at..at + 4].try_into().unwrap());
            let head: Vec<u32> = (0..8).map(|index| word(4 * index)).collect();
            let (index, count) = (index as u32, blocks.len() as u32);
            let address = 0x1000_0000 + 256 * index;
            let wanted = [0x0A32_4655, 0x9E5D_5157, 0x2000, address, 256, index, count, family];
            assert_eq!(head, wanted);
            assert_eq!(word(508), 0x0AB1_6F30);
            flash.extend(&block[32..288]);
        }
        assert!(0x1000_0000 + flash.len() <= slots, "{core:?}: the image reaches the slots");
        let word = |at: usize| u32::from_le_bytes(flash[at..at + 4].try_into().unwrap());
        assert_eq!(word(vectors), stack, "the initial stack pointer");
        let reset = word(vectors + 4);
        assert!(reset % 2 == 1 && (reset as usize) < 0x1000_0000 + flash.len(), "{reset:#x}");
        let seed = flash.windows(MAGIC.len()).position(|window| window == MAGIC).unwrap();
        let seed = Seed::parse(flash[seed..].first_chunk().unwrap()).unwrap();
        assert_eq!(seed.record.robot.0, 8);
    }
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
