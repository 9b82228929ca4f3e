//! The protocol's test vectors: files of cases with bytes in hex.

use std::{fs, path::PathBuf};

use serde_json::Value;
use ubimap_protocol::{frame::Direction, tile::Tile};

/// The folder of the vectors.
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

/// Encodes bytes in hex.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Decodes hex; ignores white space.
pub fn unhex(text: &str) -> Vec<u8> {
    let digits: Vec<_> = text.chars().filter(|it| !it.is_whitespace()).collect();
    assert!(digits.len().is_multiple_of(2), "odd number of hex digits: {text}");
    let digit = |it: char| it.to_digit(16).unwrap_or_else(|| panic!("not hex: {text}")) as u8;
    digits.chunks(2).map(|pair| digit(pair[0]) << 4 | digit(pair[1])).collect()
}

/// The name of a direction in the vectors.
pub fn direction_name(direction: Direction) -> &'static str {
    match direction {
        Direction::ToServer => "to server",
        Direction::ToRobot => "to robot",
    }
}

/// The direction with this name.
pub fn direction(name: &str) -> Direction {
    match name {
        "to server" => Direction::ToServer,
        "to robot" => Direction::ToRobot,
        _ => panic!("not a direction: {name}"),
    }
}

/// A tile's planes in hex: the rows of the low one, then those of the high one, each a
/// little-endian word.
pub fn planes(tile: &Tile) -> String {
    let words = tile.low.iter().chain(&tile.high);
    hex(&words.flat_map(|word| word.to_le_bytes()).collect::<Vec<_>>())
}

/// The tile with these planes.
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
