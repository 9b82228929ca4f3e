//! Each row of the table in SPEC.md, 7.3.

use serde_json::{Value, json};
use ubimap_protocol::tile::{Replica, Stamp, Tile, TileDecoder, TileId, Version, tile_hash};
use ubimap_tests::vectors::{hex, planes};

use super::{noise, room, room_later, stamp, update_of};
use crate::outcome_of;

/// The update of a tile from the version held (`None`: whole), from a cell on, in this much room.
fn update(
    room: usize,
    stamp: Stamp,
    base: Option<u32>,
    start: u16,
    (before, after): (&Tile, &Tile),
) -> Vec<u8> {
    let id = TileId { x: 1, y: -1 };
    update_of(room, |encoder| {
        encoder.push(id, stamp, base.map(Version), start, before, after).unwrap();
    })
}

fn end_of(coded: &[u8]) -> u16 {
    TileDecoder::new(coded).header().unwrap().unwrap().end
}

/// `new` up to a cell, `old` from there on.
fn joined(new: &Tile, old: &Tile, end: u16) -> Tile {
    let mut tile = *old;
    (0..usize::from(end)).for_each(|at| tile.set(at % 32, at / 32, new.cell(at % 32, at / 32)));
    tile
}

/// The cases.
pub(super) fn rows() -> Value {
    let (unknown, now, later, wild) = (Tile::UNKNOWN, room(), room_later(), noise(1));
    let held =
        |tile: &Tile, version: u32, next: u16| Replica::restored(*tile, stamp(2, version), next);
    let whole = update(900, stamp(2, 5), None, 0, (&unknown, &now));
    let first = update(100, stamp(2, 5), None, 0, (&unknown, &wild));
    let end = end_of(&first);
    let half = joined(&wild, &unknown, end);
    let second = update(900, stamp(2, 5), None, end, (&half, &wild));
    let change = update(900, stamp(2, 6), Some(5), 0, (&now, &later));
    let cut = update(24, stamp(2, 6), Some(5), 0, (&now, &wild));
    let cut_at = end_of(&cut);
    let cut_half = joined(&wild, &now, cut_at);
    let cut_rest = update(900, stamp(2, 6), Some(5), cut_at, (&cut_half, &wild));
    let cases: Vec<(&str, u8, Replica, &[u8])> = vec![
        ("an older whole tile", 1, held(&later, 6, 0), &whole),
        (
            "an older whole tile, in an older epoch",
            1,
            Replica::restored(later, stamp(3, 1), 0),
            &whole,
        ),
        ("an older whole tile, while parts are missing", 1, held(&half, 6, end), &whole),
        ("an older tile's first part", 1, held(&later, 6, 0), &first),
        ("the whole tile that is held", 1, held(&now, 5, 0), &whole),
        ("the first part of the tile that is held", 1, held(&wild, 5, 0), &first),
        ("a whole tile, and nothing is held", 2, Replica::default(), &whole),
        ("a newer whole tile", 2, held(&later, 4, 0), &whole),
        ("a newer tile's first part", 2, held(&later, 4, 0), &first),
        ("the stamp held, whole, while parts are missing", 2, held(&half, 5, end), &whole),
        ("the stamp held, in parts, with other cells", 2, held(&now, 5, 0), &first),
        ("a later part of the tile that is held", 3, held(&wild, 5, 0), &second),
        ("a change upon the state held", 4, held(&now, 5, 0), &change),
        ("the first part of a change", 4, held(&now, 5, 0), &cut),
        ("the second part of a tile", 5, held(&half, 5, end), &second),
        ("the second part of a change", 5, held(&cut_half, 6, cut_at), &cut_rest),
        ("a change, and nothing is held", 6, Replica::default(), &change),
        ("a change upon another version", 6, held(&now, 4, 0), &change),
        ("a change upon another epoch", 6, Replica::restored(now, stamp(1, 5), 0), &change),
        ("a change upon a state with missing parts", 6, held(&half, 5, end), &change),
        ("a part of another version", 6, held(&half, 4, end), &second),
        ("a part that does not follow", 6, held(&half, 5, end - 1), &second),
        ("a part of a change whose first part is missing", 6, held(&now, 5, 0), &cut_rest),
        ("the second part of a change again", 6, held(&wild, 6, 0), &cut_rest),
    ];
    let case = |(name, row, before, coded): &(&str, u8, Replica, &[u8])| {
        let mut replica = before.clone();
        let outcome = outcome_of(&mut replica, coded);
        let state = |replica: &Replica| {
            json!({
                "epoch": replica.stamp().epoch.0, "version": replica.stamp().version.0,
                "next": replica.next(), "cells": planes(replica.tile()),
                "hash": tile_hash(replica.tile()),
            })
        };
        json!({
            "name": name, "row": row, "held": state(before), "coded": hex(coded),
            "outcome": outcome, "after": state(&replica),
        })
    };
    cases.iter().map(case).collect()
}
