"""From a plan to the set-point table: a whole run as int32 drive positions, checked.

Nothing is armed without it. Each leg between stops begins and ends at rest, so that no corner is
rounded at a stop.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from drivers.stopping_distance import require_stopping_room_along
from executor.trajectory.dwell import (
    Dwell,
    dwell_violations,
    load_violations,
    order_violations,
    rows_of,
)
from executor.trajectory.path import IsAllowed, Path, poses_of, rounded
from executor.trajectory.time_scaling import TimeLaw, time_law
from model.clearance import ClearanceModel
from model.errors import Refused
from model.kinematics import cables_to
from model.plan import Plan
from model.pose import Array, Pose, read_only
from model.progress import SILENT, Listener
from model.rig import Rig
from model.scene import Load, Scene, legs_of
from model.statics.gravity import working_tensions
from model.statics.wrench_sets import rms_anchor_radius
from model.winches import WinchMap
from planner.check import check_path, parted, verify
from planner.check_report import CheckReport, VerifiedPlan

# Input of the loop: checked set-points and their fingerprint.
#
# A `CheckedTrajectory` has the poses and the check report; the loop needs only this part of it,
# which can be passed to another process and verified there.


Setpoints = NDArray[np.int32]


def fingerprint(cycle: float, setpoints: Setpoints) -> str:
    """SHA-256 over set-points and their cycle [s]."""
    digest = hashlib.sha256(repr(cycle).encode())
    digest.update(np.ascontiguousarray(setpoints).tobytes())
    return "sha256:" + digest.hexdigest()


@dataclass(frozen=True, eq=False)
class CheckedSetpoints:
    """Set-points for the loop.

    Attributes:
        rig: The rig they were checked for.
        cycle: Cycle time, [s].
        setpoints: One row per cycle, shape (n, m), [counts]; read-only.
        hash: Their fingerprint when checked; compared on arming.
    """

    rig: Rig
    cycle: float
    setpoints: Setpoints
    hash: str

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.setpoints)

    @property
    def unchanged(self) -> bool:
        """Whether the set-points are those that were checked; recomputed on each call."""
        return fingerprint(self.cycle, self.setpoints) == self.hash


def checked_setpoints_of(checked: CheckedTrajectory) -> CheckedSetpoints:
    """The set-points of a checked table, for the loop."""
    return CheckedSetpoints(checked.rig, checked.table.cycle, checked.table.setpoints, checked.hash)


INT32_MAX = 2**31 - 1
_ARRAYS = ("travelled", "positions", "rotations", "lengths", "tensions", "counts")
#: Accuracy of the tension solver, [N].
TENSION_ACCURACY = 1e-6


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One row per cycle, from rest at the start to rest at the goal; arrays are read-only.

    Attributes:
        cycle: Cycle time, [s].
        travelled: Path length, shape (n,), [m].
        positions: Of the platform's origin, world frame, shape (n, 3), [m].
        rotations: ``world_from_platform``, shape (n, 3, 3).
        lengths: Free cable lengths, shape (n, m), [m].
        tensions: Planned tensions, shape (n, m), [N].
        counts: Drive positions, not yet rounded, shape (n, m).
        dwells: Rows at the scene's stops.
    """

    cycle: float
    travelled: Array
    positions: Array
    rotations: Array
    lengths: Array
    tensions: Array
    counts: Array
    dwells: tuple[Dwell, ...]

    def __post_init__(self) -> None:
        """Copies the arrays and makes them read-only: what was checked is what is sent."""
        for name in _ARRAYS:
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.travelled)

    @cached_property
    def setpoints(self) -> NDArray[np.int32]:
        """Set-points, shape (n, m), [counts]; valid for a table that passed `check_table`."""
        rounded = np.rint(self.counts).astype(np.int32)
        rounded.setflags(write=False)
        return rounded

    @property
    def hash(self) -> str:
        """SHA-256 over the set-points and their cycle, recomputed on each call."""
        return fingerprint(self.cycle, self.setpoints)

    def pose(self, row: int) -> Pose:
        """The executed pose of a row."""
        return Pose(self.positions[row], self.rotations[row])

    def poses(self) -> list[Pose]:
        """The executed poses, one per row."""
        return poses_of(self.positions, self.rotations)


