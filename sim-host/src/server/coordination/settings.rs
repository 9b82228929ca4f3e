//! Settings of the coordinator: its assumptions about robots and rooms, and its safety margins.

use ubimap_protocol::{time::Duration, units::Millimetres};

/// Settings of the [`Coordinator`](super::Coordinator). The defaults suit indoor robots of some 0.4
/// m that drive at 0.2 to 0.6 m/s; the first five fields depend on the deployment.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// The side length of the map's cells. The server sets it.
    pub resolution: Millimetres,
    /// The number of the first path. A robot follows the path with the highest number, so a
    /// restarted server must continue its earlier numbers. The server sets it from its epoch.
    pub first_path: u32,
    /// Maximum distance from which a robot looks at a frontier, in metres; at most `range_m`.
    pub view_m: f64,
    /// The range of the robots' sensors in metres. A depth camera that gets nothing back leaves the
    /// ground before it unknown.
    pub range_m: f64,
    /// Time that a robot takes to look around at the end of its path.
    pub look: Duration,
    /// Intervals between decisions.
    pub rates: Rates,
    /// Clearances between a robot and everything else.
    pub clearances: Clearances,
    /// When a robot counts as following its path.
    pub following: FollowingRules,
    /// What is done about a robot that is blocked again and again.
    pub escalation: EscalationRules,
    /// How a route is granted and sent.
    pub granting: GrantingRules,
    /// Cost of crossing ground that is not open.
    pub costs: CrossingCosts,
    /// Which part of the map is surveyed, and what is passable at its edge.
    pub survey: SurveyRules,
    /// What counts as a frontier.
    pub frontiers: FrontierRules,
    /// How viewpoints are compared.
    pub viewpoints: ViewpointCosts,
    /// How frontiers are distributed among robots.
    pub exploration: ExplorationRules,
    /// How robots calibrate their odometry.
    pub calibration: CalibrationRules,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            resolution: Millimetres(50),
            first_path: 1,
            view_m: 2.5,
            range_m: 4.0,
            look: Duration::from_secs(7),
            rates: Rates::default(),
            clearances: Clearances::default(),
            following: FollowingRules::default(),
            escalation: EscalationRules::default(),
            granting: GrantingRules::default(),
            costs: CrossingCosts::default(),
            survey: SurveyRules::default(),
            frontiers: FrontierRules::default(),
            viewpoints: ViewpointCosts::default(),
            exploration: ExplorationRules::default(),
            calibration: CalibrationRules::default(),
        }
    }
}

impl Settings {
    /// The side length of the map's cells in metres, never 0.
    pub(super) fn side_m(&self) -> f64 {
        Millimetres(self.resolution.0.max(1)).metres()
    }
}

/// Intervals between decisions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rates {
    /// Interval between ticks. A robot at 0.6 m/s covers 12 cm in 200 ms, far less than the ground
    /// granted ahead of it.
    pub tick: Duration,
    /// Interval between surveys of the ground. A survey costs milliseconds, and the map changes
    /// slowly.
    pub survey: Duration,
    /// Maximum number of route searches per tick, which bounds the duration of a tick.
    pub routes_per_tick: usize,
    /// Delay before another search after robots blocked a route: they move on soon.
    pub retry: Duration,
    /// Delay before another search after there was no route at all: only a change of the map helps.
    pub retry_no_way: Duration,
}

impl Default for Rates {
    fn default() -> Self {
        Self {
            tick: Duration::from_millis(200),
            survey: Duration::from_secs(1),
            routes_per_tick: 3,
            retry: Duration::from_secs(1),
            retry_no_way: Duration::from_secs(5),
        }
    }
}

/// Clearances between a robot and everything else, in metres, beyond the robot's radius.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Clearances {
    /// From walls, for planning: the 3 cm that a robot's own driver keeps, plus the error of walls
    /// drawn in cells of 5 cm.
    pub wall_m: f64,
    /// From walls in doors and other narrow places, which are crossed where there is no cheap way around: what the
    /// robots' own planner asks for, its 3 cm and half the diagonal of a cell.
    pub narrow_m: f64,
    /// Minimum additional clearance of ground that counts as open. Ground with less costs more, so
    /// that routes keep away from walls where possible.
    pub spare_m: f64,
    /// From the points of its route, for reservations: drivers cut corners, and poses are a few
    /// centimetres off.
    pub route_m: f64,
    /// From people, in addition to the obstacle's radius.
    pub person_m: f64,
    /// Unknown ground is passable up to this distance from a robot, so that a robot that has not
    /// seen anything yet can leave its place.
    pub trodden_m: f64,
}

