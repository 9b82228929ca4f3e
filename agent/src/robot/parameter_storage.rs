//! Whether a board has stored the robot's parameters.

/// What a board has stored of the parameters, if it can store any.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum ParameterStorage {
    /// It can't store any.
    #[default]
    NoStorage,
    /// The CRC-32 of the values with which the next boot begins.
    Stored(u32),
    /// The same, while the command with this number to store the present values waits for the board.
    Waiting(u32, u16),
}

impl ParameterStorage {
    /// The CRC-32 of the values with which the next boot begins.
    pub(super) fn stored(self) -> Option<u32> {
        match self {
            Self::NoStorage => None,
            Self::Stored(crc) | Self::Waiting(crc, _) => Some(crc),
        }
    }

    /// Lets a command wait for the board, if that can store parameters.
    pub(super) fn wait(&mut self, command: u16) {
        if let Some(crc) = self.stored() {
            *self = Self::Waiting(crc, command);
        }
    }

    /// The board has stored values with this CRC, or has failed. Returns the number of the command that waited.
    pub(super) fn end(&mut self, stored: Option<u32>) -> Option<u16> {
        let Self::Waiting(before, command) = *self else { return None };
        *self = Self::Stored(stored.unwrap_or(before));
        Some(command)
    }
}
