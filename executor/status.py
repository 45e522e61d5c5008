"""How a run stands at this moment, for `cdpr monitor` and the programs that read its JSON.

Keys: ``process``, ``rig``, ``bus``, ``folder``, ``simulated_time``, ``state``, ``elapsed_s``,
``cycle``, ``row``, ``rows``, ``path_mm``, ``path_length_mm``, ``feed_percent`` (of the planned
speed, now), ``wished`` {``stop``, ``hold``, ``speed_percent``}, ``lateness_ms``,
``worst_lateness_ms``, ``following_error_mm``, ``lost_replies``, ``drives`` [{``node``, ``state``,
``position_counts``, ``set_counts``, ``tension_n``}], ``events`` [{``time_s``, ``code``,
``text``}], the newest last. A number that is not known is null; before the first cycle ``state``
is ``preparing`` and ``drives`` is empty.
"""

from __future__ import annotations

import os
from collections import deque
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from drivers.drive_group import drive_states
from executor.prepare import PreparedRun
from executor.records import CycleRecord
from executor.run_folder import RunEvent
from executor.wishes import WishBoard

#: So many of the newest events are told.
EVENTS_TOLD = 12


class RunStatus:
    """Takes in what happens; tells it to whoever asks, from any thread."""

    def __init__(
        self, prepared: PreparedRun, folder: Path, board: WishBoard, *, simulated_time: bool
    ) -> None:
        """A run that is being prepared."""
        self._prepared, self._folder, self._board = prepared, folder, board
        self._simulated_time = simulated_time
        self._record: CycleRecord | None = None
        self._began = 0.0
        self._worst_lateness = 0.0
        self._lost = 0
        self._events: deque[RunEvent] = deque(maxlen=EVENTS_TOLD)

    def take_cycle(self, record: CycleRecord) -> None:
        """A cycle is over."""
        if self._record is None:
            self._began = record.at
        self._worst_lateness = max(self._worst_lateness, record.lateness)
        self._lost += record.missing
        self._record = record

    def take_event(self, event: RunEvent) -> None:
        """Something happened."""
        self._events.append(event)

    def as_dict(self) -> dict[str, Any]:
        """See the head of this file."""
        prepared, wishes, bus = self._prepared, self._board.read(), self._prepared.rig.document.bus
        return {
            "process": os.getpid(),
            "rig": prepared.rig.name,
            "bus": f"{bus.interface} {bus.channel}".strip(),
            "folder": str(self._folder),
            "simulated_time": self._simulated_time,
            **self._motion(self._record),
            "rows": len(prepared.checked.table),
            "path_length_mm": round(prepared.length * 1e3, 3),
            "wished": {
                "stop": wishes.stop,
                "hold": wishes.hold,
                "speed_percent": round(wishes.speed * 100.0),
            },
            "lost_replies": self._lost,
            "events": [asdict(event) for event in list(self._events)],
        }

    def _motion(self, record: CycleRecord | None) -> dict[str, Any]:
        if record is None:
            return {
                "state": "preparing",
                **dict.fromkeys(("elapsed_s", "cycle", "row", "path_mm", "feed_percent")),
                **dict.fromkeys(("lateness_ms", "worst_lateness_ms", "following_error_mm")),
                "drives": [],
            }
        table = self._prepared.checked.table
        path = float(np.interp(record.index, np.arange(len(table)), table.travelled))
        late = 1e3 * table.cycle
        error = record.following_error * 1e3
        return {
            "state": record.state.value,
            "elapsed_s": round(record.at - self._began, 3),
            "cycle": record.cycle,
            "row": round(record.index, 2),
            "path_mm": round(path * 1e3, 3),
            "feed_percent": round(record.rate * 100.0, 1),
            "lateness_ms": None if self._simulated_time else round(record.lateness * late, 3),
            "worst_lateness_ms": (
                None if self._simulated_time else round(self._worst_lateness * late, 3)
            ),
            "following_error_mm": round(error, 4) if np.isfinite(error) else None,
            "drives": self._drives(record),
        }

    def _drives(self, record: CycleRecord) -> list[dict[str, Any]]:
        columns = zip(
            self._prepared.rig.winches,
            drive_states(self._prepared.rig, record.words),
            record.actual,
            record.targets,
            record.torques,
            strict=True,
        )
        return [
            {
                "node": winch.node_id,
                "state": state,
                "position_counts": actual,
                "set_counts": target,
                "tension_n": round(torque / 1000.0 * winch.torque_constant, 2),
            }
            for winch, state, actual, target, torque in columns
        ]
