"""Collects the cycles of a run in memory and makes their table afterwards."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cdpr.errors import Fault
from cdpr.kinematics import forward_kinematics, poses_near
from cdpr.poses import Array, Pose
from cdpr.rig import Rig
from cdpr.scene import Scene
from executor.cycle_table import CycleTable, quaternions_of
from executor.records import CycleRecord
from executor.run_csv import Integers
from executor.setpoints import CheckedTable
from executor.standing import legs_at


class RunLog:
    """The cycles of one run, in the order in which they were sent."""

    def __init__(self, rig: Rig, scene: Scene, checked: CheckedTable) -> None:
        """An empty log of a run of a checked table on a rig in a scene."""
        self._rig, self._scene, self._checked = rig, scene, checked
        self._records: list[CycleRecord] = []

    def add(self, record: CycleRecord) -> None:
        """Takes in a cycle; costs next to nothing."""
        self._records.append(record)

    def __len__(self) -> int:
        """Number of cycles."""
        return len(self._records)

    @property
    def last_positions(self) -> tuple[int, ...] | None:
        """Where the drives last said that they stand, [counts]; None before the first cycle."""
        return self._records[-1].actual if self._records else None

    def pose_by_drives(self, record: CycleRecord) -> Pose | None:
        """Where the drives' positions put the platform in a cycle; None when they fit no pose."""
        planned, row = self._checked.table, round(record.index)
        lengths, _ = self._lengths([record], np.array([row]))
        try:
            guess = Pose(planned.positions[row], planned.rotations[row])
            return forward_kinematics(self._rig, lengths[0], guess).pose
        except Fault:
            return None

    def table(self) -> CycleTable:
        """Everything that is known of the run's cycles."""
        records, rig, planned = self._records, self._rig, self._checked.table
        # A drive answers a SYNC with where it is then: at what it was told one cycle before.
        index = np.array([0.0, *(r.index for r in records[:-1])])[: len(records)]
        rows = np.rint(index).astype(np.int64)
        actual = _matrix([r.actual for r in records], rig.cable_count)
        lengths, tensions = self._lengths(records, rows)
        encoder, turned = poses_near(rig, lengths, planned.positions[rows], planned.rotations[rows])
        legs = legs_at(planned.stands, index)
        return CycleTable(
            time=np.array([r.at - records[0].at for r in records]),
            state=tuple(r.state.value for r in records),
            path_index=rows,
            leg=legs,
            stop=tuple(self._stop_at(row) for row in rows.tolist()),
            travelled=between(planned.travelled, index),
            lateness=np.array([r.lateness for r in records]) * planned.cycle,
            missing=np.array([r.missing for r in records], dtype=np.int64),
            rejected=np.array([r.rejected for r in records], dtype=np.int64),
            error_frames=np.array([r.error_frames for r in records], dtype=np.int64),
            planned=between(planned.positions, index),
            planned_rotation=quaternions_of(planned.rotations[rows]),
            encoder=encoder,
            encoder_rotation=quaternions_of(turned),
            following_error=np.array([r.following_error for r in records]),
            set_counts=_matrix([r.targets for r in records], rig.cable_count),
            actual_counts=actual,
            lengths=lengths,
            planned_tensions=between(planned.tensions, index),
            tensions=tensions,
        )

    def _lengths(self, records: list[CycleRecord], rows: Integers) -> tuple[Array, Array]:
        """Cable lengths [m] by the drives' positions, and tensions [N] where torques tell them.

        Args:
            records: n cycles.
            rows: The set-points that the drives were told, shape (n,).
        """
        actual = _matrix([r.actual for r in records], self._rig.cable_count)
        tensions = self._rig.tensions_by(
            _matrix([r.torques for r in records], self._rig.cable_count)
        )
        # Only drives that follow their set-points tell the cables' tensions by their torques.
        taut = np.isfinite([r.following_error for r in records])[:, None]
        stretch = np.where(taut, tensions, self._checked.table.tensions[rows])
        winches = self._checked.winches
        lengths = winches.strained(
            winches.unstrained_from_counts(actual.astype(np.float64)), stretch
        )
        return lengths, np.where(taut, tensions, np.nan)

    def _stop_at(self, row: int) -> str:
        """Name of the stop at which the platform stands; nothing on the way."""
        for stop, stand in zip(self._scene.stops, self._checked.table.stands, strict=True):
            if stand.first <= row <= stand.last:
                return stop.name
        return ""


def _matrix(
    rows: list[tuple[int, ...]], width: int
) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    return np.array(rows, dtype=np.int64).reshape(len(rows), width)


def between(values: Array, index: ArrayLike) -> Array:
    """Rows of a table at one fractional place or several."""
    index = np.asarray(index, dtype=np.float64)
    low = np.floor(index).astype(np.int64)
    high = np.minimum(low + 1, len(values) - 1)
    share = index - low
    if values.ndim > 1:
        share = share[..., None]
    mixed: Array = (1.0 - share) * values[low] + share * values[high]
    return mixed
