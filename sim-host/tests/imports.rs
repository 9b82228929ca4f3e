//! Imports run one way: a folder takes from those before it alone, and nothing but what joins all
//! knows the simulated world.

use std::{
    collections::BTreeSet,
    fs,
    path::{Path, PathBuf},
};

/// Each folder of `src`, and the others that it may import.
const LAYERS: [(&str, &[&str]); 12] = [
    ("grid", &[]),
    ("camera", &["grid"]),
    ("log", &["grid", "camera"]),
    ("perception", &["grid", "camera"]),
    ("mapping", &["grid", "camera", "perception"]),
    ("server", &["grid", "camera", "perception", "mapping"]),
    ("store", &["mapping", "server"]),
    ("placement", &["grid"]),
    ("channel", &[]),
    ("report", &["grid", "camera", "perception", "mapping", "server"]),
    ("world", &["grid", "camera"]),
    (
        "run",
        &[
            "camera",
            "channel",
            "grid",
            "log",
            "mapping",
            "perception",
            "placement",
            "report",
            "server",
            "store",
            "world",
        ],
    ),
];

#[test]
fn imports_run_one_way() {
    let src = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut folders: Vec<String> = fs::read_dir(&src)
        .unwrap()
        .map(|entry| entry.unwrap())
        .filter(|entry| entry.path().is_dir())
        .map(|entry| entry.file_name().into_string().unwrap())
        .collect();
    folders.sort();
    let mut known: Vec<&str> = LAYERS.iter().map(|(folder, _)| *folder).collect();
    known.sort_unstable();
    assert_eq!(folders, known, "a folder that this test does not know");

    let mut wrong = Vec::new();
    for (folder, allowed) in LAYERS {
        for file in sources(&src.join(folder)) {
            let text = fs::read_to_string(&file).unwrap();
            // A unit test may hold a thing against others.
            let text = text.split("#[cfg(test)]\nmod tests").next().unwrap_or_default();
            for import in imports(text) {
                let is_layer = known.contains(&import.as_str());
                if is_layer && import != folder && !allowed.contains(&import.as_str()) {
                    wrong.push(format!("{} imports {import}", file.display()));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn an_import_is_found_however_it_is_written() {
    let text = "use crate::{\n    camera::{Frame, world::No},\n    world::World,\n};\nuse crate::grid;\n\
                let it = crate::log::Log::default();";
    let found: Vec<String> = imports(text).into_iter().collect();
    assert_eq!(found, ["camera", "grid", "log", "world"]);
}

/// The sources in a folder, without the unit tests that have a file of their own.
fn sources(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.extend(sources(&path));
        } else if path.extension().is_some_and(|it| it == "rs") && !path.ends_with("tests.rs") {
            found.push(path);
        }
    }
    found
}

/// What follows `crate::` in a source: a name, or the names at the outer level of its braces.
fn imports(text: &str) -> BTreeSet<String> {
    let mut found = BTreeSet::new();
    for (at, _) in text.match_indices("crate::") {
        let rest = &text[at + "crate::".len()..];
        if !rest.starts_with('{') {
            found.insert(rest.chars().take_while(is_name).collect());
            continue;
        }
        let (mut depth, mut name, mut at_start) = (0, String::new(), true);
        for letter in rest.chars() {
            match letter {
                '{' => (depth, at_start) = (depth + 1, depth == 0),
                '}' => depth -= 1,
                ',' if depth == 1 => at_start = true,
                _ if is_name(&letter) && depth == 1 && at_start => name.push(letter),
                _ if !name.is_empty() => at_start = false,
                _ => {}
            }
            if (!at_start || !is_name(&letter)) && !name.is_empty() {
                found.insert(core::mem::take(&mut name));
            }
            if depth == 0 {
                break;
            }
        }
    }
    found
}

fn is_name(letter: &char) -> bool {
    letter.is_alphanumeric() || *letter == '_'
}
