"""One executor that moves drives over a bus in real time, and records its outcome."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from drivers.can_bus import BusSettings, open_bus
from drivers.factory import make_drive_group
from executor.control.path_runs import PathMotion, run_along_path
from executor.realtime.child import ReadyDrives
from executor.realtime.process import MotionHere
from executor.realtime.scheduling import RealClock, real_time
from executor.recording.run_folder import RunEvent, RunFolder
from executor.supervision import LocalRequests
from executor.trajectory.setpoints import PreparedRun
from model.errors import CdprError
from model.files.documents import write_atomic
from model.rig import rig_from_document
from tests.scenarios.faults.bench import recorder_for


class _Folder(RunFolder):
    """Writes events at the end: the program's loop does not write files either."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.waiting: list[RunEvent] = []

    def append_event(self, event: RunEvent) -> None:
        self.waiting.append(event)

    def write(self) -> None:
        for event in self.waiting:
            super().append_event(event)


def run(prepared: PreparedRun, settings: BusSettings, path: Path) -> None:
    """Arms and moves; SIGTERM requests a stop."""
    board = LocalRequests()
    signal.signal(signal.SIGTERM, lambda *_: board.ask_stop())
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    try:
        outcome = _moved(prepared, settings, path, board)
    except CdprError as error:
        outcome = {"state": "ready", "cause": str(error), "cycles": 0, "worst_late": 0.0, "lost": 0}
    write_atomic(path / "outcome.json", json.dumps(outcome))


def _moved(
    prepared: PreparedRun, settings: BusSettings, path: Path, board: LocalRequests
) -> dict[str, Any]:
    document = prepared.rig.document.bus.model_copy(
        update={"interface": settings.interface, "channel": settings.channel}
    )
    rig = rig_from_document(prepared.rig.document.model_copy(update={"bus": document}))
    folder = _Folder(path)
    recorder = recorder_for(prepared, folder, board)
    # The program writes cycles in the process that supervises, never in the one of the loop.
    recorder.writer.take_cycles = lambda _at: None  # type: ignore[assignment, method-assign]
    with open_bus(settings) as bus, real_time():
        group = make_drive_group(rig, bus)
        group.configure()
        drives = ReadyDrives(rig, group, None, lambda _load: None, ())
        clock = RealClock(prepared.checked.table.cycle)

        @contextmanager
        def mover(motion: PathMotion) -> Iterator[MotionHere]:
            with closing(motion):
                yield MotionHere(motion, drives, clock, board)

        outcome = run_along_path(
            prepared,  # on a virtual bus: no latch, no reference
            mover,
            recorder,
            before_motion=lambda _denied: None,
        )
    folder.write()
    table = recorder.log.table()
    return {
        "state": outcome.state.value,
        "cause": outcome.cause,
        "cycles": len(recorder.log),
        "worst_late": float(table.lateness.max()),
        "lost": int(table.missing.sum()),
    }
