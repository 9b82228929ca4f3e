//! Test vectors of the range coder, and of tile updates that no encoder writes: they need items
//! that are private to the crate. The rules are those of `tests/tests/vectors.rs`.

use std::{env, format, fs, path::PathBuf, string::String, vec, vec::Vec};

use serde_json::{Value, json};

use super::{TileDecoder, TileEncoder, TileError, TileHeader};
use crate::tile::{
    Cell, Epoch, Stamp, TILE_CELLS, Tile, TileId, Version, context,
    range_coder::{Decoder, Encoder, Model},
};

fn path() -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/vectors/coder.json"))
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn unhex(text: &str) -> Vec<u8> {
    let byte = |at| u8::from_str_radix(&text[at..at + 2], 16).unwrap();
    (0..text.len()).step_by(2).map(byte).collect()
}

/// Codes steps: `["bit", MODEL, VALUE]`, or the name of a code, the value, and its bits or order.
fn encode(steps: &[Value], models: &[Model]) -> Vec<u8> {
    let mut out = vec![0; 4096];
    let mut models = models.to_vec();
    let mut encoder = Encoder::new(&mut out);
    for step in steps {
        let (first, second) = (step[1].as_i64().unwrap(), step[2].as_i64().unwrap());
        match step[0].as_str().unwrap() {
            "bit" => encoder.bit(&mut models[first as usize], second != 0),
            "plain" => encoder.plain(first as u32, second as u32),
            "golomb" => encoder.golomb(first as u32, second as u32),
            "signed" => encoder.signed(first as i32, second as u32),
            other => panic!("{other}"),
        }
    }
    assert!(encoder.fits(0));
    let len = encoder.finish().unwrap();
    out.truncate(len);
    out
}

fn check(steps: &[Value], models: &[Model], coded: &[u8]) {
    let mut models = models.to_vec();
    let mut decoder = Decoder::new(coded);
    for step in steps {
        let (first, second) = (step[1].as_i64().unwrap(), step[2].as_i64().unwrap());
        match step[0].as_str().unwrap() {
            "bit" => assert_eq!(i64::from(decoder.bit(&mut models[first as usize])), second),
            "plain" => assert_eq!(i64::from(decoder.plain(second as u32)), first),
            "golomb" => assert_eq!(decoder.golomb(second as u32).map(i64::from), Some(first)),
            "signed" => assert_eq!(decoder.signed(second as u32).map(i64::from), Some(first)),
            other => panic!("{other}"),
        }
    }
    assert!(decoder.is_exhausted());
}

fn models(probabilities: &Value) -> Vec<Model> {
    probabilities.as_array().unwrap().iter().map(|p| Model(p.as_u64().unwrap() as u16)).collect()
}

fn generate() -> Value {
    let mut state = 1u32;
    let mut random = |below: u32| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) % below
    };
    let bits = |bits: &[i32]| bits.iter().map(|bit| json!(["bit", 0, bit])).collect();
    let mixed: Vec<_> = (0..300)
        .map(|_| match random(8) {
            0 => json!(["plain", random(1 << 10), 10]),
            1 => json!(["golomb", random(5000), random(6)]),
            2 => json!(["signed", i64::from(random(9000)) - 4500, random(6)]),
            _ => json!(["bit", random(3), i32::from(random(20) == 0)]),
        })
        .collect();
    let cases: [(&str, Vec<u16>, Vec<Value>); 8] = [
        ("nothing", vec![], vec![]),
        ("one likely bit", vec![32_768], bits(&[0])),
        ("one unlikely bit", vec![32_768], bits(&[1])),
        ("ten bits", vec![0x8080], bits(&[1, 0, 0, 1, 1, 1, 0, 1, 0, 0])),
        (
            "many zeros, and a carry",
            vec![32_768],
            (0..400).map(|at| json!(["bit", 0, i32::from(at % 97 == 96)])).collect(),
        ),
        ("all ones", vec![32_768], (0..300).map(|_| json!(["plain", 1, 1])).collect()),
        (
            "numbers",
            vec![],
            vec![
                json!(["golomb", 0, 0]),
                json!(["golomb", 1, 0]),
                json!(["golomb", 7, 3]),
                json!(["golomb", 8, 3]),
                json!(["golomb", u32::MAX, 0]),
                json!(["golomb", u32::MAX, 4]),
                json!(["golomb", u32::MAX - 1, 0]),
                json!(["golomb", 0x8000_0000u32, 3]),
                json!(["signed", -1, 0]),
                json!(["signed", 1, 0]),
                json!(["signed", i32::MIN, 3]),
                json!(["signed", i32::MAX, 3]),
                json!(["plain", 1023, 10]),
            ],
        ),
        ("a mixture", vec![32_768, 60_000, 700], mixed),
    ];
    let case = |(name, start, steps): &(&str, Vec<u16>, Vec<Value>)| {
        let models: Vec<_> = start.iter().map(|&p| Model(p)).collect();
        json!({ "name": name, "models": start, "steps": steps, "coded": hex(&encode(steps, &models)) })
    };
    let coder: Vec<_> = cases.iter().map(case).collect();
    json!({ "coder": coder, "refused": refused() })
}

