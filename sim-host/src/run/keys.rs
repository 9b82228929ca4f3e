//! `ubimap keys`: the keys that robots and the server share, as files in a folder.
//!
//! | file | content |
//! |---|---|
//! | `keys/7.key` | the key of robot 7 in hexadecimal digits, below a comment; for its owner alone |
//! | `keys/retired/7-20261124-093000.key` | a key that was retired |

use std::{
    fmt::Write as _,
    fs::{self, OpenOptions},
    io::{self, Write as _},
    path::{Path, PathBuf},
    time::{SystemTime, UNIX_EPOCH},
};

use ubimap_protocol::{
    frame::{KEY_LEN, Key},
    units::RobotId,
};

use super::options::{KeysAction, KeysOptions};
use crate::files;

/// Why the keys can't be used.
#[derive(Debug, thiserror::Error)]
#[error("{path}: {reason}", path = path.display())]
pub struct KeysError {
    path: PathBuf,
    reason: String,
}

impl KeysError {
    fn new(path: &Path, reason: impl ToString) -> Self {
        Self { path: path.to_owned(), reason: reason.to_string() }
    }
}

/// Makes, lists or retires keys. Returns what to print.
///
/// # Errors
/// [`KeysError`] if the folder or a key can't be used; nothing has changed then.
pub fn run(options: &KeysOptions) -> Result<String, KeysError> {
    let folder = &options.dir;
    match options.action {
        KeysAction::Make { robot } => make(folder, RobotId(robot)),
        KeysAction::List => list(folder),
        KeysAction::Retire { robot } => retire(folder, RobotId(robot)),
    }
}

/// The keys in a folder, in the order of the robots' numbers.
///
/// # Errors
/// [`KeysError`] if the folder or a file in it can't be used, or is open to others.
pub fn load(folder: &Path) -> Result<Vec<(RobotId, Key)>, KeysError> {
    Ok(read_all(folder)?.into_iter().map(|(robot, key, _)| (robot, key)).collect())
}

/// The key in a file.
///
/// # Errors
/// [`KeysError`] if the file can't be used, or is open to others.
pub(super) fn read_key(path: &Path) -> Result<Key, KeysError> {
    Ok(read_one(path)?.0)
}

fn make(folder: &Path, robot: RobotId) -> Result<String, KeysError> {
    prepare(folder)?;
    let path = path_of(folder, robot);
    if path.exists() {
        let number = robot.0;
        let reason =
            format!("robot {number} has a key; retire it first: ubimap keys retire {number}");
        return Err(KeysError::new(&path, reason));
    }
    let mut bytes = [0; KEY_LEN];
    getrandom::fill(&mut bytes)
        .map_err(|error| KeysError::new(&path, format!("no random numbers: {error}")))?;
    let mut text = format!("# ubimap: the key of robot {}, made {}\n", robot.0, date(now()));
    for byte in bytes {
        // Writing to a text can't fail.
        let _ = write!(text, "{byte:02x}");
    }
    text.push('\n');
    write_whole(&path, &text).map_err(|error| KeysError::new(&path, error))?;
    Ok(format!(
        "{}: made, fingerprint {}; give it to the robot; a running server takes it up by itself\n",
        path.display(),
        fingerprint(&Key::new(bytes))
    ))
}

fn list(folder: &Path) -> Result<String, KeysError> {
    let keys = read_all(folder)?;
    if keys.is_empty() {
        return Ok(format!("{}: no keys; make one: ubimap keys make ROBOT\n", folder.display()));
    }
    let lines = keys.iter().map(|(robot, key, made)| {
        format!("robot {}, {made}, fingerprint {}\n", robot.0, fingerprint(key))
    });
    Ok(lines.collect())
}

fn retire(folder: &Path, robot: RobotId) -> Result<String, KeysError> {
    let path = path_of(folder, robot);
    if !path.exists() {
        return Err(KeysError::new(&path, format!("robot {} has no key", robot.0)));
    }
    let retired = folder.join("retired");
    make_folder(&retired)?;
    let now = now();
    let (day, second) = (date(now).replace('-', ""), now % 86_400);
    let [hour, minute, second] = [second / 3_600, second / 60 % 60, second % 60];
    let name = format!("{}-{day}-{hour:02}{minute:02}{second:02}.key", robot.0);
    let to = retired.join(name);
    if to.exists() {
        return Err(KeysError::new(&to, "exists; try again in a second"));
    }
    fs::rename(&path, &to).map_err(|error| KeysError::new(&path, error))?;
    let number = robot.0;
    Ok(format!("{}: retired; a running server shuts robot {number} out\n", to.display()))
}

