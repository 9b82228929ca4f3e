//! Computes a placement from a room and a request.

use super::{
    camera::{CameraModel, Candidate, Projection},
    candidates::{CandidatesError, Choices, candidates},
    connection::{self, Connecting},
    coverage::coverage,
    floor_plan::FloorPlan,
    incidence::Incidence,
    milp::{self, Milp, MilpError},
    programme::{ANY_OVERLAP, Demand, Goal, Programme},
    solver::{Interim, Solution, solve},
};

/// Weight of a critical cell under [`CriticalRule::Weighted`].
const CRITICAL_WEIGHT: u32 = 5;
/// Minimum overlap of a critical cell under [`CriticalRule::Twice`].
const TWICE: u16 = 2;

/// Minimum floor that two neighbouring cameras share, in square metres: room for landmarks.
const SHARED_M2: f64 = 0.25;

/// The share of the time after which a solution is taken as it is, so that the rest is left for its
/// connection.
const SOLVED: f64 = 0.8;
/// The share of the time for finding out how many cameras the critical cells need.
const CHECKED: f64 = 0.2;
/// Exchanges tried to connect a placement for free, and where it is asked for.
const FREE_EXCHANGES: usize = 20_000;
const MOST_EXCHANGES: usize = 1_000_000;
/// Exchanges between two reports.
const EXCHANGES: usize = 500;

/// The demand of a cell that need not be covered.
const IGNORED: Demand = Demand { at_least: 0, at_most: ANY_OVERLAP, weight: 0, is_required: false };

/// A request for a placement.
#[derive(Clone, Debug)]
pub struct Request {
    /// Which floor counts as seen.
    pub projection: Projection,
    /// The cameras.
    pub model: CameraModel,
    /// Where they may hang and how they may look.
    pub choices: Choices,
    /// A cell counts as covered from this number of cameras on: the paper's `m`.
    pub at_least: u16,
    /// No more cameras may see a cell: the paper's `k`.
    pub at_most: Option<u16>,
    /// The goal of the optimisation.
    pub aim: Aim,
    /// Cells that matter more, and how.
    pub critical: Option<Critical>,
    /// Whether cameras may be added, or less be covered, to connect the overlap.
    pub connect: bool,
    /// Another solver for the integer programme, after the local search has had a fifth of the time.
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
    /// How they are treated.
    pub rule: CriticalRule,
}

/// How critical cells are treated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CriticalRule {
    /// At least two cameras must see them.
    Twice,
    /// They count five times.
    Weighted,
    /// They alone are the paper's `S`; other floor is left out.
    Only,
}

/// Why there is no placement. Each is one line, without the name of the room.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PlacementError {
    /// There are no candidates.
    #[error(transparent)]
    Candidates(#[from] CandidatesError),
    /// m > k.
    #[error("the minimum overlap exceeds the maximum: at least {at_least} and at most {at_most}")]
    Bounds {
        /// The lower bound.
        at_least: u16,
        /// The upper bound.
        at_most: u16,
    },
    /// Critical cells need two cameras, and may have one.
    #[error("critical cells must be seen twice, but the maximum overlap is {at_most}")]
    CriticalBounds {
        /// The upper bound.
        at_most: u16,
    },
    /// Connected cameras see some cells together.
    #[error("connected cameras must overlap, but the maximum overlap is 1")]
    ConnectedBounds,
    /// No cell is critical.
    #[error("no cell of the floor is critical")]
    NothingCritical,
    /// No candidate sees any cell.
    #[error("no candidate sees any of the floor")]
    NothingSeen,
    /// More is asked for than all candidates see together.
    #[error(
        "{asked:.1} % of the floor requested, but all candidates together see only {seen:.1} %"
    )]
    Unreachable {
        /// Coverage asked for, in per cent.
        asked: f64,
        /// Floor that any candidate sees, in per cent.
        seen: f64,
    },
    /// The critical cells need more cameras than there are.
    #[error("{cameras} cameras are too few: the critical cells need at least {least}")]
    TooFewCameras {
        /// Cameras asked for.
        cameras: usize,
        /// Cameras needed at least.
        least: u64,
    },
    /// Proved to be infeasible.
    #[error("no placement keeps every overlap within its bounds; {advice}")]
    Infeasible {
        /// What to change.
        advice: &'static str,
    },
    /// None found in time; infeasibility is not proved.
    #[error("no placement was found in time that keeps every overlap within its bounds; {advice}")]
    NotFound {
        /// What to change.
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
    /// The overlap is being connected.
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
    /// For each cell of the floor the number of candidates that see it: zero for a blind one.
    pub seen_by: Vec<u32>,
    /// Number of candidates, and the spacing of their places in metres.
    pub candidates: usize,
    /// See [`Placement::candidates`].
    pub spacing_m: f64,
    /// Cells that must be seen by more cameras than candidates see them, and are seen by fewer
    /// therefore; without blind ones.
    pub lowered: usize,
    /// What has been optimised, by its value: cameras, or total weight of the covered cells.
    pub value: u64,
    /// No placement is better than this.
    pub bound: u64,
    /// Cameras that were added to connect the overlap; beyond [`Placement::value`].
    pub added: usize,
    /// Pieces of the overlap graph: one if calibration can follow it everywhere.
    pub pieces: usize,
    /// The fewest pieces that any choice of candidates has which covers all that they see.
    pub fewest_pieces: usize,
}

