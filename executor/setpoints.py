"""The set-point table: a whole run as int32 drive positions, checked before anything is armed."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cdpr.cables import cables_to
from cdpr.errors import Refused
from cdpr.poses import Array, Pose, read_only
from cdpr.rig import Rig
from cdpr.scene import Scene
from cdpr.statics.working import working_tensions
from cdpr.winches import WinchMap
from executor.path import Path, poses_of
from executor.timing import TimeLaw
from planner.check import check_path
from planner.check_report import CheckReport

INT32_MAX = 2**31 - 1


@dataclass(frozen=True, eq=False)
class SetpointTable:
    """One row a cycle, from rest at the start to rest at the goal; arrays are read-only.

    Attributes:
        cycle: Time of a cycle, [s].
        travelled: Path length, shape (n,), [m].
        positions: Of the platform's origin, world frame, shape (n, 3), [m].
        rotations: ``world_from_platform``, shape (n, 3, 3).
        lengths: Free cable lengths, shape (n, m), [m].
        tensions: Planned tensions, shape (n, m), [N].
        counts: Drive positions, not yet rounded, shape (n, m).
    """

    cycle: float
    travelled: Array
    positions: Array
    rotations: Array
    lengths: Array
    tensions: Array
    counts: Array

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.travelled)

    @cached_property
    def setpoints(self) -> NDArray[np.int32]:
        """What is sent, shape (n, m); meaningful for a table that passed `check_table`."""
        rounded = np.rint(self.counts).astype(np.int32)
        rounded.setflags(write=False)
        return rounded

    @cached_property
    def hash(self) -> str:
        """SHA-256 over the set-points and their cycle."""
        digest = hashlib.sha256(repr(self.cycle).encode())
        digest.update(np.ascontiguousarray(self.setpoints).tobytes())
        return "sha256:" + digest.hexdigest()

    def poses(self) -> list[Pose]:
        """The executed poses, one a row."""
        return poses_of(self.positions, self.rotations)


@dataclass(frozen=True, eq=False)
class CheckedTable:
    """A table that `check_table` passed for its rig and scene; the loop takes nothing else.

    Attributes:
        table: The set-points.
        hash: Its hash when it was checked.
        report: The independent check of the executed curve.
        winches: The map between cable lengths and counts that made it.
    """

    table: SetpointTable
    hash: str
    report: CheckReport
    winches: WinchMap


def build_table(rig: Rig, scene: Scene, path: Path, law: TimeLaw, cycle: float) -> SetpointTable:
    """Samples the run at every cycle and turns poses into drive positions.

    Tensions are the rig's working tensions under the scene's payload; the cables' stretch under
    them is fed forward.

    Raises:
        TensionInfeasible: A pose cannot be held.
    """
    times = np.arange(int(np.ceil(law.duration / cycle)) + 1) * cycle
    travelled = np.array([law.at(float(t))[0] for t in times])
    positions, rotations = path.at(travelled)
    anchors = positions[:, None, :] + np.einsum("nij,mj->nmi", rotations, rig.anchors)
    lengths = cables_to(rig, anchors).lengths
    poses = poses_of(positions, rotations)
    tensions = np.array([working_tensions(rig, pose, scene.load).tensions for pose in poses])
    winches = WinchMap(rig)
    return SetpointTable(
        cycle=cycle,
        travelled=read_only(travelled),
        positions=read_only(positions),
        rotations=read_only(rotations),
        lengths=read_only(lengths),
        tensions=read_only(tensions),
        counts=read_only(winches.counts(winches.unstrained(lengths, tensions))),
    )


def check_table(rig: Rig, scene: Scene, table: SetpointTable) -> CheckedTable:
    """Passes a table on, or refuses it with everything that is wrong.

    Raises:
        Refused: A value is not finite or no int32; a winch is too fast; the ends are not the
            scene's start and goal; or the executed curve fails the independent check.
    """
    found = [*_number_violations(table), *_end_violations(scene, table)]
    if not found:
        found += _speed_violations(rig, table)
    if found:
        raise _refusal(found)
    report = check_path(rig, scene, table.poses())
    if not report.passed:
        raise _refusal([violation.sentence() for violation in report.violations])
    return CheckedTable(table, table.hash, report, WinchMap(rig))


def _refusal(found: list[str]) -> Refused:
    return Refused(
        "; ".join(found),
        where="set-point table",
        why="the executed curve is not what the plan and the rig file allow",
        next_step="plan again with a larger clearance, or correct the rig file; nothing was armed",
    )


def _number_violations(table: SetpointTable) -> list[str]:
    if not np.isfinite(table.counts).all():
        row = int(np.flatnonzero(~np.isfinite(table.counts).all(axis=1))[0])
        return [f"row {row} holds a set-point that is no number"]
    if np.abs(table.counts).max() > INT32_MAX - 1:
        largest = int(np.abs(table.counts).argmax())
        row, cable = divmod(largest, table.counts.shape[1])
        value = table.counts[row, cable]
        return [f"row {row}, cable {cable + 1}: {value:.0f} counts do not fit into 32 bits"]
    return []


def _end_violations(scene: Scene, table: SetpointTable) -> list[str]:
    found = []
    for name, pose, row in (("start", scene.start, 0), ("goal", scene.goal, -1)):
        end = Pose(table.positions[row], table.rotations[row])
        off = end.distance_to(pose)
        if off > 1e-6 or end.angle_to(pose) > 1e-6:
            found.append(
                f"the {name} of the table is {off * 1000:.4f} mm and"
                f" {np.degrees(end.angle_to(pose)):.4f}° off the scene's"
            )
    return found


def _speed_violations(rig: Rig, table: SetpointTable) -> list[str]:
    found = []
    per_metre = np.abs([w.counts_per_metre for w in rig.winches])
    speeds = np.abs(np.diff(table.setpoints.astype(np.int64), axis=0)) / per_metre / table.cycle
    rounding = 1.0 / per_metre / table.cycle  # a set-point is off by at most half a count
    for cable, winch in enumerate(rig.winches):
        fastest = float(speeds[:, cable].max(initial=0.0))
        if fastest > winch.max_speed + rounding[cable]:
            found.append(
                f"cable {cable + 1} would run at {fastest * 1000:.1f} mm/s,"
                f" its winch allows {winch.max_speed * 1000:.1f} mm/s"
            )
    return found
