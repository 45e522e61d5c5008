"""Calls the real command line in this process: `main` with arguments, like the console script."""

from __future__ import annotations

import gc
import io
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

from cdpr.cli import main
from cdpr.cli.operate import supervision


@dataclass(frozen=True)
class Answer:
    """Result of a call: exit code and output."""

    code: int
    out: str
    err: str

    @property
    def said(self) -> str:
        """The whole output without line breaks, so that wrapping hides no sentence."""
        return " ".join((self.out + " " + self.err).split())


def call(*arguments: str | Path, answers: str = "") -> Answer:
    """Runs ``cdpr ARGUMENTS`` with ``answers`` as standard input.

    The program counts as started now, not with the tests: a `cdpr stop` of another program since
    then would stop every motion of theirs.
    """
    out, err = io.StringIO(), io.StringIO()
    argv = ["cdpr", *map(str, arguments)]
    now = time.clock_gettime(time.CLOCK_BOOTTIME)
    with (
        mock.patch.object(supervision, "_process_start", return_value=now),
        mock.patch.object(sys, "argv", argv),
        mock.patch.object(sys, "stdin", io.StringIO(answers)),
        redirect_stdout(out),
        redirect_stderr(err),
    ):
        try:
            main()
        except SystemExit as end:
            code = end.code
        else:
            code = 0
        finally:
            gc.unfreeze()  # it froze what is left of it, as the last thing that a program does
    assert code is None or isinstance(code, int)
    return Answer(code or 0, out.getvalue(), err.getvalue())


def content(folder: Path) -> dict[str, bytes | None]:
    """Every path below a folder with its bytes; None for a folder."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }


@contextmanager
def nothing_written(folder: Path) -> Iterator[None]:
    """Requires that the block leaves the folder unchanged."""
    before = content(folder)
    yield
    after = content(folder)
    assert after.keys() == before.keys()
    assert after == before


def one_message(answer: Answer, code: int, *parts: str) -> None:
    """Requires one clear error: exit code, a message with a next step, and nothing else."""
    assert answer.code == code, answer
    assert "Traceback" not in answer.said
    assert "defect of cdpr" not in answer.said
    assert answer.err.count("error: ") == 1, answer.err
    assert "\n  next: " in answer.err, answer.err
    for part in parts:
        assert part in answer.said, f"{part!r} not in {answer.said!r}"
