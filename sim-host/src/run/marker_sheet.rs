//! `ubimap markers`: sheets of A4 with the robots' markers, to print and cut out.

use std::{fmt::Write, path::PathBuf, str::FromStr};

use clap::Args;

use super::RunError;
use crate::{
    report::OutputFile,
    world::{
        TAGS,
        tag::{self, SIDE, SQUARE},
    },
};

/// A4, in millimetres.
const PAGE: [f64; 2] = [210.0, 297.0];
/// Margin that printers leave white, in millimetres.
const EDGE: f64 = 10.0;
/// Height of the ruler at the foot of a page, in millimetres.
const RULER: f64 = 16.0;
/// Length of the ruler, in millimetres.
const RULER_LENGTH: u32 = 150;
/// Room around a marker for its cut marks and its name, in millimetres.
const AROUND: f64 = 8.0;
/// Length of a cut mark and its distance from the corner, in millimetres.
const CUT: [f64; 2] = [5.0, 1.0];
/// The smallest marker, in millimetres: a module of 2.5 mm is hardly seen from a ceiling.
const SMALLEST_MM: f64 = 20.0;

/// Options of `ubimap markers`.
#[derive(Args, Clone, Debug)]
pub struct MarkersOptions {
    /// The numbers of the tags (AprilTag 36h11), such as 1-8 or 1,3,5-7
    #[arg(long, value_name = "IDS")]
    pub ids: Ids,

    /// Side of a tag's black square, such as 120mm, 12cm or 0.12m
    #[arg(long, value_name = "SIZE", default_value = "120mm", value_parser = size_mm)]
    pub size: f64,

    /// The sheet; if several are needed, they are numbered: sheet-1.svg, sheet-2.svg
    #[arg(long, value_name = "SVG", default_value = "sheet.svg")]
    pub out: PathBuf,
}

/// Numbers of tags, each once.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Ids(Vec<u16>);

impl FromStr for Ids {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let mut ids: Vec<u16> = Vec::new();
        for part in text.split(',') {
            let (from, to) = part.split_once('-').unwrap_or((part, part));
            let number = |text: &str| {
                let number = text.trim().parse::<u16>().ok();
                let there = number.filter(|&it| usize::from(it) < TAGS);
                there.ok_or_else(|| format!("{part}: give numbers from 0 to {}", TAGS - 1))
            };
            let (from, to) = (number(from)?, number(to)?);
            if from > to {
                return Err(format!("{part}: the first number is above the last"));
            }
            for id in from..=to {
                if ids.contains(&id) {
                    return Err(format!("{id} is given twice"));
                }
                ids.push(id);
            }
        }
        Ok(Self(ids))
    }
}

/// A length in millimetres.
fn size_mm(text: &str) -> Result<f64, String> {
    let units = [("mm", 1.0), ("cm", 10.0), ("m", 1_000.0)];
    let parsed = units.into_iter().find_map(|(unit, mm)| {
        let number = text.strip_suffix(unit)?.trim().parse::<f64>().ok()?;
        Some(number * mm)
    });
    let most = largest_mm();
    let fits = |mm: &f64| (SMALLEST_MM..=most).contains(mm);
    parsed.filter(fits).ok_or_else(|| {
        format!("give a length from {SMALLEST_MM}mm to {most}mm (what fits on A4), such as 120mm")
    })
}

/// The side of the largest black square that fits across a page.
fn largest_mm() -> f64 {
    ((PAGE[0] - 2.0 * EDGE - 2.0 * AROUND) * SQUARE as f64 / SIDE as f64).floor()
}

/// Writes the sheets. Returns the lines of the deployment.
///
/// # Errors
/// [`RunError::Output`] if a sheet can't be written.
pub fn run(options: &MarkersOptions) -> Result<String, RunError> {
    let sheets = sheets(&options.ids, options.size);
    let mut answer = String::new();
    let is_one = sheets.len() == 1;
    for (number, sheet) in (1..).zip(&sheets) {
        let path = if is_one { options.out.clone() } else { numbered(&options.out, number)? };
        OutputFile::create(&path)?.finish(sheet.as_bytes())?;
        answer +=
            &format!("# {}: A4; print at 100 %, without fitting to the page\n", path.display());
    }
    answer += &format!(
        "# Measure the ruler. If its {RULER_LENGTH} mm are not {RULER_LENGTH} mm on paper, multiply marker_size_m by \
         what they are / {RULER_LENGTH}.\n"
    );
    answer += "# These lines belong into deployment.toml:\n";
    for id in &options.ids.0 {
        // Fails on no string.
        let _ = write!(
            answer,
            "\n[[robots]]\nid = {id}\nmarker_size_m = {}\nheight_m = 0.3     # measure: from the floor to the marker\n\
             box_m = [0.4, 0.4] # measure: the robot's length and width; for a round one, diameter_m = 0.4 instead\n",
            options.size / 1_000.0
        );
    }
    Ok(answer)
}

