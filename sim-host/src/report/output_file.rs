//! An output file that appears complete, or not at all.

use std::{
    fs::{self, File},
    io::{self, Write},
    path::{Path, PathBuf},
};

use super::output::OutputError;

/// An output file that is being written beside its place, as `.NAME.PID.partial`. If it is dropped
/// before [`OutputFile::finish`], everything stays as it was.
#[derive(Debug)]
pub struct OutputFile {
    target: PathBuf,
    partial: PathBuf,
}

impl OutputFile {
    /// Prepares to write a file, which may already exist.
    ///
    /// # Errors
    /// [`OutputError`] if the file can't be created.
    pub fn create(path: &Path) -> Result<Self, OutputError> {
        let refuse = |error| OutputError { path: path.to_owned(), error };
        // The file that a symbolic link points to is replaced, not the link.
        let target = path.canonicalize().unwrap_or_else(|_| path.to_owned());
        if target.is_dir() {
            return Err(refuse(io::Error::other("is a folder, and must be a file")));
        }
        let name = target
            .file_name()
            .ok_or_else(|| refuse(io::Error::other("has no file name; give a file with --out")))?;
        let name = format!(".{}.{}.partial", name.to_string_lossy(), std::process::id());
        let partial = target.with_file_name(name);
        if let Some(parent) = target.parent().filter(|it| !it.as_os_str().is_empty()) {
            fs::create_dir_all(parent).map_err(refuse)?;
        }
        File::create(&partial).map_err(refuse)?;
        Ok(Self { target, partial })
    }

    /// Writes the content and moves the file to its place.
    ///
    /// # Errors
    /// [`OutputError`] if it can't be written.
    pub fn finish(self, bytes: &[u8]) -> Result<(), OutputError> {
        let written = File::create(&self.partial).and_then(|mut file| {
            file.write_all(bytes)?;
            file.sync_all()?;
            fs::rename(&self.partial, &self.target)?;
            sync_folder(&self.target)
        });
        written.map_err(|error| OutputError { path: self.target.clone(), error })
    }
}

/// Makes a new name last through a cut of the power.
#[cfg(unix)]
fn sync_folder(file: &Path) -> io::Result<()> {
    let folder = file.parent().filter(|it| !it.as_os_str().is_empty());
    File::open(folder.unwrap_or(Path::new(".")))?.sync_all()
}

#[cfg(not(unix))]
fn sync_folder(_: &Path) -> io::Result<()> {
    Ok(())
}

impl Drop for OutputFile {
    fn drop(&mut self) {
        // Best effort; after `finish` it is gone already.
        let _ = fs::remove_file(&self.partial);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Folder;

    #[test]
    fn a_file_appears_complete_or_not_at_all() {
        let folder = Folder::new("output-file");
        let path = folder.file("cameras.toml", b"old");
        let read = || fs::read_to_string(&path).unwrap();
        let entries = || fs::read_dir(folder.path()).unwrap().count();
        drop(OutputFile::create(&path).unwrap());
        assert_eq!((read().as_str(), entries()), ("old", 1));
        OutputFile::create(&path).unwrap().finish(b"new").unwrap();
        assert_eq!((read().as_str(), entries()), ("new", 1));
        OutputFile::create(&folder.path().join("a/b.toml")).unwrap().finish(b"").unwrap();
        let error = OutputFile::create(folder.path()).unwrap_err().to_string();
        assert!(error.contains("is a folder"), "{error}");
        assert!(OutputFile::create(&path.join("below")).is_err());
    }
}
