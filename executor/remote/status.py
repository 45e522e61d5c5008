"""Present status of a run, for `cdpr monitor` and programs that read its JSON.

Keys: ``process``, ``rig``, ``bus``, ``folder``, ``simulated_time``, ``state``, ``cause``,
``elapsed_s``, ``cycle``, ``row``, ``rows``, ``path_mm``, ``path_length_mm``, ``next_stop``
{``name`` (``goal`` at the end), ``distance_mm``, ``seconds`` (at the set speed)}, ``feed_percent``
(of the planned speed, now), ``wished`` {``stop``, ``hold``, ``speed_percent``}, ``lateness_ms``,
``worst_lateness_ms``, ``following_error_mm``, ``lost_replies``, ``rejected_frames``,
``error_frames``, ``cameras`` [{``name``, ``source``, ``pictures``, ``poses``, ``dropped``,
``pictures_per_second`` (in run time), ``measuring_ms``, ``tags`` (detected last), ``trouble`` (why
it does not measure, or empty), ``live_image`` (descriptor of its newest image in this process, see
`executor.cameras.live_image`)}], ``measured`` (the newest fused pose of all cameras, or null)
{``time_s`` (of its images), ``position_mm``, ``quaternion``, ``covariance_mm2`` (of the position,
row by row), ``stated`` (whether it includes the errors common to all images), ``clearance``
{``distance_mm``, ``low_mm``, ``high_mm`` (its 95 % interval), ``pair``}, or null}, ``drives``
[{``node``, ``state``, ``torque`` (``enabled``, ``holding`` or ``none``: then ``tension_n`` is not
that of the cable), ``in_fault``, ``position_counts``, ``set_counts``, ``tension_n``}], ``events``
[{``time_s``, ``code``, ``text``}], the newest last. An unknown number is null; before the first
cycle ``state`` is ``preparing`` (``releasing`` during `cdpr release`) and ``drives`` is empty;
before a motion opens its devices there is also ``verb``, the verb that is being prepared; at the
end ``cause`` is the reason of a bad end, also where the motion did not begin. Winches that move
without a path (`cdpr home`, `cdpr jog --cable`) have no ``path_mm`` and ``path_length_mm``; their
``row`` of 100 ``rows`` is a percentage. A jog session has ``jog`` {``speed_mm_s`` (largest),
``position_mm``, ``quaternion`` (commanded pose), ``room_mm`` (to the end of the checked line),
``limit`` (why it ends there, or null)}, and neither rows nor a path; a session of single cables has
``cable_jog`` {``speed_mm_s`` (largest), ``limit_n`` (of every tension), ``cable`` (that moved last,
or null), ``press_mm`` (paid out by the latest press; negative for wound in), ``session_mm`` (the
same for each cable since the session began), ``limit`` (why the cable stops, or null)}.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drivers.can_bus import BusSettings
from drivers.factory import drive_flags, drive_states
from executor.recording.run_folder import RunEvent
from executor.state_machine import CycleRecord, LoopEvent, State
from executor.supervision import RequestBoard
from executor.trajectory.setpoints import PreparedRun
from model.errors import CdprError, StoppedByOperator
from model.rig import Rig
from tracking.clearance import MeasuredClearance
from tracking.measurement import PoseMeasurement

if TYPE_CHECKING:
    from executor.hold_to_run.cables import CableTravel
    from executor.hold_to_run.line import JogProver

#: Number of newest events reported.
EVENTS_SHOWN = 12
_RELEASING = "releasing"


class CyclesSoFar:
    """Status from cycle records, for any kind of motion."""

    def __init__(self, rig: Rig, *, simulated_time: bool) -> None:
        self.began = 0.0
        """Time of the first cycle, [s]."""
        self.last: CycleRecord | None = None
        self._rig, self._simulated_time = rig, simulated_time
        self._worst_lateness = 0.0
        self._lost = 0
        self._end: tuple[State | None, str] | None = None
        self.before = "preparing"
        """State reported before the first cycle."""

    def take(self, record: CycleRecord) -> None:
        """Takes a cycle."""
        if self.last is None:
            self.began = record.at
        self._worst_lateness = max(self._worst_lateness, record.lateness)
        self._lost += record.missing
        self.last = record

    def take_end(self, state: State, cause: str) -> None:
        """Takes the end of the motion, which replaces the state."""
        self._end = state, cause

    def take_error(self, error: CdprError) -> None:
        """Takes an error of the verb; before its motion began it latches nothing."""
        if self._end is None and self.last is None:
            state = State.STOPPED if isinstance(error, StoppedByOperator) else None
            self._end = State.LATCHED if self.before == _RELEASING else state, error.what

    def as_dict(self) -> dict[str, Any]:
        """State, times, replies and drives; see the module docstring."""
        state, cause = self._end or (self.last.state if self.last else None, None)
        data = {
            "state": state.value if state else self.before,
            "cause": cause or None,
            "simulated_time": self._simulated_time,
            "lost_replies": self._lost,
            "rejected_frames": self.last.rejected if self.last else 0,
            "error_frames": self.last.error_frames if self.last else 0,
        }
        record = self.last
        if record is None:
            unknown = ("elapsed_s", "cycle", "feed_percent", "lateness_ms", "worst_lateness_ms")
            nothing = dict.fromkeys((*unknown, "following_error_mm"))
            return {**data, **nothing, "drives": []}
        error = record.following_error * 1e3
        return {
            **data,
            "elapsed_s": round(record.at - self.began, 3),
            "cycle": record.cycle,
            "feed_percent": round(record.rate * 100.0, 1),
            "lateness_ms": self._lateness_ms(record.lateness),
            "worst_lateness_ms": self._lateness_ms(self._worst_lateness),
            "following_error_mm": round(error, 4) if np.isfinite(error) else None,
            "drives": self._drives(record),
        }

    def _lateness_ms(self, cycles: float) -> float | None:
        late = round(cycles * self._rig.document.bus.cycle_ms, 3)
        return None if self._simulated_time else late

    def _drives(self, record: CycleRecord) -> list[dict[str, Any]]:
        columns = zip(
            self._rig.winches,
            drive_states(self._rig, record.words),
            drive_flags(self._rig, record.words),
            record.actual,
            record.targets,
            self._rig.tensions_by(record.torques).tolist(),
            strict=True,
        )
        return [
            {
                "node": winch.node_id,
                "state": state,
                "torque": flags.torque,
                "in_fault": flags.in_fault,
                "position_counts": actual,
                "set_counts": target,
                "tension_n": round(tension, 2),
            }
            for winch, state, flags, actual, target, tension in columns
        ]


def bus_name(rig: Rig) -> str:
    """The bus of a rig, as in a status; the same text for every spelling in rig files."""
    return BusSettings.of(rig).canonical.strip()


def identity(rig: Rig, folder: Path | None) -> dict[str, Any]:
    """Process, rig, bus and record folder."""
    return {
        "process": os.getpid(),
        "rig": rig.name,
        "bus": bus_name(rig),
        "folder": "" if folder is None else str(folder),
    }


def measured_data(measured: PoseMeasurement, clearance: MeasuredClearance | None) -> dict[str, Any]:
    """A measured pose and its clearance; see the module docstring."""
    covariance = (measured.covariance + measured.shared)[:3, :3] * 1e6
    return {
        "time_s": round(measured.time, 3),
        "position_mm": [round(float(v) * 1e3, 4) for v in measured.pose.position],
        "quaternion": [round(float(v), 7) for v in measured.pose.quaternion],
        "covariance_mm2": [float(f"{v:.6g}") for v in covariance.reshape(-1)],
        "stated": not measured.unstated,
        "clearance": None if clearance is None else _clearance_data(clearance),
    }


def _clearance_data(clearance: MeasuredClearance) -> dict[str, Any]:
    nearest = min(clearance.nearest, key=lambda one: one.distance)
    return {
        "distance_mm": round(clearance.distance * 1e3, 3),
        "low_mm": round((clearance.distance - clearance.uncertainty) * 1e3, 3),
        "high_mm": round(clearance.at_most * 1e3, 3),
        "pair": [nearest.first, nearest.second],
    }


def requests_data(board: RequestBoard) -> dict[str, Any]:
    """Present operator requests."""
    requests = board.read()
    speed = round(requests.speed * 100.0)
    return {"wished": {"stop": requests.stop, "hold": requests.hold, "speed_percent": speed}}


class MotionStatus(ABC):
    """Collects events; answers requests for status, from any thread."""

    def __init__(self, rig: Rig, board: RequestBoard, *, simulated_time: bool) -> None:
        self._rig, self._board = rig, board
        self._cycles = CyclesSoFar(rig, simulated_time=simulated_time)
        self._cameras: list[dict[str, Any]] = []
        self._measured: tuple[PoseMeasurement, MeasuredClearance | None] | None = None
        self._folder: Path | None = None

    def take_folder(self, folder: Path) -> None:
        """Takes the record folder; readers of the status may run in another current folder."""
        self._folder = folder.absolute()

    def take_release(self) -> None:
        """Reports a release, in which nothing moves and no cycle is reported."""
        self._cycles.before = _RELEASING

    def take_end(self, state: State, cause: str) -> None:
        """Takes the end of the motion."""
        self._cycles.take_end(state, cause)

    def take_error(self, error: CdprError) -> None:
        """Takes an error that ended the verb; see `CyclesSoFar.take_error`."""
        self._cycles.take_error(error)

    def as_dict(self) -> dict[str, Any]:
        """See the module docstring."""
        return {
            **identity(self._rig, self._folder),
            **self._cycles.as_dict(),
            **self._position_fields(),
            "cameras": self._cameras,
            "measured": None if self._measured is None else measured_data(*self._measured),
            **requests_data(self._board),
            "events": self._event_data(),
        }

    @abstractmethod
    def _position_fields(self) -> dict[str, Any]:
        """Progress of the motion."""

    @abstractmethod
    def _event_data(self) -> list[dict[str, Any]]:
        """The newest events."""


class RunStatus(MotionStatus):
    """Status of a run along a path."""

    def __init__(
        self, prepared: PreparedRun, folder: Path, board: RequestBoard, *, simulated_time: bool
    ) -> None:
        super().__init__(prepared.rig, board, simulated_time=simulated_time)
        self.take_folder(folder)
        self._prepared = prepared
        self._events: deque[RunEvent] = deque(maxlen=EVENTS_SHOWN)

    def take_cycle(self, record: CycleRecord) -> None:
        """Takes a cycle."""
        self._cycles.take(record)

    def take_cameras(self, cameras: list[dict[str, Any]]) -> None:
        """Takes the state of each camera."""
        self._cameras = cameras

    def take_measured(self, measured: PoseMeasurement, clearance: MeasuredClearance | None) -> None:
        """Takes the newest pose of the cameras and its clearance."""
        self._measured = measured, clearance

    def take_event(self, event: RunEvent) -> None:
        """Takes an event."""
        self._events.append(event)

    def _position_fields(self) -> dict[str, Any]:
        table, record = self._prepared.checked.table, self._cycles.last
        whole = {"rows": len(table), "path_length_mm": round(self._prepared.length * 1e3, 3)}
        if record is None:
            return {"row": None, "path_mm": None, "next_stop": None, **whole}
        path = float(np.interp(record.index, np.arange(len(table)), table.travelled))
        return {
            "row": round(record.index, 2),
            "path_mm": round(path * 1e3, 3),
            "next_stop": self._next_stop(record.index, path),
            **whole,
        }

    def _next_stop(self, row: float, path: float) -> dict[str, Any]:
        """The scene's next stop, or the goal."""
        table, stops = self._prepared.checked.table, self._prepared.scene.stops
        rows = [(dwell.first, stop.name) for dwell, stop in zip(table.dwells, stops, strict=True)]
        goal = (len(table) - 1, "goal")  # its name may also be that of a stop
        last, name = next((one for one in rows if one[0] >= row), goal)
        left = (last - row) * table.cycle / self._board.read().speed
        return {
            "name": name,
            "distance_mm": round((float(table.travelled[last]) - path) * 1e3, 1),
            "seconds": round(left, 1),
        }

    def _event_data(self) -> list[dict[str, Any]]:
        return [asdict(event) for event in list(self._events)]


