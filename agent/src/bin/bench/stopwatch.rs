//! The most instructions that a robot's calls take.

use core::fmt;

use cortex_m::Peripherals;
use ubimap_agent::Port;

use crate::{
    counter::{Bench, instructions},
    player::{Call, Watch},
};

/// The kinds of calls, with their names: what is called, and whether it maps a scan.
const KINDS: [(Call, bool, &str); 10] = [
    (Call::Timeout, false, "a step of the drive"),
    (Call::Timeout, true, "a step of the drive, and a scan mapped"),
    (Call::Receive(Port::Server), false, "bytes from the server"),
    (Call::Receive(Port::Server), true, "bytes from the server, and a scan mapped"),
    (Call::Receive(Port::Sensor), false, "bytes from the sensor"),
    (Call::Receive(Port::Sensor), true, "bytes from the sensor, and a scan mapped"),
    (Call::Receive(Port::Wheels), false, "bytes from the wheels, and a command to them"),
    (Call::Receive(Port::Wheels), true, "bytes from the wheels, and a scan mapped"),
    (Call::Transmit(Port::Server), false, "bytes for the server"),
    (Call::Transmit(Port::Wheels), false, "bytes for the wheels"),
];

/// Counts the instructions of each call.
pub(crate) struct Stopwatch {
    bench: Bench,
    /// For each kind: the most ticks of a call, their sum, and the number of calls.
    counts: [(u32, u64, u32); KINDS.len()],
}

impl Stopwatch {
    /// Starts SysTick; `None` if it is in use.
    pub(crate) fn new() -> Option<Self> {
        let core = Peripherals::take()?;
        Some(Self { bench: Bench::new(core.SYST), counts: Default::default() })
    }

    /// Writes a line for each kind of call: the most instructions, their mean, and the name.
    pub(crate) fn write(&self, out: &mut impl fmt::Write) -> fmt::Result {
        for ((most, sum, calls), (.., name)) in self.counts.into_iter().zip(KINDS) {
            let [most, sum] = [most.into(), sum].map(instructions);
            let mean = sum / u64::from(calls.max(1));
            writeln!(out, "instructions {most} at most, {mean} on average of {calls}: {name}")?;
        }
        Ok(())
    }
}

impl Watch for Stopwatch {
    fn watch(&mut self, call: impl FnOnce() -> (Call, bool)) {
        let (kind, ticks) = self.bench.count(call);
        let place = KINDS.iter().position(|&(call, mapped, _)| (call, mapped) == kind);
        if let Some((most, sum, calls)) = place.and_then(|place| self.counts.get_mut(place)) {
            // A call longer than SysTick's period would be the most.
            *most = (*most).max(ticks.unwrap_or(u32::MAX));
            *sum += u64::from(ticks.unwrap_or(u32::MAX));
            *calls += 1;
        }
    }
}
