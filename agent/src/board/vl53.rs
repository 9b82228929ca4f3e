//! A VL53L5CX or VL53L8CX at a Pico's I2C, at 400 kHz, 15 frames per second.
//!
//! The main loop reads it and stands still meanwhile: 10 ms per frame by the number of bytes, and 2 s at the
//! start, for the sensor's firmware.
//!
//! By ST's documents the distances are perpendicular to the sensor, and the lens turns the picture, so that the
//! first zone sees what is above on the right when the sensor stands as in its data sheet.

use core::{
    pin::pin,
    task::{Context, Poll, Waker},
};

use embedded_hal::delay::DelayNs as _;
use ubimap_agent::device::zones::{FRAME, SIDE, to_bytes};
use ubimap_protocol::time::{Duration, Instant};
use vl53_8x8::{BlockingI2c, Resolution};

use super::chip::{
    Clock,
    hal::{
        I2C,
        fugit::{HertzU32, RateExtU32},
        gpio::{
            FunctionI2C, FunctionNull, Pin, PullDown, PullUp,
            bank0::{Gpio8, Gpio9},
        },
        pac::{I2C0, RESETS},
    },
};

type Reset<P> = Pin<P, FunctionNull, PullDown>;
type Line<P> = Pin<P, FunctionI2C, PullUp>;
type Bus = BlockingI2c<I2C<I2C0, (Line<Gpio8>, Line<Gpio9>)>>;

/// Frames per second, the most that the sensor makes with 8 x 8 zones.
const RATE: u8 = 15;

/// Time between two questions whether a frame is ready.
const INTERVAL: Duration = Duration::from_millis(5);

/// Whether a distance is valid: ST calls 5 certain and 9 half certain.
const VALID: [u8; 2] = [5, 9];

/// The sensor.
pub(crate) struct ZoneSensor {
    driver: vl53_8x8::Sensor<Bus, Pause>,
    asked: Option<Instant>,
}

impl ZoneSensor {
    /// Starts the sensor. Takes its pins SDA and SCL, and the system's clock. `None` if it does not answer.
    pub(super) fn start(
        i2c: I2C0,
        (sda, scl): (Reset<Gpio8>, Reset<Gpio9>),
        resets: &mut RESETS,
        system: HertzU32,
        clock: Clock,
    ) -> Option<Self> {
        let bus = I2C::i2c0(i2c, sda.reconfigure(), scl.reconfigure(), 400.kHz(), resets, system);
        let mut driver = vl53_8x8::Sensor::new(BlockingI2c(bus), Pause(clock));
        ready(async {
            driver.init().await?;
            driver.set_resolution(Resolution::Res8x8).await?;
            driver.set_ranging_frequency_hz(RATE).await?;
            driver.start_ranging().await
        })
        .ok()?;
        Some(Self { driver, asked: None })
    }

    /// The next frame, if one is ready.
    pub(crate) fn frame(&mut self, now: Instant) -> Option<[u8; FRAME]> {
        if self.asked.is_some_and(|asked| now.since(asked) < INTERVAL) {
            return None;
        }
        self.asked = Some(now);
        if !ready(self.driver.check_data_ready()).ok()? {
            return None;
        }
        let data = ready(self.driver.get_ranging_data()).ok()?;
        let mut distances = [0; SIDE * SIDE];
        let zones = data.distance_mm.iter().zip(&data.target_status);
        for (zone, (&distance, status)) in zones.enumerate() {
            // The rows are from above, each from the right.
            let mirrored = zone / SIDE * SIDE + (SIDE - 1 - zone % SIDE);
            if let Some(place) = distances.get_mut(mirrored)
                && VALID.contains(status)
            {
                *place = distance.max(0).unsigned_abs();
            }
        }
        Some(to_bytes(&distances))
    }
}

/// The driver waits by the clock.
struct Pause(Clock);

impl embedded_hal_async::delay::DelayNs for Pause {
    async fn delay_ns(&mut self, ns: u32) {
        self.0.delay_ns(ns);
    }
}

/// Runs a future to its end: on a blocking bus it never waits for anything.
fn ready<T>(future: impl Future<Output = T>) -> T {
    let mut future = pin!(future);
    loop {
        if let Poll::Ready(result) = future.as_mut().poll(&mut Context::from_waker(Waker::noop())) {
            return result;
        }
    }
}
