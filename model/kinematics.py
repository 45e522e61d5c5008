"""Kinematics of the platform: cable lengths, structure matrix, forward kinematics.

Source: paper, section 2, Eqs. 1–3 with the corrections of docs/paper.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from model.errors import BadInput, Fault
from model.pose import (
    Array,
    Pose,
    floats_of,
    matrix_from_rotation_vector,
    moved,
    points_by_twist,
    read_only,
)
from model.statics.wrench_sets import rms_anchor_radius

if TYPE_CHECKING:
    from model.rig import Rig

# Cables between outlets and anchors: exit points, lengths and directions.
#
# Two kinds of outlet. A point exit is the outlet point itself (paper, Eq. 1). A swivelling pulley
# of radius r swivels about its feed direction k through the outlet A, where the cable enters it;
# the cable wraps the pulley, leaves it tangentially at T and runs straight to the anchor B
# (A. Pott, "Cable-Driven Parallel Robots", 2018, section 3.5). The length is then the wrapped arc
# plus the straight part; its derivative with respect to B is the unit vector from T to B, as for a
# point exit.


class NoCable(BadInput, ValueError):
    """A pose at which a cable has no path: its anchor is at its outlet or inside its pulley."""

    code = "no_cable"


@dataclass(frozen=True, slots=True, eq=False)
class Cables:
    """The m cables of a rig at one pose or a batch of poses.

    Attributes:
        exits: Where the straight part begins, world frame, shape (..., m, 3), [m].
        anchors: Where it ends on the platform, world frame, shape (..., m, 3), [m].
        directions: Unit vectors from anchor to exit, shape (..., m, 3).
        lengths: From outlet to anchor, wrapped part included, shape (..., m), [m].
    """

    exits: Array
    anchors: Array
    directions: Array
    lengths: Array


def cables_at(rig: Rig, pose: Pose) -> Cables:
    """The cables with the platform at ``pose`` (``world_from_platform``).

    Raises:
        NoCable: An anchor lies at its outlet, inside its pulley or on its swivel axis.
    """
    return cables_to(rig, pose.apply(rig.anchors))


def cables_to(rig: Rig, anchors_in_world: Array) -> Cables:
    """The cables that end at given anchors, world frame, shape (..., m, 3), [m].

    Raises:
        NoCable: An anchor lies at its outlet, inside its pulley or on its swivel axis.
    """
    if rig.pulley_radius == 0.0:
        straight = rig.outlets - anchors_in_world
        lengths = np.sqrt(np.einsum("...i,...i", straight, straight))
        _require(lengths > 0.0, "its anchor is at its outlet")
        exits = np.broadcast_to(rig.outlets, anchors_in_world.shape)
        return Cables(exits, anchors_in_world, straight / lengths[..., None], lengths)
    return _on_pulleys(rig, anchors_in_world)


def cables_exist(rig: Rig, anchors: Array) -> NDArray[np.bool_]:
    """Whether all cables have a path, by pose; anchors shape (k, m, 3), [m]; shape (k,)."""
    try:
        cables_to(rig, anchors)
    except NoCable:
        if len(anchors) == 1:
            return np.array([False])
        half = len(anchors) // 2
        return np.concatenate(
            [cables_exist(rig, part) for part in (anchors[:half], anchors[half:])]
        )
    return np.ones(len(anchors), dtype=np.bool_)


def _on_pulleys(rig: Rig, anchors_in_world: Array) -> Cables:
    radius, feed = rig.pulley_radius, rig.feed_directions
    offset = anchors_in_world - rig.outlets
    along = np.sum(offset * feed, axis=-1)
    radial = offset - along[..., None] * feed
    reach = np.linalg.norm(radial, axis=-1)
    outward = reach - radius  # from the pulley's centre, in the pulley's plane
    centre_distance = np.hypot(outward, along)
    _require(reach > 0.0, "its anchor is on the swivel axis of its pulley")
    _require(centre_distance > radius, "its anchor is inside its pulley")
    swivel = radial / reach[..., None]
    straight = np.sqrt(centre_distance**2 - radius**2)
    # The tangent point, as an angle about the pulley's centre from the swivel direction to k.
    angle = np.arctan2(along, outward) + np.arccos(radius / centre_distance)
    wrap = np.mod(np.pi - angle, 2.0 * np.pi)
    centre = rig.outlets + radius * swivel
    exits = centre + radius * (np.cos(angle)[..., None] * swivel + np.sin(angle)[..., None] * feed)
    directions = (exits - anchors_in_world) / straight[..., None]
    return Cables(exits, anchors_in_world, directions, radius * wrap + straight)


def _require(sound: NDArray[np.bool_], what: str) -> None:
    """Raises `NoCable` for the first cable, along the last axis, that is not sound."""
    if sound.all():
        return
    number = int(np.argwhere(~sound)[0][-1]) + 1
    raise NoCable(
        f"cable {number} has no path: {what}",
        why="the pose is out of the rig's reach, or a value is not a number",
        next_step="choose a pose inside the workspace",
        values={"cable": number},
    )


LEAST_DAMPING = 1e-12
"""Keeps the steps of forward kinematics defined at singular poses."""


def cable_lengths(rig: Rig, pose: Pose) -> Array:
    """Inverse kinematics: lengths from outlet to anchor, shape (m,), [m]."""
    return cables_at(rig, pose).lengths


def structure_matrix(rig: Rig, pose: Pose) -> Array:
    """Matrix J of J t + w = 0 for tensions t and the wrench w on the platform; shape (6, m).

    Column i is [u_i; (R b_i) × u_i], u_i from anchor to outlet; forces [N], moments about the
    platform's origin [N·m]. Cable lengths change at the rate −Jᵀ (velocity, angular velocity).
    """
    return structure_matrix_of(cables_at(rig, pose), pose.position)


def structure_matrix_of(cables: Cables, position: Array) -> Array:
    """The structure matrices of cables; ``position`` shape (..., 3), [m]; shape (..., 6, m)."""
    arms = cables.anchors - position[..., None, :]
    matrix = np.empty((*arms.shape[:-2], 6, arms.shape[-2]))
    matrix[..., :3, :] = np.swapaxes(cables.directions, -1, -2)
    x, y, z = arms[..., 0], arms[..., 1], arms[..., 2]
    u, v, w = matrix[..., 0, :], matrix[..., 1, :], matrix[..., 2, :]
    # np.cross takes several times as long for the few cables of a rig.
    matrix[..., 3, :] = y * w - z * v
    matrix[..., 4, :] = z * u - x * w
    matrix[..., 5, :] = x * v - y * u
    return matrix


@dataclass(frozen=True, slots=True, eq=False)
class ForwardSolution:
    """A pose computed from cable lengths.

    Attributes:
        pose: ``world_from_platform``.
        residual: Lengths of the pose's cables minus the given lengths, shape (m,), [m].
        iterations: Number of steps.
    """

    pose: Pose
    residual: Array
    iterations: int

    @property
    def worst(self) -> float:
        """Largest absolute residual of a cable, [m]."""
        return float(np.max(np.abs(self.residual)))


def forward_kinematics(
    rig: Rig, lengths: Array, guess: Pose | None = None, *, tolerance: float = 1e-10
) -> ForwardSolution:
    """Pose whose cable lengths are nearest to the given ones (least squares).

    Args:
        rig: The robot, with point exits or pulleys.
        lengths: Shape (m,), [m].
        guess: A pose near the solution (warm start); without one (cold start) the search starts
            from several poses of the workspace and returns the best solution.
        tolerance: Size of the last step at which the search ends, [m] and [rad].

    Raises:
        BadInput: There is not a finite length for each cable.
        Fault: No start converged to a stationary pose.
    """
    wanted = floats_of(lengths)
    if wanted.shape != (rig.cable_count,) or not np.all(np.isfinite(wanted)):
        raise BadInput(
            f"needs a finite length for each of {rig.cable_count} cables",
            where="forward kinematics",
        )
    starts = [guess] if guess is not None else _cold_starts(rig)
    best = _best_from(rig, wanted, starts, tolerance)
    if best is None and guess is None:  # lengths that contradict each other, as of soft cables
        best = _best_from(rig, wanted, _settled_from(rig, wanted, starts), tolerance)
    if best is None:
        raise Fault(
            "no pose fits the cable lengths",
            where="forward kinematics",
            why="the lengths are not those of this rig, or the guess is far off",
            next_step="check the drive positions and the reference (home) counts",
        )
    return best


def _best_from(
    rig: Rig, lengths: Array, starts: Iterable[Pose], tolerance: float
) -> ForwardSolution | None:
    best: ForwardSolution | None = None
    for start in starts:
        found = _levenberg_marquardt(rig, lengths, start, tolerance)
        if found is None:
            continue
        if best is None or found.worst < best.worst:
            best = found
        if best.worst < 1e-7:
            break
    return best


def _settled_from(rig: Rig, lengths: Array, starts: Sequence[Pose]) -> list[Pose]:
    positions = np.array([start.position for start in starts])
    rotations = np.array([start.rotation for start in starts])
    sound = cables_exist(rig, anchors_at(rig, positions, rotations))
    wanted = np.broadcast_to(lengths, (int(sound.sum()), len(lengths)))
    settled = settled_poses_near(rig, wanted, positions[sound], rotations[sound])
    return [Pose(*each) for each in zip(*settled, strict=True)]


def poses_near(
    rig: Rig, lengths: Array, positions: Array, rotations: Array
) -> tuple[Array, Array, Array]:
    """Forward kinematics of many poses at once, each near a known one (Gauss–Newton).

    Each step squares an error of millimetres, so four reach round-off.

    Args:
        rig: The robot, with point exits or pulleys.
        lengths: Shape (n, m), [m].
        positions: Guesses, world frame, shape (n, 3), [m].
        rotations: Guesses, ``world_from_platform``, shape (n, 3, 3).

    Returns:
        Positions, shape (n, 3), [m]; rotations, shape (n, 3, 3); and for each pose the largest
        absolute residual of a cable before the last step, shape (n,), [m].
    """
    scale, residuals = step_scale(rig), np.zeros_like(lengths)
    for _ in range(4):
        anchors = positions[:, None, :] + np.einsum("nij,mj->nmi", rotations, rig.anchors)
        cables = cables_to(rig, anchors)
        matrices = structure_matrix_of(cables, positions) * scale[:, None]
        residuals = cables.lengths - lengths
        normal = matrices @ np.swapaxes(matrices, 1, 2)
        right = matrices @ residuals[:, :, None]
        twists = np.linalg.solve(normal, right)[:, :, 0] * scale
        positions = positions + twists[:, :3]
        turns = [matrix_from_rotation_vector(v) for v in twists[:, 3:]]
        rotations = np.reshape(turns, (-1, 3, 3)) @ rotations
    return positions, rotations, np.max(np.abs(residuals), axis=1)


_FIRST_DAMPING, _MOST_DAMPING = 1e3, 1e9
"""Relative; the first steps are short, so that the poses found are those nearest downhill."""
_MOST_STEPS = 300


def settled_poses_near(
    rig: Rig, lengths: Array, positions: Array, rotations: Array, *, tolerance: float = 1e-10
) -> tuple[Array, Array]:
    """Forward kinematics as by `poses_near`, of lengths that may contradict each other.

    Where they do by millimetres, undamped steps run past the least squares and do not settle.
    Steps here are damped for each pose, and taken only if they lower its squares.

    Args:
        rig: The robot, with point exits or pulleys.
        lengths: Shape (n, m), [m].
        positions: Guesses, world frame, shape (n, 3), [m].
        rotations: Guesses, ``world_from_platform``, shape (n, 3, 3).
        tolerance: Size of the last step at which the search ends, [m] and [rad].

    Returns:
        Positions, shape (n, 3), [m], and rotations, shape (n, 3, 3).

    Raises:
        NoCable: At a guess a cable has no path.
    """
    here: tuple[Array, ...] = (positions, rotations)
    here += _squares_near(rig, lengths, positions, rotations)
    damping = np.full(len(lengths), _FIRST_DAMPING)
    for _ in range(_MOST_STEPS):
        positions, rotations, squares, slopes, normal = here
        diagonal = damping[:, None] * np.abs(np.einsum("nii->ni", normal))
        damped = normal + diagonal[:, None, :] * np.eye(6)
        twists = -np.linalg.solve(damped, slopes[..., None])[..., 0]
        turns = np.reshape([matrix_from_rotation_vector(v) for v in twists[:, 3:]], (-1, 3, 3))
        ahead: tuple[Array, ...] = (positions + twists[:, :3], turns @ rotations)
        exists = cables_exist(rig, anchors_at(rig, *ahead))
        ahead = chosen_rows(exists, ahead, here)
        ahead += _squares_near(rig, lengths, *ahead)
        better = exists & (ahead[2] <= squares)
        here = chosen_rows(better, ahead, here)
        damping = np.clip(damping * np.where(better, 0.5, 10.0), LEAST_DAMPING, _MOST_DAMPING)
        if np.abs(twists).max(initial=0.0) < tolerance:
            break
    return here[0], here[1]


def anchors_at(rig: Rig, positions: Array, rotations: Array) -> Array:
    """Anchors at n poses, world frame, shape (n, m, 3), [m]."""
    return np.asarray(positions[:, None, :] + np.einsum("nij,mj->nmi", rotations, rig.anchors))


def chosen_rows(
    first: NDArray[np.bool_], one: tuple[Array, ...], other: tuple[Array, ...]
) -> tuple[Array, ...]:
    """Arrays with a row per pose, each row of one of two; ``first`` shape (n,)."""
    return tuple(
        np.where(first.reshape(-1, *[1] * (a.ndim - 1)), a, b)
        for a, b in zip(one, other, strict=False)
    )


def _squares_near(
    rig: Rig, lengths: Array, positions: Array, rotations: Array
) -> tuple[Array, Array, Array]:
    """Squares of the errors of cable lengths, half their gradient by twists, and its slopes.

    Second derivatives of the lengths count, since errors of lengths that contradict each other
    remain. Those of pulleys are taken as those of points: it does not change where steps end.

    Returns:
        Shapes (n,), (n, 6) and (n, 6, 6).
    """
    cables = cables_to(rig, anchors_at(rig, positions, rotations))
    matrices, errors = structure_matrix_of(cables, positions), cables.lengths - lengths
    arms, shares = cables.anchors - positions[:, None, :], errors / cables.lengths
    by_twist = points_by_twist(arms)
    normal = (matrices * (1.0 - shares[:, None, :])) @ np.swapaxes(matrices, 1, 2)
    normal += np.einsum("nm,nmki,nmkj->nij", shares, by_twist, by_twist)
    mixed = np.einsum("nm,nmi,nmj->nij", errors, cables.directions, arms)
    traces = np.einsum("nii->n", mixed)[:, None, None]
    normal[:, 3:, 3:] += traces * np.eye(3) - (mixed + np.swapaxes(mixed, 1, 2)) / 2.0
    slopes = -(matrices @ errors[:, :, None])[:, :, 0]
    return np.sum(errors**2, axis=1), slopes, normal


def interpolate_quaternions(starts: Array, ends: Array, fractions: Array) -> Array:
    """Unit quaternions (w, x, y, z) between n pairs of nearby ones, shape (n, 4).

    Args:
        starts: At fraction 0, which are returned as they are, shape (n, 4).
        ends: At fraction 1, shape (n, 4).
        fractions: Between 0 and 1, shape (n,).
    """
    signs = np.where((starts * ends).sum(axis=1) < 0.0, -1.0, 1.0)  # of the shorter rotation
    mixed = starts + fractions[:, None] * (signs[:, None] * ends - starts)
    mixed /= np.linalg.norm(mixed, axis=1, keepdims=True)
    return np.where(fractions[:, None] > 0.0, mixed, starts)


def _cold_starts(rig: Rig) -> list[Pose]:
    """Home, the workspace centre, and the centres of its octants."""
    centre = (rig.workspace_lower + rig.workspace_upper) / 2.0
    quarter = (rig.workspace_upper - rig.workspace_lower) / 4.0
    corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T
    return [
        rig.home,
        Pose.level(centre),
        *(Pose.level(centre + c * quarter) for c in corners),
    ]


def _levenberg_marquardt(
    rig: Rig, lengths: Array, start: Pose, tolerance: float
) -> ForwardSolution | None:
    """Damped Gauss–Newton on the pose; None when it does not converge."""
    pose, damping = start, 1e-6
    scale = step_scale(rig)
    residual = _residual(rig, pose, lengths)
    if residual is None:
        return None
    for iteration in range(1, 101):
        jacobian = -structure_matrix(rig, pose).T * scale
        normal = jacobian.T @ jacobian
        step = scale * np.linalg.solve(normal + damping * np.eye(6), -(jacobian.T @ residual))
        candidate = moved(pose, step)
        trial = _residual(rig, candidate, lengths)
        if trial is not None and trial @ trial <= residual @ residual:
            pose, residual, damping = candidate, trial, max(damping / 10.0, LEAST_DAMPING)
            if np.max(np.abs(step)) < tolerance:
                return ForwardSolution(pose, read_only(residual), iteration)
        elif np.max(np.abs(step)) < tolerance:
            return ForwardSolution(pose, read_only(residual), iteration)
        else:
            damping *= 10.0
    return None


def step_scale(rig: Rig) -> Array:
    """Scale with which a unit of rotation moves the anchors as far as a unit of translation."""
    radius = rms_anchor_radius(rig.anchors)
    return np.array([1.0, 1.0, 1.0, 1.0 / radius, 1.0 / radius, 1.0 / radius])


def _residual(rig: Rig, pose: Pose, lengths: Array) -> Array | None:
    try:
        return cable_lengths(rig, pose) - lengths
    except NoCable:  # the trial pose puts an anchor inside a pulley
        return None


def axis_distances(rig: Rig, anchors: Array) -> Array:
    """Distances of anchors from the swivel axes of their pulleys.

    Args:
        anchors: World frame, shape (..., m, 3), [m].

    Returns:
        Shape (..., m), [m].
    """
    offset = anchors - rig.outlets
    along = np.sum(offset * rig.feed_directions, axis=-1, keepdims=True)
    distances: Array = np.linalg.norm(offset - along * rig.feed_directions, axis=-1)
    return distances
