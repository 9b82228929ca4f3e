//! The vectors of the protocol: files of cases whose bytes are given in hex.

use std::{fs, path::PathBuf};

use serde_json::Value;
use ubimap_protocol::{frame::Direction, tile::Tile};

/// Where the vectors are.
pub fn folder() -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/vectors"))
}

/// Reads one file of vectors.
pub fn load(name: &str) -> Value {
    let path = folder().join(name).with_extension("json");
    let text =
        fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    serde_json::from_str(&text).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// Bytes as hex digits.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// The bytes of hex digits; white space between them does not matter.
pub fn unhex(text: &str) -> Vec<u8> {
    let digits: Vec<_> = text.chars().filter(|it| !it.is_whitespace()).collect();
    assert!(digits.len().is_multiple_of(2), "half a byte: {text}");
    let digit = |it: char| it.to_digit(16).unwrap_or_else(|| panic!("no hex: {text}")) as u8;
    digits.chunks(2).map(|pair| digit(pair[0]) << 4 | digit(pair[1])).collect()
}

/// The name of a direction.
pub fn direction_name(direction: Direction) -> &'static str {
    match direction {
        Direction::ToServer => "to server",
        Direction::ToRobot => "to robot",
    }
}

/// The direction of this name.
pub fn direction(name: &str) -> Direction {
    match name {
        "to server" => Direction::ToServer,
        "to robot" => Direction::ToRobot,
        _ => panic!("no direction: {name}"),
    }
}

/// A tile's planes: the low one's rows and then the high one's, each a little-endian word.
pub fn planes(tile: &Tile) -> String {
    let words = tile.low.iter().chain(&tile.high);
    hex(&words.flat_map(|word| word.to_le_bytes()).collect::<Vec<_>>())
}

/// The tile of these planes.
pub fn tile(planes: &str) -> Tile {
    let bytes = unhex(planes);
    assert_eq!(bytes.len(), 256, "a tile has 256 bytes");
    let mut tile = Tile::UNKNOWN;
    let words = tile.low.iter_mut().chain(&mut tile.high);
    for (word, bytes) in words.zip(bytes.as_chunks().0) {
        *word = u32::from_le_bytes(*bytes);
    }
    tile
}
