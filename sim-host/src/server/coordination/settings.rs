//! What can be set about coordination: what it assumes of the robots and the room, and how careful
//! it is.

use ubimap_protocol::{time::Duration, units::Millimetres};

/// Settings of the [`Coordinator`](super::Coordinator). The defaults suit indoor robots of some
/// 0.4 m that drive at 0.2 to 0.6 m/s; what differs from one deployment to another is the first
/// five fields.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// The side of the map's cells. The server sets it.
    pub resolution: Millimetres,
    /// The number of the first path. A robot follows the path with the highest number, so a server
    /// that restarts must number on from its earlier life. The server sets it, from its epoch.
    pub first_path: u32,
    /// The distance from which robots look at a frontier, in metres; at most `range_m`.
    pub view_m: f64,
    /// The range of the robots' sensors, in metres. Beyond it nothing comes back, and a beam
    /// without an echo says nothing about the ground before it.
    pub range_m: f64,
    /// How long a robot takes to look around at the end of its path.
    pub look: Duration,
    /// How often things are decided.
    pub rates: Rates,
    /// The space kept between a robot and everything else.
    pub clearances: Clearances,
    /// How the coordinator judges whether a robot follows its path.
    pub following: FollowingRules,
    /// How a route is granted and sent.
    pub granting: GrantingRules,
    /// What it costs to cross ground that is not roomy.
    pub costs: CrossingCosts,
    /// Which part of the map is surveyed, and what counts as passable at its edge.
    pub survey: SurveyRules,
    /// What counts as a frontier.
    pub frontiers: FrontierRules,
    /// How the places to look at a frontier from are compared.
    pub viewpoints: ViewpointCosts,
    /// How frontiers are shared out among robots.
    pub exploration: ExplorationRules,
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
            granting: GrantingRules::default(),
            costs: CrossingCosts::default(),
            survey: SurveyRules::default(),
            frontiers: FrontierRules::default(),
            viewpoints: ViewpointCosts::default(),
            exploration: ExplorationRules::default(),
        }
    }
}

/// How often things are decided.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rates {
    /// From one tick to the next. A robot at 0.6 m/s covers 12 cm in 200 ms, far less than the
    /// ground granted ahead of it.
    pub tick: Duration,
    /// From one survey of the ground to the next. A survey costs milliseconds, and the map
    /// changes slowly.
    pub survey: Duration,
    /// Robots for which a route is searched in one tick, which bounds the time of a tick.
    pub routes_per_tick: usize,
    /// When to search again after other robots left no room for a route: they move on soon.
    pub retry: Duration,
    /// When to search again after there was no way at all: only a change of the map helps.
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

/// The space kept between a robot and everything else, in metres, beyond the robot's own radius.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Clearances {
    /// From walls, when a route is planned: the 3 cm that a robot's own driver keeps, and the error
    /// of a wall that is drawn in cells of 5 cm.
    pub wall_m: f64,
    /// Ground is roomy if there is this much more room than a robot needs; other ground costs
    /// more, so that routes keep off the walls where they can.
    pub spare_m: f64,
    /// From the points of its route, for which a robot reserves room: drivers cut corners and
    /// poses are a few centimetres off.
    pub route_m: f64,
    /// From people, on top of the obstacle's radius.
    pub person_m: f64,
    /// Unknown ground is passable up to this distance around a robot. A robot that has seen
    /// nothing yet must be able to leave its place.
    pub trodden_m: f64,
}

impl Default for Clearances {
    fn default() -> Self {
        Self { wall_m: 0.08, spare_m: 0.1, route_m: 0.1, person_m: 0.1, trodden_m: 0.3 }
    }
}

/// How the coordinator judges whether a robot follows its path.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FollowingRules {
    /// A robot that stops this near the end of its path has arrived, in metres. Drivers stop short
    /// of an obstacle at the very end.
    pub arrived_m: f64,
    /// A robot that moved less than this stands still, in metres: above the noise of its poses.
    pub still_m: f64,
    /// A robot this far off its route has lost it, in metres, and gets a new one.
    pub astray_m: f64,
    /// A report about the end of a path is about the newest path once that was sent this long ago:
    /// until then it may be about the one before, and in flight.
    pub in_flight: Duration,
    /// A robot that should drive and was seen to stand for this long is stuck. A driver waits 3 s
    /// for its way to clear before it turns to another one.
    pub stalled: Duration,
    /// The same for a robot that no camera sees: it reports its pose every 2 s, so seven reports in
    /// a row show no motion or got lost.
    pub unmoved: Duration,
    /// A robot that was told to stop has had time to brake after this, its way through a lossy link
    /// included.
    pub halting: Duration,
    /// Then it must be seen to stand for this long.
    pub halted: Duration,
    /// Where no camera sees it, it has reported its pose after this: the report's interval of 2 s
    /// on top of `halting`.
    pub reported: Duration,
    /// A robot without a session has stopped by itself after this long: drivers accept 2 to 3 s of
    /// the server's silence, and then brake.
    pub lost: Duration,
    /// After a robot has looked around, its last tiles take this long to reach the map.
    pub tiles_arrive: Duration,
}

