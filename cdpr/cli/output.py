"""How the command line talks: results on stdout, progress and remarks on stderr."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import IO, Any, Protocol, cast

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

out = Console(highlight=False)


class _Remarks:
    """Standard error; that nobody reads it any more must not end a run that moves."""

    def write(self, text: str) -> int:
        """Writes, if anybody is there."""
        with suppress(OSError):
            sys.stderr.write(text)
        return len(text)

    def flush(self) -> None:
        """Likewise."""
        with suppress(OSError):
            sys.stderr.flush()

    def __getattr__(self, name: str) -> Any:
        """All else is as with standard error itself."""
        return getattr(sys.stderr, name)


err = Console(file=cast(IO[str], _Remarks()), highlight=False)


def show_json(document: Any) -> None:
    """A result for programs."""
    typer.echo(json.dumps(document, indent=1, allow_nan=False))


def show_facts(title: str, facts: list[tuple[str, str]], on: Console = out) -> None:
    """A result for people: names on the left, values on the right; a line each in a file.

    Args:
        title: What they are about.
        facts: Names and values.
        on: `out`, or `err` where standard output is for a program.
    """
    if not on.is_terminal:
        width = max(len(name) for name, _ in facts)
        lines = [f"  {name:<{width}}  {value}" for name, value in facts]
        typer.echo("\n".join([title, *lines]), err=on is err)
        return
    table = Table(
        title=escape(title), show_header=False, box=None, title_justify="left", padding=(0, 2)
    )
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in facts:
        table.add_row(escape(name), escape(value))
    on.print(table)


class Advance(Protocol):
    """Moves a bar."""

    def __call__(self, value: float, note: str = "") -> None:
        """So far it is now, with a remark beside it."""
        ...


@contextmanager
def progress_bar(text: str, total: float | None, shown: bool) -> Iterator[Advance]:
    """A bar on stderr where somebody looks; what is given back moves it."""
    columns = (
        TextColumn("[progress.description]{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f}" if total else "{task.completed:.0f}"),
        TimeElapsedColumn(),
        TextColumn("{task.fields[note]}", markup=False, style="dim"),
    )
    with Progress(
        *columns, console=err, transient=True, disable=not (shown and err.is_terminal)
    ) as bar:
        task = bar.add_task(text, total=total, note="")
        yield lambda value, note="": bar.update(task, completed=value, note=note)


@contextmanager
def spinner(text: str, shown: bool) -> Iterator[None]:
    """A remark that something takes a moment."""
    if not shown or not err.is_terminal:
        yield
        return
    with err.status(text):
        yield
