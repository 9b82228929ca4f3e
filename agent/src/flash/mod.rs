//! The robot's number, key, parameters and boot counter in flash.
//!
//! `ubimap provision` writes a [`Record`] into an image, behind [`MAGIC`]: the image's [`Seed`]. At
//! the first boot [`identify`] copies it into one of two slots of a [`NorFlash`], which images leave
//! alone, and counts boots there. So an image without a seed is an update that keeps the robot's
//! number and key, a seed replaces them, and a boot number is never used twice with a key, whatever
//! is flashed, and wherever the power is cut. Parameters that were set since can be kept there too: [`store`].

mod paged;
mod record;
mod slots;
mod wireless;

#[cfg(test)]
mod model;
#[cfg(test)]
mod tests;

pub use paged::{PAGE, Paged, PagedFlash};
pub use record::{MAGIC, Record, SEED_LEN, Seed, UNPROVISIONED};
pub use slots::{HEAD, NorFlash, Slot};
pub use wireless::{MAX_NAME, MAX_PASSWORD, WIRELESS_LEN, WITHOUT_NETWORK, Wireless};

use ubimap_protocol::{message::ParameterValue, units::RobotId};

use crate::{Config, Port, Seal};
use slots::Slots;

/// The identity and the parameters that image and flash give a robot.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Identity {
    /// Its record, and what a sealed link needs if it has a key.
    Known(Record, Option<Seal>),
    /// Neither the image nor the flash has a record: the robot must not move.
    Unknown,
    /// The robot has a key, but the number of this boot can't be kept: a link must not be sealed.
    NotKept,
}

impl Identity {
    /// The ports that the robot serves: only the server's if it does not know its number, so that it has
    /// no devices. `None` if its link must not be sealed, so that it must be silent.
    pub fn served(&self) -> Option<&'static [Port]> {
        const SERVER: [Port; 1] = [Port::Server];
        match self {
            Self::Known(..) => Some(&Port::ALL),
            Self::Unknown => Some(&SERVER),
            Self::NotKept => None,
        }
    }

    /// Completes a configuration. A robot that does not know its number is robot 0.
    pub fn complete(&self, mut config: Config) -> Config {
        match self {
            Self::Known(record, seal) => {
                (config.robot, config.seal) = (record.robot, *seal);
                config.set(&record.parameters);
                config.keeps_parameters = true;
            }
            Self::Unknown | Self::NotKept => config.robot = RobotId(0),
        }
        config
    }
}

/// The robot's identity, from the image's seed and the slots. Counts the boot. Call it once per boot.
///
/// Programs one word of flash; a new seed and a full log of boots cost an erase as well. A robot
/// without a key does without a flash that can't be written.
pub fn identify(flash: &mut impl NorFlash, seed: Option<Seed>) -> Identity {
    let mut slots = Slots::new(flash);
    match slots.boot(seed.as_ref()) {
        Ok(Some((record, boot))) => {
            let seal = record.key.map(|key| Seal { key, boot });
            Identity::Known(record, seal)
        }
        Ok(None) => Identity::Unknown,
        Err(_) => match seed.map(|seed| seed.record).or_else(|| slots.record()) {
            Some(record) if record.key.is_none() => Identity::Known(record, None),
            _ => Identity::NotKept,
        },
    }
}

/// Keeps parameters for the boots to come, in the place of their former values. Returns whether they are kept:
/// not without a record, without room for more of them, or in a flash that can't be written.
///
/// Erases a slot, programs it, and uses up the number of a boot. Wherever the power is cut, the next boot has
/// either all of the new values or none.
pub fn store(flash: &mut impl NorFlash, changed: &[ParameterValue]) -> bool {
    Slots::new(flash).store(changed).is_ok()
}
