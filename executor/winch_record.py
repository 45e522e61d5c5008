"""What a motion of winches without a path leaves: a folder with its events and its cycles.

``events.jsonl`` is as in a run folder. ``winches.csv`` has one row a cycle: ``cycle``, ``time_s``,
``state``, and per cable ``set_counts_K``, ``counts_K`` and ``torque_per_mille_K`` (of rated torque,
positive where it pulls the cable in). Both are written while the winches move, without waiting for
the disk: what a killed program had written is there.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TextIO

from cdpr.errors import BadInput
from executor.records import CycleRecord, LoopEvent
from executor.run_folder import EVENTS

WINCHES = "winches.csv"


class WinchRecord:
    """Of one motion; make one with `recording`.

    Attributes:
        folder: Where it is.
        cycles: How many were taken in.
    """

    def __init__(self, folder: Path, events: TextIO, winches: TextIO) -> None:
        """Takes open files; they stay the caller's."""
        self.folder, self.cycles = folder, 0
        self._events, self._winches = events, winches
        self._began = float("inf")  # until there is a cycle

    def take_cycle(self, record: CycleRecord) -> None:
        """A cycle is over."""
        if self.cycles == 0:
            columns = ("set_counts", "counts", "torque_per_mille")
            cables = range(1, len(record.actual) + 1)
            names = [f"{column}_{cable}" for column in columns for cable in cables]
            self._winches.write(f"cycle,time_s,state,{','.join(names)}\n")
            self._began = record.at
        self.cycles += 1
        numbers = (*record.targets, *record.actual, *record.torques)
        row = (record.cycle, f"{self._time(record.at):.6f}", record.state.value, *numbers)
        self._winches.write(",".join(map(str, row)) + "\n")

    def take_event(self, event: LoopEvent) -> None:
        """Something happened."""
        told = {"time_s": round(self._time(event.at), 6), "code": event.code, "text": event.text}
        self._events.write(json.dumps(told, ensure_ascii=False) + "\n")

    def _time(self, at: float) -> float:
        """Since the first cycle, [s]; 0 before it."""
        return max(0.0, at - self._began)


@contextmanager
def recording(folder: Path) -> Iterator[WinchRecord]:
    """Makes the folder; removes it if no cycle came of it.

    Raises:
        BadInput: It cannot be made.
    """
    with ExitStack() as files:
        try:
            folder.mkdir()
            events = files.enter_context((folder / EVENTS).open("w", buffering=1, encoding="utf-8"))
            winches = files.enter_context((folder / WINCHES).open("w", encoding="utf-8"))
        except OSError as error:
            raise BadInput(
                "the record of the motion cannot be made",
                where=str(folder),
                why=error.strerror or str(error),
                next_step="change to a folder that you may write to; nothing was moved",
            ) from None
        record = WinchRecord(folder, events, winches)
        try:
            yield record
        finally:
            if record.cycles == 0:
                shutil.rmtree(folder, ignore_errors=True)