NO_PATH = {"path_mm": None, "path_length_mm": None, "next_stop": None}


class WinchStatus(MotionStatus):
    """Status of winches that move without a path."""

    def __init__(self, rig: Rig, board: RequestBoard, *, simulated_time: bool) -> None:
        super().__init__(rig, board, simulated_time=simulated_time)
        self._events: deque[LoopEvent] = deque(maxlen=EVENTS_SHOWN)

    def take_cycle(self, record: CycleRecord) -> None:
        """Takes a cycle."""
        self._cycles.take(record)

    def take_event(self, event: LoopEvent) -> None:
        """Takes an event."""
        self._events.append(event)

    def _position_fields(self) -> dict[str, Any]:
        row = None if self._cycles.last is None else round(self._cycles.last.index, 1)
        return {"row": row, "rows": 100, **NO_PATH}

    def _event_data(self) -> list[dict[str, Any]]:
        began = self._cycles.began
        return [
            {"time_s": max(0.0, round(event.at - began, 3)), "code": event.code, "text": event.text}
            for event in list(self._events)
        ]


class SessionStatus(WinchStatus):
    """Status of a jog session."""

    def _position_fields(self) -> dict[str, Any]:
        return {"row": None, "rows": None, **NO_PATH, **self._jogged()}

    @abstractmethod
    def _jogged(self) -> dict[str, Any]:
        """Progress of the jogs."""


