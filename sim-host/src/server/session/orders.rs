//! Delivery of commands to one robot.

use std::collections::VecDeque;

use ubimap_protocol::message::{ParameterCommand, ToRobot, Writer};

use crate::server::command::Command;

/// The commands that wait to be sent, the commands in force, and the parameter command that is not
/// answered yet.
#[derive(Debug, Default)]
pub(super) struct Orders {
    /// Commands that have not been sent, in order.
    waiting: VecDeque<Command>,
    /// The newest command of each kind that stays in force; each is repeated in a new session.
    standing: Vec<Command>,
    /// The parameter command that was sent but not answered. A robot answers only the newest one,
    /// so the next one waits.
    asked: Option<ParameterCommand>,
}

impl Orders {
    /// Adds a command. A Stop or a path replaces one of its kind that has not been sent yet.
    pub(super) fn add(&mut self, command: Command) {
        self.waiting.retain(|waiting| !waiting.is_replaced_by(&command));
        if command.stands() {
            self.standing.retain(|standing| !standing.is_replaced_by(&command));
            self.standing.push(command.clone());
        }
        if command.is_urgent() {
            self.waiting.push_front(command);
        } else {
            self.waiting.push_back(command);
        }
    }

    /// Takes over the commands of an earlier session of the robot: those in force, the unanswered
    /// one and those not sent.
    pub(super) fn continue_from(&mut self, earlier: Self) {
        let asked = earlier.asked.map(Command::Parameter);
        for command in earlier.standing.into_iter().chain(asked).chain(earlier.waiting) {
            self.add(command);
        }
    }

    /// Handles the answer to a parameter command.
    pub(super) fn answered(&mut self, number: u16) {
        self.asked.take_if(|asked| asked.number == number);
    }

    /// Whether the next command must be sent before everything else.
    pub(super) fn is_urgent(&self) -> bool {
        self.waiting.front().is_some_and(Command::is_urgent)
    }

    /// Adds the next command to a frame if it is urgent. Returns whether it was added.
    pub(super) fn write_urgent(&mut self, writer: &mut Writer<'_, ToRobot>) -> bool {
        let is_written = self.is_urgent() && self.waiting[0].write(writer);
        if is_written {
            self.waiting.pop_front();
        }
        is_written
    }

    /// Adds the next command to a frame. Returns whether one was added.
    pub(super) fn write(&mut self, writer: &mut Writer<'_, ToRobot>) -> bool {
        let Some(index) = self.next().filter(|&index| self.waiting[index].write(writer)) else {
            return false;
        };
        if let Some(Command::Parameter(command)) = self.waiting.remove(index) {
            self.asked = Some(command);
        }
        true
    }

    /// Whether a command can be sent now.
    pub(super) fn is_ready(&self) -> bool {
        self.next().is_some()
    }

    fn next(&self) -> Option<usize> {
        let waits =
            |command: &Command| self.asked.is_some() && matches!(command, Command::Parameter(_));
        self.waiting.iter().position(|command| !waits(command))
    }

    /// Number of commands waiting to be sent.
    pub(super) fn waiting(&self) -> usize {
        self.waiting.len()
    }
}
