//! The four lines that a run prints at its end.

use std::path::Path;

use super::{summary::Report, watching::WatchReport};

/// The texts for the four lines of a report.
pub trait Brief {
    /// The quality of the map.
    fn quality(&self) -> String;
    /// Whether the robots and the server agree on the map; for recorded cameras, which of them drew
    /// it.
    fn agreement(&self) -> String;
    /// The durations of the run, simulated and real.
    fn time(&self) -> String;
}

/// The four lines: quality, agreement, time, and where the results are.
pub fn brief(report: &impl Brief, results: &Path) -> String {
    let map = results.join("map.png");
    format!(
        "quality:   {}\nagreement: {}\ntime:      {}\nresults:   in {}; open {} first\n",
        report.quality(),
        report.agreement(),
        report.time(),
        results.display(),
        map.display(),
    )
}

impl Brief for Report {
    fn quality(&self) -> String {
        let map = &self.map;
        let known = area(map.known, map.resolution_m);
        match self.truth {
            Some(truth) => format!(
                "F1 of walls and furniture {:.3}; {known} known, {:.1} % of the room",
                truth.f1_occupied,
                100.0 * truth.coverage,
            ),
            None => format!("{known} known, with {} occupied cells", map.occupied),
        }
    }

    fn agreement(&self) -> String {
        let robots = count(self.robots.len(), "robot");
        if self.map.known == 0 {
            "NOT reached: nothing was mapped, so there is nothing to agree on".to_owned()
        } else if self.map.converged {
            format!("{robots} and the server hold the same map")
        } else {
            format!("NOT reached: {robots} and the server hold different maps")
        }
    }

    fn time(&self) -> String {
        format!(
            "{:.0} s of simulated or recorded time, processed in {:.0} s",
            self.simulated_s, self.elapsed_s
        )
    }
}

impl Brief for WatchReport {
    fn quality(&self) -> String {
        let map = &self.map;
        let seen = self.robots.iter().filter(|robot| robot.sightings > 0).count();
        format!(
            "{} known, {} in view at the end; {seen} of {} localised",
            area(map.known, map.resolution_m),
            area(map.in_view, map.resolution_m),
            count(self.robots.len(), "robot"),
        )
    }

    fn agreement(&self) -> String {
        let looked = self.cameras.iter().filter(|camera| camera.looks > 0).count();
        let drew = format!("{looked} of {} drew the map", count(self.cameras.len(), "camera"));
        let floors = || self.cameras.iter().filter_map(|camera| camera.floor);
        if floors().count() == 0 {
            return drew;
        }
        let height_m = floors().map(|floor| floor.height_m.abs()).fold(0.0, f64::max);
        let tilt_deg = floors().map(|floor| floor.tilt_deg).fold(0.0, f64::max);
        let corrected = match floors().filter(|floor| floor.is_corrected).count() {
            0 => String::new(),
            number => format!(", {number} corrected"),
        };
        format!(
            "{drew}; floors within {:.1} cm and {tilt_deg:.2} degrees of z = 0{corrected}",
            100.0 * height_m
        )
    }

    fn time(&self) -> String {
        format!("{:.0} s recorded, watched in {:.0} s", self.recorded_s, self.elapsed_s)
    }
}

fn area(cells: u64, resolution_m: f64) -> String {
    format!("{:.1} m2", cells as f64 * resolution_m * resolution_m)
}

fn count(number: usize, what: &str) -> String {
    format!("{number} {what}{}", if number == 1 { "" } else { "s" })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::{CameraSummary, Comparison, MapSummary, SeenRobot, TruthScores};

    #[test]
    fn a_run_ends_with_four_lines() {
        let map = MapSummary { known: 4_000, resolution_m: 0.05, ..MapSummary::default() };
        let mut report = Report::new(1, vec![Default::default()], map, Comparison::default());
        report.simulated_s = 20.0;
        let text = brief(&report, Path::new("out"));
        assert_eq!(
            text,
            "quality:   10.0 m2 known, with 0 occupied cells\n\
             agreement: NOT reached: 1 robot and the server hold different maps\n\
             time:      20 s of simulated or recorded time, processed in 0 s\n\
             results:   in out; open out/map.png first\n"
        );
        report.map.known = 0;
        report.map.converged = true;
        assert!(report.agreement().starts_with("NOT reached: nothing was mapped"));
        report.map.known = 4_000;
        report.truth =
            Some(TruthScores { f1_occupied: 0.9, coverage: 0.5, ..TruthScores::default() });
        assert_eq!(
            report.quality(),
            "F1 of walls and furniture 0.900; 10.0 m2 known, 50.0 % of the room"
        );
        assert_eq!(report.agreement(), "1 robot and the server hold the same map");
    }

    #[test]
    fn a_recording_tells_of_its_cameras() {
        let report = WatchReport {
            cameras: vec![CameraSummary { looks: 1, ..Default::default() }, Default::default()],
            robots: vec![SeenRobot { sightings: 7, ..Default::default() }],
            ..WatchReport::default()
        };
        assert_eq!(report.agreement(), "1 of 2 cameras drew the map");
        assert!(report.quality().ends_with("1 of 1 robot localised"), "{}", report.quality());
    }
}