/// `sheet.svg` becomes `sheet-2.svg`.
fn numbered(path: &std::path::Path, number: usize) -> Result<PathBuf, RunError> {
    let stem = path.file_stem().and_then(|it| it.to_str());
    let stem =
        stem.ok_or_else(|| RunError::Markers(format!("{}: not a file's name", path.display())))?;
    let ending = path.extension().and_then(|it| it.to_str()).unwrap_or("svg");
    Ok(path.with_file_name(format!("{stem}-{number}.{ending}")))
}

/// The pages, as SVG in millimetres.
fn sheets(ids: &Ids, size_mm: f64) -> Vec<String> {
    let cell = size_mm * SIDE as f64 / SQUARE as f64 + 2.0 * AROUND;
    let fit = |room: f64| ((room / cell + 1e-9).floor() as usize).max(1);
    let columns = fit(PAGE[0] - 2.0 * EDGE);
    let rows = fit(PAGE[1] - 2.0 * EDGE - RULER);
    let page = |ids: &[u16]| {
        let markers = ids.iter().enumerate().map(|(index, &id)| {
            let (row, column) = (index / columns, index % columns);
            let at = [column, row].map(|it| EDGE + it as f64 * cell + AROUND);
            marker(id, size_mm, at)
        });
        let [width, height] = PAGE;
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}mm\" height=\"{height}mm\" \
             viewBox=\"0 0 {width} {height}\" font-family=\"sans-serif\" font-size=\"4\">\n\
             <rect x=\"0\" y=\"0\" width=\"{width}\" height=\"{height}\" fill=\"#fff\"/>\n{}{}</svg>\n",
            markers.collect::<String>(),
            ruler()
        )
    };
    ids.0.chunks(columns * rows).map(page).collect()
}

/// A tag whose white margin has its upper left corner at a point; around it cut marks and its name.
fn marker(id: u16, size_mm: f64, [left, top]: [f64; 2]) -> String {
    let module = size_mm / SQUARE as f64;
    let whole = module * SIDE as f64;
    let mut text = format!("<!-- tag {id} -->\n");
    for (row, modules) in tag::pattern(usize::from(id)).iter().flatten().enumerate() {
        // Each run of black modules is one rectangle: no seams within a row.
        let mut column = 0;
        for run in modules.chunk_by(|a, b| a == b) {
            if !run[0] {
                let [x, y] = [left + column as f64 * module, top + row as f64 * module];
                text += &rectangle([x, y], [run.len() as f64 * module, module]);
            }
            column += run.len();
        }
    }
    let [length, gap] = CUT;
    for (x, outwards) in [(left, -1.0), (left + whole, 1.0)] {
        for (y, down) in [(top, -1.0), (top + whole, 1.0)] {
            text += &line([x + outwards * gap, y], [x + outwards * (gap + length), y]);
            text += &line([x, y + down * gap], [x, y + down * (gap + length)]);
        }
    }
    let middle = left + whole / 2.0;
    let label = |y: f64, words: String| {
        format!("<text x=\"{middle:.3}\" y=\"{y:.3}\" text-anchor=\"middle\">{words}</text>\n")
    };
    text += &label(top - 2.0, "front".into());
    text + &label(top + whole + 5.0, format!("36h11 tag {id}, {size_mm} mm"))
}

/// A ruler with a mark every 10 mm.
fn ruler() -> String {
    let [left, y] = [(PAGE[0] - f64::from(RULER_LENGTH)) / 2.0, PAGE[1] - EDGE - 4.0];
    let mut text = line([left, y], [left + f64::from(RULER_LENGTH), y]);
    for mark in (0..=RULER_LENGTH).step_by(10) {
        let x = left + f64::from(mark);
        let height = if mark % 50 == 0 { 5.0 } else { 3.0 };
        text += &line([x, y], [x, y - height]);
    }
    let words = format!(
        "{RULER_LENGTH} mm between the outer marks: if not, the printer has scaled the page"
    );
    text + &format!("<text x=\"{left}\" y=\"{}\">{words}</text>\n", y + 4.0)
}

