//! The firmware of a robot with an A010 depth camera (with the feature `ld06`, an LD06 lidar) on an iRobot
//! Create 2, which maps and drives, and speaks to the server by UDP over Wi-Fi. For the ESP32-C3.
//!
//! The robot has no heap; the radio has one, and a scheduler, by which its driver's tasks interrupt the main
//! loop. Not emulated; never tried on a board.
#![no_std]
#![no_main]

#[cfg_attr(feature = "ld06", path = "../../../src/bin/firmware/lidar.rs")]
#[cfg_attr(not(feature = "ld06"), path = "../../../src/bin/firmware/configuration.rs")]
mod configuration;
#[path = "../../../src/bin/firmware/driving.rs"]
mod driving;
mod flash;
mod provisioned;
mod radio;
mod serial;
mod super_mini;

extern crate alloc;

use alloc::boxed::Box;
use core::panic::PanicInfo;

use esp_hal::{ram, system, time::Duration};
use esp_println::println;
use smoltcp::wire::IpEndpoint;
use static_cell::ConstStaticCell;
use ubimap_agent::{
    Machine, Memory,
    device::create2::Create2,
    drive::Driving,
    firmware::{self, Board as _, Fault},
    flash::{Identity, identify},
    memory,
};

use configuration::{BAUDS, BOUNDS, SLICE_LENGTH};
use radio::Radio;
use super_mini::{Board, Chip};
use udp_link::{Buffers, Link};

esp_bootloader_esp_idf::esp_app_desc!();

/// Sizes of the two parts of the radio's heap in bytes: what the boot loader leaves, and more.
const HEAPS: [usize; 2] = [64 << 10, 48 << 10];

/// The watchdog's time.
const WATCHDOG: Duration = Duration::from_secs(2);
/// The watchdog's time while the radio starts, which was never measured.
const RADIO_START: Duration = Duration::from_secs(10);

// Statics, not local variables, so that the image's size includes them.
static MEMORY: ConstStaticCell<memory!(BOUNDS, Driving)> = ConstStaticCell::new(Memory::EMPTY);
static SLICE: ConstStaticCell<[u16; SLICE_LENGTH]> = ConstStaticCell::new([0; SLICE_LENGTH]);
static BUFFERS: ConstStaticCell<Buffers> = ConstStaticCell::new(Buffers::EMPTY);

#[esp_hal::main]
fn main() -> ! {
    esp_alloc::heap_allocator!(#[ram(reclaimed)] size: HEAPS[0]);
    esp_alloc::heap_allocator!(size: HEAPS[1]);
    let Some((mut board, chip)) = Board::take(BAUDS) else { system::software_reset() };
    let fault = run(&mut board, chip);
    println!("ubimap: fault {}; see the table of faults", fault as u8);
    firmware::fail(&mut board, fault)
}

/// Starts the robot, and returns only if that fails.
fn run(board: &mut Board, chip: Chip) -> Fault {
    // Before the scheduler and the radio start, since erasing stops everything.
    let identity = identify(&mut board.flash, provisioned::seed());
    match &identity {
        Identity::Known(record, seal) => {
            let link = if seal.is_some() { "sealed" } else { "open" };
            println!("ubimap: robot {}, its link is {link}", record.robot.0);
        }
        Identity::Unknown => println!("ubimap: not provisioned: robot 0, which moves nothing"),
        Identity::NotKept => println!("ubimap: the flash does not keep the number of this boot"),
    }
    let Some(served) = identity.served() else { return Fault::Flash };
    let Some(wireless) = provisioned::wireless() else {
        println!("ubimap: no Wi-Fi network: ubimap provision IMAGE --wifi NAME --server ADDRESS");
        return Fault::Network;
    };
    println!("ubimap: Wi-Fi {}, server {}", wireless.name, wireless.server);

    let Some(sensor) = configuration::sensor(SLICE.take()) else { return Fault::Sensor };
    let config = identity.complete(configuration::config(chip.nonce));
    let config = config.with_drive(driving::driving());
    // Borrowed, because moving it would take twice its size of stack.
    let machine = &mut Machine::new(config, MEMORY.take(), sensor, Create2::new());
    let Ok(machine) = machine else { return Fault::Robot };

    esp_rtos::start(chip.scheduler_timer, chip.scheduler_interrupt);
    board.watch(RADIO_START);
    // The wheels may still turn from before a reset, and the radio takes a while.
    firmware::turn(board, machine, served, |_, _, _| {});
    let Ok(controller) = radio::start(chip.radio, &wireless) else { return Fault::Network };
    board.connection = Some(Box::pin(radio::stay_connected(controller)));
    let (server, now) = (IpEndpoint::from(wireless.server), board.now());
    board.link = Some(Link::new(Radio::new(), BUFFERS.take(), server, chip.nonce, now));
    board.watch(WATCHDOG);
    if chip.was_reset_by_watchdog {
        machine.report_watchdog(board.now());
    }
    firmware::run(board, machine, served, |_, _, _| {})
}

/// Resets on panic; the link recovers as after any boot.
#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    system::software_reset()
}
