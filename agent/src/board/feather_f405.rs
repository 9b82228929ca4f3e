//! The Adafruit Feather STM32F405 Express.
//!
//! | printed | pin | use |
//! |---|---|---|
//! | TX, RX | PB10, PB11 | USART3, to and from the server |
//! | D6, D5 | PC6, PC7 | USART6, to and from the depth sensor |
//! | SCL, SDA | PB6, PB7 | USART1, to and from the wheels |
//! | D13 | PC1 | status LED (red), lit by a high level |

use cortex_m::Peripherals;
use stm32f4xx_hal::{
    gpio::{Output, PC1},
    pac,
    prelude::*,
};

use super::{
    Board, JournalPort,
    chip::{self, APB1_HZ, APB2_HZ, port},
    serial::{DEVICE_QUEUES, SERVER_QUEUES},
};

/// The status LED.
pub(crate) type Led = PC1<Output>;

impl Board {
    /// Sets up the board, with the baud rates of its three ports; `None` if it was set up before.
    pub(crate) fn take([server, sensor, wheels]: [u32; 3]) -> Option<Self> {
        #[cfg_attr(not(feature = "flash"), expect(unused_mut, reason = "its cycles are counted"))]
        let mut core = Peripherals::take()?;
        let chip = pac::Peripherals::take()?;
        let was_reset_by_watchdog = chip::was_reset_by_watchdog(&chip.RCC);
        let timer_hz = chip::start_pll(&chip.RCC, &chip.FLASH);
        let mut rcc = chip.RCC.constrain();
        chip::start_alarm(chip.TIM2, timer_hz, &mut rcc);
        #[cfg(feature = "flash")]
        chip::Clock::count_cycles(&mut core.DCB, &mut core.DWT);
        let clock = chip::Clock::start(core.SYST);

        let pins = chip.GPIOB.split(&mut rcc);
        pins.pb10.into_alternate::<7>();
        pins.pb11.into_alternate::<7>();
        let server = port!(USART3, APB1_HZ, chip.USART3, server, SERVER_QUEUES, &mut rcc)?;
        pins.pb6.into_alternate::<7>();
        pins.pb7.into_alternate::<7>();
        let wheels = port!(USART1, APB2_HZ, chip.USART1, wheels, DEVICE_QUEUES, &mut rcc)?;
        let pins = chip.GPIOC.split(&mut rcc);
        pins.pc6.into_alternate::<8>();
        pins.pc7.into_alternate::<8>();
        let sensor = port!(USART6, APB2_HZ, chip.USART6, sensor, DEVICE_QUEUES, &mut rcc)?;

        let led = pins.pc1.into_push_pull_output();
        let journal = JournalPort::open(chip.UART4, &mut rcc);
        let nonce = chip::boot_nonce(&chip.RNG, &mut rcc);
        // Before the watchdog starts, because erasing may take as long as its time.
        #[cfg(feature = "flash")]
        let mut flash = super::flash::Sectors(chip.FLASH);
        #[cfg(feature = "flash")]
        let identity = super::identity::identity(&mut flash);
        let watchdog = chip::Watchdog::start(chip.IWDG);
        let ports = [server, sensor, wheels];
        Some(Self {
            clock,
            ports,
            journal,
            #[cfg(feature = "in-step")]
            simulation: super::in_step::Simulation::open()?,
            led,
            watchdog,
            was_reset_by_watchdog,
            nonce,
            #[cfg(feature = "flash")]
            identity,
            #[cfg(feature = "flash")]
            flash,
        })
    }
}
