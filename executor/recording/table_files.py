"""Tables of a run as CSV files: columns of equal length, with the unit in the name."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any, Self, get_type_hints

import numpy as np
from numpy.typing import ArrayLike, NDArray

from executor.recording.record_files import AGAIN, LARGEST_RECORDED
from model.errors import BadInput
from model.files.csv_table import quoted
from model.files.documents import write_atomic
from model.files.reading import TABLE_LIMIT, CsvFile, read_text
from model.pose import Array

Integers = NDArray[np.int64]
Texts = tuple[str, ...]
_CABLE = re.compile(r"_\d+_")
"""Number of a cable in the name of a column."""


@dataclass(frozen=True, slots=True, eq=False)
class Column:
    """One column of a CSV file.

    Attributes:
        name: Header, with the unit at its end.
        values: Shape (n,): numbers in that unit, or texts.
        form: ``%`` format of one value.
    """

    name: str
    values: Array | Integers | Texts
    form: str


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """The columns that hold an attribute of a table.

    Attributes:
        names: Headers, with the unit at their ends; ``{}`` in the only one is the number of a
            cable, from 1.
        form: ``%`` format of one value, which also states its type.
        scale: The file holds numbers times this: one for all columns, or of the shape below.
        shape: Of the attribute in one row; columns hold the upper triangle of a matrix, which is
            symmetric.
    """

    names: tuple[str, ...]
    form: str
    scale: ArrayLike = 1
    shape: tuple[int, ...] = ()

    @property
    def kind(self) -> type[str | int | float]:
        """Type of a value."""
        return str if self.form == "%s" else int if self.form == "%d" else float

    @property
    def of_cables(self) -> bool:
        """Whether there is a column for each cable."""
        return "{}" in self.names[0]

    def numbered(self, cables: int) -> Columns:
        """These columns; of a number of cables if there is one for each."""
        if not self.of_cables:
            return self
        names = tuple(self.names[0].format(i + 1) for i in range(cables))
        return replace(self, names=names, shape=(cables,))

    def of(self, values: Any) -> list[Column]:
        """The columns of an attribute's values."""
        if self.kind is str:
            return [Column(self.names[0], values, self.form)]
        if self.kind is int:
            return [Column(name, values[:, *at], self.form) for name, at, _ in self._entries()]
        return [Column(name, values[:, *at] * by, self.form) for name, at, by in self._entries()]

    def read(self, file: TableFile) -> Any:
        """The attribute's values in a file.

        Raises:
            BadInput: A column is missing, or a value is of another type or beyond ±1e15.
        """
        if self.kind is str:
            return file.texts(self.names[0])
        found: Any = np.empty((len(file), *self.shape), self.kind)
        for name, at, by in self._entries():
            column = file.column(name, self.kind)
            found[:, *at] = found[:, *at[::-1]] = column if self.kind is int else column / by
        return found

    def rounded(self, values: Any) -> Any:
        """An attribute's numbers as read from a file to which they were written."""
        found: Any = np.empty_like(values)
        for _, at, by in self._entries():
            column = np.array([float(self.form % x) for x in (values[:, *at] * by).tolist()])
            found[:, *at] = found[:, *at[::-1]] = column / by
        return found

    def _entries(self) -> Iterator[tuple[str, tuple[int, ...], Any]]:
        """Name of each column, its index into a row of the attribute, and its scale."""
        scales = np.broadcast_to(self.scale, self.shape)
        indices = (at for at in np.ndindex(self.shape) if at == tuple(sorted(at)))
        for name, at in zip(self.names, indices, strict=True):
            yield name, at, scales[at]


def numbers(*names: str, scale: ArrayLike = 1, decimals: int = 6) -> Columns:
    """Columns of numbers: of one for each row, of a vector, or of one for each cable."""
    return Columns(names, f"%.{decimals}f", scale, (len(names),) if len(names) > 1 else ())


def integers(name: str) -> Columns:
    """A column of whole numbers, or one for each cable."""
    return Columns((name,), "%d")


def texts(name: str) -> Columns:
    """A column of texts, quoted where CSV requires it."""
    return Columns((name,), "%s")


