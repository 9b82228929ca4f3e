//! Two DC motors with encoders at a Pico, by a TB6612 or the like.

use core::{
    cell::Cell,
    sync::atomic::{AtomicU32, Ordering},
};

use cortex_m::interrupt::{self as interrupts, Mutex};
use embedded_hal::digital::InputPin;
use ubimap_agent::device::{pwm_motors, quadrature::Quadrature};
use ubimap_protocol::time::Instant;

use super::{
    chip::hal::{
        gpio::{
            DynPinId, FunctionNull, FunctionSioInput, FunctionSioOutput,
            Interrupt::{EdgeHigh, EdgeLow},
            Pin, PullDown, PullUp,
            bank0::{Gpio16, Gpio17, Gpio18, Gpio19, Gpio20, Gpio21},
        },
        pac::{Interrupt, PWM, RESETS, interrupt},
        pwm::{A, B, Channel, FreeRunning, Pwm0, Slice, Slices},
    },
    unmask,
};

/// A pin after a reset.
type Reset<P> = Pin<P, FunctionNull, PullDown>;
type Input = Pin<DynPinId, FunctionSioInput, PullUp>;
type Output<P> = Pin<P, FunctionSioOutput, PullDown>;
type Motor<C, P, Q> = pwm_motors::Motor<Channel<Slice<Pwm0, FreeRunning>, C>, Output<P>, Output<Q>>;

/// The motors, the left and the right one.
pub(crate) type Motors = (LeftMotor, RightMotor);
pub(crate) type LeftMotor = Motor<A, Gpio18, Gpio19>;
pub(crate) type RightMotor = Motor<B, Gpio20, Gpio21>;

/// Number of steps of a motor's power: 20 kHz at 125 MHz, 24 kHz at 150 MHz, both inaudible.
const STEPS: u16 = 6_250;

/// Starts the PWM. Takes the pins for the powers of both motors, then those for the direction of each.
pub(super) fn start(
    pwm: PWM,
    resets: &mut RESETS,
    powers: (Reset<Gpio16>, Reset<Gpio17>),
    left: (Reset<Gpio18>, Reset<Gpio19>),
    right: (Reset<Gpio20>, Reset<Gpio21>),
) -> Motors {
    let mut slice = Slices::new(pwm, resets).pwm0;
    slice.set_top(STEPS - 1);
    slice.enable();
    let Slice { mut channel_a, mut channel_b, .. } = slice;
    channel_a.output_to(powers.0);
    channel_b.output_to(powers.1);
    let left = (left.0.into_push_pull_output(), left.1.into_push_pull_output());
    let right = (right.0.into_push_pull_output(), right.1.into_push_pull_output());
    (Motor::new(channel_a, left.0, left.1), Motor::new(channel_b, right.0, right.1))
}

/// The encoders' counts since boot, which wrap. The interrupt alone writes them.
static COUNTS: [AtomicU32; 2] = [const { AtomicU32::new(0) }; 2];

/// The encoders of the left and the right wheel, whose edges an interrupt counts.
pub(crate) struct Encoders {
    /// The counts that have been taken.
    taken: [u32; 2],
    /// When they were taken.
    pub(crate) since: Option<Instant>,
}

impl Encoders {
    /// Starts counting. Takes the pins of A and B of the left encoder, then of the right one.
    pub(super) fn start(pins: [[Input; 2]; 2]) -> Self {
        let encoders = pins.map(|pins| {
            for pin in &pins {
                pin.set_interrupt_enabled(EdgeHigh, true);
                pin.set_interrupt_enabled(EdgeLow, true);
            }
            Encoder { pins, state: Quadrature::default() }
        });
        interrupts::free(|cs| ENCODERS.borrow(cs).set(Some(encoders)));
        unmask(Interrupt::IO_IRQ_BANK0);
        Self { taken: [0; 2], since: None }
    }

    /// The counts of the left and the right wheel since the last call.
    pub(crate) fn take(&mut self) -> [i32; 2] {
        let counts = COUNTS.each_ref().map(|count| count.load(Ordering::Relaxed));
        let taken = core::mem::replace(&mut self.taken, counts);
        [counts[0].wrapping_sub(taken[0]) as i32, counts[1].wrapping_sub(taken[1]) as i32]
    }
}

struct Encoder {
    pins: [Input; 2],
    state: Quadrature,
}

/// Hands the encoders from the setup to the interrupt, which then owns them.
static ENCODERS: Mutex<Cell<Option<[Encoder; 2]>>> = Mutex::new(Cell::new(None));

#[interrupt]
fn IO_IRQ_BANK0() {
    static mut OWNED: Option<[Encoder; 2]> = None;
    if OWNED.is_none() {
        *OWNED = interrupts::free(|cs| ENCODERS.borrow(cs).take());
    }
    for (encoder, count) in OWNED.iter_mut().flatten().zip(&COUNTS) {
        // Cleared before the levels are read, so that no edge after it is lost.
        for pin in &mut encoder.pins {
            pin.clear_interrupt(EdgeHigh);
            pin.clear_interrupt(EdgeLow);
        }
        let [a, b] = encoder.pins.each_ref().map(|pin| pin.as_input().is_high().unwrap_or(false));
        let counts = encoder.state.update(a, b);
        count.store(count.load(Ordering::Relaxed).wrapping_add_signed(counts), Ordering::Relaxed);
    }
}
