//! The port for recorded data.

use stm32f4xx_hal::{
    pac::{self, USART1},
    prelude::*,
    rcc::Enable,
};

/// USART1. The emulator waits until each byte has been read.
pub(crate) struct Port(USART1);

impl Port {
    /// Opens it; `None` if it was opened before.
    pub(crate) fn open() -> Option<Self> {
        let chip = pac::Peripherals::take()?;
        let mut rcc = chip.RCC.constrain();
        USART1::enable(&mut rcc);
        chip.USART1.cr1().write(|w| w.ue().set_bit().re().set_bit());
        Some(Self(chip.USART1))
    }

    pub(crate) fn byte(&mut self) -> u8 {
        while self.0.sr().read().rxne().bit_is_clear() {}
        self.0.dr().read().dr().bits() as u8
    }

    pub(crate) fn half_word(&mut self) -> u16 {
        u16::from_le_bytes([self.byte(), self.byte()])
    }

    pub(crate) fn word(&mut self) -> u32 {
        u32::from_le_bytes([self.byte(), self.byte(), self.byte(), self.byte()])
    }
}
