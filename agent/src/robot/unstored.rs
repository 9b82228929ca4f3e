//! Which parameters a board has not stored.

/// The parameters that were set since the robot booted or stored them, if its board can store them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Unstored {
    has_storage: bool,
    /// Bit `n`: the parameter with number `n` was set.
    set: u16,
    /// Number of the command to store that waits for the board.
    command: Option<u16>,
}

impl Unstored {
    /// Nothing was set yet.
    pub(super) fn new(has_storage: bool) -> Self {
        Self { has_storage, ..Self::default() }
    }

    /// Whether the board can store parameters.
    pub(super) fn has_storage(&self) -> bool {
        self.has_storage
    }

    /// Notes that the parameter with a number below 16 was set.
    pub(super) fn add(&mut self, number: u16) {
        self.set |= bit(number);
    }

    /// Whether the parameter with this number was set.
    pub(super) fn has(&self, number: u16) -> bool {
        self.set & bit(number) != 0
    }

    /// Whether no parameter was set.
    pub(super) fn is_empty(&self) -> bool {
        self.set == 0
    }

    /// Lets a command wait for the board.
    pub(super) fn begin(&mut self, command: u16) {
        self.command = Some(command);
    }

    /// Whether a command waits for the board.
    pub(super) fn is_waiting(&self) -> bool {
        self.command.is_some()
    }

    /// The board is done. Returns the number of the command.
    pub(super) fn end(&mut self, is_stored: bool) -> Option<u16> {
        let command = self.command.take()?;
        if is_stored {
            self.set = 0;
        }
        Some(command)
    }
}

fn bit(number: u16) -> u16 {
    1_u16.wrapping_shl(number.into())
}
