//! What is left to explore, and why.

use core::fmt;

use super::{coordinator::Coordinator, frontiers::Frontier, ground::Point};

/// A border of unknown ground that no camera sees.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Unexplored {
    /// A place on it in `map`, in metres.
    pub place_m: [f64; 2],
    /// At most the area that looking at it would reveal, as far as the robots' sensors reach, in square metres.
    pub area_m2: f64,
    /// Why it is left.
    pub why: WhyUnexplored,
}

/// Why ground is not explored. The text continues a sentence that starts with the ground.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WhyUnexplored {
    /// A robot is sent to look at it.
    IsTarget,
    /// Robots have looked at it from several places, and nothing was seen.
    SeenInVain,
    /// A robot could not see or reach it, and others may try after a while.
    PutOff,
    /// No robot that explores gets to a place from which it would be seen.
    OutOfReach,
    /// Robots that could look at it have other things to do.
    Waits,
}

impl Coordinator {
    /// What is left to explore by the last survey, the largest first: of the borders that one look reveals, the
    /// one with most behind it. Cost: a search for each robot that explores.
    pub fn unexplored(&self) -> Vec<Unexplored> {
        let all: Vec<&Frontier> = self.frontiers.iter().collect();
        let Some(ground) = &self.ground else { return Vec::new() };
        let explorers = (0..self.members.len()).filter(|&it| self.members[it].explores);
        let views: Vec<Vec<bool>> = explorers
            .map(|index| {
                let views = self.approach(ground, index, &[]).views(&all);
                views.iter().map(Option::is_some).collect()
            })
            .collect();
        let rules = &self.settings.exploration;
        let why = |at: usize, frontier: &Frontier| {
            let is_target = |place: Point| (frontier.place - place).norm() <= rules.same_m;
            let mut targets = self.frontier_targets();
            let tried = self.tried.iter().filter(|it| it.is_of(frontier.place, rules.tried_m));
            match tried.count() {
                _ if targets.any(|target| is_target(target.frontier)) => WhyUnexplored::IsTarget,
                looks if looks >= rules.most_looks => WhyUnexplored::SeenInVain,
                _ if !views.iter().any(|views| views[at]) => WhyUnexplored::OutOfReach,
                0 => WhyUnexplored::Waits,
                _ => WhyUnexplored::PutOff,
            }
        };
        let mut left: Vec<(&Frontier, WhyUnexplored)> =
            all.iter().enumerate().map(|(at, frontier)| (*frontier, why(at, frontier))).collect();
        left.sort_by(|(one, _), (other, _)| other.gain_m2.total_cmp(&one.gain_m2));
        // A long border is in many pieces, and a look at one reveals what is behind those beside it.
        let mut told: Vec<(&Frontier, WhyUnexplored)> = Vec::new();
        for (frontier, why) in left {
            let is_beside = |(other, its): &(&Frontier, WhyUnexplored)| {
                *its == why && (other.place - frontier.place).norm() <= self.settings.view_m
            };
            if !told.iter().any(is_beside) {
                told.push((frontier, why));
            }
        }
        let told = told.into_iter().map(|(frontier, why)| Unexplored {
            place_m: [frontier.place.x, frontier.place.y],
            area_m2: frontier.gain_m2,
            why,
        });
        told.collect()
    }
}

impl fmt::Display for WhyUnexplored {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::IsTarget => "a robot is on its way",
            Self::SeenInVain => {
                "robots have looked from several places, and there is nothing to be seen"
            }
            Self::PutOff => "a robot could not see or reach it; it is tried again",
            Self::OutOfReach => "no robot gets to where it would be seen",
            Self::Waits => "waits for a robot",
        })
    }
}