/// The robots with their keys and when these were made.
fn read_all(folder: &Path) -> Result<Vec<(RobotId, Key, String)>, KeysError> {
    check_private(folder, 0o700)?;
    let entries = fs::read_dir(folder).map_err(|error| KeysError::new(folder, error))?;
    let mut keys = Vec::new();
    for entry in entries {
        let path = entry.map_err(|error| KeysError::new(folder, error))?.path();
        let extension = path.extension().and_then(|it| it.to_str());
        if extension != Some("key") {
            continue;
        }
        let number = path.file_stem().and_then(|stem| stem.to_str()).and_then(|it| it.parse().ok());
        let Some(robot) = number.map(RobotId) else {
            return Err(KeysError::new(&path, "is not named after a robot, such as 7.key"));
        };
        let (key, made) = read_one(&path)?;
        keys.push((robot, key, made));
    }
    keys.sort_by_key(|&(robot, ..)| robot);
    Ok(keys)
}

/// The key in a file, and when it was made.
fn read_one(path: &Path) -> Result<(Key, String), KeysError> {
    check_private(path, 0o600)?;
    let text = files::read_settings(path).map_err(|error| KeysError::new(path, error))?;
    let reason = "is no key: 32 hexadecimal digits in a line are expected";
    parse(&text).ok_or_else(|| KeysError::new(path, reason))
}

/// The key in a text, and the end of its comment.
fn parse(text: &str) -> Option<(Key, String)> {
    let lines = || text.lines().map(str::trim).filter(|line| !line.is_empty());
    let mut digits = lines().filter(|line| !line.starts_with('#'));
    let line = digits.next().filter(|line| line.len() == 2 * KEY_LEN && line.is_ascii())?;
    if digits.next().is_some() {
        return None;
    }
    let mut bytes = [0; KEY_LEN];
    for (at, byte) in bytes.iter_mut().enumerate() {
        *byte = u8::from_str_radix(line.get(2 * at..2 * at + 2)?, 16).ok()?;
    }
    let comment = lines().find_map(|line| line.strip_prefix('#')?.split_once(", "));
    Some((Key::new(bytes), comment.map_or("no date", |(_, made)| made).to_owned()))
}

/// A number that tells keys apart and says nothing about them.
fn fingerprint(key: &Key) -> String {
    format!("{:08x}", key.fingerprint())
}

fn path_of(folder: &Path, robot: RobotId) -> PathBuf {
    folder.join(format!("{}.key", robot.0))
}

/// The time in seconds since 1970 (UTC).
fn now() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs())
}

/// The date of a time in seconds since 1970. Counts years from March on, so that a leap day is the
/// last day of its year.
fn date(seconds: u64) -> String {
    let days = seconds / 86_400 + 719_468;
    let (era, day) = (days / 146_097, days % 146_097);
    let year = (day - day / 1_460 + day / 36_524 - day / 146_096) / 365;
    let day = day - (365 * year + year / 4 - year / 100);
    let month = (5 * day + 2) / 153;
    let day = day - (153 * month + 2) / 5 + 1;
    let (month, next) = if month < 10 { (month + 3, 0) } else { (month - 9, 1) };
    format!("{}-{month:02}-{day:02}", era * 400 + year + next)
}

/// Makes the folder unless it is there, and refuses one that is open to others.
fn prepare(folder: &Path) -> Result<(), KeysError> {
    make_folder(folder)?;
    check_private(folder, 0o700)
}

fn make_folder(folder: &Path) -> Result<(), KeysError> {
    let mut builder = fs::DirBuilder::new();
    #[cfg(unix)]
    std::os::unix::fs::DirBuilderExt::mode(&mut builder, 0o700);
    match builder.create(folder) {
        Err(error) if error.kind() != io::ErrorKind::AlreadyExists => {
            Err(KeysError::new(folder, error))
        }
        _ => Ok(()),
    }
}

