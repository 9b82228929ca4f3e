//! The Bitcraze Crazyflie 2.1, by its expansion connector.
//!
//! | printed | pin | use |
//! |---|---|---|
//! | TX1, RX1 | PC10, PC11 | USART3, to and from the server |
//! | TX2, RX2 | PA2, PA3 | USART2, to and from the depth sensor |
//! | SCL, SDA | PB6, PB7 | USART1, to and from the wheels |
//! | M4 LED | PC1 | status LED (green, left), lit by a low level |

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

        let pins = chip.GPIOC.split(&mut rcc);
        pins.pc10.into_alternate::<7>();
        pins.pc11.into_alternate::<7>();
        let server = port!(USART3, APB1_HZ, chip.USART3, server, SERVER_QUEUES, &mut rcc)?;
        let led = pins.pc1.into_push_pull_output();
        let pins = chip.GPIOA.split(&mut rcc);
        pins.pa2.into_alternate::<7>();
        pins.pa3.into_alternate::<7>();
        let sensor = port!(USART2, APB1_HZ, chip.USART2, sensor, DEVICE_QUEUES, &mut rcc)?;
        let pins = chip.GPIOB.split(&mut rcc);
        pins.pb6.into_alternate::<7>();
        pins.pb7.into_alternate::<7>();
        let wheels = port!(USART1, APB2_HZ, chip.USART1, wheels, DEVICE_QUEUES, &mut rcc)?;

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
