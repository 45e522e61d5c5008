"""Follows a checked line while a press is held; a task of the real-time process.

It differs from a run only in this: rows arrive during the motion; it slows down before the end of
the checked rows, or at once when the press ends; and the drives stay enabled at rest.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from drivers.drive_group import CycleStatus
from executor.control.cycle import Feed, targets_at
from executor.control.loop import Loop
from executor.control.preconditions import require_still_referenced
from executor.control.sync_master import SyncMaster
from executor.hold_to_run.line import Piece, PieceRing
from executor.hold_to_run.presses import PressReader, PressState
from executor.interlock.reference import HomingReference
from executor.realtime.child import MotionTask, ReadyDrives
from executor.realtime.shared_memory import SharedMemory
from executor.safety.gate import Purpose
from executor.state_machine import Event, State
from executor.supervision import SupervisorCalls
from executor.trajectory.setpoints import CheckedSetpoints, Setpoints, fingerprint
from model.errors import Fault
from model.files.rig_file import RigDocument
from model.rig import rig_from_document

#: Checked rows to keep beyond the point of rest, [rows].
MARGIN = 4.0
#: Set-points of the same pose may differ by rounding, [counts].
ROUNDED = 1


class JogLoop(Loop):
    """One session of jogs on one drive group."""

    motion_phrase = "along the jog"
    takes_feed_requests = False  # the held control sets hold and speed

    def __init__(
        self,
        here: CheckedSetpoints,
        master: SyncMaster,
        calls: SupervisorCalls,
        *,
        held: Callable[[], PressState],
        pieces: Callable[[], Iterable[Piece]],
    ) -> None:
        """Prepares the session; sends nothing yet.

        Args:
            here: One row: the positions at rest.
            master: See `Loop`.
            calls: See `Loop`; of the requests only a stop counts.
            held: Returns the press held now; called every cycle.
            pieces: Returns pieces that arrived since the last call; called every cycle.
        """
        super().__init__(here, master, calls)
        self._held_now, self._pieces = held, pieces
        self._feed = Feed(1, here.cycle, here.rig.motion, rate=0.0)
        self._rows: Setpoints = here.setpoints
        self._press, self._from_rest, self._peak = 0, True, 1.0

    def _follow(self) -> None:
        """One cycle on the line, or at rest."""
        held = self._held_now()
        for piece in self._pieces():
            if piece.press == held.press:
                self._take(piece, held.share)
        moving = self.machine.state is State.MOVING
        if not (moving and held.press and held.press == self._press):
            self._feed.stop()
        else:
            self._feed.go_to(self._rate(held.share))
        if not self._feed.at_rest:
            index = self._feed.advance()
            self._send(Purpose.MOVE, targets_at(self._rows, index), index)
        elif not moving or held.ends:
            self.machine.on(Event.AT_REST)
        else:
            self._send(Purpose.HOLD, self._sender.resting_targets)

    def _rate(self, share: float) -> float:
        """Rows per cycle for a share of the jog speed; 0 near the end of the checked rows."""
        if self._from_rest:  # it has its own ramps, and short steps do not reach the jog speed
            return min(share / self._peak, 1.0)
        return share if self._has_room() else 0.0

    def _has_room(self) -> bool:
        return self._feed.index + self._feed.rows_to_rest + MARGIN < len(self._rows) - 1

    def _take(self, piece: Piece, share: float) -> None:
        """Begins a line at the platform's rest position, or extends the present one."""
        if not piece.is_unchanged(self._checked.cycle):
            raise Fault(
                "the set-points of a jog differ from those that were checked",
                where="jog",
                why="memory changed after the check: a defect of the program or the computer",
                next_step="test the computer's memory",
            )
        if piece.first == 0:
            if self._feed.at_rest and _meet(piece.rows[0], self._sender.resting_targets):
                self._begin(piece, share)
            else:
                text = f"press {piece.press}: its line does not begin where the platform rests"
                self._report("jog_not_begun", text)
        elif (
            piece.press == self._press
            and piece.first == len(self._rows) - 1
            and _meet(piece.rows[0], self._rows[-1].tolist())
        ):
            self._rows = np.concatenate([self._rows, piece.rows[1:]])
            self._feed.extend(len(self._rows))
            self._sender.allow(self._rows)

    def _begin(self, piece: Piece, share: float) -> None:
        self._press, self._from_rest, self._rows = piece.press, piece.from_rest, piece.rows
        self._peak = piece.peak
        rate = self._rate(share) if piece.from_rest else 0.0
        motion = self._rig.motion
        self._feed = Feed(len(self._rows), self._checked.cycle, motion, rate=rate)
        self._sender.index = 0.0
        self._sender.allow(self._rows)


def _meet(row: Setpoints, others: Sequence[int]) -> bool:
    return bool(np.max(np.abs(row.astype(np.int64) - np.asarray(others))) <= ROUNDED)


@dataclass(frozen=True, slots=True, eq=False)
class JogMotion(MotionTask):
    """A session of jogs, which owns the memory.

    Attributes:
        rig: The rig file, with the jog speed.
        begin: Required positions of the drives, [counts].
        presses: See `PressBoard`.
        pieces: See `PieceRing`.
        reference: The drives' homing reference, if any.
    """

    rig: RigDocument
    begin: tuple[int, ...]
    presses: SharedMemory
    pieces: SharedMemory
    reference: HomingReference | None

    def loop(self, drives: ReadyDrives, master: SyncMaster, calls: SupervisorCalls) -> Loop:
        """See `MotionTask`."""
        row = np.array([self.begin], dtype=np.int32)
        rig = rig_from_document(self.rig)
        here = CheckedSetpoints(rig, self.cycle, row, fingerprint(self.cycle, row))
        return JogLoop(
            here,
            master,
            calls,
            held=PressReader(self.presses, lambda: master.clock.now).read,
            pieces=PieceRing(self.pieces, self.cables).take,
        )

    def require(self, drives: ReadyDrives, seen: CycleStatus) -> None:
        """See `MotionTask`."""
        require_still_referenced(drives.rig, self.reference, drives.group.restarted, seen)
