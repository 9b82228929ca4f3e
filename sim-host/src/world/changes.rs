//! Changes of the room during a run: furniture is moved, doors open and close.

use parry2d_f64::glamx::DVec2;
use ubimap_protocol::time::Instant;

use super::{
    room::{Room, WallGrid, furniture, leaf},
    route::Body,
    scenario::{FootprintConfig, MoveConfig, Scenario, ScenarioError},
    shapes::Prism,
};

/// Minimum distance in metres between a placed object and a person or robot.
const APART: f64 = 0.02;

/// Maximum distance in metres between the posts that stand for a closed door: nobody fits between.
const POST_SPACING: f64 = 0.1;

/// The changeable parts of the room and the schedule of their changes.
pub(super) struct Changes {
    /// The scenario after the changes already made.
    scenario: Scenario,
    walls: Option<WallGrid>,
    are_open: Vec<bool>,
    /// Pending changes in order of time.
    due: Vec<(Instant, Change)>,
}

#[derive(Clone, Copy)]
enum Change {
    Move { furniture: usize, to: MoveConfig },
    Door { door: usize, is_open: bool },
}

impl Change {
    /// Identifies the object that changes: the kind and its number.
    fn subject(&self) -> (bool, usize) {
        match *self {
            Self::Move { furniture, .. } => (true, furniture),
            Self::Door { door, .. } => (false, door),
        }
    }
}

impl Changes {
    pub(super) fn new(scenario: &Scenario, walls: Option<&WallGrid>) -> Self {
        let at = |seconds: f64| Instant::from_micros((seconds * 1e6).round() as u64);
        let moves = scenario.furniture.iter().enumerate().flat_map(|(furniture, config)| {
            let moved = config.moved.iter();
            moved.map(move |&to| (at(to.at_s), Change::Move { furniture, to }))
        });
        let doors = scenario.doors.iter().enumerate().flat_map(|(door, config)| {
            config.open_s.iter().flat_map(move |&[opens, shuts]| {
                [(opens, true), (shuts, false)]
                    .map(|(moment, is_open)| (at(moment), Change::Door { door, is_open }))
            })
        });
        let mut due: Vec<(Instant, Change)> = moves.chain(doors).collect();
        due.sort_by_key(|&(moment, _)| moment);
        Self {
            scenario: scenario.clone(),
            walls: walls.cloned(),
            are_open: vec![false; scenario.doors.len()],
            due,
        }
    }

    /// The room in its present state.
    pub(super) fn room(&self) -> Result<Room, ScenarioError> {
        Room::new(&self.scenario, self.walls.as_ref(), &self.are_open)
    }

    /// The present room, and the room after each future move of furniture; all doors are open.
    pub(super) fn rooms(&self) -> impl Iterator<Item = Result<Room, ScenarioError>> + '_ {
        let mut scenario = self.scenario.clone();
        let moves = self.due.iter().filter(|(_, change)| matches!(change, Change::Move { .. }));
        let states = std::iter::once(None).chain(moves.map(|(_, change)| Some(change)));
        states.map(move |change| {
            if let Some(Change::Move { furniture, to }) = change {
                place(&mut scenario, *furniture, to);
            }
            Room::new(&scenario, self.walls.as_ref(), &vec![true; self.are_open.len()])
        })
    }

    /// Makes the changes that are due and not obstructed. Returns the new room if anything has changed.
    pub(super) fn make(&mut self, now: Instant, bodies: &[Body]) -> Option<Room> {
        let mut waiting = Vec::new();
        let mut is_changed = false;
        for (moment, change) in std::mem::take(&mut self.due) {
            let waits = |(_, other): &(Instant, Change)| other.subject() == change.subject();
            let is_due = moment <= now
                && !waiting.iter().any(waits)
                && !self.prisms_after(&change).iter().any(|prism| is_met(prism, bodies));
            if !is_due {
                waiting.push((moment, change));
                continue;
            }
            is_changed = true;
            match change {
                Change::Move { furniture, to } => place(&mut self.scenario, furniture, &to),
                Change::Door { door, is_open } => self.are_open[door] = is_open,
            }
        }
        self.due = waiting;
        is_changed.then(|| self.room().ok()).flatten()
    }

    /// Obstacles for people and scripted robots: the leaves of the closed doors, each as a row of
    /// posts as thick as the leaf.
    pub(super) fn barriers(&self) -> impl Iterator<Item = Body> + '_ {
        let doors = self.scenario.doors.iter().zip(&self.are_open);
        doors.filter(|&(_, is_open)| !is_open).flat_map(|(door, _)| {
            let heading = door.heading_deg.to_radians();
            let along = DVec2::new(libm::cos(heading), libm::sin(heading)) * door.width_m;
            let spaces = (door.width_m / POST_SPACING).ceil().max(1.0);
            (0..=spaces as u32).map(move |post| Body {
                centre: DVec2::from(door.hinge_m) + along * (f64::from(post) / spaces),
                radius: door.thickness_m / 2.0,
                height: door.height_m,
            })
        })
    }

    /// The prisms of the changed object in its new place.
    fn prisms_after(&self, change: &Change) -> Vec<Prism> {
        match *change {
            Change::Move { furniture: index, ref to } => {
                let mut config = self.scenario.furniture[index].clone();
                move_footprint(&mut config.footprint, to);
                furniture(&config).unwrap_or_default()
            }
            Change::Door { door, is_open } => vec![leaf(&self.scenario.doors[door], is_open)],
        }
    }
}

fn place(scenario: &mut Scenario, furniture: usize, to: &MoveConfig) {
    move_footprint(&mut scenario.furniture[furniture].footprint, to);
}

fn move_footprint(footprint: &mut FootprintConfig, to: &MoveConfig) {
    match footprint {
        FootprintConfig::Box { centre_m, heading_deg, .. } => {
            (*centre_m, *heading_deg) = (to.centre_m, to.heading_deg);
        }
        FootprintConfig::Disc { centre_m, .. } => *centre_m = to.centre_m,
        // Refused when the scenario is read.
        FootprintConfig::Polygon { .. } => {}
    }
}

/// Whether a prism would be too close to a person or robot.
fn is_met(prism: &Prism, bodies: &[Body]) -> bool {
    bodies.iter().any(|body| {
        let apart = |at: DVec2| prism.footprint.nearest(at).distance(at);
        prism.reaches(0.0, body.height) && apart(body.centre) < body.radius + APART
    })
}
