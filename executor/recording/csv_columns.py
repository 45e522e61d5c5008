"""Tables of a run as CSV files: columns of equal length, with the unit in the name."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from executor.recording.record_files import AGAIN, LARGEST_RECORDED
from model.errors import BadInput
from model.files.documents import write_atomic
from model.files.reading import TABLE_LIMIT, CsvFile, read_text
from model.pose import Array

Integers = NDArray[np.int64]
#: Columns of texts in the tables of a run.
_TEXTS = frozenset({"state", "stop", "status", "tags", "picture", "source", "body", "obstacle"})
#: Columns of whole numbers; those of neither kind hold other numbers.
_INTEGERS = re.compile(
    r"cycle|path_index|leg|missing|rejected_frames|error_frames|frame|(set|actual)_\d+_counts"
)


@dataclass(frozen=True, slots=True, eq=False)
class Column:
    """One column of a CSV file.

    Attributes:
        name: Header, with the unit at its end.
        values: Shape (n,): numbers in that unit, or texts.
        form: ``%`` format of one value.
    """

    name: str
    values: NDArray[np.float64] | Integers | Sequence[str]
    form: str


def numbers(name: str, values: Array, scale: float = 1.0, decimals: int = 6) -> Column:
    """A column of floats; the file holds ``values * scale``."""
    return Column(name, np.asarray(values, dtype=np.float64) * scale, f"%.{decimals}f")


def integers(name: str, values: Integers) -> Column:
    """A column of whole numbers."""
    return Column(name, values, "%d")


def texts(name: str, values: Sequence[str]) -> Column:
    """A column of texts, quoted where CSV requires it."""
    return Column(name, [_quoted(value) for value in values], "%s")


def require_equal_lengths(table: Any) -> None:
    """Refuses arrays of different lengths in a table, a data class with an attribute ``time``.

    Raises:
        ValueError: Naming the attribute.
    """
    for field in fields(table):
        rows = len(getattr(table, field.name))
        if rows != len(table.time):
            raise ValueError(f"{field.name} has {rows} rows, time has {len(table.time)}")


def write_table(path: Path, columns: Sequence[Column]) -> None:
    """Writes a table atomically.

    Raises:
        BadInput: The folder cannot be written to.
    """
    write_atomic(path, header(columns) + rows(columns))


def header(columns: Sequence[Column]) -> str:
    """The first line of a table."""
    return ",".join(_quoted(column.name) for column in columns) + "\n"


def rows(columns: Sequence[Column]) -> str:
    """All lines of a table except the first."""
    # One format for the whole row: twenty times faster than csv.writer with a format per value.
    form = ",".join(column.form for column in columns) + "\n"
    values = [
        column.values.tolist() if isinstance(column.values, np.ndarray) else column.values
        for column in columns
    ]
    return "".join(form % row for row in zip(*values, strict=True))


def _quoted(text: str) -> str:
    if not any(sign in text for sign in ',"\r\n'):
        return text
    return '"' + text.replace('"', '""').replace("\r", " ").replace("\n", " ") + '"'


class TableFile:
    """The columns of a CSV file.

    Args:
        path: The file.
        text: Its content, if already read.

    Raises:
        BadInput: It cannot be read, is larger than `TABLE_LIMIT`, a row has more or fewer values
            than the header, or two columns have the same name.
    """

    def __init__(self, path: Path, text: str | None = None) -> None:
        self._path = path
        file = CsvFile(path, read_text(path, TABLE_LIMIT) if text is None else text)
        rows = file.rows
        if not rows:
            raise self._bad("the file is empty; the first line must name the columns")
        self.names = tuple(rows[0])
        for name, times in Counter(self.names).most_common(1):
            if times > 1:
                raise self._bad(f"{times} columns have the name {name!r}")
        for number, row in zip(file.lines[1:], rows[1:], strict=True):
            if len(row) != len(self.names):
                raise self._bad(
                    f"line {number} has {len(row)} values for {len(self.names)} columns"
                )
        columns: list[Sequence[str]] = list(zip(*rows[1:], strict=True))
        self._columns = columns or [()] * len(self.names)

    def count(self, pattern: str) -> int:
        """Number of columns whose name fully matches a regular expression."""
        return sum(1 for name in self.names if re.fullmatch(pattern, name))

    def pairs_from(self, first: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names of the first and of the second columns of pairs, from the index ``first`` on.

        Raises:
            BadInput: The last column has no partner.
        """
        if (len(self.names) - first) % 2:
            raise self._bad(f"the last column {self.names[-1]!r} lacks its partner")
        return self.names[first::2], self.names[first + 1 :: 2]

    def texts(self, name: str) -> tuple[str, ...]:
        """A column of texts.

        Raises:
            BadInput: There is no such column.
        """
        if name not in self.names:
            raise self._bad(f"the column {name!r} is missing")
        return tuple(self._columns[self.names.index(name)])

    def floats(self, name: str, scale: float = 1.0) -> Array:
        """A column of numbers divided by ``scale``, shape (n,).

        Raises:
            BadInput: The column is missing, or a value is no number or beyond ±1e15.
        """
        return self._numbers(name, self.texts(name)) / scale

    def ints(self, name: str) -> Integers:
        """A column of whole numbers, shape (n,).

        Raises:
            BadInput: The column is missing or has a value that is not a whole number.
        """
        values = self.texts(name)
        try:
            return np.fromiter(map(int, values), np.int64, len(values))
        except (ValueError, OverflowError) as error:
            raise self._bad(
                f"the column {name!r} has a value that is not a whole number: {error}"
            ) from None

    def matrix(self, names: Sequence[str], scale: float = 1.0) -> Array:
        """Columns side by side, shape (n, len(names)), divided by ``scale``.

        Raises:
            BadInput: A column is missing, or a value is no number or beyond ±1e15.
        """
        if not names:
            return np.empty((len(self._columns[0]), 0))
        return np.column_stack([self.floats(name, scale) for name in names])

    def int_matrix(self, names: Sequence[str]) -> Integers:
        """Columns of whole numbers side by side, shape (n, len(names)).

        Raises:
            BadInput: A column is missing or has a value that is not a whole number.
        """
        return np.column_stack([self.ints(name) for name in names])

    def columns(self) -> dict[str, NDArray[Any]]:
        """All columns by name, each shape (n,) and read-only; their types depend on the names only.

        Raises:
            BadInput: A value is not of its column's type, or beyond ±1e15.
        """
        found: dict[str, NDArray[Any]] = {}
        for name in self.names:
            values: NDArray[Any]
            if name in _TEXTS:
                values = np.array(self.texts(name), dtype=np.str_)
            elif _INTEGERS.fullmatch(name):
                values = self.ints(name)
            else:
                values = self.floats(name)
            values.setflags(write=False)
            found[name] = values
        return found

    def _numbers(self, name: str, values: Sequence[str]) -> Array:
        try:
            found = np.fromiter(map(float, values), np.float64, len(values))
        except ValueError as error:
            raise self._bad(
                f"the column {name!r} has a value that is not a number: {error}"
            ) from None
        beyond = found[np.abs(found) > LARGEST_RECORDED]  # NaN stands for unknown
        if len(beyond):
            raise self._bad(
                f"the column {name!r} has a value beyond ±{LARGEST_RECORDED:g}: {beyond[0]:g}"
            )
        return found

    def _bad(self, what: str) -> BadInput:
        return BadInput(
            what,
            where=str(self._path),
            why="the file was edited or truncated after the run",
            next_step=AGAIN,
        )
