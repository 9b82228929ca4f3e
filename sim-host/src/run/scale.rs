//! `ubimap scale`: fits the scale curve of a grey camera to a measured table (Ahmed, table 1 and
//! equation 1).

use std::{fmt, path::PathBuf};

use clap::Args;
use serde::Serialize;
use ubimap_agent::sense::{ScaleCurve, TABLE_1};

use super::{RunError, vision};
use crate::{files, report::ScaleRow};

/// Options of `ubimap scale`.
#[derive(Args, Clone, Debug)]
pub struct ScaleOptions {
    /// A table with two columns, separated by a comma, and at least five rows: pixels of free floor in the
    /// picture's middle column, and the distance to the object there in any unit. Without it, Ahmed's
    /// table 1
    #[arg(value_name = "TABLE.csv")]
    pub table: Option<PathBuf>,

    /// Print the fit as JSON
    #[arg(long)]
    pub json: bool,
}

/// A table with its fit.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ScaleFit {
    /// The table's name.
    pub name: String,
    /// Coefficients of the scale factor alpha by powers of the pixels, from the constant on: what
    /// [`ScaleCurve::of_powers`] takes.
    pub coefficients: [f64; 5],
    /// The rows of the table.
    pub rows: Vec<ScaleRow>,
    /// For table 1: distances by equation 1 as printed, row by row.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub as_printed: Vec<f64>,
    /// Distance up to which an error of one pixel moves a boundary at most twice as far as at the near end.
    pub near: f64,
}

/// Fits the table, or table 1.
///
/// # Errors
/// [`RunError::Scale`]: the table can't be read or fitted.
pub fn run(options: &ScaleOptions) -> Result<ScaleFit, RunError> {
    let Some(path) = &options.table else { return table_1() };
    let name = path.display().to_string();
    let wrong = |reason: String| RunError::Scale { name: name.clone(), reason };
    let text = files::read_settings(path).map_err(|error| wrong(error.to_string()))?;
    let table = read(&text).map_err(wrong)?;
    fit(&name, &table)
}

/// The fit of table 1 beside equation 1.
///
/// # Errors
/// [`RunError::Scale`]: never, the table is built in.
pub fn table_1() -> Result<ScaleFit, RunError> {
    let printed = |&(pixels, _): &(u8, f32)| {
        ScaleCurve::EQUATION_1.distance(pixels).map_or(f64::NAN, f64::from)
    };
    let as_printed = TABLE_1.iter().map(printed).collect();
    Ok(ScaleFit { as_printed, ..fit("Ahmed's table 1", &TABLE_1)? })
}

fn fit(name: &str, table: &[(u8, f32)]) -> Result<ScaleFit, RunError> {
    let curve = ScaleCurve::fit(table)
        .map_err(|error| RunError::Scale { name: name.to_owned(), reason: error.to_string() })?;
    Ok(ScaleFit {
        name: name.to_owned(),
        coefficients: powers(&curve, table),
        rows: vision::rows(table, &curve),
        as_printed: Vec::new(),
        near: curve.near().into(),
    })
}

/// The rows of a table; a first line that starts with no number is a heading.
fn read(text: &str) -> Result<Vec<(u8, f32)>, String> {
    let mut rows = Vec::new();
    for (index, line) in text.lines().enumerate() {
        let cells: Vec<&str> = line.split(',').map(str::trim).collect();
        let is_heading =
            index == 0 && !line.trim_start().starts_with(|it: char| it.is_ascii_digit());
        if is_heading || line.trim().is_empty() {
            continue;
        }
        let row = match cells[..] {
            [pixels, distance, ..] => pixels.parse().ok().zip(distance.parse().ok()),
            _ => None,
        };
        rows.push(row.ok_or_else(|| {
            format!(
                "line {}: \"{line}\" is no row; give pixels (1 to 255) and a distance, such as 62,74",
                index + 1
            )
        })?);
    }
    Ok(rows)
}

