//! Rows with a checksum, by which a row that was changed on disk is detected. SQLite's pages have
//! no checksums.
//!
//! The checksum is the CRC-32 of IEEE 802.3 over the table's name and the values of the row, each
//! with its type and length. It detects every error that affects at most 32 consecutive bits of a
//! row, and misses others with a probability of 2^-32.

use rusqlite::{
    Connection, Row, Statement, params_from_iter,
    types::{Value, ValueRef},
};

use super::Trouble;

/// A table whose last column, `crc`, holds the checksum of the others.
#[derive(Debug)]
pub(super) struct Table {
    pub(super) name: &'static str,
    /// The columns of the primary key, which come first.
    key: &'static [&'static str],
    /// The other columns, in their order, without `crc`.
    rest: &'static [&'static str],
}

pub(super) const SERVER: Table =
    Table { name: "server", key: &["id"], rest: &["resolution_mm", "epoch", "clock_us"] };
pub(super) const TILE: Table = Table {
    name: "tile",
    key: &["robot", "x", "y", "epoch"],
    rest: &["version", "cells", "known"],
};
pub(super) const SEEN: Table =
    Table { name: "seen", key: &["robot", "x", "y"], rest: &["seconds"] };
pub(super) const CAMERA: Table =
    Table { name: "camera", key: &["x", "y"], rest: &["cells", "seconds", "cameras"] };
pub(super) const CURED: Table = Table {
    name: "cured",
    key: &["robot"],
    rest: &["first_epoch", "identifier_deg", "sensor_deg", "is_over"],
};

pub(super) const PLACEMENT: Table =
    Table { name: "placement", key: &["robot"], rest: &["corrections", "ground"] };

/// All tables.
pub(super) const ALL: [&Table; 6] = [&SERVER, &TILE, &SEEN, &CAMERA, &CURED, &PLACEMENT];

impl Table {
    fn columns(&self) -> impl Iterator<Item = &'static str> {
        self.key.iter().chain(self.rest).copied()
    }

    /// Prepares to write rows.
    pub(super) fn writer<'c>(
        &'static self,
        connection: &'c Connection,
    ) -> Result<RowWriter<'c>, Trouble> {
        let columns: Vec<_> = self.columns().collect();
        let values = "?, ".repeat(columns.len());
        let columns = columns.join(", ");
        let replace = format!("REPLACE INTO {} ({columns}, crc) VALUES ({values}?)", self.name);
        Ok(RowWriter { table: self, statement: connection.prepare(&replace)? })
    }

    /// Writes one row. `values` excludes the checksum.
    pub(super) fn write(
        &'static self,
        connection: &Connection,
        values: Vec<Value>,
    ) -> Result<(), Trouble> {
        self.writer(connection)?.write(values)
    }

    /// Writes the checksum of every row.
    pub(super) fn seal(&'static self, connection: &Connection) -> Result<(), Trouble> {
        let mut all = Vec::new();
        self.visit(connection, |values, _| all.push(owned(values)))?;
        let mut writer = self.writer(connection)?;
        all.into_iter().try_for_each(|values| writer.write(values))
    }

    /// Deletes the rows that do not match their checksum, and returns their keys.
    pub(super) fn remove_damaged(
        &'static self,
        connection: &Connection,
    ) -> Result<Vec<Vec<Value>>, Trouble> {
        let keys = self.damaged(connection)?;
        let is_key: Vec<_> = self.key.iter().map(|column| format!("{column} IS ?")).collect();
        let delete = format!("DELETE FROM {} WHERE {}", self.name, is_key.join(" AND "));
        let mut delete = connection.prepare(&delete)?;
        for key in &keys {
            delete.execute(params_from_iter(key))?;
        }
        Ok(keys)
    }

    /// The keys of the rows that do not match their checksum.
    pub(super) fn damaged(
        &'static self,
        connection: &Connection,
    ) -> Result<Vec<Vec<Value>>, Trouble> {
        let mut keys = Vec::new();
        self.visit(connection, |values, is_intact| {
            if !is_intact {
                keys.push(owned(&values[..self.key.len()]));
            }
        })?;
        Ok(keys)
    }

    /// Calls `visit` with the values of each row, and whether they match their checksum.
    fn visit(
        &'static self,
        connection: &Connection,
        mut visit: impl FnMut(&[ValueRef<'_>], bool),
    ) -> Result<(), Trouble> {
        let columns: Vec<_> = self.columns().collect();
        let select = format!("SELECT {}, crc FROM {}", columns.join(", "), self.name);
        let mut statement = connection.prepare(&select)?;
        let mut rows = statement.query([])?;
        while let Some(row) = rows.next()? {
            let values = values(row, columns.len())?;
            let sum = self.sum(values.iter().copied());
            let is_intact = row.get_ref(columns.len())? == ValueRef::Integer(sum.into());
            visit(&values, is_intact);
        }
        Ok(())
    }

    fn sum<'v>(&self, values: impl Iterator<Item = ValueRef<'v>>) -> u32 {
        let mut sum = crc32fast::Hasher::new();
        sum.update(self.name.as_bytes());
        for value in values {
            let (kind, number, bytes) = match value {
                ValueRef::Null => (0, 0, &[][..]),
                ValueRef::Integer(number) => (1, number as u64, &[][..]),
                ValueRef::Real(number) => (2, number.to_bits(), &[][..]),
                ValueRef::Text(text) => (3, text.len() as u64, text),
                ValueRef::Blob(blob) => (4, blob.len() as u64, blob),
            };
            sum.update(&[kind]);
            sum.update(&number.to_le_bytes());
            sum.update(bytes);
        }
        sum.finalize()
    }
}

/// Text that is not UTF-8 becomes NULL; no table contains text.
fn owned(values: &[ValueRef<'_>]) -> Vec<Value> {
    values.iter().map(|&value| Value::try_from(value).unwrap_or(Value::Null)).collect()
}

fn values<'r>(row: &'r Row<'_>, count: usize) -> Result<Vec<ValueRef<'r>>, Trouble> {
    Ok((0..count).map(|column| row.get_ref(column)).collect::<Result<_, _>>()?)
}

/// Writes rows of a table.
#[derive(Debug)]
pub(super) struct RowWriter<'c> {
    table: &'static Table,
    statement: Statement<'c>,
}

impl RowWriter<'_> {
    /// Writes a row, and replaces an existing one with the same key. `values` excludes the
    /// checksum.
    pub(super) fn write(&mut self, mut values: Vec<Value>) -> Result<(), Trouble> {
        let sum = self.table.sum(values.iter().map(ValueRef::from));
        values.push(sum.into());
        self.statement.execute(params_from_iter(values))?;
        Ok(())
    }
}
