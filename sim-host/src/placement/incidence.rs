//! A sparse 0/1 matrix by rows.

/// The matrix as lists: for each row the columns that contain a one, ascending.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Incidence {
    /// The index in `columns` at which each row begins; has one entry more than there are rows.
    starts: Vec<u32>,
    columns: Vec<u32>,
}

impl Incidence {
    /// A matrix from its rows, each sorted and without duplicates.
    pub fn from_rows<R: AsRef<[u32]>>(rows: impl IntoIterator<Item = R>) -> Self {
        let mut matrix = Self { starts: vec![0], columns: Vec::new() };
        for row in rows {
            matrix.columns.extend_from_slice(row.as_ref());
            matrix.starts.push(matrix.columns.len() as u32);
        }
        matrix
    }

    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.starts.len().saturating_sub(1)
    }

    /// Number of ones.
    pub fn ones(&self) -> usize {
        self.columns.len()
    }

    /// The columns of a row.
    pub fn row(&self, row: usize) -> &[u32] {
        &self.columns[self.starts[row] as usize..self.starts[row + 1] as usize]
    }

    /// All rows in order.
    pub fn iter(&self) -> impl Iterator<Item = &[u32]> {
        (0..self.rows()).map(|row| self.row(row))
    }

    /// The transpose; `columns` is the number of columns of this matrix.
    pub fn transpose(&self, columns: usize) -> Self {
        let mut starts = vec![0; columns + 1];
        for &column in &self.columns {
            starts[column as usize + 1] += 1;
        }
        for column in 0..columns {
            starts[column + 1] += starts[column];
        }
        let mut next = starts.clone();
        let mut rows = vec![0; self.columns.len()];
        for row in 0..self.rows() {
            for &column in self.row(row) {
                let place = &mut next[column as usize];
                rows[*place as usize] = row as u32;
                *place += 1;
            }
        }
        Self { starts, columns: rows }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn transposing_twice_gives_the_matrix_back() {
        let matrix = Incidence::from_rows([&[0, 3][..], &[], &[1, 2, 3]]);
        let transposed = matrix.transpose(4);
        assert_eq!(transposed.row(3), [0, 2]);
        assert_eq!(transposed.rows(), 4);
        assert_eq!(transposed.transpose(3), matrix);
        assert_eq!((matrix.rows(), matrix.ones()), (3, 5));
    }
}