impl Default for Clearances {
    fn default() -> Self {
        Self {
            wall_m: 0.08,
            narrow_m: 0.065,
            spare_m: 0.1,
            route_m: 0.1,
            person_m: 0.1,
            trodden_m: 0.3,
        }
    }
}

/// When a robot counts as following its path.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FollowingRules {
    /// A robot that stops within this distance of the end of its path has arrived, in metres:
    /// drivers stop short of an obstacle at the end.
    pub arrived_m: f64,
    /// Maximum movement of a robot that counts as standing still, in metres. It exceeds the noise
    /// of poses.
    pub still_m: f64,
    /// Minimum step between two poses that counts as a correction instead of a motion, in metres.
    pub jump_m: f64,
    /// Distance from its route at which a robot gets a new one, in metres.
    pub astray_m: f64,
    /// A report of a reached end refers to the newest path if that was sent at least this long ago.
    /// Earlier, the report may be about the previous path and may have been in flight.
    pub in_flight: Duration,
    /// A robot that should drive but was seen standing for this long is stuck. Drivers wait 3 s for
    /// their way to clear before they try another one.
    pub stalled: Duration,
    /// Like `stalled`, for a robot out of the cameras' view. Such a robot reports its pose every 2
    /// s, so seven reports in a row showed no motion or were lost.
    pub unmoved: Duration,
    /// Time for a robot to receive a stop over a lossy link and to brake.
    pub halting: Duration,
    /// Time for which the robot must be seen standing, after `halting`.
    pub halted: Duration,
    /// Time until a robot out of view has reported that it stands: `halting` plus the 2 s report
    /// interval.
    pub reported: Duration,
    /// Time after which a robot without a session has stopped by itself: drivers tolerate 2 to 3 s
    /// without the server, and then brake.
    pub lost: Duration,
    /// Time for the last tiles to reach the map after a robot has looked around.
    pub tiles_arrive: Duration,
    /// Time since a robot stopped for a person in which whatever is in its way is taken for that
    /// person, who will leave.
    pub behind_person: Duration,
}

impl Default for FollowingRules {
    fn default() -> Self {
        Self {
            arrived_m: 0.25,
            still_m: 0.03,
            jump_m: 0.5,
            astray_m: 0.6,
            in_flight: Duration::from_secs(1),
            stalled: Duration::from_secs(6),
            unmoved: Duration::from_secs(15),
            halting: Duration::from_millis(1_500),
            halted: Duration::from_secs(1),
            reported: Duration::from_millis(3_500),
            lost: Duration::from_secs(5),
            tiles_arrive: Duration::from_millis(500),
            behind_person: Duration::from_secs(12),
        }
    }
}

/// What is done about a robot that is blocked again and again at one place: each time it pauses for twice as
/// long, and the place before it is avoided for twice as long. From the second time on it looks at another
/// frontier; a goal that a user gave is given up at last.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EscalationRules {
    /// Maximum distance between two places that count as one, in metres.
    pub same_m: f64,
    /// The shortest pause, before the second attempt.
    pub pause: Duration,
    /// Maximum number of doublings.
    pub doublings: u32,
    /// How often in a row a robot is blocked until its goal is given up.
    pub gives_up: u32,
}

impl EscalationRules {
    /// A time that has grown with the number of failures in a row.
    pub(super) fn longer(&self, time: Duration, times: u32) -> Duration {
        let doublings = times.saturating_sub(1).min(self.doublings).min(16);
        Duration::from_micros(time.micros().saturating_mul(1 << doublings))
    }
}

impl Default for EscalationRules {
    /// Pauses of 2, 4, 8 and 16 s: a goal is given up after some 40 s.
    fn default() -> Self {
        Self { same_m: 0.5, pause: Duration::from_secs(1), doublings: 4, gives_up: 6 }
    }
}

/// How a route is granted and sent. Routes are lists of points 0.1 m apart.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GrantingRules {
    /// Length of the route granted ahead of a robot, in metres: more than its braking distance, so
    /// that it never slows down for lack of a grant.
    pub ahead_m: f64,
    /// How long a robot waits behind a person before it takes another way.
    pub patience: Duration,
    /// A robot is sent more points when it knows at most this number of points ahead.
    pub low_points: usize,
    /// Minimum number of points to send, unless they are the rest of the route: fewer are not worth
    /// a message.
    pub least_points: usize,
    /// A robot is sent all granted points, even fewer than `least_points`, when it knows at most
    /// this number of points ahead, because it would have to brake.
    pub urgent_points: usize,
}

