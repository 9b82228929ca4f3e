//! Computes a placement from a room and a request.

use super::{
    camera::{CameraModel, Candidate, Projection},
    candidates::{CandidatesError, Choices, candidates},
    connection::{self, Connecting, Views},
    coverage::coverage,
    floor_plan::FloorPlan,
    incidence::Incidence,
    milp::{self, Milp, MilpError},
    programme::{ANY_OVERLAP, Demand, Goal, Programme},
    solver::{Interim, Solution, solve},
};

/// Weight of a critical cell under [`CriticalRule::Weighted`].
const CRITICAL_WEIGHT: u32 = 5;
/// Minimum number of cameras that must see a critical cell under [`CriticalRule::Twice`].
const TWICE: u16 = 2;

/// Minimum area of floor that two neighbouring cameras must share, in square metres: enough for
/// landmarks.
const SHARED_M2: f64 = 0.25;

/// Share of a picture in which a marker is whole, which stands above the floor that is seen there.
const MARKER_SHARE: f64 = 0.8;

/// Fraction of the time after which the solver must stop, so that the rest is left for connecting
/// the cameras.
const SOLVED: f64 = 0.8;
/// Fraction of the time for finding out how many cameras the critical cells need.
const CHECKED: f64 = 0.2;
/// Maximum number of exchanges for connecting a placement: without [`Request::connect`], and
/// with it.
const FREE_EXCHANGES: usize = 20_000;
const MOST_EXCHANGES: usize = 1_000_000;
/// Number of exchanges for more coverage once the cameras are connected.
const IMPROVING: usize = 200_000;
/// Number of exchanges between two reports.
const EXCHANGES: usize = 500;

/// The demand of a cell that need not be covered.
const IGNORED: Demand = Demand { at_least: 0, at_most: ANY_OVERLAP, weight: 0, is_required: false };

/// A request for a placement.
#[derive(Clone, Debug)]
pub struct Request {
    /// Which floor counts as seen.
    pub projection: Projection,
    /// The cameras' properties.
    pub model: CameraModel,
    /// What the cameras' pictures see, in which calibration finds landmarks.
    pub picture: CameraModel,
    /// The distance in metres at which a picture shows a marker that faces it just large enough to be read; infinite
    /// if any size will do.
    pub readable_m: f64,
    /// The possible places and orientations of the cameras.
    pub choices: Choices,
    /// The minimum number of cameras that must see a cell for it to count as covered: the paper's
    /// `m`.
    pub at_least: u16,
    /// The maximum number of cameras that may see a cell: the paper's `k`.
    pub at_most: Option<u16>,
    /// The goal of the optimisation.
    pub aim: Aim,
    /// Cells that matter more, and how.
    pub critical: Option<Critical>,
    /// Whether cameras may be added, or coverage be given up, to connect the cameras' views.
    pub connect: bool,
    /// Another solver for the integer programme, used after the local search has had a fifth of the
    /// time.
    pub milp: Option<Milp>,
    /// Seed of all random numbers.
    pub seed: u64,
}

/// The goal of the optimisation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Aim {
    /// The fewest cameras that cover every cell that any candidate can see.
    Cover,
    /// The fewest cameras that cover this share of the floor, from 0 to 1.
    Share(f64),
    /// The greatest coverage with this number of cameras.
    Cameras(usize),
}

/// Cells that matter more.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Critical {
    /// For each cell of the floor whether it is critical.
    pub cells: Vec<bool>,
    /// How these cells are treated.
    pub rule: CriticalRule,
}

/// How critical cells are treated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CriticalRule {
    /// At least two cameras must see them.
    Twice,
    /// Critical cells count five times.
    Weighted,
    /// Only critical cells must be covered (the paper's `S`); other floor is ignored.
    Only,
}

