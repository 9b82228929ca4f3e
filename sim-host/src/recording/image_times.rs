//! The capture times of images that are not in a file of ours: in a list as TUM's RGB-D benchmark has
//! it, or in the names of the images.

use std::{collections::BTreeMap, path::Path, path::PathBuf};

use super::{
    error::{Field, LogError},
    lines::{Lines, number},
};

/// Maximum time stamp in seconds: a larger one is in a smaller unit.
const MAX_TIME_S: f64 = 1e11;

/// The file that lists the times of the images in a folder: `depth.txt` beside `depth/`.
pub(super) fn list_of(images: &Path) -> PathBuf {
    images.with_extension("txt")
}

/// The capture times in seconds of the images of a folder: from the list of lines `TIME FILE` beside the
/// folder or, without one, from the names, if all are decimal numbers (`1305031102.160407.png`).
/// `None` if neither states them.
///
/// # Errors
/// [`LogError::Line`] if the list is malformed, [`LogError::Unlisted`] if it lacks an image.
pub(super) fn image_times(images: &[PathBuf]) -> Result<Option<Vec<f64>>, LogError> {
    let Some(folder) = images.first().and_then(|image| image.parent()) else { return Ok(None) };
    let list = list_of(folder);
    if !list.is_file() {
        let of_name = |image: &PathBuf| {
            let name = image.file_stem()?.to_str()?;
            let time = name.parse::<f64>().ok()?;
            (name.contains('.') && (0.0..MAX_TIME_S).contains(&time)).then_some(time)
        };
        return Ok(images.iter().map(of_name).collect());
    }
    let listed = read(&list)?;
    let time = |image: &PathBuf| {
        let name = image.file_name()?.to_str()?;
        listed.get(name).copied()
    };
    let unlisted = |image: &PathBuf| LogError::Unlisted { path: image.clone(), list: list.clone() };
    let times = images.iter().map(|image| time(image).ok_or_else(|| unlisted(image)));
    Ok(Some(times.collect::<Result<_, _>>()?))
}

/// The times in a list, by the names of the images without their folders.
fn read(list: &Path) -> Result<BTreeMap<String, f64>, LogError> {
    let mut times = BTreeMap::new();
    let mut lines = Lines::open(list)?;
    while let Some(line) = lines.next() {
        let (at, text) = line?;
        let text = text.trim_ascii();
        if text.is_empty() || text.starts_with('#') {
            continue;
        }
        let field = Field::Named("time");
        let (time, file) =
            text.split_once(|it: char| it.is_ascii_whitespace()).unwrap_or((text, ""));
        let time = number(time, field).and_then(|value| {
            let reason = "no time in seconds";
            let fault = super::error::LineFault::OutOfRange { field, value, reason };
            if (0.0..MAX_TIME_S).contains(&value) { Ok(value) } else { Err(fault) }
        });
        let time =
            time.map_err(|fault| LogError::Line { path: list.to_owned(), line: at, fault })?;
        let name = Path::new(file.trim_ascii()).file_name().unwrap_or_default();
        times.insert(name.to_string_lossy().into_owned(), time);
    }
    Ok(times)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Folder;

    #[test]
    fn times_come_from_a_list_or_from_the_names() {
        let folder = Folder::new("image-times");
        let image = |name: &str| folder.path().join("depth").join(name);
        let times =
            |names: &[&str]| image_times(&names.iter().map(|name| image(name)).collect::<Vec<_>>());
        assert_eq!(
            times(&["1305031102.16.png", "5.5.png"]).unwrap(),
            Some(vec![1305031102.16, 5.5])
        );
        assert_eq!(times(&["1305031102.16.png", "5.png"]).unwrap(), None);
        assert_eq!(times(&["nan.png"]).unwrap(), None);
        assert_eq!(times(&[]).unwrap(), None);
        folder.file("depth.txt", b"# timestamp filename\n7.25 depth/a.png\n 8.5\tb.png\r\n");
        assert_eq!(times(&["a.png", "b.png"]).unwrap(), Some(vec![7.25, 8.5]));
        let error = times(&["c.png"]).unwrap_err().to_string();
        assert!(error.contains("c.png: no line in ") && error.contains("depth.txt"), "{error}");
        folder.file("depth.txt", b"7.25 depth/a.png\nx depth/b.png\n");
        let error = times(&["a.png"]).unwrap_err().to_string();
        assert!(error.contains("depth.txt:2: time: \"x\""), "{error}");
        folder.file("depth.txt", b"1305031102160407000 depth/a.png\n");
        assert!(times(&["a.png"]).unwrap_err().to_string().contains("no time in seconds"));
    }
}