/// Updates that no encoder writes.
fn refused() -> Vec<Value> {
    let header = TileHeader {
        id: TileId { x: 1, y: -1 },
        stamp: Stamp { epoch: Epoch(2), version: Version(5) },
        base: Some(Version(4)),
        start: 0,
        end: TILE_CELLS,
    };
    let whole = TileHeader { base: None, ..header };
    let mut cases = bad_headers(header);
    cases.extend([
        (
            "more bytes than it says",
            [&written(&[whole])[..], &[1, 2, 3, 4, 5]].concat(),
            "malformed",
            1,
        ),
        ("nothing but ones", vec![0xFF; 60], "malformed", 0),
        ("a second tile beyond the grid", beyond_the_grid(whole), "malformed", 1),
    ]);
    let beyond = raw(|encoder| {
        encoder.signed(32_768, super::FIRST_ID_ORDER);
        encoder.signed(0, super::FIRST_ID_ORDER);
    });
    cases.push(("a first tile beyond the grid", beyond, "malformed", 0));
    let sides = [
        ("a tile that is complete, but beyond the grid to the east", 32_768, 0),
        ("a tile that is complete, but beyond the grid to the west", -32_769, 0),
        ("a tile that is complete, but beyond the grid to the north", 0, 32_768),
        ("a tile that is complete, but beyond the grid to the south", 0, -32_769),
    ];
    for (name, x, y) in sides {
        let beyond = raw(|encoder| {
            encoder.signed(x, super::FIRST_ID_ORDER);
            encoder.signed(y, super::FIRST_ID_ORDER);
            encoder.golomb(1, super::EPOCH_ORDER);
            an_unknown_tile(encoder);
        });
        cases.push((name, beyond, "malformed", 0));
    }
    let long_epoch = raw(|encoder| {
        encoder.signed(0, super::FIRST_ID_ORDER);
        encoder.signed(0, super::FIRST_ID_ORDER);
        // 2^32, in the code that 2^32 - 1 has.
        encoder.plain(u32::MAX, 28);
        encoder.plain(0, 1);
        encoder.plain(16, 32);
        an_unknown_tile(encoder);
    });
    cases.push(("an epoch of more than 32 bits", long_epoch, "malformed", 0));
    let start_zero = raw(|encoder| {
        let mut models = context::models();
        encoder.signed(0, super::FIRST_ID_ORDER);
        encoder.signed(0, super::FIRST_ID_ORDER);
        encoder.golomb(1, super::EPOCH_ORDER);
        encoder.bit(&mut models[context::HAS_BASE], false);
        encoder.golomb(1, super::VERSION_ORDER);
        encoder.bit(&mut models[context::FROM_START], false);
        encoder.plain(0, 10);
        encoder.bit(&mut models[context::TO_END], true);
    });
    cases.push(("a part from the start that says otherwise", start_zero, "malformed", 0));
    let many: Vec<_> = (0..33).map(|x| TileHeader { id: TileId { x, y: 0 }, ..whole }).collect();
    cases.push(("one tile too many", written(&many), "too many tiles", 32));
    let case = |(name, coded, error, before): &Refused| json!({ "name": name, "coded": hex(coded), "error": error, "tiles_before": before });
    cases.iter().map(case).collect()
}

/// A name, the update, the error, and the number of tiles read before it.
type Refused = (&'static str, Vec<u8>, &'static str, i32);

