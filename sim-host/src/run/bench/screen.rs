//! Pictures of text that are drawn again at their place in a terminal, and line by line elsewhere.

use std::io::{self, IsTerminal, Write};

use crate::run::RunError;

/// Standard output.
#[derive(Debug)]
pub(super) struct Screen {
    redraws: bool,
    /// Number of lines of the picture that is shown.
    lines: usize,
}

impl Screen {
    /// A screen that draws pictures at their place if standard output is a terminal and `plain` is false.
    pub(super) fn new(plain: bool) -> Self {
        Self { redraws: !plain && io::stdout().is_terminal(), lines: 0 }
    }

    /// Whether pictures are drawn at their place.
    pub(super) fn redraws(&self) -> bool {
        self.redraws
    }

    /// Prints lines, above the picture if there is one. Returns whether somebody reads on.
    ///
    /// # Errors
    /// [`RunError::Print`].
    pub(super) fn print(&mut self, text: &str) -> Result<bool, RunError> {
        let erase = self.erase();
        self.lines = 0;
        write(&(erase + text))
    }

    /// Draws a picture in place of the last one.
    ///
    /// # Errors
    /// [`RunError::Print`].
    pub(super) fn draw(&mut self, picture: &str) -> Result<bool, RunError> {
        let erase = self.erase();
        self.lines = if self.redraws { picture.lines().count() } else { 0 };
        write(&(erase + picture))
    }

    /// What goes back to the first line of the picture and clears from there on.
    fn erase(&self) -> String {
        if self.lines == 0 { String::new() } else { format!("\x1b[{}A\x1b[J", self.lines) }
    }
}

/// Writes to standard output. Whoever has closed it wants no more.
fn write(text: &str) -> Result<bool, RunError> {
    let mut out = io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Ok(()) => Ok(true),
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(false),
        Err(error) => Err(RunError::Print(error)),
    }
}
