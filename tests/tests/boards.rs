//! The boards' tables of pins: the one in the README of the agent, the one of the module, and the pins
//! that the module sets up are the same.

use std::{collections::BTreeSet, fs, path::Path};

/// A file of the agent.
fn read(path: &str) -> String {
    let agent = Path::new(env!("CARGO_MANIFEST_DIR")).join("../agent");
    fs::read_to_string(agent.join(path)).unwrap()
}

/// The rows of tables in a text, without a prefix of each line.
fn rows<'t>(text: &'t str, prefix: &str) -> Vec<&'t str> {
    let rows = text.lines().filter_map(|line| line.strip_prefix(prefix));
    rows.filter(|row| row.starts_with("| ")).collect()
}

/// A word such as `PB10` or `GPIO4`.
fn is_pin(word: &str) -> bool {
    let number = word.strip_prefix("GPIO").or_else(|| {
        word.strip_prefix('P').and_then(|it| it.strip_prefix(|port| matches!(port, 'A'..='I')))
    });
    number.is_some_and(|it| !it.is_empty() && it.bytes().all(|byte| byte.is_ascii_digit()))
}

/// The words of a text.
fn words(text: &str) -> impl Iterator<Item = &str> {
    text.split(|letter: char| !letter.is_ascii_alphanumeric())
}

#[test]
fn the_tables_of_pins_are_those_of_the_boards() {
    let readme = read("README.md");
    for board in [
        "src/board/feather_f405.rs",
        "src/board/crazyflie21.rs",
        "src/board/pico.rs",
        "boards/esp32c3/src/super_mini.rs",
    ] {
        let module = read(board);
        let table = rows(&module, "//! ");
        assert!(table.len() >= 5, "{board}: {table:?}");
        let listed = rows(&readme, "");
        for row in &table {
            assert!(listed.contains(row), "{board}: the README has no row {row:?}");
        }

        let code: String =
            module.lines().filter(|line| !line.starts_with("//!")).collect::<Vec<_>>().join("\n");
        let code = code.split_once("fn take").unwrap().1.to_uppercase();
        let named = |text: &str, of: fn(&str) -> bool| -> BTreeSet<String> {
            words(text).filter(|word| of(word)).map(str::to_owned).collect()
        };
        let is_usart = |word: &str| word.starts_with("USART") || ["UART0", "UART1"].contains(&word);
        let table = table.join("\n");
        assert_eq!(named(&table, is_pin), named(&code, is_pin), "{board}: pins");
        assert_eq!(named(&table, is_usart), named(&code, is_usart), "{board}: ports");
    }
}