/// Why there is no placement. Each message is one line, and does not name the room.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PlacementError {
    /// There are no candidates.
    #[error(transparent)]
    Candidates(#[from] CandidatesError),
    /// The minimum overlap exceeds the maximum (m > k).
    #[error(
        "the minimum overlap exceeds the maximum: at least {at_least} and at most {at_most}; raise --max-overlap or lower --min-overlap"
    )]
    Bounds {
        /// The lower bound.
        at_least: u16,
        /// The upper bound.
        at_most: u16,
    },
    /// Critical cells must be seen twice, but the maximum overlap is below two.
    #[error(
        "critical cells must be seen twice, but the maximum overlap is {at_most}; raise --max-overlap or choose another --critical-rule"
    )]
    CriticalBounds {
        /// The upper bound.
        at_most: u16,
    },
    /// Connected cameras see common cells, so the maximum overlap must be at least two.
    #[error(
        "connected cameras must overlap, but the maximum overlap is 1; raise --max-overlap or leave out --connect"
    )]
    ConnectedBounds,
    /// No cell is critical.
    #[error(
        "no cell of the floor is critical; in the image for --critical, mark floor with 50 % grey or lighter"
    )]
    NothingCritical,
    /// No candidate sees any cell.
    #[error(
        "no candidate sees any of the floor; change the heights, tilts or range of the cameras"
    )]
    NothingSeen,
    /// The requested coverage exceeds what all candidates see together.
    #[error(
        "{asked:.1} % of the floor requested, but all candidates together see only {seen:.1} %; \
         lower --coverage, or give more places, headings or tilts"
    )]
    Unreachable {
        /// Coverage asked for, in per cent.
        asked: f64,
        /// Floor that any candidate sees, in per cent.
        seen: f64,
    },
    /// There are fewer cameras than the critical cells need.
    #[error(
        "{cameras} cameras are too few: the critical cells need at least {least}; raise --cameras"
    )]
    TooFewCameras {
        /// Cameras asked for.
        cameras: usize,
        /// Cameras needed at least.
        least: u64,
    },
    /// It is proved that no placement exists.
    #[error("no placement keeps every overlap within its bounds; {advice}")]
    Infeasible {
        /// What the user can change.
        advice: &'static str,
    },
    /// No placement was found in time; it is not proved that none exists.
    #[error("no placement was found in time that keeps every overlap within its bounds; {advice}")]
    NotFound {
        /// What the user can change.
        advice: &'static str,
    },
    /// The other solver failed.
    #[error(transparent)]
    Milp(#[from] MilpError),
}

/// The current stage of the work.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// The view of each candidate is being computed.
    Seeing {
        /// Number of candidates.
        candidates: usize,
    },
    /// The integer programme is being solved.
    Solving(Interim),
    /// The views of the cameras are being connected.
    Connecting {
        /// Cameras of the placement.
        cameras: usize,
        /// Pieces of its overlap graph.
        pieces: usize,
    },
}

/// A placement of cameras.
#[derive(Clone, Debug, PartialEq)]
pub struct Placement {
    /// The cameras: the paper's `P`.
    pub cameras: Vec<Candidate>,
    /// For each cell of the floor the number of cameras that see it.
    pub overlap: Vec<u16>,
    /// For each cell of the floor, the number of candidates that see it; zero if no camera can see
    /// it.
    pub seen_by: Vec<u32>,
    /// Number of candidates, and the spacing of their places in metres.
    pub candidates: usize,
    /// See [`Placement::candidates`].
    pub spacing_m: f64,
    /// Number of cells for which the minimum overlap was lowered, because too few candidates see
    /// them; without cells that no candidate sees.
    pub lowered: usize,
    /// The value of the goal: the number of cameras, or the total weight of the covered cells.
    pub value: u64,
    /// A proved bound: no placement has a better value.
    pub bound: u64,
    /// Number of cameras added to connect the views; not included in [`Placement::value`].
    pub added: usize,
    /// Number of pieces of the overlap graph. If it is one, every camera can be calibrated against
    /// every other.
    pub pieces: usize,
    /// The minimum number of pieces of any placement that covers everything the candidates see.
    pub fewest_pieces: usize,
}

impl Placement {
    /// Whether it is proved that no placement has a better value.
    pub fn is_optimal(&self) -> bool {
        self.value == self.bound
    }