_PROOF = object()


@dataclass(frozen=True, eq=False)
class CheckedTrajectory:
    """A table that passed `check_table`, which alone makes one; the loop accepts nothing else.

    Attributes:
        table: The set-points.
        rig: The rig they were checked for.
        hash: Its hash when checked.
        report: The independent check of the executed curve.
        winches: The map between cable lengths and counts used for it.
    """

    table: Trajectory
    rig: Rig
    hash: str
    report: CheckReport
    winches: WinchMap
    proof: object

    def __post_init__(self) -> None:
        """Refuses to exist without the check."""
        if self.proof is not _PROOF:
            raise TypeError(
                "a CheckedTrajectory comes only from executor.trajectory.setpoints.check_table"
            )


def build_table(
    rig: Rig, scene: Scene, legs: Sequence[tuple[Path, TimeLaw]], cycle: float
) -> Trajectory:
    """Samples the run at every cycle and converts poses to drive positions.

    Tensions are the rig's working tensions under the load of each leg; the cables' elastic stretch
    under them is compensated.

    Args:
        scene: Its stops, dwells and loads.
        legs: Curve and time law of each leg between stops.
        cycle: [s].

    Raises:
        TensionInfeasible: A pose cannot be held.
    """
    parts: list[list[Array]] = []
    dwells: list[Dwell] = []
    reached: list[Array] = []
    for (path, law), leg in zip(legs, legs_of(scene), strict=True):
        part = _leg_rows(rig, leg.scene.load, path, law, cycle)
        if parts:
            part[0] += reached[0]
            first = sum(len(rows[0]) for rows in parts) - 1
            waiting = rows_of(scene.stops[len(dwells)].dwell, cycle)
            dwells.append(Dwell(first, first + waiting))
            parts.append(_dwell_rows(reached, part, max(waiting - 1, 0)))
        reached = [values[-1] for values in part]
        parts.append(part if not dwells or waiting else [values[1:] for values in part])
    travelled, positions, rotations, tensions = map(np.concatenate, zip(*parts, strict=True))
    anchors = positions[:, None, :] + np.einsum("nij,mj->nmi", rotations, rig.anchors)
    lengths = cables_to(rig, anchors).lengths
    winches = WinchMap(rig)
    return Trajectory(
        cycle=cycle,
        travelled=travelled,
        positions=positions,
        rotations=rotations,
        lengths=lengths,
        tensions=tensions,
        counts=winches.counts(winches.unstrained(lengths, tensions)),
        dwells=tuple(dwells),
    )


def _leg_rows(rig: Rig, load: Load, path: Path, law: TimeLaw, cycle: float) -> list[Array]:
    """Travelled lengths, positions, rotations and tensions of a leg, from rest to rest."""
    times = np.arange(int(np.ceil(law.duration / cycle)) + 1) * cycle
    travelled = np.array([law.at(float(t))[0] for t in times])
    positions, rotations = path.at(travelled)
    poses = poses_of(positions, rotations)
    tensions = np.array([working_tensions(rig, pose, load).tensions for pose in poses])
    return [travelled, positions, rotations, tensions]


def _dwell_rows(reached: list[Array], after: list[Array], count: int) -> list[Array]:
    """Rows between the last of a leg and the first of the next, all at the same pose."""
    travelled, positions, rotations = (np.repeat(v[None], count, axis=0) for v in reached[:3])
    shares = np.linspace(0.0, 1.0, count + 2)[1:-1, None]
    tensions = reached[3] + shares * (after[3][0] - reached[3])
    return [travelled, positions, rotations, tensions]


