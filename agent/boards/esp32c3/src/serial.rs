//! The serial ports. Their interrupts move received bytes from the hardware into queues, since the hardware
//! holds 128 bytes only: 11 ms at 115,200 baud.

use core::cell::RefCell;

use critical_section::Mutex;
use esp_hal::{
    Blocking, handler,
    interrupt::InterruptHandler,
    uart::{Uart, UartInterrupt},
};
use heapless::Deque;
use ubimap_agent::firmware::MAX_COMMAND;

/// Size of a queue in bytes: 22 ms at 230,400 baud, several times what the main loop takes at the most.
const QUEUE: usize = 512;

/// Number of bytes that the hardware holds.
const FIFO: usize = 128;

/// A serial port.
pub(crate) struct Serial {
    open: Mutex<RefCell<Option<Open>>>,
}

struct Open {
    uart: Uart<'static, Blocking>,
    received: Deque<u8, QUEUE>,
}

/// The port of the depth sensor.
pub(crate) static SENSOR: Serial = Serial::closed();
/// The port of the wheels.
pub(crate) static WHEELS: Serial = Serial::closed();

#[handler]
pub(crate) fn serve_sensor() {
    SENSOR.with(Open::serve);
}

#[handler]
pub(crate) fn serve_wheels() {
    WHEELS.with(Open::serve);
}

impl Serial {
    const fn closed() -> Self {
        Self { open: Mutex::new(RefCell::new(None)) }
    }

    /// Opens the port, with the interrupt that serves it.
    pub(crate) fn open(&self, mut uart: Uart<'static, Blocking>, interrupt: InterruptHandler) {
        uart.set_interrupt_handler(interrupt);
        critical_section::with(|cs| {
            let open = Open { uart, received: Deque::new() };
            self.open.borrow_ref_mut(cs).insert(open).uart.listen(UartInterrupt::RxFifoFull);
        });
    }

    fn with<T: Default>(&self, act: impl FnOnce(&mut Open) -> T) -> T {
        critical_section::with(|cs| self.open.borrow_ref_mut(cs).as_mut().map(act))
            .unwrap_or_default()
    }

    /// Whether nothing has arrived.
    pub(crate) fn is_empty(&self) -> bool {
        self.with(|open| !open.uart.read_ready() && open.received.is_empty())
    }

    /// Reads received bytes. Returns their number.
    pub(crate) fn read(&self, bytes: &mut [u8]) -> usize {
        self.with(|open| {
            open.serve();
            let received = core::iter::from_fn(|| open.received.pop_front());
            bytes.iter_mut().zip(received).map(|(place, byte)| *place = byte).count()
        })
    }

    /// Number of bytes that [`Serial::write`] accepts now: the hardware holds several commands.
    pub(crate) fn room(&self) -> usize {
        MAX_COMMAND
    }

    /// Sends bytes; those that the hardware has no room for are lost.
    pub(crate) fn write(&self, mut bytes: &[u8]) {
        self.with(|open| {
            while !bytes.is_empty() && open.uart.write_ready() {
                let Ok(count) = open.uart.write(bytes) else { break };
                bytes = bytes.get(count..).unwrap_or_default();
            }
        });
    }
}

impl Open {
    /// Moves bytes from the hardware to the queue. The checksums of the protocols detect what a full queue
    /// or the hardware loses.
    fn serve(&mut self) {
        let mut bytes = [0; FIFO];
        // An error is reported once, and clears itself.
        let count = self.uart.read_buffered(&mut bytes).unwrap_or_default();
        for &byte in bytes.iter().take(count) {
            let _ = self.received.push_back(byte);
        }
        self.uart.clear_interrupts(UartInterrupt::RxFifoFull.into());
    }
}
