"""Output of the command line: results on stdout, progress and remarks on stderr."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from itertools import chain
from typing import IO, Any, cast

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from model.progress import Advance, Listener

out = Console(highlight=False, emoji=False)


class _Remarks:
    """Standard error that ignores a closed pipe or terminal: it must not end a run in motion."""

    def write(self, text: str) -> int:
        """Writes; errors are ignored."""
        with suppress(OSError, ValueError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Flushes; errors are ignored."""
        with suppress(OSError, ValueError):
            self._stream.flush()

    @property
    def rich_proxied_file(self) -> _Remarks:
        """What rich writes to while it shows a bar: this, or an error would end the motion."""
        return self

    @property
    def _stream(self) -> IO[str]:
        """Standard error, also while rich has replaced it to keep a bar below the text."""
        return cast(IO[str], getattr(sys.stderr, "rich_proxied_file", sys.stderr))

    def __getattr__(self, name: str) -> Any:
        """Everything else comes from standard error itself."""
        return getattr(sys.stderr, name)


err = Console(file=cast(IO[str], _Remarks()), highlight=False, emoji=False)


def show_json(document: Any) -> None:
    """Prints a result for programs."""
    typer.echo(json.dumps(document, indent=1, allow_nan=False))


def show_line(text: str, on: Console = out) -> None:
    """Prints plain text without wrapping lines."""
    on.print(text, markup=False, soft_wrap=True)


def show_facts(title: str, facts: list[tuple[str, str]], on: Console = out) -> None:
    """Prints a result for people: names on the left, values on the right.

    Args:
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


def present(
    as_json: bool, document: Mapping[str, Any], title: str, facts: list[tuple[str, str]]
) -> None:
    """Prints a result: for programs as JSON, for people as names and values."""
    if as_json:
        show_json(document)
    else:
        show_facts(title, facts)


@contextmanager
def progress_bar(text: str, total: float | None, shown: bool) -> Iterator[Advance]:
    """Shows a progress bar on stderr if that is a terminal; yields the function that moves it."""
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


class Terminal(Listener):
    """Shows the reports of a library function on stderr."""

    def __init__(self, *, quiet: bool = False) -> None:
        """Shows everything, or only remarks and warnings.

        Args:
            quiet: Standard output is for a program: no notes, no spinner, no bar.
        """
        self._shown, self._is_busy = not quiet, False

    def note(self, text: str) -> None:
        """See `Listener`."""
        if self._shown:
            show_line(text, err)

    def remark(self, text: str) -> None:
        """See `Listener`."""
        err.print(f"[yellow]remark[/] {escape(text)}", soft_wrap=True)

    def remarks(self, *texts: Iterable[str]) -> None:
        """Shows remarks on several files."""
        for text in chain(*texts):
            self.remark(text)

    def warning(self, text: str) -> None:
        """See `Listener`."""
        err.print(f"[red]warning[/] {escape(text)}", soft_wrap=True)

    @contextmanager
    def waiting(self, text: str) -> Iterator[None]:
        """See `Listener`."""
        with (
            self._exclusive() as shown,
            err.status(text) if shown and err.is_terminal else nullcontext(),
        ):
            yield

    @contextmanager
    def progress(self, text: str, total: float | None) -> Iterator[Advance]:
        """See `Listener`."""
        with self._exclusive() as shown, progress_bar(text, total, shown) as advance:
            yield advance

    @contextmanager
    def _exclusive(self) -> Iterator[bool]:
        """Whether a spinner or a bar may be shown: a terminal shows one at a time."""
        before, self._is_busy = self._is_busy, True
        try:
            yield self._shown and not before
        finally:
            self._is_busy = before