    /// The relative difference between the value and the bound, an upper limit of how far the value
    /// is from optimal: relative to the value for the fewest cameras, to the bound for the greatest
    /// coverage.
    pub fn gap(&self) -> f64 {
        self.value.abs_diff(self.bound) as f64 / self.value.max(self.bound).max(1) as f64
    }
}

/// Places cameras in a room.
///
/// `report` is called every few milliseconds with the current stage, and returns the fraction of
/// the time that is spent; from 1 on, `place` ends with the best placement so far.
///
/// # Errors
/// Every [`PlacementError`].
pub fn place(
    plan: &FloorPlan,
    request: &Request,
    report: &mut dyn FnMut(Stage) -> f64,
) -> Result<Placement, PlacementError> {
    check(request)?;
    let (candidates, spacing_m) =
        candidates(plan, request.projection, &request.model, &request.choices)?;
    report(Stage::Seeing { candidates: candidates.len() });
    let covers = coverage(plan, request.projection, &request.model, &candidates);
    let seen_by: Vec<u32> = covers
        .transpose(plan.cells().len())
        .iter()
        .map(|candidates| candidates.len() as u32)
        .collect();
    let area = Area::new(request, &seen_by)?;
    let programme = area.programme(request, &covers)?;
    check_camera_count(&programme, request, report)?;
    let solution = solve_all(&programme, request, report)?;
    let mut chosen =
        solution.chosen.ok_or_else(|| no_placement(request, solution.is_infeasible))?;
    drop_surplus(&programme, &mut chosen);
    let value = match programme.goal {
        Goal::Fewest { .. } => chosen.len() as u64,
        Goal::Best { .. } => programme.tally(&chosen).covered_weight,
    };
    let required: u64 =
        programme.demands.iter().filter(|it| it.is_required).map(|it| u64::from(it.weight)).sum();
    let bound = match programme.goal {
        Goal::Fewest { .. } => solution.bound.min(value),
        Goal::Best { .. } => solution.bound.saturating_add(required).max(value),
    };
    let shared = (SHARED_M2 / (plan.side_m() * plan.side_m())).ceil().max(1.0) as u16;
    let fewest_pieces = connection::fewest_pieces(&programme);
    let before = chosen.len();
    let is_other = request.picture != request.model || request.readable_m.is_finite();
    let pictures = is_other.then(|| {
        let whole = request.picture.narrowed(MARKER_SHARE);
        let sees = coverage(plan, request.projection, &whole, &candidates);
        let sees = area.numbered(&readable(plan, request.readable_m, &candidates, &sees));
        let sees = area.passable(plan, &sees);
        let seen_by = sees.transpose(programme.demands.len());
        (sees, seen_by)
    });
    let views = match &pictures {
        Some((sees, seen_by)) => Views { sees, seen_by, shared },
        None => Views::of(&programme, shared),
    };
    let mut connection = Connection { programme: &programme, request, views, fewest_pieces };
    let pieces = connection.mend(&mut chosen, report);
    let overlap = overlap(&covers, &chosen, plan.cells().len());
    Ok(Placement {
        cameras: chosen.iter().map(|&it| candidates[it as usize]).collect(),
        overlap,
        seen_by,
        candidates: candidates.len(),
        spacing_m,
        lowered: area.lowered,
        value: match programme.goal {
            Goal::Fewest { .. } => value,
            Goal::Best { .. } => programme.tally(&chosen).covered_weight,
        },
        bound,
        added: chosen.len().saturating_sub(before),
        pieces,
        fewest_pieces,
    })
}

/// The cells in which a marker that lies flat is large enough in the picture. At a distance `d`, from a height `h`, it is
/// seen at an angle whose sine is `h / d`, so that its picture is as high as that of one that faces the camera at
/// `d * d / h`.
fn readable(
    plan: &FloorPlan,
    readable_m: f64,
    candidates: &[Candidate],
    sees: &Incidence,
) -> Incidence {
    Incidence::from_rows(sees.iter().zip(candidates).map(|(cells, candidate)| {
        let [x, y, height] = candidate.position_m;
        let is_readable = |cell: &u32| {
            let [cell_x, cell_y] = plan.cells()[*cell as usize].aim_m;
            let squared = (cell_x - x).powi(2) + (cell_y - y).powi(2) + height * height;
            squared <= readable_m * height
        };
        cells.iter().copied().filter(is_readable).collect::<Vec<u32>>()
    }))
}