class JogStatus(SessionStatus):
    """Status of a session that jogs the platform."""

    def __init__(
        self, rig: Rig, board: RequestBoard, progress: JogProver, *, simulated_time: bool
    ) -> None:
        super().__init__(rig, board, simulated_time=simulated_time)
        self._jog = progress

    def _jogged(self) -> dict[str, Any]:
        pose = self._jog.pose
        jog = {
            "speed_mm_s": round(self._rig.motion.speed * 1e3, 3),
            "position_mm": [round(float(v) * 1e3, 3) for v in pose.position],
            "quaternion": [round(float(v), 7) for v in pose.quaternion],
            "room_mm": round(self._jog.room * 1e3, 2),
            "limit": self._jog.limit or None,
        }
        return {"jog": jog}


class CableStatus(SessionStatus):
    """Status of a session that jogs one cable at a time."""

    def __init__(
        self, rig: Rig, board: RequestBoard, progress: CableTravel, *, simulated_time: bool
    ) -> None:
        super().__init__(rig, board, simulated_time=simulated_time)
        self._moved = progress

    def _jogged(self) -> dict[str, Any]:
        moved = self._moved
        jog = {
            "speed_mm_s": round(self._rig.motion.speed * 1e3, 3),
            "limit_n": round(moved.tension_limit, 3),
            "cable": moved.cable or None,
            "press_mm": round(moved.by_press * 1e3, 3),
            "session_mm": [round(length * 1e3, 3) for length in moved.by_session],
            "limit": moved.limit or None,
        }
        return {"cable_jog": jog}
