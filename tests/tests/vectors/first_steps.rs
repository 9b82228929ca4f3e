//! The first steps: one file that a new implementation passes from top to bottom, in the order of
//! SPEC.md.

use serde_json::{Value, json};
use ubimap_protocol::{
    checksum::crc32,
    frame::{FrameKind, Header, SessionId, payload_capacity, seal},
    message::{
        ParameterAction, ParameterCommand, ParameterValue, Stop, TimeReply, TimeRequest, ToRobot,
        ToServer,
    },
    tile::{Cell, Tile, TileId, Version, tile_hash},
    time::Instant,
};
use ubimap_tests::vectors::{folder, hex, planes};

use super::{
    TO_SERVER, message, sealed, stamp, stuff,
    trace::{Trace, trace},
    update_of,
};

/// All stages. Each names the section of SPEC.md that it needs.
pub(super) fn first_steps() -> Value {
    let contents = [0x03, 0x30, 0x02, 0x01, 0x07];
    let header = Header { version: 1, kind: FrameKind::Datagram, sequence: 3 };
    let frame = sealed(TO_SERVER, 0xA1B2_C3D4, header, &contents[2..]);
    let request = message::<ToServer>(&TimeRequest { nonce: 7 });
    json!([
        stage("varint", "1.2", varints()),
        stage("zigzag", "1.2", zigzags()),
        stage(
            "stuffing",
            "2.2",
            json!([
                { "contents": "11000022", "bytes": hex(&stuff(&[0x11, 0, 0, 0x22])) },
                { "contents": "1100", "bytes": hex(&stuff(&[0x11, 0])) },
            ])
        ),
        stage(
            "header",
            "2.3",
            json!([
                { "version": 1, "kind": "datagram", "sequence": 3, "bytes": hex(&header.encode()) },
            ])
        ),
        stage(
            "crc",
            "2.4",
            json!([
                { "contents": hex(b"123456789"), "crc": crc32(&[b"123456789"]) },
                { "contents": "", "crc": crc32(&[]) },
            ])
        ),
        stage(
            "seal",
            "2.4",
            json!([{
                "direction": "to server", "session": 0xA1B2_C3D4u32, "contents": hex(&contents),
                "bytes": hex(&seal(SessionId(0xA1B2_C3D4), TO_SERVER, &contents)),
            }])
        ),
        stage(
            "frame",
            "2.1",
            json!([{
                "direction": "to server", "session": 0xA1B2_C3D4u32, "version": 1, "kind": "datagram",
                "sequence": 3, "payload": hex(&contents[2..]), "bytes": hex(&frame),
            }])
        ),
        stage(
            "payload",
            "2.5",
            json!([
                { "bytes": hex(&request), "messages": [{ "kind": 2, "body": "07" }] },
            ])
        ),
        stage(
            "message",
            "5",
            json!([
                { "direction": "to server", "kind": 2, "body": "07", "fields": { "nonce": 7 } },
            ])
        ),
        stage(
            "capacity",
            "2.7",
            [32, 250, 256, 257, 258, 1_024]
                .map(|frame: usize| json!({ "frame": frame, "capacity": payload_capacity(frame) }))
                .into_iter()
                .collect()
        ),
        stage("one tile", "8", Value::Array(vec![one_cell()])),
        stage("an update on a base", "8", Value::Array(vec![on_a_base()])),
    ])
}

fn stage(name: &str, section: &str, cases: Value) -> Value {
    json!({ "stage": name, "section": section, "cases": cases })
}

fn varints() -> Value {
    let case = |value: u64, bits: u32, bytes: &[u8]| json!({ "value": value, "bits": bits, "bytes": hex(bytes) });
    let short = [7, 127, 128, 300, u16::MAX]
        .map(|nonce| case(nonce.into(), 16, &message::<ToServer>(&TimeRequest { nonce })[2..]));
    let stop = |number: u32| message::<ToRobot>(&Stop { number, stop: true });
    let middle = [250, u32::MAX].map(|number| {
        let body = stop(number);
        case(number.into(), 32, &body[2..body.len() - 1])
    });
    let long = [61_500_000, u64::MAX].map(|time| {
        let received = Instant(time);
        let body = message::<ToRobot>(&TimeReply { nonce: 0, received, held_micros: 0 });
        case(time, 64, &body[3..body.len() - 1])
    });
    short.into_iter().chain(middle).chain(long).collect()
}

fn zigzags() -> Value {
    let case = |value: i32| {
        let action = ParameterAction::Set(ParameterValue { parameter: 0, value });
        let body = message::<ToRobot>(&ParameterCommand { number: 0, action });
        json!({ "value": value, "bits": 32, "bytes": hex(&body[5..]) })
    };
    [0, -1, 1, -2, 63, -64, 64, -1234, i32::MAX, i32::MIN].map(case).into_iter().collect()
}

fn one_cell() -> Value {
    let mut tile = Tile::UNKNOWN;
    tile.set(0, 0, Cell::Free);
    traced("one tile, decision by decision", None, &Tile::UNKNOWN, &tile)
}

fn on_a_base() -> Value {
    let mut base = Tile::UNKNOWN;
    (0..6).for_each(|x| base.set(x, 0, Cell::Free));
    (0..4).for_each(|x| base.set(x, 1, Cell::Free));
    base.set(4, 1, Cell::Occupied);
    let mut tile = base;
    for (x, cell) in [(3, Cell::Occupied), (4, Cell::Movable), (5, Cell::Free)] {
        tile.set(x, 1, cell);
    }
    traced("an update on a base, cell by cell", Some(1), &base, &tile)
}

fn traced(name: &str, base: Option<u32>, before: &Tile, after: &Tile) -> Value {
    let version = base.unwrap_or(0) + 1;
    let id = TileId { x: 0, y: 0 };
    let coded = update_of(1_000, |encoder| {
        let base = base.map(Version);
        encoder.push(id, stamp(1, version), base, 0, before, after).unwrap();
    });
    let Trace { decisions, cells, header, after: read } = trace(&coded, before, &priors());
    assert_eq!(read, *after, "{name}");
    json!({
        "name": name, "coded": hex(&coded), "header": header, "before": planes(before),
        "decisions": decisions, "cells": cells, "after": planes(after), "hash": tile_hash(after),
    })
}

/// The priors as SPEC.md prints them.
fn priors() -> Vec<u32> {
    let text = std::fs::read_to_string(folder().join("../../protocol/SPEC.md")).unwrap();
    let block = text.split("```priors\n").nth(1).unwrap().split("```").next().unwrap();
    block.split_whitespace().map(|prior| prior.parse().unwrap()).collect()
}