fn rectangle([x, y]: [f64; 2], [width, height]: [f64; 2]) -> String {
    format!(
        "<rect x=\"{x:.4}\" y=\"{y:.4}\" width=\"{width:.4}\" height=\"{height:.4}\" fill=\"#000\"/>\n"
    )
}

fn line([x1, y1]: [f64; 2], [x2, y2]: [f64; 2]) -> String {
    format!("<path d=\"M{x1:.3} {y1:.3}L{x2:.3} {y2:.3}\" stroke=\"#000\" stroke-width=\"0.2\"/>\n")
}

#[cfg(test)]
mod tests {
    use image::{GrayImage, Luma};

    use super::*;
    use crate::{
        camera::Picture,
        deployment::registry::Registry,
        perception::markers::{Identifier, ImageRegion, TagDetector},
        testing::Folder,
    };

    /// Pixels per millimetre.
    const SCALE: f64 = 4.0;

    /// The rectangles and lines of a sheet as a picture.
    fn rasterised(sheet: &str) -> GrayImage {
        let [width, height] = PAGE.map(|it| (it * SCALE) as u32);
        let mut picture = GrayImage::from_pixel(width, height, Luma([255]));
        for line in sheet.lines().filter(|it| it.starts_with("<rect")) {
            let value = |key: &str| -> f64 {
                let rest = line.split_once(&format!(" {key}=\"")).unwrap().1;
                rest.split_once('"').unwrap().0.parse().unwrap()
            };
            let shade = if line.contains("#000") { 0 } else { 255 };
            let from = [value("x"), value("y")].map(|it| (it * SCALE).round() as u32);
            let to = [value("x") + value("width"), value("y") + value("height")];
            let to = to.map(|it| (it * SCALE).round() as u32);
            for y in from[1]..to[1] {
                (from[0]..to[0]).for_each(|x| picture.put_pixel(x, y, Luma([shade])));
            }
        }
        picture
    }

    #[test]
    fn the_detector_reads_every_marker_of_the_sheets_at_its_size() {
        let all: Ids = format!("0-{}", TAGS - 1).parse().unwrap();
        // Three columns of four with 30 mm, one alone with 120 mm.
        for (ids, size, pages) in
            [(all, 30.0, 64_usize.div_ceil(12)), ("1-2".parse().unwrap(), 120.0, 2)]
        {
            let sheets = sheets(&ids, size);
            assert_eq!(sheets.len(), pages);
            let mut read = Vec::new();
            for sheet in &sheets {
                let picture = Picture::Grey(rasterised(sheet));
                for marker in TagDetector::default().detect(&picture, ImageRegion::all(&picture)) {
                    let Identifier::Tag(id) = marker.identifier else { panic!("a tag") };
                    read.push(id);
                    let [a, b] = [marker.points[0], marker.points[1]];
                    let side = (a[0] - b[0]).hypot(a[1] - b[1]) / SCALE;
                    assert!((side - size).abs() < 0.3, "tag {id}: {side} mm");
                }
            }
            assert_eq!(read.len(), ids.0.len());
            read.sort_unstable();
            assert_eq!(read, ids.0);
        }
    }

    #[test]
    fn the_lines_are_those_of_a_deployment() {
        let folder = Folder::new("markers");
        let out = folder.path().join("sheet.svg");
        let options = MarkersOptions { ids: "7,2-3".parse().unwrap(), size: 120.0, out };
        let registry = Registry::from_toml(&run(&options).unwrap()).unwrap();
        let robots = registry.robots.iter().map(|it| (it.id, it.marker_size_m));
        assert_eq!(robots.collect::<Vec<_>>(), [(7, 0.12), (2, 0.12), (3, 0.12)]);
        for page in 1..=3 {
            assert!(folder.path().join(format!("sheet-{page}.svg")).exists());
        }
    }

    #[test]
    fn bad_numbers_and_sizes_are_named() {
        for (ids, expected) in [
            ("3-1", "3-1: the first number is above the last"),
            ("1,64", "64: give numbers from 0 to 63"),
            ("1-3,2", "2 is given twice"),
            ("", "give numbers"),
        ] {
            let error = ids.parse::<Ids>().unwrap_err();
            assert!(error.contains(expected), "{error}");
        }
        assert_eq!([size_mm("12cm"), size_mm("0.12 m")], [Ok(120.0), Ok(120.0)]);
        for size in ["120", "NaNmm", "-5mm", "10mm", "200mm", "5in"] {
            assert!(size_mm(size).unwrap_err().contains("20mm to 139mm"), "{size}");
        }
    }
}