def check_table(rig: Rig, scene: Scene, table: Trajectory) -> CheckedTrajectory:
    """Checks a table; refuses it with all violations.

    Raises:
        Refused: A value is not finite or not an int32; a winch is too fast; a tension is outside
            the rig's limits or tensions do not hold the load; drive positions do not match the
            poses; ends and dwells do not match the scene's start, stops and goal; the executed
            curve fails the independent check, or its clearance is less than the stopping distance
            when the master is lost.
    """
    found = _number_violations(rig, table) or order_violations(scene, table.dwells, len(table))
    poses = [] if found else table.poses()
    if not found:
        found = [
            *_end_violations(scene, table),
            *dwell_violations(scene, table.dwells, poses, table.cycle),
            *load_violations(rig, scene, table.dwells, poses, table.tensions),
            *_speed_violations(rig, table),
            *_tension_violations(rig, table),
            *_count_violations(rig, table),
        ]
    if found:
        raise _refusal(found)
    report = check_path(rig, scene, poses, [dwell.first for dwell in table.dwells])
    if not report.passed:
        raise _refusal(
            [violation.sentence() for violation in report.violations],
            report.cure or "plan again, with a larger clearance if that is violated",
        )
    loads = [leg.scene.load for leg in legs_of(scene)]
    room = report.proved_obstacle_clearance, report.proved_capacity_margin
    require_stopping_room_along(rig, loads, table.positions, table.rotations, *room)
    return CheckedTrajectory(table, rig, table.hash, report, WinchMap(rig), _PROOF)


def _refusal(
    found: list[str], next_step: str = "correct the rig file, or plan again for it"
) -> Refused:
    return Refused(
        "; ".join(found),
        where="set-point table",
        why="the trajectory violates the plan or the rig file",
        next_step=f"{next_step}; nothing was armed",
    )


def _number_violations(rig: Rig, table: Trajectory) -> list[str]:
    cycle = rig.cycle
    if not abs(table.cycle - cycle) <= 1e-9:
        return [f"the table is for a cycle of {table.cycle} s, the bus has {cycle} s"]
    rows, cables = len(table), rig.cable_count
    shapes = [(rows,), (rows, 3), (rows, 3, 3), *[(rows, cables)] * 3]
    for name, shape in zip(_ARRAYS, shapes, strict=True):
        values: Array = getattr(table, name)
        if values.shape != shape or rows == 0:
            return [f"{name} have the shape {values.shape}, not {shape}"]
        if not np.isfinite(values).all():
            row = int(np.argwhere(~np.isfinite(values))[0][0])
            return [f"row {row} has {name} that are not numbers"]
    if np.abs(table.counts).max() > INT32_MAX - 1:
        largest = int(np.abs(table.counts).argmax())
        row, cable = divmod(largest, table.counts.shape[1])
        value = table.counts[row, cable]
        return [f"row {row}, cable {cable + 1}: {value:.0f} counts exceed 32 bits"]
    return []


def _end_violations(scene: Scene, table: Trajectory) -> list[str]:
    found = []
    for name, pose, row in (("start", scene.start, 0), ("goal", scene.goal, -1)):
        end = table.pose(row)
        off = end.distance_to(pose)
        if off > 1e-6 or end.angle_to(pose) > 1e-6:
            found.append(
                f"the {name} of the table is {off * 1000:.4f} mm and"
                f" {np.degrees(end.angle_to(pose)):.4f}° off the scene's"
            )
    return found


def _tension_violations(rig: Rig, table: Trajectory) -> list[str]:
    low, high = float(table.tensions.min()), float(table.tensions.max())
    if low >= rig.min_tension - TENSION_ACCURACY and high <= rig.max_tension + TENSION_ACCURACY:
        return []
    return [
        f"planned tensions range from {low:.3f} to {high:.3f} N,"
        f" the limits are {rig.min_tension:g} to {rig.max_tension:g} N"
    ]


def _count_violations(rig: Rig, table: Trajectory) -> list[str]:
    """Set-points that do not match their poses, for which the executed curve is checked."""
    winches = WinchMap(rig)
    unstrained = winches.unstrained_from_counts(table.setpoints.astype(np.float64))
    anchors = [pose.apply(rig.anchors) for pose in table.poses()]
    off = winches.strained(unstrained, table.tensions) - cables_to(rig, np.array(anchors)).lengths
    row, cable = np.unravel_index(int(np.abs(off).argmax()), off.shape)
    worst = float(abs(off[row, cable]))
    if worst <= 1.0 / abs(rig.winches[int(cable)].counts_per_metre):
        return []
    return [f"row {row}: the set-point of cable {cable + 1} is {worst * 1000:.4f} mm off its pose"]


