//! The cells that each candidate covers: the paper's `f : C -> 2^S`.

use super::{
    camera::{CameraModel, Candidate, Footprint, Projection},
    floor_plan::FloorPlan,
    incidence::Incidence,
    sight::Sight,
};

/// For each candidate the cells of a floor that it covers, ascending.
///
/// Candidates at the same point should be adjacent in the list: the floor hidden from that point is
/// then computed only once.
pub fn coverage(
    plan: &FloorPlan,
    projection: Projection,
    model: &CameraModel,
    candidates: &[Candidate],
) -> Incidence {
    let mut seen: Option<([f64; 3], Vec<u32>)> = None;
    Incidence::from_rows(candidates.iter().map(|candidate| {
        let footprint = Footprint::new(projection, model, candidate);
        let eye = candidate.position_m;
        let reach = footprint.reach_m();
        if projection == Projection::Paper {
            let cells = plan
                .cells_within([eye[0] - reach, eye[1] - reach], [eye[0] + reach, eye[1] + reach]);
            return inside(plan, &footprint, cells);
        }
        if seen.as_ref().is_none_or(|(from, _)| *from != eye) {
            seen = Some((eye, Sight::new(plan, eye, reach).cells(reach)));
        }
        let cells = seen.iter().flat_map(|(_, cells)| cells).map(|&cell| cell as usize);
        inside(plan, &footprint, cells)
    }))
}

fn inside(plan: &FloorPlan, footprint: &Footprint, cells: impl Iterator<Item = usize>) -> Vec<u32> {
    let is_inside = |cell: &usize| footprint.contains(plan.cells()[*cell].aim_m);
    cells.filter(is_inside).map(|cell| cell as u32).collect()
}
