"""How the command line talks: results on stdout, progress and remarks on stderr."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import IO, Any, cast

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from model.progress import Advance, Listener

out = Console(highlight=False)


class _Remarks:
    """Standard error; a closed pipe must not end a run in motion."""

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


def show_line(text: str, on: Console = out) -> None:
    """Plain text, of which no terminal wraps a line."""
    on.print(text, markup=False, soft_wrap=True)


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

        def advance(value: float, note: str = "", text: str = "") -> None:
            bar.update(task, completed=value, description=text or None, note=note)

        yield advance


@contextmanager
def spinner(text: str, shown: bool) -> Iterator[None]:
    """A remark that something takes a moment."""
    if not shown or not err.is_terminal:
        yield
        return
    with err.status(text):
        yield


class Terminal(Listener):
    """Shows the reports of a library function on stderr."""

    def __init__(self, *, quiet: bool = False) -> None:
        """Shows everything, or only remarks and warnings.

        Args:
            quiet: Standard output is for a program: no notes, no spinner, no bar.
        """
        self._shown, self._shown_already = not quiet, False

    def note(self, text: str) -> None:
        """See `Listener`."""
        if self._shown:
            show_line(text, err)

    def remark(self, text: str) -> None:
        """See `Listener`."""
        err.print(f"[yellow]remark[/] {escape(text)}", soft_wrap=True)

    def warning(self, text: str) -> None:
        """See `Listener`."""
        err.print(f"[red]warning[/] {escape(text)}", soft_wrap=True)

    @contextmanager
    def waiting(self, text: str) -> Iterator[None]:
        """See `Listener`."""
        with self._alone() as shown, spinner(text, shown):
            yield

    @contextmanager
    def progress(self, text: str, total: float | None) -> Iterator[Advance]:
        """See `Listener`."""
        with self._alone() as shown, progress_bar(text, total, shown) as advance:
            yield advance

    @contextmanager
    def _alone(self) -> Iterator[bool]:
        """Whether a spinner or a bar may be shown: a terminal shows one at a time."""
        before, self._shown_already = self._shown_already, True
        try:
            yield self._shown and not before
        finally:
            self._shown_already = before
