//! Stack usage of a robot, measured by images in the emulator: `cargo stack`, `cargo stack-m0`.

use ubimap_tests::{
    elf::Image,
    emulator::{Core, EmulatorError, count, image, leave_out, lines},
};

/// Maximum stack of a robot that does not drive, including the robot: the current usage, rounded up to
/// a hundred bytes. It may only be lowered. `tests/firmware.rs` measures the images.
const STACK: usize = 8_400;
/// Maximum stack of the smallest agent, on a Cortex-M0+.
const SMALLEST_STACK: usize = 8_700;

#[test]
#[ignore = "runs an image in the emulator: cargo thorough"]
fn a_robots_stack_is_bounded_in_all_stages() {
    match deepest(Core::M4) {
        Ok((_, stack)) => assert!(stack <= STACK, "{stack} bytes of stack"),
        Err(error) => leave_out("a robot's stack", &error),
    }
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
