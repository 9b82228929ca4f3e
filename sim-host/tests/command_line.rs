//! The command line as its users meet it: exit codes, and where words go.

use std::{
    path::Path,
    process::{Command, Output},
};

fn ubimap(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_ubimap")).args(arguments).output().unwrap()
}

/// Bad use and bad input: exit code 2, one line on standard error, nothing on standard output.
#[track_caller]
fn refused(arguments: &[&str], expected: &str) {
    let output = ubimap(arguments);
    let words = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{words}");
    assert!(words.starts_with("ubimap: ") && words.contains(expected), "{words}");
    assert_eq!(words.lines().count(), 1, "{words}");
    assert!(output.stdout.is_empty());
}

#[test]
fn bad_use_is_told_in_one_line() {
    refused(&[], "no command given");
    refused(&["frob"], "frob");
    refused(&["replay"], "LOG");
    refused(&["replay", "x", "--loss", "1.5"], "--loss");
    refused(&["replay", "x", "--corrupt", "nan"], "--corrupt");
    refused(&["replay", "x", "--latency", "-5"], "--latency");
    refused(&["replay", "x", "--robots", "0"], "--robots");
    refused(&["replay", "x", "--resolution", "0"], "--resolution");
    refused(&["replay", "x", "--format", "png"], "--format");
    refused(&["simulate", "--duration", "-1"], "--duration");
    refused(&["serve"], "PORT");
    refused(&["serve", "/dev/no-such-port"], "/dev/no-such-port: ");
    refused(&["serve", "x", "--baud", "0"], "--baud");
    refused(&["serve", "x", "--pose", "-1,2"], "--pose");
    refused(&["serve", "x", "--pose", "1,2,3", "--pose", "1,2,3"], "--pose");
    refused(&["simulate", "--store", "/dev/null/map.db"], "/dev/null/map.db: can't be opened");
    refused(&["compare", "a.yaml"], "REFERENCE.yaml");
    refused(&["compare", "a.yaml", "b.yaml", "--tolerance", "-1"], "--tolerance");
    refused(&["compare", "a.yaml", "b.yaml"], "a.yaml");
}

#[test]
fn help_is_no_error() {
    for arguments in [&["--help"][..], &["replay", "--help"], &["--version"]] {
        let output = ubimap(arguments);
        assert_eq!(output.status.code(), Some(0));
        assert!(!output.stdout.is_empty() && output.stderr.is_empty());
    }
}

#[test]
fn a_run_goes_on_from_the_file_of_the_one_before() {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("store");
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).unwrap();
    let path = folder.join("map.db");
    let store = path.to_str().unwrap();
    let log = |name: &str, x: f64| {
        let scan = |time: u32| {
            format!("FLASER 180{} {x} 0 0 {x} 0 0 {time} host {time}\n", " 2.0".repeat(180))
        };
        let path = folder.join(name);
        std::fs::write(&path, (1..4).map(scan).collect::<String>()).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let [here, there] = [log("here.log", 0.0), log("there.log", 20.0)];
    let known = |arguments: &[&str]| {
        let output = ubimap(&[&["replay", "--json"], arguments].concat());
        assert_eq!(output.status.code(), Some(0), "{output:?}");
        let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        report["map"]["known"].as_u64().unwrap()
    };
    let [first, second] = [known(&[&here, "--store", store]), known(&[&there])];
    assert!(first > 1_000 && second > 1_000);
    assert_eq!(known(&[&there, "--store", store]), first + second);

    std::fs::write(&path, "no map. ".repeat(100)).unwrap();
    refused(&["simulate", "--store", store], "map.db: no file of ubimap's");
}

#[test]
fn maps_are_compared() {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("compare");
    std::fs::create_dir_all(&folder).unwrap();
    let map = |name: &str, pixels: &str| {
        let yaml = format!(
            "image: {name}.pgm\nresolution: 0.1\norigin: [0, 0, 0]\nnegate: 0\n\
             occupied_thresh: 0.65\nfree_thresh: 0.196\n"
        );
        std::fs::write(folder.join(format!("{name}.pgm")), format!("P2 4 1 255 {pixels}")).unwrap();
        let path = folder.join(format!("{name}.yaml"));
        std::fs::write(&path, yaml).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let a = map("a", "0 254 254 0");
    let b = map("b", "0 254 205 254");

    let output = ubimap(&["compare", &a, &b, "--json"]);
    assert_eq!(output.status.code(), Some(0));
    let scores: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(scores["precision"], 0.5);
    assert_eq!(scores["recall"], 1.0);
    assert_eq!(scores["agreement_known"], 2.0 / 3.0);

    let output = ubimap(&["compare", &a, &b, "--tolerance", "0.31"]);
    assert!(String::from_utf8(output.stdout).unwrap().contains("F1 1.0000"));

    let torn = map("torn", "0 254");
    refused(&["compare", &torn, &b], "torn.pgm");
}