/// Writes a file that only its owner can read, whole or not at all.
fn write_whole(path: &Path, text: &str) -> io::Result<()> {
    let part = path.with_extension("part");
    let mut options = OpenOptions::new();
    options.write(true).create_new(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    // Left by a process that was killed.
    let _ = fs::remove_file(&part);
    let written = options.open(&part).and_then(|mut file| {
        file.write_all(text.as_bytes())?;
        file.sync_all()
    });
    // A link does not replace a key that was made meanwhile.
    let linked = written.and_then(|()| fs::hard_link(&part, path));
    let _ = fs::remove_file(&part);
    linked
}

/// Refuses a file or folder that others can read or write. `mode` is the one to give it.
fn check_private(path: &Path, mode: u32) -> Result<(), KeysError> {
    let metadata = fs::metadata(path).map_err(|error| KeysError::new(path, error))?;
    #[cfg(unix)]
    {
        let found = std::os::unix::fs::PermissionsExt::mode(&metadata.permissions()) & 0o777;
        if found & 0o077 != 0 {
            let path_text = path.display();
            let reason =
                format!("is open to others (mode {found:o}); run: chmod {mode:o} {path_text}");
            return Err(KeysError::new(path, reason));
        }
    }
    let _ = (metadata, mode);
    Ok(())
}

#[cfg(test)]
#[cfg(unix)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;
    use crate::testing::Folder;

    fn mode(path: &Path) -> u32 {
        fs::metadata(path).unwrap().permissions().mode() & 0o777
    }

    #[test]
    fn keys_are_made_listed_and_retired() {
        let outer = Folder::new("keys");
        let folder = outer.path().join("keys");
        let run = |action| run(&KeysOptions { action, dir: folder.clone() });
        let made = run(KeysAction::Make { robot: 7 }).unwrap();
        run(KeysAction::Make { robot: 12 }).unwrap();
        let file = folder.join("7.key");
        assert_eq!((mode(&folder), mode(&file)), (0o700, 0o600));
        let keys = load(&folder).unwrap();
        assert_eq!(keys.iter().map(|(robot, _)| robot.0).collect::<Vec<_>>(), [7, 12]);
        assert_ne!(keys[0].1, keys[1].1);
        // The list tells keys apart and does not show them.
        let listed = run(KeysAction::List).unwrap();
        let text = fs::read_to_string(&file).unwrap();
        let digits = text.lines().last().unwrap();
        assert_eq!((digits.len(), listed.lines().count()), (32, 2));
        let print = format!("{:08x}", keys[0].1.fingerprint());
        assert!(listed.contains(&print) && made.contains(&print), "{listed}");
        assert!(
            !digits
                .as_bytes()
                .windows(8)
                .any(|part| { listed.contains(std::str::from_utf8(part).unwrap()) })
        );
        // A second key does not replace the first one.
        let error = run(KeysAction::Make { robot: 7 }).unwrap_err().to_string();
        assert!(error.contains("ubimap keys retire 7"), "{error}");
        assert_eq!(load(&folder).unwrap(), keys);
        run(KeysAction::Retire { robot: 7 }).unwrap();
        assert_eq!(load(&folder).unwrap(), keys[1..]);
        let retired: Vec<_> = fs::read_dir(folder.join("retired")).unwrap().collect();
        assert_eq!(fs::read_to_string(retired[0].as_ref().unwrap().path()).unwrap(), text);
        assert!(run(KeysAction::Retire { robot: 7 }).is_err());
    }

    #[test]
    fn what_others_can_read_is_refused_with_the_command_that_cures_it() {
        let outer = Folder::new("open-keys");
        let folder = outer.path().join("keys");
        run(&KeysOptions { action: KeysAction::Make { robot: 7 }, dir: folder.clone() }).unwrap();
        let file = folder.join("7.key");
        for (path, open, closed) in [(&file, 0o640, 0o600), (&folder, 0o755, 0o700)] {
            fs::set_permissions(path, fs::Permissions::from_mode(open)).unwrap();
            let error = load(&folder).unwrap_err().to_string();
            let cure = format!("run: chmod {closed:o} {}", path.display());
            assert!(error.ends_with(&cure), "{error}");
            fs::set_permissions(path, fs::Permissions::from_mode(closed)).unwrap();
            assert_eq!(load(&folder).unwrap().len(), 1);
        }
    }

    #[test]
    fn dates_are_those_of_the_calendar() {
        // From `date -u -d @SECONDS +%F`.
        let known = [
            (0, "1970-01-01"),
            (951_782_399, "2000-02-28"),
            (951_782_400, "2000-02-29"),
            (1_709_251_199, "2024-02-29"),
            (1_709_251_200, "2024-03-01"),
            (1_798_761_599, "2026-12-31"),
            (4_107_542_400, "2100-03-01"),
        ];
        for (seconds, day) in known {
            assert_eq!(date(seconds), day);
        }
    }

    #[test]
    fn only_keys_are_read() {
        let digits = "000102030405060708090a0b0c0d0e0f";
        let key = Key::new(core::array::from_fn(|at| at as u8));
        assert_eq!(parse(digits), Some((key, "no date".into())));
        assert_eq!(parse(&format!("# x, made y\n\n {digits}\r\n")), Some((key, "made y".into())));
        let long = format!("{digits}00");
        let twice = format!("{digits}\n{digits}");
        for bad in ["", "# only", &digits[2..], &long, &twice, &digits.replace('0', "g"), "ä"] {
            assert_eq!(parse(bad), None, "{bad}");
        }
    }
}