fn check(request: &Request) -> Result<(), PlacementError> {
    let &Request { at_least, at_most, connect, .. } = request;
    let Some(at_most) = at_most else { return Ok(()) };
    if at_least > at_most {
        return Err(PlacementError::Bounds { at_least, at_most });
    }
    let is_twice = request.critical.as_ref().is_some_and(|it| it.rule == CriticalRule::Twice);
    if is_twice && at_most < TWICE {
        return Err(PlacementError::CriticalBounds { at_most });
    }
    if connect && at_most < 2 {
        return Err(PlacementError::ConnectedBounds);
    }
    Ok(())
}

/// The part of the floor that a programme covers.
struct Area {
    /// For each cell of the floor its index in the programme plus one; zero if it is not part of
    /// it.
    numbers: Vec<u32>,
    demands: Vec<Demand>,
    /// Total weight of the requested floor, including cells that no candidate can see.
    weight: u64,
    lowered: usize,
}

impl Area {
    fn new(request: &Request, seen_by: &[u32]) -> Result<Self, PlacementError> {
        let critical = request.critical.as_ref();
        let is_critical = |cell: usize| critical.is_some_and(|it| it.cells[cell]);
        let rule = critical.map(|it| it.rule);
        if critical.is_some_and(|it| !it.cells.contains(&true)) {
            return Err(PlacementError::NothingCritical);
        }
        let mut area =
            Self { numbers: vec![0; seen_by.len()], demands: Vec::new(), weight: 0, lowered: 0 };
        for (cell, &seen_by) in seen_by.iter().enumerate() {
            let is_twice = is_critical(cell) && rule == Some(CriticalRule::Twice);
            if rule == Some(CriticalRule::Only) && !is_critical(cell) {
                // The cell need not be covered, but overlap in it connects cameras.
                area.demands.push(IGNORED);
                area.numbers[cell] = area.demands.len() as u32;
                continue;
            }
            let is_weighted = is_critical(cell) && rule == Some(CriticalRule::Weighted);
            let weight = if is_weighted { CRITICAL_WEIGHT } else { 1 };
            area.weight += u64::from(weight);
            if seen_by == 0 {
                continue;
            }
            let wanted = request.at_least.max(if is_twice { TWICE } else { 1 });
            let is_required = request.aim == Aim::Cover || is_twice;
            // A cell can't require more cameras than there are candidates that see it.
            let most = u16::try_from(seen_by).unwrap_or(u16::MAX);
            let at_least = if is_required { wanted.min(most) } else { wanted };
            area.lowered += usize::from(at_least < wanted);
            let at_most = request.at_most.unwrap_or(ANY_OVERLAP);
            area.demands.push(Demand { at_least, at_most, weight, is_required });
            area.numbers[cell] = area.demands.len() as u32;
        }
        if area.demands.iter().all(|demand| *demand == IGNORED) {
            return Err(PlacementError::NothingSeen);
        }
        Ok(area)
    }

    /// The same views with the cells' indices in the programme.
    fn numbered(&self, covers: &Incidence) -> Incidence {
        let number = |&cell: &u32| self.numbers[cell as usize].checked_sub(1);
        let rows = covers.iter().map(|cells| cells.iter().filter_map(number).collect::<Vec<u32>>());
        Incidence::from_rows(rows)
    }

    /// The views without cells beside an obstacle, where no robot can bring a landmark; in the indices of
    /// the programme.
    fn passable(&self, plan: &FloorPlan, views: &Incidence) -> Incidence {
        let mut is_passable = vec![false; self.demands.len()];
        for (cell, number) in plan.cells().iter().zip(&self.numbers) {
            let (column, row) = (cell.column, cell.row);
            let beside = [
                (column + 1, row),
                (column.wrapping_sub(1), row),
                (column, row + 1),
                (column, row.wrapping_sub(1)),
            ];
            if let Some(number) = number.checked_sub(1) {
                is_passable[number as usize] =
                    beside.iter().all(|&(column, row)| plan.cell_at(column, row).is_some());
            }
        }
        let passable = |cells: &[u32]| -> Vec<u32> {
            cells.iter().copied().filter(|&cell| is_passable[cell as usize]).collect()
        };
        Incidence::from_rows(views.iter().map(passable))
    }

