"""Records and events as bytes in the status ring."""

from __future__ import annotations

import json
import math
import struct
from dataclasses import asdict

from cdpr.poses import Pose
from executor.machine import State
from executor.records import CycleRecord, LoopEvent

_STATES = tuple(State)
_NUMBERS = {state: number for number, state in enumerate(_STATES)}
_NO_POSE = (math.nan,) * 7


class RecordWire:
    """How a record of a rig with m cables is laid out.

    Attributes:
        size: [bytes].
    """

    def __init__(self, cables: int) -> None:
        """For so many cables."""
        self._cables = cables
        self._layout = struct.Struct(f"<Qd B dd HQQ dd {4 * cables}i 7d")
        self.size = self._layout.size

    def pack(self, record: CycleRecord, pose: Pose | None) -> bytes:
        """A record, and where the simulated platform is if that is known."""
        place = (*pose.position, *pose.quaternion) if pose is not None else _NO_POSE
        return self._layout.pack(
            record.cycle,
            record.at,
            _NUMBERS[record.state],
            record.index,
            record.rate,
            record.missing,
            record.rejected,
            record.error_frames,
            record.following_error,
            record.lateness,
            *record.targets,
            *record.actual,
            *record.torques,
            *record.words,
            *place,
        )

    def unpack(self, content: bytes) -> tuple[CycleRecord, Pose | None]:
        """The inverse of `pack`."""
        values = self._layout.unpack(content)
        cycle, at, state, index, rate, missing, rejected, error_frames = values[:8]
        error, lateness = values[8:10]
        m = self._cables
        targets, actual, torques, words = (values[10 + k * m : 10 + (k + 1) * m] for k in range(4))
        place = values[10 + 4 * m :]
        record = CycleRecord(
            cycle=cycle,
            at=at,
            state=_STATES[state],
            index=index,
            rate=rate,
            targets=targets,
            actual=actual,
            torques=torques,
            words=words,
            missing=missing,
            rejected=rejected,
            error_frames=error_frames,
            following_error=error,
            lateness=lateness,
        )
        if math.isnan(place[0]):
            return record, None
        return record, Pose.from_quaternion(place[:3], place[3:])


def pack_event(event: LoopEvent, most: int) -> bytes:
    """An event in at most so many bytes; a text that is too long loses its middle."""
    text = event.text
    while len(content := json.dumps({**asdict(event), "text": text}).encode()) > most:
        keep = len(text) * 2 // 5
        text = f"{text[:keep]} … {text[len(text) - keep :]}"
    return content


def unpack_event(content: bytes) -> LoopEvent:
    """The inverse of `pack_event`."""
    return LoopEvent(**json.loads(content))
