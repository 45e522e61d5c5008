"""Odd command lines for every verb, each in a separate process."""

from __future__ import annotations

import io
import os
import random
import shlex
import shutil
import signal
import sys
import time
from enum import Enum
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import typer.main

CALL_S, SILENT_S, LONG_S = 10, 25, 6
"""Limits of a call, [s]: processor time, total time, and total time of a long one."""

PRELOADED = (
    "calibration.result_files",
    "executor.trajectory.setpoints",
    "executor.report.page",
    "planner.planning",
    "simulation.factory",
    "tracking.tracker",
)

#: Not called: they act on any run in progress on this machine.
LEFT_OUT = ("stop", "hold", "resume", "speed")
#: These may take longer than a call may; they are then killed, which is not a failure.
LONG = (
    "demo", "plan", "run", "sim", "bench", "workspace", "monitor", "home", "jog", "track",
    "calibrate", "check", "doctor", "console",
)  # fmt: skip
FILES = {
    "rig": "rig",
    "scene": "scene",
    "plan": "plan",
    "calibration": "result",
    "results": "result",
    "first": "result",
    "second": "result",
    "file": "camera",
    "coordinates": "coordinates",
    "poses": "poses",
    "data": "places",
    "eds": "eds",
}
"""Kind of valid file for each parameter."""
VALUES = (
    "0",
    "1",
    "-1",
    "3",
    "nan",
    "inf",
    "-inf",
    "1e308",
    "1e30",
    "9" * 30,
    "2147483648",
    "",
    " ",
    "x",
    "x" * 300,
    "é",
    "\udcff",
    "/dev/null",
    "/dev/zero",
    "/dev/full",
    "pipe",
    "loop",
    ".",
    "..",
    "/",
    "a=b",
    "front=0",
    "0.001",
    "1,2,3",
    "z=10",
    "http://x",
    "none.yaml",
    "pictures",
    "{",
)


class VerbFuzzer:
    """Generates and runs command lines.

    Args:
        corpus: Valid files by kind.
        scratch: Working folder.
    """

    def __init__(self, corpus: dict[str, list[Path]], scratch: Path) -> None:
        from cdpr.cli.app import build_app

        for module in PRELOADED:  # once instead of in every call
            import_module(module)
        self._corpus, self._scratch = corpus, scratch
        self._verbs = dict(_commands(typer.main.get_command(build_app())))
        os.mkfifo(scratch / "pipe")
        (scratch / "loop").symlink_to(scratch / "loop")
        shutil.copytree(corpus["picture"][0].parent, scratch / "pictures")

    def one(self, chance: random.Random, now: Path) -> list[str]:
        """Runs one; returns the verb's counter, and failures, each beginning with ``verb ``."""
        words, command = chance.choice(sorted(self._verbs.items(), key=lambda item: item[0]))
        arguments = [*words, *self._arguments(command, chance)]
        now.write_text(shlex.join(arguments), errors="surrogateescape")
        folder = self._scratch / "out"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        code, output_text = self._called(arguments, chance)
        found = [f"calls of {' '.join(words)}"]
        if code is None and words[0] not in LONG:
            found.append("verb hangs")
        if "this is a defect in cdpr" in output_text or "Traceback" in output_text:
            found.append("verb tracebacks")
        if code is not None and code < 0:
            found.append(f"verb died with {code}")
        if code is not None and any(folder.rglob(".*")):
            found.append("verb left an unfinished output")
        if len(found) > 1:
            with now.open("a") as stream:
                stream.write("\n\n" + output_text)
        return found

    def _arguments(self, command: Any, chance: random.Random) -> list[str]:
        """Valid arguments with up to three odd values among them."""
        odd = chance.choice((0, 1, 1, 2, 3))
        chosen: list[str] = []
        params = list(command.params)
        for param in params:
            wanted = param.required or chance.random() < 0.25
            if not wanted or "help" in param.opts[0]:
                continue
            value = self._usual(param, chance)
            if odd and chance.random() < 0.4:
                odd -= 1
                value = [chance.choice(VALUES) for _ in range(max(1, param.nargs))]
            if param.opts[0].startswith("-"):
                chosen += [param.opts[-1], *([] if param.is_flag else value)]
            else:
                chosen += value
        return chosen

    def _usual(self, param: Any, chance: random.Random) -> list[str]:
        name, kind = param.name or "", param.type_descriptor.annotation
        if get_origin(kind) is list:
            (kind,) = get_args(kind)
        if name in ("run", "from_run"):
            return [str(self._corpus["run"][0].parent)]
        if name in ("output", "mcap", "overlay", "foxglove_layout"):
            return [f"out/{chance.choice(('a.json', 'a.csv', 'a', 'a.pdf', 'a.avi'))}"]
        if name in FILES:
            return [str(chance.choice(self._corpus[FILES[name]]))]
        if name in ("source", "folder", "live"):
            return ["pictures"]
        if get_origin(kind) is Literal:
            return [chance.choice(get_args(kind))]
        if isinstance(kind, type) and issubclass(kind, Enum):
            return [chance.choice([one.value for one in kind])]
        return [chance.choice(("1", "2", "5", "10")) for _ in range(max(1, param.nargs))]

    def _called(self, arguments: list[str], chance: random.Random) -> tuple[int | None, str]:
        """Exit code (None if killed here, negative for a signal), and the output."""
        log = self._scratch / "log"
        output = "/dev/full" if chance.random() < 0.1 else str(log)
        encoding = chance.choice(("utf-8", "utf-8", "ascii"))
        child = os.fork()
        if child == 0:
            _run_verb(arguments, output, str(log), encoding)
        code = _waited(child, LONG_S if arguments[0] in LONG else SILENT_S)
        if code == -signal.SIGPROF:
            code = None
        return code, log.read_text(errors="replace") if log.exists() else ""


def _run_verb(arguments: list[str], output: str, log: str, encoding: str) -> None:
    """Runs the command line in the child process, then exits."""
    code = 99
    try:
        signal.signal(signal.SIGPROF, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_PROF, CALL_S)  # processor time; its signal kills
        os.setsid()
        Path(log).write_text("")
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(os.open(output, os.O_WRONLY | os.O_APPEND), 1)
        os.dup2(os.open(log, os.O_WRONLY | os.O_APPEND), 2)
        sys.stdin = open(0, closefd=False)  # noqa: SIM115
        sys.stdout = io.TextIOWrapper(io.FileIO(1, "w"), encoding=encoding, write_through=False)
        sys.stderr = io.TextIOWrapper(io.FileIO(2, "w"), encoding=encoding, line_buffering=True)
        sys.argv = ["cdpr", *arguments]
        from cdpr.cli import main

        main()
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
    except BaseException:
        import traceback

        os.write(2, traceback.format_exc().encode(errors="replace"))
    finally:
        os._exit(code)


def _waited(child: int, limit: float) -> int | None:
    end = time.monotonic() + limit
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.01)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


def _commands(command: Any, words: tuple[str, ...] = ()) -> list[tuple[tuple[str, ...], Any]]:
    if hasattr(command, "commands"):
        return [
            found
            for name in command.commands
            if name not in LEFT_OUT
            for found in _commands(command.loaded(name), (*words, name))
        ]
    return [(words, command)]
