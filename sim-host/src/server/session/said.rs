//! A robot's reports in its session.

use ubimap_protocol::{
    message::{DistanceVector, Event, ParameterReport, State},
    time::Instant,
};

use crate::server::{command, event_log::EventLog};

/// The newest report of each kind, and counts.
#[derive(Debug, Default)]
pub(crate) struct Said {
    state: Option<State>,
    /// Number of states in this session.
    states: u32,
    events: EventLog,
    time_requests: u32,
    /// The answer to the newest parameter command of a user.
    parameters: Option<ParameterReport>,
    /// The answer to the server's newest parameter command, until it is taken.
    own_parameters: Option<ParameterReport>,
    vector: Option<DistanceVector>,
    vectors: u32,
    /// The last received distance vector, until it is taken.
    new_vector: Option<DistanceVector>,
}

impl Said {
    /// Takes over the reports from an earlier session of the robot.
    pub(super) fn continue_from(&mut self, earlier: Self) {
        self.parameters = earlier.parameters;
        self.events = earlier.events;
    }

    pub(super) fn add_state(&mut self, state: State) {
        self.state = Some(state);
        self.states = self.states.saturating_add(1);
    }

    pub(super) fn add_event(&mut self, event: Event, received: Instant) {
        self.events.add(received, event);
    }

    pub(super) fn add_time_request(&mut self) {
        self.time_requests = self.time_requests.saturating_add(1);
    }

    pub(super) fn add_parameters(&mut self, report: ParameterReport) {
        if command::is_own(report.number) {
            self.own_parameters = Some(report);
        } else {
            self.parameters = Some(report);
        }
    }

    /// Adds a distance vector; vectors may arrive out of order.
    pub(super) fn add_vector(&mut self, vector: DistanceVector) {
        self.vectors = self.vectors.saturating_add(1);
        self.new_vector = Some(vector.clone());
        if self.vector.as_ref().is_none_or(|newest| newest.time < vector.time) {
            self.vector = Some(vector);
        }
    }

    /// Takes the last received distance vector.
    pub(crate) fn take_vector(&mut self) -> Option<DistanceVector> {
        self.new_vector.take()
    }

    /// Whether [`Said::take_vector`] would return a vector.
    pub(crate) fn has_vector(&self) -> bool {
        self.new_vector.is_some()
    }

    /// Takes the answer to the server's own parameter command.
    pub(crate) fn take_own_parameters(&mut self) -> Option<ParameterReport> {
        self.own_parameters.take()
    }

    pub(crate) fn state(&self) -> Option<State> {
        self.state
    }

    pub(crate) fn events(&self) -> &EventLog {
        &self.events
    }

    pub(crate) fn states(&self) -> u32 {
        self.states
    }

    pub(crate) fn time_requests(&self) -> u32 {
        self.time_requests
    }

    pub(crate) fn parameters(&self) -> Option<&ParameterReport> {
        self.parameters.as_ref()
    }

    /// The newest distance vector, and the number of vectors received.
    pub(crate) fn vectors(&self) -> (Option<&DistanceVector>, u32) {
        (self.vector.as_ref(), self.vectors)
    }
}