impl Default for GrantingRules {
    fn default() -> Self {
        Self {
            ahead_m: 2.0,
            patience: Duration::from_secs(3),
            low_points: 12,
            least_points: 5,
            urgent_points: 3,
        }
    }
}

/// Cost factors of ground. Open ground has the factor 2; the maximum is 63.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CrossingCosts {
    /// Cost of ground with little clearance: 1.5 times that of open ground.
    pub tight: u8,
    /// Cost of ground that is crossed although walls are nearer than `wall_m`.
    pub narrow: u8,
    /// Cost of ground last seen occupied by something movable.
    pub movable: u8,
    /// Cost of open ground without landmarks: outside camera coverage, and farther than half of `range_m` from walls,
    /// movable objects and unmapped ground. Twice the cost of other open ground (coastal navigation: Roy et al. 1999).
    pub empty: u8,
    /// Cost of unknown ground at the edge of known ground, on which a robot's own planner does not drive.
    pub unknown: u8,
    /// Cost where a robot or a person stands: worth a detour of up to 6 m.
    pub standing: u8,
    /// Cost where a robot reported that it could not pass: worth a detour of about 20 m.
    pub held_up: u8,
    /// Radius around a place where a robot could not pass, in metres.
    pub held_up_m: f64,
    /// Time for which that place is avoided: the obstacle may leave.
    pub held_up_for: Duration,
    /// The same if a person was in the way.
    pub held_up_by_person_for: Duration,
}

impl Default for CrossingCosts {
    fn default() -> Self {
        Self {
            tight: 3,
            narrow: 20,
            empty: 4,
            movable: 12,
            unknown: 40,
            standing: 12,
            held_up: 40,
            held_up_m: 0.4,
            held_up_for: Duration::from_secs(20),
            held_up_by_person_for: Duration::from_secs(5),
        }
    }
}

/// Which part of the map is surveyed, and what is passable at its edge.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurveyRules {
    /// Maximum distance of surveyed tiles from the median of the robots' positions: 40 tiles are 64
    /// m with 5 cm cells. Bounds the memory that a stray tile can cost.
    pub reach_tiles: i32,
    /// Unknown cells at most this number of cells from free ones are no walls. Otherwise every narrow passage would be closed until all cells around it are known.
    /// Only small things can be hidden there, and a robot stops before obstacles that it sees.
    pub edge_cells: u32,
}

impl Default for SurveyRules {
    fn default() -> Self {
        Self { reach_tiles: 40, edge_cells: 2 }
    }
}

/// What counts as a frontier: unknown ground that no camera sees, next to free ground.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrontierRules {
    /// Minimum number of connected cells; fewer are noise.
    pub least_cells: usize,
    /// Maximum extent of a piece of a frontier, in metres, so that robots can share a long one.
    pub piece_m: f64,
    /// Minimum area of ground that looking at a frontier reveals, in square metres; less is not
    /// worth a drive.
    pub least_gain_m2: f64,
    /// Spacing, in metres, of the frontier's cells for which viewpoints are sought: there may be no
    /// room to stand opposite some of them.
    pub through_m: f64,
    /// Minimum distance between a robot and the frontier it looks at, in metres: depth sensors are
    /// blind at close range.
    pub nearest_m: f64,
    /// Cosine of the maximum angle between the line of sight and the direction to the unknown
    /// ground, 70 degrees. Along the edge of a shadow only the object that casts it is visible.
    pub ahead_cosine: f64,
}

impl Default for FrontierRules {
    fn default() -> Self {
        Self {
            least_cells: 4,
            piece_m: 1.0,
            least_gain_m2: 0.05,
            through_m: 0.3,
            nearest_m: 0.4,
            ahead_cosine: 0.34,
        }
    }
}

/// How viewpoints are compared. The unit is a metre of open ground.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ViewpointCosts {
    /// Cost per metre between the viewpoint and the frontier. Above 1, so that the last viewpoint
    /// on a straight way is the best.
    pub away: f64,
    /// Penalty if no wall is known behind the frontier: a sensor may get no echo there.
    pub unbacked_m: f64,
    /// Cost of a turn by one radian: the distance that a robot drives in the same time.
    pub turn_m: f64,
    /// Penalty for a place where the robot would block others and has to wait for them.
    pub wait_m: f64,
    /// Up to this distance, in metres, no turn is needed.
    pub here_m: f64,
    /// Minimum distance, in metres, that a robot must drive to see something different.
    pub afresh_m: f64,
}

