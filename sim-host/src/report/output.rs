//! An output folder whose files appear all together, or not at all.
//!
//! The files are written into a staging folder beside the output folder, `.NAME.PID.partial`. Then
//! the two folders are exchanged: in one step where the system supports it (Linux), otherwise by
//! two renames. If the process is killed between the two renames, the output folder is missing and
//! the earlier results are in the staging folder; the next run with the same output folder puts
//! them back. Files that are not results are moved from the old folder to the new one right after
//! the exchange; if a kill prevents that, the next run moves them. The next run also removes the
//! staging folders of killed runs; a lock distinguishes them from those of live ones.

use std::{
    collections::BTreeSet,
    fs::{self, File},
    io::{self, Write},
    path::{Path, PathBuf},
};

use crate::files;

/// An output file or folder can't be written.
#[derive(Debug, thiserror::Error)]
#[error("{path}: can't write: {}", told(error), path = path.display())]
pub struct OutputError {
    /// The file or folder.
    pub path: PathBuf,
    /// The operating system's error.
    pub error: io::Error,
}

/// The error's text, or advice if the cause is known.
fn told(error: &io::Error) -> String {
    match error.kind() {
        io::ErrorKind::NotADirectory => {
            "it, or a part of its path, is a file; give a folder with --out".into()
        }
        _ => error.to_string(),
    }
}

/// Results that only some commands write.
const OPTIONAL: [&str; 9] = [
    "coverage.png",
    "error.png",
    "plan.png",
    "timelapse.png",
    "volatility.png",
    "robot-view.png",
    "points.png",
    "network.svg",
    "robots.csv",
];

/// An output folder that is being written. If it is dropped before [`OutputFolder::finish`],
/// everything stays as it was.
#[derive(Debug)]
pub struct OutputFolder {
    stage: Stage,
    /// Names of the files written so far.
    pending: BTreeSet<String>,
}

impl OutputFolder {
    /// Prepares to write a folder, which may already exist. First completes the swaps of killed
    /// runs and removes their staging folders.
    ///
    /// # Errors
    /// [`OutputError`] if the folder can't be created or replaced. For example, a folder can't be
    /// replaced while it is the working folder of the shell.
    pub fn create(path: &Path) -> Result<Self, OutputError> {
        let refuse = |error| OutputError { path: path.to_owned(), error };
        let parent = match path.parent() {
            Some(parent) if !parent.as_os_str().is_empty() => parent,
            _ => Path::new("."),
        };
        fs::create_dir_all(parent).map_err(refuse)?;
        // A symbolic link is kept: the folder that it points to is replaced.
        let target = match path.canonicalize() {
            Ok(path) => path,
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                let name = path.file_name().ok_or(error).map_err(refuse)?;
                parent.canonicalize().map_err(refuse)?.join(name)
            }
            Err(error) => return Err(refuse(error)),
        };
        if target.exists() && !target.is_dir() {
            return Err(refuse(io::ErrorKind::NotADirectory.into()));
        }
        let parent = target.parent().unwrap_or(&target);
        if std::env::current_dir().is_ok_and(|here| here.starts_with(&target))
            || is_mount_point(&target, parent)
        {
            let reason = "a working folder or a mount point can't be replaced; name a folder in it";
            return Err(refuse(io::Error::other(reason)));
        }
        let refuse = |error| OutputError { path: parent.to_owned(), error };
        recover(&target, parent).map_err(refuse)?;
        let stage = Stage::create(target.clone()).map_err(refuse)?;
        Ok(Self { stage, pending: BTreeSet::new() })
    }

    /// Writes a file into the staging folder.
    pub fn add(&mut self, name: &str, bytes: &[u8]) -> Result<(), OutputError> {
        let path = self.stage.new_folder().join(name);
        let written = File::create(&path).and_then(|mut file| {
            file.write_all(bytes)?;
            file.sync_all()
        });
        self.pending.insert(name.to_owned());
        written.map_err(|error| OutputError { path: self.stage.target.join(name), error })
    }

    /// Replaces the folder's results with the new ones. Optional results of an earlier run that
    /// this run has not written are removed, so that they are not mistaken for results of this run.
    /// All other files are kept.
    pub fn finish(self) -> Result<(), OutputError> {
        for name in &self.pending {
            let path = self.stage.target.join(name);
            if path.is_dir() {
                let error = io::Error::other(
                    "a folder of that name exists; remove it or choose another output folder",
                );
                return Err(OutputError { path, error });
            }
        }
        let mut results = self.pending.clone();
        let report =
            files::read_settings(&self.stage.target.join("report.json")).unwrap_or_default();
        if report.contains("\"schema\": \"ubimap-") {
            results.extend(OPTIONAL.map(str::to_owned));
        }
        let refuse = |error| OutputError { path: self.stage.target.clone(), error };
        self.stage.swap(&results).map_err(refuse)
    }
}

