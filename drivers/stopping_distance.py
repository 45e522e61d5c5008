"""Travel of the platform after the loss of the master, which a plan's clearance must exceed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot, inf, sqrt

import numpy as np

from drivers.can_load import heartbeat_timeout
from model.errors import BadInput, Refused
from model.files.rig_file import Cia402Document, OdriveDocument
from model.kinematics import cables_to, structure_matrix_of
from model.pose import Array, Pose
from model.rig import Rig
from model.scene import Load
from model.statics.gravity import largest_lever
from model.statics.wrench_sets import rms_anchor_radius, with_scaled_moments
from model.winches import whole_lengths


@dataclass(frozen=True, slots=True)
class LostMaster:
    """Reaction of the drives to the loss of their master.

    Attributes:
        noticed_by: Missing message: SYNC, the heartbeat, or set-points.
        notice: Time until the last drive begins to stop, [s].
        distance: Travel of every point of the platform until the winches stop, without rotation,
            [m]; its inertia adds `coasting_distance`.
        distance_turning: Largest travel of any point where the platform rotates, [m].
    """

    noticed_by: str
    notice: float
    distance: float
    distance_turning: float


def lost_master(rig: Rig) -> LostMaster:
    """The reaction, from the rig file and its drive profile.

    Drives that interpolate may continue at their last speed until they notice, then decelerate
    uniformly, so the distance is v × (notice + ramp / 2). Along a path v² = |dp/dt|² + (ρ ω)², with
    ρ the RMS distance of the anchors, so a point at the distance R from the platform's origin moves
    at up to |dp/dt| + R ω ≤ v √(1 + (R/ρ)²).

    Raises:
        BadInput: There is no such profile, or its file is invalid.
    """
    cycle = rig.cycle
    drives = rig.document.drives
    if isinstance(drives, Cia402Document):
        noticed_by, notice, ramp = _cia402_times(rig)
    else:
        noticed_by, notice, ramp = "set-points", _watchdog(drives), cycle
    distance = rig.motion.speed * (notice + 0.5 * ramp)
    turning = hypot(1.0, rig.reach / rms_anchor_radius(rig.anchors))
    return LostMaster(noticed_by, notice, distance, turning * distance)


def _cia402_times(rig: Rig) -> tuple[str, float, float]:
    """Missing message, time until the last CiA 402 drive notices, and its ramp, [s]."""
    from drivers.cia402.object_dictionary import QUICK_STOP_RAMP
    from drivers.cia402.profile import profile_of, quick_stop_ramp, quick_stop_time

    cycle, profile = rig.cycle, profile_of(rig)
    allowed = profile.range_of(QUICK_STOP_RAMP, 0)
    wanted = max(quick_stop_ramp(rig, i, cycle, profile) for i in range(rig.cable_count))
    ramp = cycle if allowed is None else quick_stop_time(wanted, allowed, cycle)
    if profile.monitoring == "heartbeat":
        return "heartbeat", heartbeat_timeout(cycle), ramp
    return "SYNC", profile.sync_timeout_periods * cycle, ramp


def _watchdog(drives: OdriveDocument) -> float:
    """Watchdog time, [s]; arming requires one."""
    return (drives.watchdog_ms or 0.0) / 1000.0


def coasting_distance(
    rig: Rig,
    loads: Sequence[Load],
    positions: Array,
    rotations: Array,
    margin: float,
    *,
    turns: bool,
) -> float:
    """How far inertia carries a point of the platform after its winches have stopped, [m].

    The cables stretch until they have taken up the kinetic energy E of platform and payload, with
    at least the stiffness k of the weakest direction, and at most the force F that the tension
    limits leave: √(2 E / k) + E / F. The first alone holds for small E, the second for large.

    Args:
        rig: The robot, whose motion has the path's speed.
        loads: Payloads carried along the path.
        positions: Of the platform's origin along the path, world frame, shape (n, 3), [m].
        rotations: ``world_from_platform``, shape (n, 3, 3).
        margin: Smallest capacity margin of the path, F, [N].
        turns: Whether the platform rotates along it.
    """
    radius = rms_anchor_radius(rig.anchors)
    anchors = positions[:, None, :] + np.einsum("nij,mj->nmi", rotations, rig.anchors)
    cables = cables_to(rig, anchors)
    columns = with_scaled_moments(structure_matrix_of(cables, positions), radius)
    per_metre = rig.cable_stiffness / whole_lengths(rig, cables.lengths)
    stiffness = (columns * per_metre[:, None, :]) @ columns.swapaxes(1, 2)
    weakest = float(np.linalg.eigvalsh(stiffness)[:, 0].min())
    if not (margin > 0.0 and weakest > 0.0):
        return inf
    mass = rig.mass + max((load.payload_mass for load in loads), default=0.0)
    lever = max((largest_lever(rig, load) for load in loads), default=rig.reach)
    spread = hypot(1.0, lever / radius) if turns else 1.0
    energy = 0.5 * mass * (spread * rig.motion.speed) ** 2
    return hypot(1.0, rig.reach / radius) * (sqrt(2.0 * energy / weakest) + energy / margin)


def stopping_remarks(
    rig: Rig, loads: Sequence[Load], waypoints: Sequence[Pose], clearance: float, margin: float
) -> list[str]:
    """Why a run of a path may be refused, if its obstacles are too close to stop before them.

    The run itself decides, by its set-points, of which these are only the waypoints.

    Args:
        rig: The robot, whose motion has the path's speed.
        loads: Payloads carried along the path.
        clearance: Proved for the whole path, [m]; infinite without obstacles.
        margin: Smallest capacity margin of the path, [N].
    """
    if clearance == inf:
        return []
    positions = np.array([pose.position for pose in waypoints])
    rotations = np.array([pose.rotation for pose in waypoints])
    try:
        require_stopping_room_along(rig, loads, positions, rotations, clearance, margin)
    except Refused as refused:
        return [f"a run at {rig.motion.speed * 1000:.3g} mm/s may be refused: {refused.what}"]
    except BadInput as error:  # a profile file of another computer or folder
        why = str(error).partition("\n")[0]
        return [f"whether a run can stop before obstacles is not checked: {why}"]
    return []


def require_stopping_room_along(
    rig: Rig,
    loads: Sequence[Load],
    positions: Array,
    rotations: Array,
    clearance: float,
    margin: float,
) -> None:
    """As `require_stopping_room`, for a path.

    Args:
        rig: The robot, whose motion has the path's speed.
        loads: Payloads carried along the path.
        positions: As for `coasting_distance`.
        rotations: As for `coasting_distance`.
        clearance: Proved for the whole path, [m]; infinite without obstacles.
        margin: Smallest capacity margin of the path, [N].

    Raises:
        Refused: The clearance is smaller than the distance to a stop.
    """
    turns = bool(np.abs(rotations - rotations[0]).max() > 1e-6)  # beyond rounding errors of files
    coasting = coasting_distance(rig, loads, positions, rotations, margin, turns=turns)
    require_stopping_room(rig, clearance, coasting, turns=turns)


def require_stopping_room(rig: Rig, clearance: float, coasting: float, *, turns: bool) -> None:
    """Requires that the platform stops before it touches an obstacle after a loss of the master.

    Args:
        clearance: Proved for the whole path, [m]; infinite without obstacles.
        coasting: The `coasting_distance` along it, [m].
        turns: Whether the platform rotates along it.

    Raises:
        Refused: The clearance is smaller than the distance to a stop.
    """
    lost = lost_master(rig)
    distance = coasting + (lost.distance_turning if turns else lost.distance)
    if clearance >= distance:
        return
    where = " along a path that rotates the platform" if turns else ""
    raise Refused(
        f"the path comes within {clearance * 1000:.1f} mm of an obstacle; without its master the"
        f" platform travels up to {distance * 1000:.1f} mm",
        where="set-point table",
        why=f"the drives detect the loss by {lost.noticed_by} after {lost.notice * 1000:.0f} ms, at"
        f" {rig.motion.speed * 1000:g} mm/s{where}; its inertia adds {coasting * 1000:.2g} mm",
        next_step="plan with a larger clearance, or lower motion.speed_mm_s; nothing was armed",
        values={"clearance_mm": clearance * 1000.0, "distance_mm": distance * 1000.0},
    )
