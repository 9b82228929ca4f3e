//! The page: Markdown with pictures.

use std::fmt::Write;

use image::RgbImage;

use super::super::{Outcome, RunError};
use crate::report::{self, png};

/// What the page has of a section.
#[derive(Clone, Copy, Debug)]
pub(super) enum Has {
    /// The paper's experiment, run.
    Experiment,
    /// Figures for what the paper claims without one.
    Claims,
    /// How it is done here; the figures are elsewhere.
    Method,
    /// Nothing to run.
    Nothing,
}

/// A page that is being written.
pub(super) struct Page {
    contents: String,
    body: String,
    pictures: Vec<(String, Vec<u8>)>,
}

impl Page {
    pub(super) fn new(seconds: Option<f64>) -> Self {
        let cut = seconds.map_or(String::new(), |seconds| {
            format!(" **Each run was cut to {seconds} s: its figures say little.**")
        });
        let contents = format!(
            "# The papers' experiments\n\nWritten by `ubimap reproduce`: every number under \"ours\" is \
                of the runs that have \
             just been made, by the command beside it.{cut}\n\n## Contents\n\n"
        );
        Self { contents, body: String::new(), pictures: Vec::new() }
    }

    /// The title of a paper.
    pub(super) fn paper(&mut self, title: &str, reference: &str) {
        self.heading(0, title);
        let _ = writeln!(self.body, "{reference}\n");
    }

    /// A section of a paper, and what there is of it here, for the contents.
    pub(super) fn section(&mut self, title: &str, has: Has) {
        self.heading(1, title);
        let has = match has {
            Has::Experiment => "**experiment run**",
            Has::Claims => "**claims measured**",
            Has::Method => "method described, tested elsewhere",
            Has::Nothing => "no experiment",
        };
        // The heading has just ended its line.
        self.contents.pop();
        let _ = writeln!(self.contents, ": {has}");
    }

    fn heading(&mut self, depth: usize, title: &str) {
        let anchor: String = title
            .to_lowercase()
            .chars()
            .filter(|letter| letter.is_alphanumeric() || [' ', '-', '_'].contains(letter))
            .map(|letter| if letter == ' ' { '-' } else { letter })
            .collect();
        // Writing to a string can't fail.
        let _ = writeln!(self.contents, "{}- [{title}](#{anchor})", "  ".repeat(depth));
        let _ = writeln!(self.body, "{} {title}\n", "#".repeat(depth + 2));
    }

    /// A paragraph, or a table.
    pub(super) fn say(&mut self, text: &str) {
        let _ = writeln!(self.body, "{text}\n");
    }

    /// A table with these columns; the first is of words, the others of figures.
    pub(super) fn table(&mut self, columns: &[&str], rows: &[Vec<String>]) {
        let _ = writeln!(self.body, "| {} |", columns.join(" | "));
        let _ = writeln!(self.body, "|---{}|", "|--:".repeat(columns.len().saturating_sub(1)));
        for row in rows {
            let _ = writeln!(self.body, "| {} |", row.join(" | "));
        }
        self.body.push('\n');
    }

    /// The map of a run.
    pub(super) fn map(&mut self, name: &str, run: &Outcome, text: &str) -> Result<(), RunError> {
        let picture = report::render(&run.map, &run.markers, &run.caption);
        self.picture(name, &picture, text)
    }

    /// A picture of a run by its file name; nothing if there is none.
    pub(super) fn picture_of(
        &mut self,
        name: &str,
        run: &Outcome,
        which: &str,
        text: &str,
    ) -> Result<(), RunError> {
        let picture = run.pictures.iter().find(|(name, _)| *name == which);
        picture.map_or(Ok(()), |(_, picture)| self.picture(name, picture, text))
    }

    fn picture(&mut self, name: &str, picture: &RgbImage, text: &str) -> Result<(), RunError> {
        self.file(&format!("{name}.png"), png(picture)?, text);
        Ok(())
    }

    /// A picture as a file.
    pub(super) fn file(&mut self, name: &str, bytes: Vec<u8>, text: &str) {
        let _ = writeln!(self.body, "![{text}]({name})\n\n*{text}*\n");
        self.pictures.push((name.to_owned(), bytes));
    }

    /// All pictures with their names.
    pub(super) fn pictures(&self) -> impl Iterator<Item = (&str, &[u8])> {
        self.pictures.iter().map(|(name, bytes)| (name.as_str(), bytes.as_slice()))
    }

    pub(super) fn text(&self) -> String {
        format!("{}\n{}", self.contents, self.body)
    }
}

/// A number with its digits in groups of three.
pub(super) fn grouped(number: u64) -> String {
    let digits = number.to_string();
    let mut text = String::new();
    for (index, digit) in digits.chars().enumerate() {
        if index > 0 && (digits.len() - index).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

/// A row of a table.
pub(super) fn row<const N: usize>(cells: [String; N]) -> Vec<String> {
    cells.to_vec()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_heading_is_in_the_contents_with_its_anchor() {
        let mut page = Page::new(Some(5.0));
        page.paper("Ahmed et al.", "Reference.");
        page.section("2.1 Objects' boundary detection", Has::Experiment);
        page.table(&["what", "ours"], &[row(["time".to_owned(), "4 s".to_owned()])]);
        let text = page.text();
        assert!(text.contains("- [Ahmed et al.](#ahmed-et-al)"), "{text}");
        assert!(
            text.contains(
                "  - [2.1 Objects' boundary detection](#21-objects-boundary-detection): **experiment run**\n"
            ),
            "{text}"
        );
        assert_eq!([0, 999, 1_000, 12_345_678].map(grouped), ["0", "999", "1,000", "12,345,678"]);
        assert!(text.contains("| what | ours |\n|---|--:|\n| time | 4 s |\n"));
        assert!(text.contains("cut to 5 s"));
    }
}
