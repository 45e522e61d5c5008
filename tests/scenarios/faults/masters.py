"""Executors in separate processes, forked from one that has imported everything once.

    python -m tests.scenarios.faults.masters PLAN RIG

reads one line per run (interface, channel, folder) and answers with the ID of its process;
`outcome.json` in the folder has the outcome, if the run ended.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import subprocess
import sys
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Protocol

from drivers.can_bus import BusSettings
from executor.trajectory.setpoints import PreparedRun

ROOT = Path(__file__).parents[3]
PROGRAM = (
    f"import sys; sys.path.insert(0, {str(ROOT)!r});"
    " from tests.scenarios.faults.masters import serve; serve()"
)


def gone(process: int) -> bool:
    """Whether it ended, also before it was waited for."""
    try:
        state = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:
        return True
    return state == "Z"


class StartsMasters(Protocol):
    """Starts executors for one plan."""

    def start(self, settings: BusSettings, folder: Path) -> int:
        """A run with the drives on a bus; the number of its process."""
        ...


class ForkedMasters:
    """Forks this process: with instruction counting, importing everything again takes a minute."""

    def __init__(self, prepared: PreparedRun) -> None:
        context = multiprocessing.get_context("fork")
        self._link, far_end = context.Pipe()
        self._process = context.Process(target=_serve_forked, args=(prepared, far_end))
        self._process.start()

    def start(self, settings: BusSettings, folder: Path) -> int:
        """A run with the drives on a bus; the number of its process."""
        self._link.send((settings, folder))
        return int(self._link.recv())

    def close(self) -> None:
        self._link.send(None)
        self._process.join()
        self._process.close()


class Masters:
    """Starts executors for one plan, from a process that was started for it."""

    def __init__(self, plan: Path, rig: Path) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, str(plan), str(rig)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def start(self, settings: BusSettings, folder: Path) -> int:
        """A run with the drives on a bus; the number of its process."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        line = json.dumps([settings.interface, settings.channel, str(folder)])
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()
        return int(self._process.stdout.readline())

    def close(self) -> None:
        self._process.communicate()


def serve() -> None:
    """What the process does."""
    from executor.trajectory.setpoints import prepare
    from model.plan import load_plan
    from model.rig import load_rig
    from planner.check import verify

    plan, rig = map(Path, sys.argv[1:])
    prepared = prepare(verify(load_plan(plan)), load_rig(rig))
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    for line in sys.stdin:
        interface, channel, folder = json.loads(line)
        child = _forked(prepared, BusSettings(interface, channel), Path(folder))
        sys.stdout.write(f"{child}\n")
        sys.stdout.flush()


def _serve_forked(prepared: PreparedRun, link: Connection) -> None:
    os.setsid()
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    while (asked := link.recv()) is not None:
        link.send(_forked(prepared, *asked))


def _forked(prepared: PreparedRun, settings: BusSettings, folder: Path) -> int:
    """A run in a process of its own; its number."""
    from tests.scenarios.faults import one_master

    child = os.fork()
    if child == 0:
        with suppress(KeyboardInterrupt):
            one_master.run(prepared, settings, folder)
        os._exit(0)
    return child