def _speed_violations(rig: Rig, table: Trajectory) -> list[str]:
    found = []
    per_metre = np.abs([w.counts_per_metre for w in rig.winches])
    speeds = np.abs(np.diff(table.setpoints.astype(np.int64), axis=0)) / per_metre / table.cycle
    rounding = 1.0 / per_metre / table.cycle  # a set-point is off by at most half a count
    for cable, winch in enumerate(rig.winches):
        fastest = float(speeds[:, cable].max(initial=0.0))
        if not fastest <= winch.max_speed + rounding[cable]:
            found.append(
                f"cable {cable + 1} would move at {fastest * 1000:.1f} mm/s,"
                f" its winch allows {winch.max_speed * 1000:.1f} mm/s"
            )
    return found


# From a plan to the checked table: round the corners, time the path, check all.


@dataclass(frozen=True, slots=True, eq=False)
class PreparedRun:
    """A checked run, ready to be armed.

    Attributes:
        plan: The plan, verified for this rig.
        rig: The rig file as given; its winches, bus and motion may be newer than the plan's.
        checked: The set-points.
    """

    plan: VerifiedPlan
    rig: Rig
    checked: CheckedTrajectory

    @property
    def scene(self) -> Scene:
        """The plan's scene."""
        return self.plan.plan.scene

    @property
    def length(self) -> float:
        """Length of the path with rounded corners, [m]."""
        return float(self.checked.table.travelled[-1])

    @property
    def duration(self) -> float:
        """Duration including dwells, [s]."""
        return (len(self.checked.table) - 1) * self.checked.table.cycle


def prepare_plan(plan: Plan, rig: Rig, listener: Listener = SILENT) -> PreparedRun:
    """The checked set-points of a plan, for a rig.

    Raises:
        Refused: The plan, or its executed curve, does not pass the checks.
    """
    with listener.waiting("checking the plan and its set-points"):
        return prepare(verify(plan, rig), rig)


def prepare(verified: VerifiedPlan, rig: Rig) -> PreparedRun:
    """Makes and checks the set-points of a plan.

    Raises:
        Refused: The executed curve violates the scene or the rig, as for `check_table`.
        TensionInfeasible: A pose on it cannot be held.
    """
    plan = verified.plan
    weight = rms_anchor_radius(rig.anchors)
    is_allowed = _keeps_clearance(rig, plan.scene)
    legs = []
    for waypoints in parted(plan.waypoints, plan.stops, len(plan.scene.stops)):
        path = rounded(waypoints, rig.motion.blend_tolerance, weight, is_allowed)
        legs.append((path, time_law(path, rig.motion)))
    cycle = rig.cycle
    table = build_table(rig, plan.scene, legs, cycle)
    return PreparedRun(verified, rig, check_table(rig, plan.scene, table))


def _keeps_clearance(rig: Rig, scene: Scene) -> IsAllowed:
    """A check that dense poses keep the scene's clearances plus half their spacing.

    Moves between them must keep the scene's rotation limits.
    """
    model = ClearanceModel(rig, scene)

    def is_allowed(poses: Sequence[Pose]) -> bool:
        reach = float(np.max(np.linalg.norm(rig.anchors, axis=1)))
        half_step = 0.5 * max(a.distance_to(b) + reach * a.angle_to(b) for a, b in pairwise(poses))
        limits = scene.rotation_limits
        if limits and any(limits.excess(a, b) for a, b in pairwise(poses)):
            return False
        for pose in poses:
            near = model.smallest(pose)
            if near is not None and near.distance < scene.obstacle_clearance + half_step:
                return False
        positions = np.array([pose.position for pose in poses])
        rotations = np.array([pose.rotation for pose in poses])
        own = float(model.self_clearances(positions, rotations).min())
        return own >= scene.self_clearance + 2.0 * half_step

    return is_allowed
