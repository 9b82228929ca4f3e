//! `ubimap conformance` and `ubimap decode`.
#![cfg(unix)]

use std::{
    fs,
    net::UdpSocket,
    process::{Child, Command, Output, Stdio},
    thread, time,
};

fn ubimap(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_ubimap")).args(arguments).output().unwrap()
}

fn printed(output: &Output) -> String {
    String::from_utf8(output.stdout.clone()).unwrap()
}

/// Ends the server with the test.
struct Server(Child);

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// The checks whose names are given, as `--only` takes them.
fn numbers(names: &[&str]) -> String {
    let list = printed(&ubimap(&["conformance", "--role", "server", "--list"]));
    let is_named =
        |line: &&str| line.split_whitespace().nth(1).is_some_and(|it| names.contains(&it));
    let named: Vec<&str> =
        list.lines().filter(is_named).filter_map(|line| line.split_whitespace().next()).collect();
    assert_eq!(named.len(), names.len(), "{list}");
    named.join(",")
}

#[test]
fn serve_passes_checks_over_udp() {
    let free = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let mut serve = Command::new(env!("CARGO_BIN_EXE_ubimap"));
    serve.args(["serve", &format!("udp:{free}"), "--open"]).stdout(Stdio::null());
    let _server = Server(serve.stderr(Stdio::null()).spawn().unwrap());
    thread::sleep(time::Duration::from_millis(500));
    let folder = std::env::temp_dir().join(format!("ubimap-conformance-{}", std::process::id()));
    let junit = folder.with_extension("xml");
    // The quick ones; tests/tests/conformance.rs runs all of them.
    let only =
        numbers(&["welcome", "hello-twice", "cut-payload", "unknown-kind", "reordered-frames"]);
    let address = free.to_string();
    let output = ubimap(&[
        "conformance",
        "--udp",
        &address,
        "--role",
        "server",
        "--only",
        &only,
        "--junit",
        junit.to_str().unwrap(),
        "--json",
    ]);
    let report: serde_json::Value = serde_json::from_str(&printed(&output)).unwrap();
    assert!(output.status.success() && report["passed"] == 5, "{report:#}");
    let xml = fs::read_to_string(&junit).unwrap();
    fs::remove_file(&junit).unwrap();
    assert!(
        xml.contains("tests=\"5\" failures=\"0\"") && xml.matches("<testcase ").count() == 5,
        "{xml}"
    );
}

#[test]
fn an_implementation_that_ends_fails() {
    let output = ubimap(&["conformance", "--exec", "true", "--only", "1,2"]);
    let text = printed(&output);
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(
        text.contains("FAIL   1 hello") && text.contains("robot: 0 passed, 1 failed, 1 skipped"),
        "{text}"
    );
    let output = ubimap(&["conformance", "--exec", "true", "--only", "999"]);
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2));
    assert!(said.starts_with("ubimap: --only 999: there is no such check"), "{said}");
}

/// The example of SPEC 4.1, and the answer that opens a session.
#[test]
fn a_capture_is_decoded_from_digits_and_from_a_file() {
    let hello = "01 10 20 01 08 01 01 01 63 fa 01 64 10 6d 40 45 90 00";
    let output = ubimap(&["decode", hello]);
    let text = printed(&output);
    assert!(
        text.contains("to server  handshake 0, version 1  sealed outside any session"),
        "{text}"
    );
    assert!(text.contains("Hello { version: 1, min_version: 1, robot: 1, nonce: 99"), "{text}");
    let path = std::env::temp_dir().join(format!("ubimap-capture-{}", std::process::id()));
    let bytes: Vec<u8> =
        hello.split(' ').map(|byte| u8::from_str_radix(byte, 16).unwrap()).collect();
    fs::write(&path, bytes).unwrap();
    assert_eq!(printed(&ubimap(&["decode", path.to_str().unwrap()])), text);
    fs::remove_file(&path).unwrap();
    let output = ubimap(&["decode", "no-such-file"]);
    assert_eq!(output.status.code(), Some(2));
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(said, "ubimap: no-such-file: neither a file nor hexadecimal digits\n");
}
