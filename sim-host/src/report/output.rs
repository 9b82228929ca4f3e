//! An output folder whose files appear all together, or not at all.

use std::{
    fs::{self, File},
    io::{self, Write},
    path::{Path, PathBuf},
};

/// Why an output file can't be written.
#[derive(Debug, thiserror::Error)]
#[error("{path}: can't write: {error}", path = path.display())]
pub struct OutputError {
    /// The file or folder.
    pub path: PathBuf,
    /// What the system says.
    pub error: io::Error,
}

/// Results that only some commands write.
const OF_SOME: [&str; 4] = ["coverage.png", "error.png", "timelapse.png", "robots.csv"];

/// A folder that is being written to. Files lie in it under temporary names until
/// [`OutputFolder::finish`] renames them; if that never happens, they are removed, and the folder
/// too if it was made for them.
#[derive(Debug)]
pub struct OutputFolder {
    path: PathBuf,
    is_new: bool,
    /// Final names of the files written so far.
    pending: Vec<String>,
}

impl OutputFolder {
    /// Opens a folder, made if it isn't there.
    pub fn create(path: &Path) -> Result<Self, OutputError> {
        let is_new = !path.exists();
        fs::create_dir_all(path).map_err(|error| OutputError { path: path.to_owned(), error })?;
        Ok(Self { path: path.to_owned(), is_new, pending: Vec::new() })
    }

    /// Writes a file under a temporary name.
    pub fn add(&mut self, name: &str, bytes: &[u8]) -> Result<(), OutputError> {
        let path = self.partial(name);
        let written = File::create(&path).and_then(|mut file| {
            self.pending.push(name.to_owned());
            file.write_all(bytes)?;
            file.sync_all()
        });
        written.map_err(|error| OutputError { path, error })
    }

    /// Gives all files their names, over whatever had them before. Results of an earlier run that this
    /// one does not have are removed: beside these they would be taken for its own.
    pub fn finish(mut self) -> Result<(), OutputError> {
        let report = fs::read_to_string(self.path.join("report.json")).unwrap_or_default();
        let stale: Vec<&str> = if report.contains("\"schema\": \"ubimap-") {
            OF_SOME.into_iter().filter(|name| !self.pending.iter().any(|it| it == name)).collect()
        } else {
            Vec::new()
        };
        // A name that can't be taken is found before any is.
        for name in &self.pending {
            let path = self.path.join(name);
            if path.is_dir() {
                let error = io::Error::other("a folder of that name is in the way");
                return Err(OutputError { path, error });
            }
        }
        self.is_new = false;
        while let Some(name) = self.pending.first() {
            let path = self.path.join(name);
            fs::rename(self.partial(name), &path).map_err(|error| OutputError { path, error })?;
            self.pending.remove(0);
        }
        for name in stale {
            match fs::remove_file(self.path.join(name)) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => {
                    return Err(OutputError { path: self.path.join(name), error });
                }
                _ => {}
            }
        }
        Ok(())
    }

    fn partial(&self, name: &str) -> PathBuf {
        self.path.join(format!(".{name}.{}.partial", std::process::id()))
    }
}

impl Drop for OutputFolder {
    fn drop(&mut self) {
        // What can't be removed is left: there is nobody to tell.
        for name in &self.pending {
            let _ = fs::remove_file(self.partial(name));
        }
        if self.is_new {
            let _ = fs::remove_dir(&self.path);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Folder;

    fn names(path: &Path) -> Vec<String> {
        let entries = fs::read_dir(path).unwrap();
        let mut names: Vec<_> =
            entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn files_appear_together_or_not_at_all() {
        let folder = Folder::new("output");
        folder.file("b", b"old");

        let mut output = OutputFolder::create(folder.path()).unwrap();
        output.add("a", b"1").unwrap();
        output.add("b", b"2").unwrap();
        drop(output);
        assert_eq!(names(folder.path()), ["b"]);
        assert_eq!(fs::read(folder.path().join("b")).unwrap(), b"old");

        let mut output = OutputFolder::create(folder.path()).unwrap();
        output.add("a", b"1").unwrap();
        output.add("b", b"2").unwrap();
        output.finish().unwrap();
        assert_eq!(names(folder.path()), ["a", "b"]);
        assert_eq!(fs::read(folder.path().join("b")).unwrap(), b"2");
    }

    #[test]
    fn results_of_an_earlier_run_are_removed_and_nothing_else() {
        let folder = Folder::new("output-stale");
        for name in ["coverage.png", "error.png", "notes.txt"] {
            folder.file(name, b"old");
        }
        let write = || {
            let mut output = OutputFolder::create(folder.path()).unwrap();
            output.add("coverage.png", b"new").unwrap();
            output.add("report.json", b"{\n  \"schema\": \"ubimap-report\"\n}\n").unwrap();
            output.finish().unwrap();
        };
        // No report of ours was there: the files are somebody else's.
        write();
        assert_eq!(names(folder.path()), ["coverage.png", "error.png", "notes.txt", "report.json"]);
        write();
        assert_eq!(names(folder.path()), ["coverage.png", "notes.txt", "report.json"]);
    }

    #[test]
    fn a_name_that_is_taken_stops_all() {
        let folder = Folder::new("output-taken");
        folder.file("new/b/inside", b"");
        let path = folder.path().join("new");
        let mut output = OutputFolder::create(&path).unwrap();
        output.add("a", b"1").unwrap();
        output.add("b", b"2").unwrap();
        let error = output.finish().unwrap_err().to_string();
        assert!(error.contains("in the way"), "{error}");
        assert_eq!(names(&path), ["b"]);

        let file = folder.file("file", b"");
        assert!(OutputFolder::create(&file).is_err());
        assert!(OutputFolder::create(&file.join("below")).is_err());
        drop(OutputFolder::create(&folder.path().join("fresh")));
        assert_eq!(names(folder.path()), ["file", "new"]);
    }
}
