//! How much of the stack a robot takes, of images in the emulator: `cargo stack`, `cargo stack-m0`.

use ubimap_tests::{
    elf::Image,
    emulator::{Core, EmulatorError, count, firmware, image, leave_out, lines},
};

/// RAM of the reference board's firmware: static, the stack, and an interrupt upon it.
const RAM: usize = 24 * 1_024;

/// What an interrupt takes of the stack at the most: 108 bytes that the core saves, and 16 of its
/// handler, within which no other one comes.
const INTERRUPT: usize = 124;

/// The deepest stack, the robot on it: what it takes today, to the next hundred, and may only
/// improve.
const FIRMWARE_STACK: usize = 8_400;
const SMALLEST_STACK: usize = 8_700;

#[test]
fn the_firmware_with_its_stack_fits_its_ram() {
    let read = |path| Ok(Image::parse(&std::fs::read(path).unwrap()).unwrap());
    let measured = firmware().and_then(read).and_then(|image| Ok((image, deepest(Core::M4)?.1)));
    let (image, stack) = match measured {
        Ok(measured) => measured,
        Err(error) => return leave_out("the firmware's stack", &error),
    };
    let all = image.ram + stack + INTERRUPT;
    println!("{all:>12}  bytes of RAM: {} static, {stack} of stack, an interrupt", image.ram);
    assert!(all <= RAM, "{all} bytes of RAM");
    assert!(stack <= FIRMWARE_STACK, "{stack} bytes of stack");
}

#[test]
fn the_smallest_agent_runs_as_a_cortex_m0_does_and_holds_neither_panics_nor_a_heap() {
    let (image, stack) = match deepest(Core::M0) {
        Ok(measured) => measured,
        Err(error) => return leave_out("the robot on a Cortex-M0+", &error),
    };
    assert!(image.symbols.iter().any(|name| name == "main"), "no symbols: {image:?}");
    assert_eq!(image.panics_and_heap(), [""; 0]);
    assert!(stack <= SMALLEST_STACK, "{stack} bytes of stack");
}

/// The image that measures its stack, and the deepest that it found.
fn deepest(core: Core) -> Result<(Image, usize), EmulatorError> {
    let path = image("stack", core)?;
    let table = count(&path, Vec::new())?;
    print!("{table}");
    let deepest = lines(&table).find(|(_, name)| name.ends_with("at the most"));
    let Some((stack, _)) = deepest else { panic!("{table}") };
    Ok((Image::parse(&std::fs::read(path).unwrap()).unwrap(), stack as usize))
}