/// Updates of one tile with an inconsistent header.
fn bad_headers(header: TileHeader) -> Vec<Refused> {
    let version_zero = Stamp { version: Version(0), ..header.stamp };
    let headers = [
        ("version zero", TileHeader { base: None, stamp: version_zero, ..header }),
        ("a base that is as new", TileHeader { base: Some(Version(5)), ..header }),
        ("base zero", TileHeader { base: Some(Version(0)), ..header }),
        ("a part that ends where it starts", TileHeader { start: 9, end: 9, ..header }),
        ("a part that ends before it starts", TileHeader { start: 9, end: 8, ..header }),
    ];
    let mut cases = vec![("an empty update", vec![], "malformed", 0)];
    cases.extend(headers.map(|(name, header)| (name, written(&[header]), "malformed", 0)));
    cases
}

/// Ends an update after the epoch of its only tile, in which nothing is known.
fn an_unknown_tile(encoder: &mut Encoder<'_>) {
    let mut models = context::models();
    encoder.bit(&mut models[context::HAS_BASE], false);
    encoder.golomb(1, super::VERSION_ORDER);
    encoder.bit(&mut models[context::FROM_START], true);
    encoder.bit(&mut models[context::TO_END], true);
    (0..32).for_each(|_| encoder.bit(&mut models[context::ROW], false));
    encoder.bit(&mut models[context::MORE], false);
}

/// An update whose second tile lies east of the grid.
fn beyond_the_grid(header: TileHeader) -> Vec<u8> {
    let mut update = vec![0; 64];
    let mut encoder = TileEncoder::new(&mut update);
    let east = TileHeader { id: TileId { x: i16::MAX, y: 0 }, ..header };
    encoder.try_push(&east, &Tile::UNKNOWN, &Tile::UNKNOWN);
    let TileEncoder { mut coder, mut models, .. } = encoder;
    coder.bit(&mut models[context::MORE], true);
    coder.signed(1, 0);
    coder.signed(0, 0);
    let len = coder.finish().unwrap();
    update.truncate(len);
    update
}

/// An update with these headers, valid or not, and one free cell in each tile.
fn written(headers: &[TileHeader]) -> Vec<u8> {
    let mut out = vec![0; 4096];
    let mut encoder = TileEncoder::new(&mut out);
    let mut tile = Tile::UNKNOWN;
    tile.set(0, 0, Cell::Free);
    for header in headers {
        if header.start < header.end {
            encoder.try_push(header, &Tile::UNKNOWN, &tile);
        } else {
            encoder.put_header(header);
        }
        encoder.previous = Some((header.id, header.stamp.epoch));
        encoder.tiles = 1;
    }
    let len = encoder.finish().unwrap();
    out.truncate(len);
    out
}

fn raw(fill: impl FnOnce(&mut Encoder<'_>)) -> Vec<u8> {
    let mut out = vec![0; 64];
    let mut encoder = Encoder::new(&mut out);
    fill(&mut encoder);
    let len = encoder.finish().unwrap();
    out.truncate(len);
    out
}

#[test]
fn the_coder_reads_and_writes_its_vectors() {
    if env::var_os("UBIMAP_WRITE_VECTORS").is_some() {
        let text = serde_json::to_string_pretty(&generate()).unwrap() + "\n";
        fs::write(path(), text).unwrap();
    }
    let text = fs::read_to_string(path()).unwrap();
    let cases: Value = serde_json::from_str(&text).unwrap();
    for case in cases["coder"].as_array().unwrap() {
        let (steps, models) = (case["steps"].as_array().unwrap(), models(&case["models"]));
        let coded = case["coded"].as_str().unwrap();
        assert_eq!(hex(&encode(steps, &models)), coded, "{}", case["name"]);
        check(steps, &models, &unhex(coded));
    }
    for case in cases["refused"].as_array().unwrap() {
        let coded = unhex(case["coded"].as_str().unwrap());
        let mut decoder = TileDecoder::new(&coded);
        let error = loop {
            match decoder.header() {
                Ok(Some(header)) => decoder.cells(&header, &mut Tile::default()),
                Ok(None) => panic!("not refused: {}", case["name"]),
                Err(TileError::Malformed) => break "malformed",
                Err(TileError::TooManyTiles) => break "too many tiles",
                Err(TileError::WrongBase) => break "wrong base",
            }
        };
        assert_eq!(error, case["error"].as_str().unwrap(), "{}", case["name"]);
    }
}
