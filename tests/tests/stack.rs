//! Stack usage of a robot, measured by images in the emulator: `cargo stack`, `cargo stack-m0`.

use ubimap_tests::{
    elf::Image,
    emulator::{Core, EmulatorError, count, firmware, image, leave_out, lines},
};

/// RAM budget of the reference board's firmware: static memory, the stack, and one interrupt.
const RAM: usize = 24 * 1_024;

/// Maximum stack usage of an interrupt: 108 bytes saved by the core, and 16 of its handler;
/// interrupts do not nest.
const INTERRUPT: usize = 124;

/// Maximum stack of the firmware, including the robot: the current usage, rounded up to a hundred
/// bytes. It may only be lowered.
const FIRMWARE_STACK: usize = 8_400;
/// Maximum stack of the smallest agent, on a Cortex-M0+.
const SMALLEST_STACK: usize = 8_700;

#[test]
#[ignore = "runs an image in the emulator: cargo thorough"]
fn the_firmware_with_its_stack_fits_its_ram() {
    let read = |path| Ok(Image::parse(&std::fs::read(path).unwrap()).unwrap());
    let measured = firmware().and_then(read).and_then(|image| Ok((image, deepest(Core::M4)?.1)));
    let (image, stack) = match measured {
        Ok(measured) => measured,
        Err(error) => return leave_out("the firmware's stack", &error),
    };
    let all = image.ram + stack + INTERRUPT;
    println!("{all:>12}  bytes of RAM: {} static, {stack} of stack, and an interrupt", image.ram);
    assert!(all <= RAM, "{all} bytes of RAM");
    assert!(stack <= FIRMWARE_STACK, "{stack} bytes of stack");
}

#[test]
#[ignore = "runs an image in the emulator: cargo thorough"]
fn the_smallest_agent_runs_on_a_cortex_m0_without_panics_or_heap() {
    let (image, stack) = match deepest(Core::M0) {
        Ok(measured) => measured,
        Err(error) => return leave_out("the robot on a Cortex-M0+", &error),
    };
    assert!(image.symbols.iter().any(|name| name == "main"), "no symbols: {image:?}");
    assert_eq!(image.panics_and_heap(), [""; 0]);
    assert!(stack <= SMALLEST_STACK, "{stack} bytes of stack");
}

/// The image that measures its stack, and the maximum depth that it reports.
fn deepest(core: Core) -> Result<(Image, usize), EmulatorError> {
    let path = image("stack", core)?;
    let table = count(&path, Vec::new())?;
    print!("{table}");
    let deepest = lines(&table).find(|(_, name)| name.ends_with("at the most"));
    let Some((stack, _)) = deepest else { panic!("{table}") };
    Ok((Image::parse(&std::fs::read(path).unwrap()).unwrap(), stack as usize))
}
