//! What a board has not stored of the robot's parameters.

/// Number of parameters whose values are compared.
pub(super) const STORABLE: usize = 12;

/// What a board has stored, if it can store parameters, and whether it is to do so.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Unstored {
    /// The values with which the next boot begins.
    stored: Option<[i32; STORABLE]>,
    /// Number of the command to store that waits for the board.
    command: Option<u16>,
}

impl Unstored {
    /// The next boot begins with these values.
    pub(super) fn begin(&mut self, values: [i32; STORABLE]) {
        self.stored = Some(values);
    }

    /// The values with which the next boot begins; `None` if the board can't store any.
    pub(super) fn stored(&self) -> Option<&[i32; STORABLE]> {
        self.stored.as_ref()
    }

    /// Lets a command wait for the board.
    pub(super) fn wait(&mut self, command: u16) {
        self.command = Some(command);
    }

    /// Whether a command waits for the board.
    pub(super) fn is_waiting(&self) -> bool {
        self.command.is_some()
    }

    /// The board has stored these values, or has failed. Returns the number of the command.
    pub(super) fn end(&mut self, stored: Option<[i32; STORABLE]>) -> Option<u16> {
        let command = self.command.take()?;
        self.stored = stored.or(self.stored);
        Some(command)
    }
}