    fn programme(
        &self,
        request: &Request,
        covers: &Incidence,
    ) -> Result<Programme, PlacementError> {
        let total = |is_required: bool| -> u64 {
            let cells = self.demands.iter().filter(|it| it.is_required == is_required);
            cells.map(|it| u64::from(it.weight)).sum()
        };
        let goal = match request.aim {
            Aim::Cover => Goal::Fewest { weight: 0 },
            Aim::Cameras(cameras) => Goal::Best { cameras },
            Aim::Share(share) => {
                // Slightly less, so that rounding does not turn 0.9 of ten cells into more than
                // nine.
                let asked = (share * self.weight as f64 - 1e-9).ceil() as u64;
                if asked > total(true) + total(false) {
                    let of_all = |weight: f64| 100.0 * weight / self.weight as f64;
                    return Err(PlacementError::Unreachable {
                        asked: 100.0 * share,
                        seen: of_all((total(true) + total(false)) as f64),
                    });
                }
                Goal::Fewest { weight: asked.saturating_sub(total(true)) }
            }
        };
        Ok(Programme::new(self.demands.clone(), self.numbered(covers), goal))
    }
}

/// Checks that there are enough cameras for the cells that must be seen.
fn check_camera_count(
    programme: &Programme,
    request: &Request,
    report: &mut dyn FnMut(Stage) -> f64,
) -> Result<(), PlacementError> {
    let Aim::Cameras(cameras) = request.aim else { return Ok(()) };
    if !programme.demands.iter().any(|it| it.is_required) {
        return Ok(());
    }
    let fewest = Programme { goal: Goal::Fewest { weight: 0 }, ..programme.clone() };
    let solution = solve(&fewest, request.seed, &mut |interim| {
        let is_enough = interim.cameras.is_some_and(|found| found <= cameras);
        let is_proved = interim.bound.is_some_and(|least| least > cameras as u64);
        let spent = report(Stage::Solving(Interim::default()));
        if is_enough || is_proved { 1.0 } else { spent / CHECKED }
    });
    if solution.is_infeasible {
        return Err(no_placement(request, true));
    }
    if solution.bound > cameras as u64 {
        return Err(PlacementError::TooFewCameras { cameras, least: solution.bound });
    }
    Ok(())
}

/// Solves the programme with the own solver, then with the requested one.
fn solve_all(
    programme: &Programme,
    request: &Request,
    report: &mut dyn FnMut(Stage) -> f64,
) -> Result<Solution, PlacementError> {
    let share = if request.milp.is_some() { CHECKED } else { SOLVED };
    let solution = solve(programme, request.seed, &mut |it| report(Stage::Solving(*it)) / share);
    match &request.milp {
        Some(milp) if report(Stage::Solving(Interim::default())) < 1.0 => {
            Ok(milp::improve(programme, solution, milp)?)
        }
        _ => Ok(solution),
    }
}

fn no_placement(request: &Request, is_proved: bool) -> PlacementError {
    let advice = match (request.at_most, request.at_least) {
        (Some(_), _) => "raise --max-overlap, or give more places, headings or tilts",
        (None, _) => "lower --min-overlap, or give more places, headings or tilts",
    };
    if is_proved {
        PlacementError::Infeasible { advice }
    } else {
        PlacementError::NotFound { advice }
    }
}

/// Removes cameras that add no coverage.
fn drop_surplus(programme: &Programme, chosen: &mut Vec<u32>) {
    let weight = programme.tally(chosen).covered_weight;
    for index in (0..chosen.len()).rev() {
        let candidate = chosen.remove(index);
        let tally = programme.tally(chosen);
        if tally.covered_weight < weight || tally.shortfall > 0 {
            chosen.insert(index, candidate);
        }
    }
}