/// A staging folder. Its subfolder `new` contains the new files, or the earlier output folder after
/// an exchange. Its subfolder `old` is the earlier output folder after the first of two renames.
/// The file `results` lists the names of results, which are not moved from the earlier output
/// folder to the new one; it exists while a swap is in progress.
#[derive(Debug)]
struct Stage {
    path: PathBuf,
    target: PathBuf,
    /// Locked until the run ends.
    _lock: File,
}

impl Stage {
    fn create(target: PathBuf) -> io::Result<Self> {
        let path = target.with_file_name(stage_name(&target, std::process::id()));
        fs::create_dir(&path)?;
        let lock = File::create(path.join("lock"))?;
        // If locks are not supported, no staging folder is treated as abandoned.
        let _ = lock.try_lock();
        fs::create_dir(path.join("new"))?;
        Ok(Self { path, target, _lock: lock })
    }

    fn new_folder(&self) -> PathBuf {
        self.path.join("new")
    }

    /// Exchanges `new` and the target, then moves all files that are not results to the target.
    fn swap(&self, results: &BTreeSet<String>) -> io::Result<()> {
        let (new, target) = (self.new_folder(), &self.target);
        if !target.exists() {
            return fs::rename(new, target);
        }
        fs::set_permissions(&new, fs::metadata(target)?.permissions())?;
        let mut list = File::create(self.path.join("results"))?;
        for name in results {
            writeln!(list, "{name}")?;
        }
        list.sync_all()?;
        if exchange(&new, target).is_err() {
            fs::rename(target, self.path.join("old"))?;
            fs::rename(&new, target)?;
        }
        settle(&self.path, target)
    }
}

impl Drop for Stage {
    fn drop(&mut self) {
        // Best effort: errors can't be reported here. The next run handles a folder that could not
        // be settled.
        if settle(&self.path, &self.target).is_ok() {
            let _ = fs::remove_dir_all(&self.path);
        }
    }
}

/// Exchanges two folders in one step.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
fn exchange(one: &Path, other: &Path) -> io::Result<()> {
    use nix::fcntl::{AT_FDCWD, RenameFlags, renameat2};
    Ok(renameat2(AT_FDCWD, one, AT_FDCWD, other, RenameFlags::RENAME_EXCHANGE)?)
}

#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
fn exchange(_: &Path, _: &Path) -> io::Result<()> {
    Err(io::ErrorKind::Unsupported.into())
}

/// Completes a swap that has begun: restores the earlier output folder if there is none, and moves
/// all files that are not results to the target. Does nothing if no swap has begun.
fn settle(stage: &Path, target: &Path) -> io::Result<()> {
    let list = stage.join("results");
    let Ok(results) = fs::read_to_string(&list) else { return Ok(()) };
    let [new, old] = ["new", "old"].map(|name| stage.join(name));
    if !target.exists() && old.exists() {
        fs::rename(&old, target)?;
    }
    for folder in [new, old].iter().filter(|folder| folder.exists()) {
        for entry in fs::read_dir(folder)? {
            let name = entry?.file_name();
            let is_result = name.to_str().is_some_and(|it| results.lines().any(|line| line == it));
            if !is_result {
                fs::rename(folder.join(&name), target.join(&name))?;
            }
        }
    }
    fs::remove_file(list)
}

/// Settles the swaps of killed runs with this target, and removes their staging folders.
fn recover(target: &Path, parent: &Path) -> io::Result<()> {
    for entry in fs::read_dir(parent)? {
        let stage = entry?.path();
        let name = stage.file_name().unwrap_or_default().to_string_lossy();
        let run = name.strip_suffix(".partial").and_then(|it| it.rsplit_once('.')?.1.parse().ok());
        let Some(run) = run.filter(|&run| name == stage_name(target, run)) else { continue };
        if is_abandoned(&stage, run) {
            settle(&stage, target)?;
            fs::remove_dir_all(stage)?;
        }
    }
    Ok(())
}

fn stage_name(target: &Path, run: u32) -> String {
    format!(".{}.{run}.partial", target.file_name().unwrap_or_default().to_string_lossy())
}

/// Whether no live run uses a staging folder: the lock is free, and the run is not just about to
/// take it. A run that was killed before it took the lock, or while it removed the folder, leaves none.
fn is_abandoned(stage: &Path, run: u32) -> bool {
    // Process ids are reused, especially in containers, so a folder with the id of this process
    // belongs to an earlier run.
    let may_be_starting =
        run != std::process::id() && Path::new("/proc").join(run.to_string()).exists();
    let is_free = match File::open(stage.join("lock")) {
        Ok(lock) => lock.try_lock().is_ok(),
        // Where processes can't be looked up, another run may be about to take it.
        Err(error) => error.kind() == io::ErrorKind::NotFound && Path::new("/proc/self").exists(),
    };
    !may_be_starting && is_free
}