impl Default for ViewpointCosts {
    fn default() -> Self {
        Self { away: 1.5, unbacked_m: 0.5, turn_m: 0.35, wait_m: 3.0, here_m: 0.1, afresh_m: 0.5 }
    }
}

/// How frontiers are distributed among robots.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ExplorationRules {
    /// Driving distance, in metres, that a square metre of unknown ground is worth.
    pub worth_m: f64,
    /// Frontiers with less driving distance between them, in metres, are better left to one robot:
    /// two would be in each other's way.
    pub neighbours_m: f64,
    /// Cost per metre below `neighbours_m`.
    pub neighbours_cost: f64,
    /// Maximum distance between positions of the same frontier, in metres.
    pub same_m: f64,
    /// Radius around a failed viewpoint within which no viewpoint is tried for `tried_for`, in
    /// metres.
    pub tried_m: f64,
    /// Time for which the surroundings of a failed viewpoint are not tried.
    pub tried_for: Duration,
    /// Number of failed looks after which a frontier is given up: it can't be seen.
    pub most_looks: usize,
    /// Time for which other robots may block the way before a robot gives up a frontier.
    pub patience: Duration,
    /// Time after which a robot that gets to no frontier looks for a way out of where it is shut in: other robots may
    /// have stood in its way. It gives up after `most_looks` within `tried_for`; a
    /// look that others prevented counts for `put_off`.
    pub shut_in_for: Duration,
    /// Time for which a robot is shut in before [`Notice::ShutIn`](super::Notice::ShutIn), if it has nowhere left to look.
    pub no_way_out_for: Duration,
    /// Time for which a frontier that was given up for lack of a way is not tried again.
    pub put_off: Duration,
    /// Distance driven out of the cameras' view, in metres, after which an exploring robot is called back there, when it has
    /// looked at its target: its pose drifts, and so does what it draws.
    pub blind_m: f64,
    /// How far within the view such a place is, in metres: the robot's pose may be off.
    pub within_m: f64,
    /// Time for which it explores on if it can't come into view.
    pub recall_again: Duration,
    /// Time after which a robot that finds nothing to look at returns to where cameras see it; `None` to
    /// stay where it is.
    pub returns_after: Option<Duration>,
}

impl Default for ExplorationRules {
    fn default() -> Self {
        Self {
            worth_m: 0.4,
            neighbours_m: 2.0,
            neighbours_cost: 2.0,
            same_m: 1.0,
            tried_m: 0.3,
            tried_for: Duration::from_secs(300),
            most_looks: 3,
            patience: Duration::from_secs(2),
            shut_in_for: Duration::from_secs(20),
            no_way_out_for: Duration::from_secs(60),
            put_off: Duration::from_secs(20),
            blind_m: 40.0,
            within_m: 0.3,
            recall_again: Duration::from_secs(30),
            returns_after: None,
        }
    }
}

/// How exploring robots calibrate their odometry: by driving to and fro where cameras see them, once after each boot, and
/// after each start of the server.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CalibrationRules {
    /// Distance driven in view after which odometry counts as calibrated, in metres.
    pub distance_m: f64,
    /// The limit for robots without calibration in place of [`ExplorationRules::blind_m`], while there is a frontier for which
    /// calibration is worth its time.
    pub blind_m: f64,
    /// Distance between the cameras' view and such a frontier, in metres in a straight line, even through walls.
    pub far_m: f64,
    /// Minimum length of a straight way, in metres: robots learn from ways of a metre and more.
    pub least_m: f64,
    /// Maximum length of a straight way, in metres.
    pub most_m: f64,
    /// Distance from the end of a way at which the robot gets the next one, in metres, so that it seldom stops to look
    /// around.
    pub turn_within_m: f64,
    /// Margin around a robot within which cameras may not see the ground, in metres: its shadow, and where it was a moment
    /// ago.
    pub hidden_m: f64,
    /// Delay before the next attempt after no way was found, or no camera saw the robot's tag. It doubles each time, as in
    /// [`EscalationRules`].
    pub put_off: Duration,
}

impl Default for CalibrationRules {
    fn default() -> Self {
        Self {
            distance_m: 10.0,
            blind_m: 2.0,
            far_m: 4.0,
            least_m: 1.2,
            most_m: 4.0,
            turn_within_m: 0.5,
            hidden_m: 0.2,
            put_off: Duration::from_secs(120),
        }
    }
}