impl Default for FollowingRules {
    fn default() -> Self {
        Self {
            arrived_m: 0.25,
            still_m: 0.03,
            astray_m: 0.6,
            in_flight: Duration::from_secs(1),
            stalled: Duration::from_secs(6),
            unmoved: Duration::from_secs(15),
            halting: Duration::from_millis(1_500),
            halted: Duration::from_secs(1),
            reported: Duration::from_millis(3_500),
            lost: Duration::from_secs(5),
            tiles_arrive: Duration::from_millis(500),
        }
    }
}

/// How a route is granted and sent. Routes are lists of points 0.1 m apart.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GrantingRules {
    /// How much of its route a robot is granted ahead of it, in metres: more than it needs to
    /// brake, so that it never slows down for want of a grant.
    pub ahead_m: f64,
    /// How long a robot waits behind a person before it looks for another way.
    pub patience: Duration,
    /// A robot that knows at most this many points ahead is sent more ...
    pub low_points: usize,
    /// ... if there are at least this many more, or the rest of its route: fewer are not worth a
    /// message.
    pub least_points: usize,
    /// At this many points, or fewer, it is sent any that there are: it would have to brake.
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

/// What it costs to cross ground, relative to 2 for roomy ground. 63 is the most that counts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CrossingCosts {
    /// Ground with little room to spare: half as much again.
    pub tight: u8,
    /// Ground that something movable took up when it was last seen.
    pub movable: u8,
    /// Where somebody stands: worth a detour of up to 6 m.
    pub standing: u8,
    /// Where a robot reported that it could not pass: worth a detour of some 20 m.
    pub held_up: u8,
    /// The radius of that place, in metres.
    pub held_up_m: f64,
    /// How long it is avoided: whatever stood there may have left.
    pub held_up_for: Duration,
}

impl Default for CrossingCosts {
    fn default() -> Self {
        Self {
            tight: 3,
            movable: 12,
            standing: 12,
            held_up: 40,
            held_up_m: 0.4,
            held_up_for: Duration::from_secs(20),
        }
    }
}

/// Which part of the map is surveyed, and what counts as passable at its edge.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurveyRules {
    /// Tiles surveyed on each side of the middle robot: 64 m with cells of 5 cm. It bounds the
    /// memory that a stray tile can cost.
    pub reach_tiles: i32,
    /// Unknown cells at most this far from free ones are passable. Little can hide there, and a
    /// robot stops before what it sees; if the edge counted as a wall, it would close every narrow
    /// passage until everything around it is known.
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
    /// Fewer cells side by side are noise.
    pub least_cells: usize,
    /// A frontier is cut into pieces of this reach, in metres, so that robots can share a long one.
    pub piece_m: f64,
    /// A frontier that would reveal less ground than this is not worth a drive, in square metres.
    pub least_gain_m2: f64,
    /// A frontier is looked at through cells this far apart, in metres: one side of it may offer
    /// no room to stand.
    pub through_m: f64,
    /// The nearest that a robot stands to a frontier it looks at, in metres: depth sensors are
    /// blind at close range.
    pub nearest_m: f64,
    /// The cosine of the largest angle between the line of sight and the direction to the unknown
    /// ground, 70 degrees. Along the edge of a shadow only what casts it is in view.
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

/// How the places to look at a frontier from are compared. The unit is a metre of roomy way.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ViewpointCosts {
    /// The cost of a metre between the place and the frontier. Above 1: of the places along one
    /// straight way the last is best.
    pub away: f64,
    /// Added where no surface is known behind the frontier: a sensor may get no echo there.
    pub unbacked_m: f64,
    /// The cost of a turn by one radian: it takes as long as this many metres.
    pub turn_m: f64,
    /// Added where others have to pass, as the robot would have to wait for them.
    pub wait_m: f64,
    /// No turn is needed towards a place nearer than this, in metres.
    pub here_m: f64,
    /// A robot that drives this far has something else before its sensor, in metres.
    pub afresh_m: f64,
}

impl Default for ViewpointCosts {
    fn default() -> Self {
        Self { away: 1.5, unbacked_m: 0.5, turn_m: 0.35, wait_m: 3.0, here_m: 0.1, afresh_m: 0.5 }
    }
}

/// How frontiers are shared out among robots.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ExplorationRules {
    /// The way that a square metre of unknown ground is worth, in metres.
    pub worth_m: f64,
    /// Two frontiers with less way than this between them are better left to one robot, in metres:
    /// two would be in each other's way.
    pub neighbours_m: f64,
    /// The cost of each metre by which they are nearer.
    pub neighbours_cost: f64,
    /// Two frontiers nearer to each other than this are the same one, in metres.
    pub same_m: f64,
    /// A frontier looked at in vain is not looked at from places within this radius, in metres ...
    pub tried_m: f64,
    /// ... for this long.
    pub tried_for: Duration,
    /// After this many looks in vain a frontier is given up: it can't be seen.
    pub most_looks: usize,
    /// A robot gives up a frontier if other robots leave it no room for this long ...
    pub patience: Duration,
    /// ... and tries another one for this long.
    pub put_off: Duration,
}

impl Default for ExplorationRules {
    fn default() -> Self {
        Self {
            worth_m: 0.2,
            neighbours_m: 2.0,
            neighbours_cost: 2.0,
            same_m: 1.0,
            tried_m: 0.3,
            tried_for: Duration::from_secs(300),
            most_looks: 3,
            patience: Duration::from_secs(2),
            put_off: Duration::from_secs(20),
        }
    }
}