#[cfg(unix)]
fn is_mount_point(path: &Path, parent: &Path) -> bool {
    use std::os::unix::fs::MetadataExt;
    let device = |path: &Path| Some(fs::metadata(path).ok()?.dev());
    path.exists() && device(path) != device(parent)
}

#[cfg(not(unix))]
fn is_mount_point(_: &Path, _: &Path) -> bool {
    false
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
    fn stale_results_of_an_earlier_run_are_removed() {
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
        // Without a report of this program, the files are not taken for results of an earlier run.
        write();
        assert_eq!(names(folder.path()), ["coverage.png", "error.png", "notes.txt", "report.json"]);
        write();
        assert_eq!(names(folder.path()), ["coverage.png", "notes.txt", "report.json"]);
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

    /// A staging folder as left by a run that was killed.
    fn abandoned(folder: &Folder, files: &[&str]) -> PathBuf {
        for file in [&["lock"], files].concat() {
            folder.file(&format!(".out.4294967295.partial/{file}"), b"stale");
        }
        folder.path().join(".out.4294967295.partial")
    }

    #[test]
    fn the_next_run_repairs_what_a_killed_one_left() {
        let folder = Folder::new("output-killed");
        let out = folder.path().join("out");
        let read = |name: &str| fs::read_to_string(out.join(name)).unwrap();

        // The run was killed while it wrote its files.
        folder.file("out/map.pgm", b"before");
        let stage = abandoned(&folder, &["new/map.pgm"]);
        drop(OutputFolder::create(&out).unwrap());
        assert!(!stage.exists() && read("map.pgm") == "before");

        // The run was killed before it took the lock, or while it removed the folder.
        let stage = abandoned(&folder, &["new/map.pgm"]);
        fs::remove_file(stage.join("lock")).unwrap();
        drop(OutputFolder::create(&out).unwrap());
        assert_eq!(stage.exists(), !Path::new("/proc/self").exists());
        let _ = fs::remove_dir_all(&stage);

        // The run was killed after the exchange: one of the user's files is still in the old
        // folder.
        abandoned(&folder, &["new/map.pgm", "new/notes.txt"]);
        folder.file(".out.4294967295.partial/results", b"map.pgm\n");
        drop(OutputFolder::create(&out).unwrap());
        assert!(!stage.exists() && read("map.pgm") == "before" && read("notes.txt") == "stale");

        // The run was killed between two renames.
        fs::remove_dir_all(&out).unwrap();
        abandoned(&folder, &["new/map.pgm", "old/map.pgm", "old/notes.txt"]);
        folder.file(".out.4294967295.partial/old/map.pgm", b"before");
        folder.file(".out.4294967295.partial/results", b"map.pgm\n");
        drop(OutputFolder::create(&out).unwrap());
        assert!(!stage.exists() && read("map.pgm") == "before" && read("notes.txt") == "stale");
        assert_eq!(names(folder.path()), ["out"]);
    }

    #[test]
    fn the_folder_of_a_live_run_is_left_alone() {
        let folder = Folder::new("output-live");
        let out = folder.path().join("out");
        let stage = abandoned(&folder, &["new/map.pgm"]);
        let lock = File::open(stage.join("lock")).unwrap();
        lock.try_lock().unwrap();
        drop(OutputFolder::create(&out).unwrap());
        assert!(stage.exists());
        drop(lock);
        drop(OutputFolder::create(&out).unwrap());
        assert!(!stage.exists());
    }

    #[test]
    fn files_of_others_are_kept_and_working_folders_refused() {
        let folder = Folder::new("output-foreign");
        let out = folder.path().join("out");
        folder.file("out/notes.txt", b"mine");
        folder.file("out/frames/0.png", b"mine");
        let mut output = OutputFolder::create(&out).unwrap();
        output.add("map.pgm", b"new").unwrap();
        // No result appears before the run is finished.
        assert_eq!(names(&out), ["frames", "notes.txt"]);
        output.finish().unwrap();
        assert_eq!(names(&out), ["frames", "map.pgm", "notes.txt"]);
        assert!(out.join("frames/0.png").exists());
        assert_eq!(names(folder.path()), ["out"]);
        let error = OutputFolder::create(Path::new(".")).unwrap_err().to_string();
        assert!(error.contains("name a folder in it"), "{error}");
    }
}