class Table:
    """A table of a run: a data class whose attributes are annotated with their `Columns`."""

    __slots__ = ()

    def __init__(self, **attributes: Any) -> None:
        """Made by `dataclass`."""

    def __post_init__(self) -> None:
        """Refuses attributes of different lengths.

        Raises:
            ValueError: Naming the attribute.
        """
        for name in self.layout():
            if (count := len(getattr(self, name))) != len(self):
                raise ValueError(f"{name} has {count} rows, time has {len(self)}")

    def __len__(self) -> int:
        return len(self.time)  # type: ignore[attr-defined]

    @classmethod
    @cache
    def layout(cls) -> dict[str, Columns]:
        """The columns of each attribute that has some, in the order of the file."""
        hints = get_type_hints(cls, include_extras=True)
        annotated = {name: getattr(hint, "__metadata__", ()) for name, hint in hints.items()}
        return {name: found[0] for name, found in annotated.items() if found}

    @classmethod
    def empty(cls, cables: int = 0) -> Self:
        """A table without rows."""
        names = chain(*(columns.numbered(cables).names for columns in cls.layout().values()))
        return cls.of_file(TableFile(Path(), ",".join(names)))

    def as_read(self, *names: str) -> Self:
        """The table with these attributes, of numbers, as read from its file.

        So what is computed from them is the same before and after they are written.
        """
        layout = self.layout()
        read = {name: layout[name].rounded(getattr(self, name)) for name in names}
        return replace(self, **read)  # type: ignore[type-var]

    def columns(self) -> list[Column]:
        """All columns of the file; those of each cable are last, side by side."""
        pairs = [(columns, getattr(self, name)) for name, columns in self.layout().items()]
        alone = [one.of(values) for one, values in pairs if not one.of_cables]
        each = [one.numbered(values.shape[1]).of(values) for one, values in pairs if one.of_cables]
        return [*chain(*alone), *chain(*zip(*each, strict=True))]

    def write_csv(self, path: Path) -> None:
        """Writes the file atomically.

        Raises:
            BadInput: The folder cannot be written to.
        """
        write_atomic(path, self.csv_header() + self.csv_rows())

    def csv_header(self) -> str:
        """The first line of the file."""
        return ",".join(quoted(column.name) for column in self.columns()) + "\n"

    def csv_rows(self, first: int = 0) -> str:
        """All lines of the file except the header, from a row on."""
        columns = self.columns()
        # One format for the whole row: twenty times faster than csv.writer with a format per value.
        form = ",".join(column.form for column in columns) + "\n"
        values = [
            column.values[first:].tolist()
            if isinstance(column.values, np.ndarray)
            else map(quoted, column.values[first:])
            for column in columns
        ]
        return "".join(form % row for row in zip(*values, strict=True))

    @classmethod
    def read_csv(cls, path: Path) -> Self:
        """Reads the file.

        Raises:
            BadInput: It is missing, cut short or has other columns.
        """
        return cls.of_file(TableFile(path))

    @classmethod
    def of_file(cls, file: TableFile) -> Self:
        """The table in a file.

        Raises:
            BadInput: A column is missing or has invalid values.
        """
        return cls(**cls.attributes_in(file))

    @classmethod
    def attributes_in(cls, file: TableFile) -> dict[str, Any]:
        """The attributes that have columns, from a file.

        Raises:
            BadInput: As for `of_file`.
        """
        layout = cls.layout()
        each = [columns.names[0] for columns in layout.values() if columns.of_cables]
        cables = sum(file.count(name.replace("{}", r"\d+")) for name in each[:1])
        return {name: columns.numbered(cables).read(file) for name, columns in layout.items()}

    @classmethod
    def read_columns(cls, path: Path) -> dict[str, NDArray[Any]]:
        """All columns of the file by name, each shape (n,) and read-only.

        Raises:
            BadInput: A value is not of its column's type, or beyond ±1e15.
        """
        layout, file = cls.layout().values(), TableFile(path)
        kinds = {name: columns.kind for columns in layout for name in columns.names}
        found = {}
        for name in file.names:
            kind = kinds.get(_CABLE.sub("_{}_", name), float)
            found[name] = file.column(name, kind)
            found[name].setflags(write=False)
        return found


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

    def __len__(self) -> int:
        """Number of rows."""
        return len(self._columns[0])

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

    def column(self, name: str, kind: type[str | int | float]) -> NDArray[Any]:
        """A column of texts or numbers, shape (n,).

        Raises:
            BadInput: The column is missing, or a value is of another type or beyond ±1e15.
        """
        values = self.texts(name)
        if kind is str:
            return np.array(values, dtype=np.str_)
        try:
            found = np.fromiter(map(kind, values), kind, len(values))
        except (ValueError, OverflowError) as error:
            what = "a whole number" if kind is int else "a number"
            what = f"the column {name!r} has a value that is not {what}: {error}"
            raise self._bad(what) from None
        if kind is float and len(beyond := found[np.abs(found) > LARGEST_RECORDED]):  # not NaN
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