impl Placement {
    /// Whether no placement is better, apart from cameras added to connect the overlap: proved.
    pub fn is_optimal(&self) -> bool {
        self.value == self.bound
    }

    /// How far from optimal the value may be: the difference between it and the bound, by the value
    /// for the fewest cameras and by the bound for the greatest coverage.
    pub fn gap(&self) -> f64 {
        self.value.abs_diff(self.bound) as f64 / self.value.max(self.bound).max(1) as f64
    }
}

/// Places cameras in a room.
///
/// `report` hears what goes on, every few milliseconds while a solution is searched for, and gives
/// the share of the time that is spent; from 1 on the best placement so far is taken.
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
    let mut connection = Connection { programme: &programme, request, shared, fewest_pieces };
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

/// The cells of a programme among those of the floor.
struct Area {
    /// For each cell of the floor its number in the programme plus one; zero for none.
    numbers: Vec<u32>,
    demands: Vec<Demand>,
    /// Total weight of the floor that is asked for, seen by any candidate or not.
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
                // Nothing is asked of it, but overlap there connects cameras.
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
            // A required cell can't demand more cameras than candidates see it.
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

    fn programme(
        &self,
        request: &Request,
        covers: &Incidence,
    ) -> Result<Programme, PlacementError> {
        let number = |&cell: &u32| self.numbers[cell as usize].checked_sub(1);
        let rows = covers.iter().map(|cells| cells.iter().filter_map(number).collect::<Vec<u32>>());
        let total = |is_required: bool| -> u64 {
            let cells = self.demands.iter().filter(|it| it.is_required == is_required);
            cells.map(|it| u64::from(it.weight)).sum()
        };
        let goal = match request.aim {
            Aim::Cover => Goal::Fewest { weight: 0 },
            Aim::Cameras(cameras) => Goal::Best { cameras },
            Aim::Share(share) => {
                // A share of 0.9 of ten cells is nine, whatever the product is rounded to.
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
        Ok(Programme::new(self.demands.clone(), Incidence::from_rows(rows), goal))
    }
}

/// Whether the cells that must be seen don't need more cameras than there are.
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

/// Solves the programme, first by the usual solver, then by the one that is asked for.
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
    shared: u16,
    fewest_pieces: usize,
}

impl Connection<'_> {
    /// Makes a placement fall into as few pieces as possible: for free, or, if the request says so, at
    /// the cost of cameras or of coverage. Returns the number of pieces.
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
        let pieces = connection::pieces(self.programme, chosen, self.shared);
        pieces.into_iter().max().map_or(0, |last| last + 1)
    }

    /// Exchanges cameras for others; takes what falls into fewer pieces, and returns how many there
    /// are.
    fn anneal(
        &self,
        chosen: &mut Vec<u32>,
        least_weight: u64,
        exchanges: usize,
        report: &mut dyn FnMut(Stage) -> f64,
    ) -> usize {
        let seed = self.request.seed;
        let mut search = Connecting::new(self.programme, chosen, self.shared, least_weight, seed);
        let mut pieces = self.count(chosen);
        for _ in 0..exchanges / EXCHANGES {
            let stage = Stage::Connecting { cameras: chosen.len(), pieces };
            if pieces <= self.fewest_pieces || report(stage) >= 1.0 {
                break;
            }
            search.run(EXCHANGES, self.fewest_pieces);
            if let Some((fewer, best)) = search.best().filter(|(found, _)| *found < pieces) {
                pieces = fewer;
                *chosen = best.to_vec();
            }
        }
        pieces
    }

    /// Adds cameras until the pieces are connected, then looks for a placement with fewer of them.
    fn add_cameras(&self, chosen: &mut Vec<u32>, report: &mut dyn FnMut(Stage) -> f64) {
        let least = chosen.len();
        let before = self.count(chosen);
        let bridged = connection::bridge(self.programme, chosen, self.shared, self.fewest_pieces);
        if self.count(&bridged) >= before {
            return;
        }
        *chosen = bridged;
        let pieces = self.count(chosen);
        while chosen.len() > least + 1 {
            // One camera fewer, whichever it is: the search finds the rest.
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
