"""What the console started: verbs of the command line, each in a process that outlives it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from model.errors import BadInput, Refused

#: Of what a verb printed, this much is shown, [characters].
SHOWN = 4000
_REPORT = re.compile(r"(\S+/report\.html)")
_HELP = re.compile(r"docs/faults/(\w+)\.md")


@dataclass(frozen=True, slots=True)
class VerbOutcome:
    """How a verb ended.

    Attributes:
        verb: Its name.
        exit_code: Of the process.
        text: The end of what it printed.
        report: The run's report, if it wrote one.
        fault: Code of the fault whose page it names.
    """

    verb: str
    exit_code: int
    text: str
    report: Path | None
    fault: str | None


class StartedVerb:
    """One verb at a time; it writes to a file, so that no pipe ends with the console."""

    def __init__(self) -> None:
        """Nothing was started."""
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._output = Path()
        self.verb: str | None = None
        """What is under way."""
        self.outcome: VerbOutcome | None = None
        """How the last one ended."""

    def start(self, verb: str, arguments: Sequence[str]) -> None:
        """Starts a verb without a terminal.

        Raises:
            Refused: Another one is under way.
        """
        with self._lock:
            self._look()
            if self.verb is not None:
                raise Refused(
                    f"`cdpr {self.verb}` is still under way",
                    where="console",
                    next_step="wait until it has ended, or stop it",
                )
            self._start(verb, arguments)

    def look(self) -> str:
        """The newest line that the verb printed; notices its end."""
        with self._lock:
            return self._look()

    def _start(self, verb: str, arguments: Sequence[str]) -> None:
        descriptor, name = tempfile.mkstemp(prefix=f"cdpr-{verb}-", suffix=".log")
        command = [sys.executable, "-c", "from cdpr.cli import main; main()", verb, *arguments]
        try:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=descriptor,
                stderr=subprocess.STDOUT,
                env={**os.environ, "NO_COLOR": "1", "COLUMNS": "100"},
                start_new_session=True,
            )
        finally:
            os.close(descriptor)
        self._output, self.verb, self.outcome = Path(name), verb, None

    def _look(self) -> str:
        if self._process is None or self.verb is None:
            return ""
        text = self._output.read_text(encoding="utf-8", errors="replace")
        code = self._process.poll()
        if code is not None:
            self.outcome = _outcome(self.verb, code, text)
            self._output.unlink(missing_ok=True)
            self._process = self.verb = None
        lines = text.strip().splitlines()
        return lines[-1].strip() if lines else ""


def _outcome(verb: str, code: int, text: str) -> VerbOutcome:
    report, fault = _REPORT.findall(text), _HELP.findall(text)
    return VerbOutcome(
        verb=verb,
        exit_code=code,
        text=text.strip()[-SHOWN:],
        report=Path(report[-1]) if report else None,
        fault=fault[-1] if fault else None,
    )


def file_here(name: str) -> Path:
    """A file below the folder that the console was started in.

    Raises:
        BadInput: It is elsewhere.
    """
    path = Path(name)
    if not path.resolve().is_relative_to(Path.cwd().resolve()):
        raise BadInput(
            f"{name} is not below the folder in which the console runs",
            where="console",
            next_step="copy it there, or start the console elsewhere",
        )
    return path
