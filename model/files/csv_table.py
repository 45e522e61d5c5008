"""CSV files with named columns, written by hand or by other programs; quotes in our own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from model.errors import BadInput
from model.files.reading import CsvFile
from model.pose import Array


class CsvTable:
    """Named columns of text and numbers, without the lines and columns that are empty.

    Attributes:
        names: Of the columns, in order; empty for one that has no name.
    """

    def __init__(self, path: Path) -> None:
        """Reads a file with a header line and at least one line of values.

        Raises:
            BadInput: It cannot be read, has other separators than commas, names a column twice, or
                a line has more or fewer values than there are columns, or several columns of
                values have no name.
        """
        self._path = path
        file = CsvFile(path)
        widths = [
            max((k for k, text in enumerate(row, 1) if text.strip()), default=0)
            for row in file.rows
        ]
        used = max(widths, default=0)
        self._kept = [k for k, width in enumerate(widths) if width]
        rows, lines = [file.rows[k][:used] for k in self._kept], [file.lines[k] for k in self._kept]
        self.names = tuple(name.strip() for name in rows[0]) if rows else ()
        self._rows, self._lines = rows[1:], lines[1:]
        if not self._rows:
            raise self.bad("the file holds no values", "write a header line, then lines of values")
        for separator, name in ((";", "semicolons"), ("\t", "tabs")):
            if len(self.names) == 1 and separator in self.names[0]:
                what = f"values are separated by {name}"
                raise self.bad(what, "separate them by commas, and decimals by a point")
        twice = {name for name in self.names if name and self.names.count(name) > 1}
        if twice:
            raise self.bad(f"the column {min(twice)!r} appears twice", "name each column once")
        for number, row in zip(self._lines, self._rows, strict=True):
            if len(row) != len(self.names):
                values, columns = (
                    f"{len(many)} {noun}{'s' * (len(many) != 1)}"
                    for many, noun in ((row, "value"), (self.names, "column"))
                )
                what = f"line {number} has {values} for {columns}"
                raise self.bad(what, "give every line one value per column")
        nameless = [
            not name and any(row[k].strip() for row in self._rows)
            for k, name in enumerate(self.names)
        ]
        if sum(nameless) > 1:  # one may be the numbers of the lines
            raise self.bad(f"{sum(nameless)} columns of values have no name", "name them")

    def require(self, names: Sequence[str]) -> None:
        """Refuses a table that lacks one of these columns.

        Raises:
            BadInput: With all that are missing.
        """
        missing = [repr(name) for name in names if name not in self.names]
        if missing:
            several = f"columns {', '.join(missing)} are" if len(missing) > 1 else None
            what = f"the {several or f'column {missing[0]} is'} missing"
            present = ", ".join(filter(None, self.names))
            raise self.bad(what, f"name it in the first line, which has: {present}")

    def of(self, names: Sequence[str]) -> Array:
        """Columns of finite numbers side by side, shape (n, len(names)).

        Raises:
            BadInput: A column is missing, or a value is not a finite number; with its line.
        """
        self.require(names)
        columns = [(self.names.index(name), name) for name in names]
        return np.array(
            [
                [self._number(row[index], name, line) for index, name in columns]
                for row, line in zip(self._rows, self._lines, strict=True)
            ]
        )

    def texts(self, name: str) -> list[str]:
        """A column as text, without surrounding blanks.

        Raises:
            BadInput: It is missing.
        """
        self.require([name])
        index = self.names.index(name)
        return [row[index].strip() for row in self._rows]

    def require_no_gap(self) -> None:
        """Refuses a table with an empty line between others, for rows numbered by their order.

        Raises:
            BadInput: With the first line after a gap.
        """
        for before, after, line in zip(self._kept, self._kept[1:], self._lines, strict=False):
            if after != before + 1:
                what = f"line {line} follows an empty line"
                raise self.bad(what, "fill in the empty line, or delete it")

    def line(self, row: int) -> int:
        """The line, counted from 1, of a row, counted from 0."""
        return self._lines[row]

    def bad(self, what: str, next_step: str) -> BadInput:
        """The error about this file."""
        return BadInput(what, where=str(self._path), next_step=next_step)

    def _number(self, text: str, name: str, line: int) -> float:
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not np.isfinite(value):
            what = f"line {line}, {name}: {text!r} is not a finite number"
            raise self.bad(what, "leave out lines that were not measured")
        return value


def quoted(text: str) -> str:
    """A value for a line of a CSV file, quoted where necessary; line breaks become blanks."""
    if not any(sign in text for sign in ',"\r\n'):
        return text
    return '"' + text.replace('"', '""').replace("\r", " ").replace("\n", " ") + '"'
