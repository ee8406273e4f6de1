//! What verbs print: text, tables and JSON on standard output.

use std::io::{self, ErrorKind, Write};

use serde::Serialize;

use super::Failure;

/// Prints data. A reader that has closed the pipe (`busker plan | head`) has read enough: no failure.
pub fn print(text: &str) -> Result<(), Failure> {
    let mut stdout = io::stdout().lock();
    match stdout.write_all(text.as_bytes()).and_then(|()| stdout.flush()) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => Err(error.into()),
        _ => Ok(()),
    }
}

/// Prints data as indented JSON.
pub fn print_json(data: &impl Serialize) -> Result<(), Failure> {
    let mut text = serde_json::to_string_pretty(data)?;
    text.push('\n');
    print(&text)
}

/// `1 bus`, `2 buses`
pub fn counted(count: usize, one: &str) -> String {
    match (count, one) {
        (1, one) => format!("1 {one}"),
        (count, one) if one.ends_with('s') => format!("{count} {one}es"),
        (count, one) => format!("{count} {one}s"),
    }
}

/// Columns that are as wide as their widest cell.
#[derive(Clone, Debug, Default)]
pub struct Table {
    rows: Vec<Vec<Cell>>,
}

#[derive(Clone, Debug)]
enum Cell {
    Left(String),
    Right(String),
}

impl Cell {
    fn width(&self) -> usize {
        let (Cell::Left(text) | Cell::Right(text)) = self;
        text.chars().count()
    }
}

impl Table {
    pub fn new() -> Table {
        Table::default()
    }

    /// Adds a row of texts.
    pub fn row<T: ToString>(&mut self, cells: impl IntoIterator<Item = T>) -> &mut Table {
        self.rows.push(cells.into_iter().map(|cell| Cell::Left(cell.to_string())).collect());
        self
    }

    /// Moves the last row's cell number `column` to the right side of its column, as numbers stand.
    pub fn right(&mut self, column: usize) -> &mut Table {
        if let Some(cell) = self.rows.last_mut().and_then(|row| row.get_mut(column)) {
            let (Cell::Left(text) | Cell::Right(text)) = cell;
            *cell = Cell::Right(std::mem::take(text));
        }
        self
    }

    /// The table as text: two spaces between columns, none at the end of a line.
    pub fn render(&self) -> String {
        let columns = self.rows.iter().map(Vec::len).max().unwrap_or(0);
        let widths: Vec<usize> = (0..columns)
            .map(|column| {
                self.rows.iter().filter_map(|row| row.get(column)).map(Cell::width).max().unwrap_or(0)
            })
            .collect();
        let mut text = String::new();
        for row in &self.rows {
            let mut line = String::new();
            for (cell, &width) in row.iter().zip(&widths) {
                match cell {
                    Cell::Left(text) => line.push_str(&format!("{text:<width$}  ")),
                    Cell::Right(text) => line.push_str(&format!("{text:>width$}  ")),
                }
            }
            text.push_str(line.trim_end());
            text.push('\n');
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_as_wide_as_their_widest_cell_and_lines_have_no_tail() {
        let mut table = Table::new();
        table.row(["point", "value", ""]);
        table.row(["relay_1", "ON", ""]);
        table.row(["channel_1_value", "21.5", "°C"]).right(1);
        let expected = "\
point            value
relay_1          ON
channel_1_value   21.5  °C
";
        assert_eq!(table.render(), expected);
    }
}
