"""A straight line from a pose, checked piece by piece as set-points before they are sent."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from executor.hold_to_run.presses import PlatformMove, Press, PressBoard
from executor.realtime.shared_memory import Ring, SharedMemory
from executor.state_machine import ON_PATH, CycleRecord, State
from executor.trajectory.path import Path, line
from executor.trajectory.setpoints import (
    CheckedTrajectory,
    Setpoints,
    build_table,
    check_table,
    fingerprint,
)
from executor.trajectory.time_scaling import TimeLaw, s_curve, time_law
from model.errors import CdprError, Refused
from model.pose import Array, Pose
from model.rig import Rig
from model.scene import Scene
from model.statics.wrench_sets import rms_anchor_radius

#: Rows of the first piece, which must be checked quickly, and largest number of a later one.
FIRST_ROWS, MOST_ROWS = 10, 40
#: Subtracted from a piece's length, so that rounding never adds a row, [rows].
_SHORT = 1e-6


class JogLine:
    """The line of a jog, sampled at equal distances per row, as far as it is checked."""

    def __init__(self, rig: Rig, scene: Scene, start: Pose, direction: Array) -> None:
        """A line of which nothing is checked yet.

        Args:
            rig: The robot; its motion has the jog speed.
            start: Pose of the platform at rest, ``world_from_platform``.
            direction: Unit vector in the world frame, shape (3,).
        """
        self._rig, self._scene, self._start = rig, scene, start
        self._direction = direction
        self._cycle = rig.cycle
        self._spacing = rig.motion.speed * self._cycle
        self._weight = rms_anchor_radius(rig.anchors)
        self._travelled: Array = np.zeros(1)

    @property
    def rows(self) -> int:
        """Number of checked rows; 1 at first."""
        return len(self._travelled)

    def pose(self, row: float) -> Pose:
        """The pose at a row of the checked line."""
        return self._at(self.travelled(row))

    def travelled(self, row: float) -> float:
        """Travelled length at a row of the checked line, [m]."""
        return float(np.interp(row, np.arange(self.rows), self._travelled))

    def extend(self, rows: int) -> CheckedTrajectory:
        """Checks further rows, at the jog speed, from the last checked row on.

        Raises:
            CdprError: They violate the scene or the rig; nothing is added.
        """
        begin = float(self._travelled[-1])
        length = (rows - _SHORT) * self._spacing
        speed = self._rig.motion.speed
        steady = s_curve(length, (speed, speed), speed, self._rig.motion)
        law = TimeLaw((steady,), (0.0,), np.array([0.0, length / speed]))
        checked = self._checked_table(begin, length, law)
        even = begin + self._spacing * np.arange(1, rows + 1)
        self._travelled = np.concatenate([self._travelled, even])
        return checked

    def step(self, length: float) -> CheckedTrajectory:
        """Checks a whole step [m] from rest to rest; the line has nothing else.

        Raises:
            CdprError: As for `extend`.
        """
        law = time_law(self._path(0.0, length), self._rig.motion)
        if law.duration > (LONGEST_STEP - 1) * self._cycle:
            raise Refused(
                f"a step of {length * 1000:g} mm takes {law.duration:.1f} s at this speed",
                where="jog",
                why=f"a step lasts {LONGEST_STEP - 1} cycles at most",
                next_step="hold the control instead, or begin the session with a higher speed",
            )
        checked = self._checked_table(0.0, length, law)
        self._travelled = checked.table.travelled
        return checked

    def _checked_table(self, begin: float, length: float, law: TimeLaw) -> CheckedTrajectory:
        path = self._path(begin, length)
        scene = self._scene.changed(start=self._at(begin), goal=self._at(begin + length), stops=())
        table = build_table(self._rig, scene, [(path, law)], self._cycle)
        return check_table(self._rig, scene, table)

    def _path(self, begin: float, length: float) -> Path:
        return Path((line(self._at(begin), self._at(begin + length), self._weight),))

    def _at(self, travelled: float) -> Pose:
        return Pose(self._start.position + travelled * self._direction, self._start.rotation)


# Transfer of checked pieces to the real-time process.


_HEAD = struct.Struct("<QQ?d71s")
#: Pieces in transit at most.
SLOTS = 64
#: Largest step, [rows].
LONGEST_STEP = 1024


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """Rows of one press.

    Attributes:
        press: Its number.
        first: Index of the first row on the line.
        from_rest: Whether the rows include the ramps; others are at the jog speed.
        peak: Their largest speed, as a share of the jog speed; up to 1.
        rows: Set-points, int32, shape (n, m), [counts].
        hash: Their fingerprint when checked.
    """

    press: int
    first: int
    from_rest: bool
    peak: float
    rows: Setpoints
    hash: str

    def is_unchanged(self, cycle: float) -> bool:
        """Whether the rows are those that were checked, for that cycle [s]."""
        return fingerprint(cycle, self.rows) == self.hash


class PieceRing:
    """Queue of pieces in shared memory, from one process to another."""

    def __init__(self, memory: SharedMemory, cables: int) -> None:
        """Uses memory of `size`, on both sides."""
        self._ring, self._cables = Ring(memory, SLOTS), cables

    @staticmethod
    def size(cables: int) -> int:
        """Size of the memory, [bytes]."""
        return Ring.size(_HEAD.size + 4 * cables * (LONGEST_STEP + 1), SLOTS)

    def put(self, piece: Piece) -> None:
        """Sends a piece.

        Raises:
            ValueError: It is too long.
        """
        values = (piece.press, piece.first, piece.from_rest, piece.peak, piece.hash.encode())
        self._ring.put(_HEAD.pack(*values) + np.ascontiguousarray(piece.rows).tobytes())

    def take(self) -> Iterator[Piece]:
        """Pieces that arrived since the last call, in order."""
        for content in self._ring.take():
            press, first, from_rest, peak, digest = _HEAD.unpack_from(content)
            counts = np.frombuffer(content, dtype=np.int32, offset=_HEAD.size)
            rows = counts.reshape(-1, self._cables)
            yield Piece(press, first, from_rest, peak, rows, digest.decode())


# Look-ahead check of the line, in the supervisor.


#: Time for which rows are checked ahead beyond the stopping distance, [s].
AHEAD = 0.4
#: Cycles after the end of a press until the loop's reports no longer belong to it.
CERTAIN = 2.0


class JogProver:
    """Checks the line ahead of the platform while a press is held."""

    def __init__(
        self, rig: Rig, scene: Scene, start: Pose, board: PressBoard, send: Callable[[Piece], None]
    ) -> None:
        """Begins with the platform at rest at ``start``, ``world_from_platform``."""
        self._rig, self._scene, self._board, self._send = rig, scene, board, send
        self._cycle = rig.cycle
        motion = rig.motion
        to_rest = motion.speed / motion.acceleration + motion.acceleration / motion.jerk
        self._wanted_rows = (AHEAD + to_rest) / self._cycle
        self._line = self._followed = JogLine(rig, scene, start, np.zeros(3))
        self._press, self._size, self._narrows, self._is_whole = 0, FIRST_ROWS, False, True
        self._row = 0.0
        self.limit = ""
        """Why the line ends; empty while it may continue."""

    @property
    def pose(self) -> Pose:
        """Last commanded pose, ``world_from_platform``."""
        return self._followed.pose(self._row)

    @property
    def room(self) -> float:
        """Checked length ahead of the platform, [m]."""
        return self._line.travelled(self._line.rows - 1) - self._line.travelled(self._row_on_line)

    @property
    def _row_on_line(self) -> float:
        """Row on the line that is checked: its first until the loop follows it."""
        return self._row if self._followed is self._line else 0.0

    def take_cycle(self, record: CycleRecord) -> None:
        """Takes a cycle; checks at most one piece.

        The loop follows the line of a press only if its first piece arrives before its end.
        """
        if record.state not in ON_PATH:
            return
        if record.press == self._press:
            self._followed = self._line
        self._row = record.index  # on the line that the loop follows
        press = self._board.held()
        is_moving = record.state is State.MOVING
        if not is_moving or press is None or not isinstance(press.move, PlatformMove):
            return
        if press.number != self._press:
            # The motion of this cycle was decided up to one cycle before it began.
            if record.rate == 0.0 and record.at - press.free_since > CERTAIN * self._cycle:
                self._begin(press, press.move)
        elif not self._is_whole and self._line.rows - 1 - self._row_on_line < self._wanted_rows:
            self._check(press)

    def _begin(self, press: Press, move: PlatformMove) -> None:
        start = self.pose
        rotation = start.rotation if move.in_platform else np.eye(3)
        self._line = JogLine(self._rig, self._scene, start, rotation @ move.direction)
        self._press, self.limit = press.number, ""
        self._size, self._narrows, self._is_whole = FIRST_ROWS, False, False
        self._check(press)

    def _check(self, press: Press) -> None:
        """Checks the next piece; halves it when refused, until no row is left."""
        first = self._line.rows - 1
        try:
            if press.step is None:
                checked = self._line.extend(self._size)
            else:
                checked = self._line.step(press.step)
        except CdprError as error:
            self.limit = self.limit or error.what
            self._size, self._narrows = self._size // 2, True
            self._is_whole = press.step is not None or self._size == 0
            return
        self._is_whole = press.step is not None
        if not self._narrows:
            self._size = MOST_ROWS
        rows, peak = checked.table.setpoints, 1.0
        if self._is_whole:
            fastest = float(np.max(np.diff(checked.table.travelled))) / self._cycle
            peak = min(fastest / self._rig.motion.speed, 1.0)
        self._send(Piece(press.number, first, self._is_whole, peak, rows, checked.hash))
