"""Executors in processes of their own, forked from one that has imported everything once.

    python -m tests.scenarios.faults.masters PLAN RIG

reads a line a run (interface, channel, folder) and answers with the number of the process that
runs it; `outcome.json` in the folder tells how it ended, if it came to its end.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

from drivers.bus import BusSettings

ROOT = Path(__file__).parents[3]
PROGRAM = (
    f"import sys; sys.path.insert(0, {str(ROOT)!r});"
    " from tests.scenarios.faults.masters import serve; serve()"
)


def gone(process: int) -> bool:
    """Ended, also when nobody has waited for it yet."""
    try:
        state = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:
        return True
    return state == "Z"


class Masters:
    """Starts executors for one plan."""

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
    from cdpr.plan import load_plan
    from cdpr.rig import load_rig
    from executor.prepare import prepare
    from planner.check import verify

    plan, rig = map(Path, sys.argv[1:])
    prepared = prepare(verify(load_plan(plan)), load_rig(rig))
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    from tests.scenarios.faults import one_master

    for line in sys.stdin:
        interface, channel, folder = json.loads(line)
        child = os.fork()
        if child == 0:
            with suppress(KeyboardInterrupt):
                one_master.run(prepared, BusSettings(interface, channel), Path(folder))
            os._exit(0)
        sys.stdout.write(f"{child}\n")
        sys.stdout.flush()