/// The number of these candidates that see each cell.
fn overlap(covers: &Incidence, chosen: &[u32], cells: usize) -> Vec<u16> {
    let mut overlap = vec![0; cells];
    for &candidate in chosen {
        for &cell in covers.row(candidate as usize) {
            overlap[cell as usize] += 1;
        }
    }
    overlap
}

/// Inputs for connecting the overlap graph.
struct Connection<'a> {
    programme: &'a Programme,
    request: &'a Request,
    views: Views<'a>,
    fewest_pieces: usize,
}

impl Connection<'_> {
    /// Changes a placement so that it has as few pieces as possible. Cameras are added, or coverage
    /// given up, only if the request allows it. Returns the number of pieces.
    fn mend(&mut self, chosen: &mut Vec<u32>, report: &mut dyn FnMut(Stage) -> f64) -> usize {
        let pieces = self.count(chosen);
        if pieces <= self.fewest_pieces || self.request.at_most == Some(1) {
            return pieces;
        }
        let weight = self.programme.tally(chosen).optional_weight;
        let least_weight = match self.programme.goal {
            Goal::Best { .. } if self.request.connect => 0,
            Goal::Best { .. } => weight,
            Goal::Fewest { .. } => 0,
        };
        let exchanges = if self.request.connect { MOST_EXCHANGES } else { FREE_EXCHANGES };
        if self.anneal(chosen, least_weight, exchanges, report) > self.fewest_pieces
            && self.request.connect
            && matches!(self.programme.goal, Goal::Fewest { .. })
        {
            self.add_cameras(chosen, report);
        }
        self.count(chosen)
    }

    fn count(&self, chosen: &[u32]) -> usize {
        let pieces = connection::pieces(self.views, chosen);
        pieces.into_iter().max().map_or(0, |last| last + 1)
    }

    /// Exchanges cameras, and accepts placements with fewer pieces. Returns the number of pieces.
    fn anneal(
        &self,
        chosen: &mut Vec<u32>,
        least_weight: u64,
        exchanges: usize,
        report: &mut dyn FnMut(Stage) -> f64,
    ) -> usize {
        let seed = self.request.seed;
        let mut search = Connecting::new(self.programme, self.views, chosen, least_weight, seed);
        let mut pieces = self.count(chosen);
        let mut rest = exchanges / EXCHANGES;
        while rest > 0 && report(Stage::Connecting { cameras: chosen.len(), pieces }) < 1.0 {
            rest -= 1;
            search.run(EXCHANGES);
            let Some((found, best)) = search.best().filter(|(found, _)| *found <= pieces) else {
                continue;
            };
            if found < pieces && found <= self.fewest_pieces {
                // What remains to be gained is coverage.
                let is_best = matches!(self.programme.goal, Goal::Best { .. });
                rest = if is_best { rest.min(IMPROVING / EXCHANGES) } else { 0 };
            }
            pieces = found;
            *chosen = best.to_vec();
        }
        pieces
    }

    /// Adds cameras until the pieces are connected, then looks for a connected placement with fewer
    /// cameras.
    fn add_cameras(&self, chosen: &mut Vec<u32>, report: &mut dyn FnMut(Stage) -> f64) {
        let least = chosen.len();
        let before = self.count(chosen);
        let bridged = connection::bridge(self.programme, self.views, chosen, self.fewest_pieces);
        if self.count(&bridged) >= before {
            return;
        }
        *chosen = bridged;
        let pieces = self.count(chosen);
        while chosen.len() > least + 1 {
            // Starts with an arbitrary camera removed: the search replaces the others as needed.
            let mut fewer = chosen[1..].to_vec();
            let spent = report(Stage::Connecting { cameras: fewer.len(), pieces });
            if spent >= 1.0
                || self.anneal(&mut fewer, 0, MOST_EXCHANGES, report) > pieces
                || !self.programme.is_feasible(&fewer)
            {
                return;
            }
            *chosen = fewer;
        }
    }
}