/// The coefficients of a curve by powers of the pixels: of the polynomial through five of its points.
fn powers(curve: &ScaleCurve, table: &[(u8, f32)]) -> [f64; 5] {
    let (first, last) = (table.first(), table.last());
    let (first, last) = (first.map_or(0, |it| it.0), last.map_or(0, |it| it.0));
    let at = |index: usize| first + ((usize::from(last - first) * index) / 4) as u8;
    let points: [u8; 5] = std::array::from_fn(at);
    let mut slopes = points.map(|pixels| curve.alpha(pixels).map_or(f64::NAN, f64::from));
    for order in 1..5 {
        for index in (order..5).rev() {
            let apart = f64::from(points[index]) - f64::from(points[index - order]);
            slopes[index] = (slopes[index] - slopes[index - 1]) / apart;
        }
    }
    // Newton's form, multiplied out from the last term on.
    let mut powers = [0.0; 5];
    for (slope, pixels) in slopes.into_iter().zip(points).rev() {
        for index in (0..5).rev() {
            let lower = if index > 0 { powers[index - 1] } else { 0.0 };
            powers[index] = lower - powers[index] * f64::from(pixels);
        }
        powers[0] += slope;
    }
    powers
}

impl fmt::Display for ScaleFit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}, fitted with a polynomial of fourth degree", self.name)?;
        write!(f, "  d_r (px)   d_c  alpha  fitted d_c  residual")?;
        writeln!(f, "{}", if self.as_printed.is_empty() { "" } else { "  by equation 1" })?;
        for (index, row) in self.rows.iter().enumerate() {
            let &ScaleRow { pixels, distance, fitted } = row;
            let (alpha, off) = (distance / f64::from(pixels), fitted - distance);
            write!(f, "  {pixels:>8} {distance:>5} {alpha:>6.2} {fitted:>11.1} {off:>9.2}")?;
            match self.as_printed.get(index) {
                Some(printed) => writeln!(f, " {printed:>14.1}")?,
                None => writeln!(f)?,
            }
        }
        let squares: f64 = self.rows.iter().map(|row| (row.fitted - row.distance).powi(2)).sum();
        let rms = (squares / self.rows.len().max(1) as f64).sqrt();
        let [a, b, c, d, e] = self.coefficients;
        let [first, last] =
            [self.rows.first(), self.rows.last()].map(|row| row.map_or(0, |it| it.pixels));
        writeln!(f, "residual {rms:.2} (RMS); distances up to {:.0} count as near", self.near)?;
        writeln!(
            f,
            "for the robot: ScaleCurve::of_powers([{a:.6e}, {b:.6e}, {c:.6e}, {d:.6e}, {e:.6e}], {first}, {last})"
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_printed_coefficients_are_those_that_a_robot_takes() {
        let found = table_1().unwrap();
        let curve = ScaleCurve::of_powers(found.coefficients.map(|it| it as f32), 62, 121);
        for row in &found.rows {
            let again = f64::from(curve.distance(row.pixels).unwrap());
            assert!((again - row.fitted).abs() < 0.1, "{row:?}: {again}");
            assert!((row.fitted - row.distance).abs() < 3.0, "{row:?}");
        }
        // Equation 1 as printed lies 3 to 11 pixels below its own table.
        let below = found.rows.iter().zip(&found.as_printed);
        let below: Vec<f64> = below.map(|(row, printed)| row.distance - printed).collect();
        assert!(below.iter().all(|it| (2.0..12.0).contains(it)), "{below:?}");
    }

    #[test]
    fn a_table_is_read_with_or_without_a_heading_and_mistakes_are_named() {
        let rows = "62,74\n69, 83\n75,91,1.21\n";
        let expected = Ok(vec![(62, 74.0), (69, 83.0), (75, 91.0)]);
        assert_eq!(read(rows), expected);
        assert_eq!(read(&format!("d_r,d_c\n{rows}\n")), expected);
        for bad in ["62;74", "62,74\nd_r,d_c", "300,1", "62,"] {
            assert!(read(bad).unwrap_err().contains("is no row"), "{bad}");
        }
        assert!(fit("t", &[(62, 74.0)]).unwrap_err().to_string().starts_with("t: the scale table"));
    }
}
