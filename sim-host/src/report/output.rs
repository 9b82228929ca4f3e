//! An output folder whose files appear all together, or not at all.

use std::{
    fs::{self, File},
    io::{self, Write},
    path::{Path, PathBuf},
};

/// An output file or folder can't be written.
#[derive(Debug, thiserror::Error)]
#[error("{path}: can't write: {error}", path = path.display())]
pub struct OutputError {
    /// The file or folder.
    pub path: PathBuf,
    /// The operating system's error.
    pub error: io::Error,
}

/// A folder being written to. Its files have temporary names until [`OutputFolder::finish`] renames
/// them; if it is dropped before, they are removed, and so is the folder if it was created here.
#[derive(Debug)]
pub struct OutputFolder {
    path: PathBuf,
    is_new: bool,
    /// Final names of the files written so far.
    pending: Vec<String>,
}

impl OutputFolder {
    /// Opens a folder; creates it if it does not exist.
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

    /// Renames all files to their final names, replacing existing files.
    pub fn finish(mut self) -> Result<(), OutputError> {
        // Check all names before the first one is replaced.
        for name in &self.pending {
            let path = self.path.join(name);
            if path.is_dir() {
                let error = io::Error::other(
                    "a folder of that name exists; remove it or choose another output folder",
                );
                return Err(OutputError { path, error });
            }
        }
        self.is_new = false;
        while let Some(name) = self.pending.first() {
            let path = self.path.join(name);
            fs::rename(self.partial(name), &path).map_err(|error| OutputError { path, error })?;
            self.pending.remove(0);
        }
        Ok(())
    }

    fn partial(&self, name: &str) -> PathBuf {
        self.path.join(format!(".{name}.{}.partial", std::process::id()))
    }
}

impl Drop for OutputFolder {
    fn drop(&mut self) {
        // Best effort: errors can't be reported from here.
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
    fn a_folder_of_the_same_name_prevents_all_files() {
        let folder = Folder::new("output-taken");
        folder.file("new/b/inside", b"");
        let path = folder.path().join("new");
        let mut output = OutputFolder::create(&path).unwrap();
        output.add("a", b"1").unwrap();
        output.add("b", b"2").unwrap();
        let error = output.finish().unwrap_err().to_string();
        assert!(error.contains("a folder of that name exists"), "{error}");
        assert_eq!(names(&path), ["b"]);

        let file = folder.file("file", b"");
        assert!(OutputFolder::create(&file).is_err());
        assert!(OutputFolder::create(&file.join("below")).is_err());
        drop(OutputFolder::create(&folder.path().join("fresh")));
        assert_eq!(names(folder.path()), ["file", "new"]);
    }
}
