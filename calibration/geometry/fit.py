"""Robust damped least-squares fit of a rig's parameters and the platform's poses.

The pose of each sample is eliminated (Schur complement), so the cost is linear in the number of
samples. Unknowns are in standard deviations of the rig file, which acts as a prior on each.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import inf, radians

import numpy as np

from calibration.geometry.measurements import RigMeasurements
from calibration.geometry.model import RigModel
from calibration.geometry.parameters import Parameters
from calibration.statistics import huber, huber_weight
from model.errors import Fault
from model.kinematics import (
    LEAST_DAMPING,
    NoCable,
    anchors_at,
    cables_exist,
    cables_to,
    chosen_rows,
    structure_matrix_of,
)
from model.pose import Array, matrix_from_rotation_vector, read_only, rotation_vector_from_matrix
from model.rig import Rig

# Normal equations, sample by sample, with the poses eliminated.


@dataclass(frozen=True, slots=True, eq=False)
class NormalEquations:
    """Normal equations of n samples for r unknowns.

    Attributes:
        own: Of the unknowns, shape (n, r, r).
        prior: Deviation of the unknowns from the rig file, shape (r,).
        mixed: Of unknowns and pose, shape (n, r, 6).
        poses: Of the pose, shape (n, 6, 6).
        pull: Half the gradient of the sum of squares by the unknowns, shape (n, r).
        pose_pull: Half the gradient by the pose, shape (n, 6).
    """

    own: Array
    prior: Array
    mixed: Array
    poses: Array
    pull: Array
    pose_pull: Array

    def reduced_by_sample(self, damping: float = 0.0) -> tuple[Array, Array]:
        """Each sample's information on the unknowns, its pose eliminated.

        Returns:
            Information, shape (n, r, r), and half the gradient of the squares, shape (n, r).
        """
        poses = self._poses(damping)
        gained = np.linalg.solve(poses, np.swapaxes(self.mixed, 1, 2))
        alone = np.asarray(np.linalg.solve(poses, self.pose_pull[..., None]))
        schur = self.own - self.mixed @ gained
        symmetric: Array = (schur + np.swapaxes(schur, 1, 2)) / 2.0
        slopes: Array = self.pull - (self.mixed @ alone)[..., 0]
        return symmetric, slopes

    def solved(self, damping: float) -> tuple[Array, Array]:
        """Steps of the unknowns, shape (r,), and twists of the poses, shape (n, 6)."""
        informations, slopes = self.reduced_by_sample(damping)
        right = self.prior + slopes.sum(axis=0)
        left = informations.sum(axis=0) + (1.0 + damping) * np.eye(len(right))
        step: Array = -np.linalg.solve(left, right)
        moved = self.pose_pull + np.swapaxes(self.mixed, 1, 2) @ step
        twists = -np.asarray(np.linalg.solve(self._poses(damping), moved[..., None]))[..., 0]
        return step, twists

    def _poses(self, damping: float) -> Array:
        diagonal = np.einsum("nii->ni", self.poses)
        damped: Array = self.poses + damping * diagonal[:, None, :] * np.eye(6)
        return damped


MOST_STEPS = 200
SETTLED = 1e-6
"""The fit has converged when a step lowers the sum of squares by less, relative."""
MOST_DAMPING = 1e9
"""No smaller step is tried: its gain would be below round-off."""
START_TOLERANCE = 1e-5
"""Tolerance of initial poses, [m] and [rad]."""
START_DEVIATION, START_TURN = 5e-3, radians(10.0)
"""Assumed for initial poses: standard deviation of lengths and positions, [m], and of rotations
from home, [rad]; the fit itself assumes nothing about rotations that were not measured."""
RESIDUAL_BEND, POSE_BEND = 3.0, 4.0
"""Huber thresholds of cable and sensor residuals, and of poses, in standard deviations."""


@dataclass(frozen=True, slots=True, eq=False)
class RigFit:
    """The best fit to the measurements.

    Attributes:
        values: Of the unknowns, shape (p,).
        positions: World frame, shape (n, 3), [m].
        rotations: ``world_from_platform``, shape (n, 3, 3).
        sensors: Names of the k − m values measured beside the m cable lengths of each sample.
        residuals: Of cable lengths, then of the sensors, shape (n, k), [m], [rad]; 0 where nothing
            was measured.
        deviations: Assumed standard deviations, shape (n, k), [m], [rad]; infinite where nothing
            was measured.
        weights: Huber weight of each residual, shape (n, k); below 1 for outliers.
        pose_misfits: Distances of estimated from measured poses, in standard deviations, shape
            (n,); 0 where no pose was measured.
        informations: Information of each sample on the unknowns, its pose projected out, shape
            (n, p, p), per variance of the rig file.
        scores: Half the gradient of each sample's squares by the unknowns, same units, (n, p).
        common_scores: Change of the sum of these by one deviation of each error common to all
            poses, shape (p, q).
        tension_squares: Growth of the expected sum of squares, poses eliminated, by independent
            tension errors of each cable with a variance of 1 N², shape (m,).
    """

    values: Array
    positions: Array
    rotations: Array
    sensors: tuple[str, ...]
    residuals: Array
    deviations: Array
    weights: Array
    pose_misfits: Array
    informations: Array
    scores: Array
    common_scores: Array
    tension_squares: Array

    @property
    def cables(self) -> Array:
        """Residuals of the cable lengths alone, shape (n, m), [m]."""
        return self.residuals[:, : self.residuals.shape[1] - len(self.sensors)]

    @property
    def squares(self) -> float:
        """Sum of weighted squares of the residuals of cables and sensors, in deviations."""
        return float(np.sum(self.weights * (self.residuals / self.deviations) ** 2))

    @property
    def sensor_rms(self) -> Array:
        """RMS of each sensor's residuals where measured, shape (k − m,), [rad]."""
        m = self.cables.shape[1]
        known = np.maximum(np.isfinite(self.deviations[:, m:]).sum(axis=0), 1)
        return np.asarray(np.sqrt(np.sum(self.residuals[:, m:] ** 2, axis=0) / known))

    @property
    def information(self) -> Array:
        """Information of the data alone, shape (p, p), per variance of the rig file.

        Directions of eigenvalues above 1 are known better from the data than from the rig file.
        """
        total: Array = self.informations.sum(axis=0)
        return total


class RigFitter:
    """Fitter for one set of measurements and unknowns."""

    def __init__(
        self, parameters: Parameters, measured: RigMeasurements, length_deviation: float
    ) -> None:
        """Prepares the model; `fit` runs the fit.

        Args:
            length_deviation: Of a cable's length from the encoder, [m].
        """
        self._parameters, self._measured = parameters, measured
        self._model = RigModel(parameters, measured)
        self._deviations = self._model.deviations(length_deviation)
        self._posed, self._rotated = measured.has_position, measured.has_rotation

    def fit(self, basis: Array | None = None) -> RigFit:
        """The maximum a posteriori values and poses.

        Args:
            basis: Directions in which the unknowns may differ from the rig file, orthonormal
                columns in standard deviations of the rig file, shape (p, r); all when left out.

        Raises:
            Fault: The fit does not converge.
        """
        free = np.eye(len(self._parameters)) if basis is None else basis
        spread = self._parameters.deviations[:, None] * free
        z = np.zeros(free.shape[1])
        positions, rotations = self._initial_poses
        cost, damping = self._cost(spread @ z, z, positions, rotations), 1e-3
        for _ in range(MOST_STEPS):
            system = self._system(spread @ z, z, spread, positions, rotations)
            gain = -1.0
            while gain < 0.0 and damping < MOST_DAMPING:
                step, twists = system.solved(damping)
                trial = (z + step, positions + twists[:, :3], _rotated(rotations, twists[:, 3:]))
                gain = cost - self._cost(spread @ trial[0], *trial)
                damping *= 0.1 if gain >= 0.0 else 10.0
            if gain >= 0.0:
                z, positions, rotations = trial
                cost -= gain
            if gain < SETTLED * (1.0 + cost):
                return self._result(spread @ z, positions, rotations)
        raise Fault(
            "the rig's parameters could not be fitted to the measurements",
            where="calibrate rig",
            why="the measurements contradict each other, or the rig file is far off",
            next_step="check units, the order of the cables and the homing of the drives",
        )

    @cached_property
    def _initial_poses(self) -> tuple[Array, Array]:
        """Measured poses; missing ones and missing rotations from the lengths by the rig file."""
        rig, counted, measured = self._parameters.rig, self._model.counted, self._measured
        lengths = counted.lengths(self._parameters.geometry(np.zeros(len(self._parameters))))
        positions, rotations = measured.positions.copy(), measured.rotations.copy()
        unknown = ~(self._posed & self._rotated)
        if unknown.any():
            found = poses_from_lengths(rig, lengths[unknown], measured.part(unknown))
            positions[unknown], rotations[unknown] = found
        origins = measured.origins(rotations)
        return np.where(self._posed[:, None], origins, positions), rotations

    def _distances(self, errors: Array, weights: Array) -> Array:
        """Distances from the measured poses, in standard deviations, shape (n,)."""
        squares = np.einsum("ni,nij,nj->n", errors, weights, errors)
        distances: Array = np.sqrt(np.maximum(squares, 0.0))
        return distances

    def _cost(self, values: Array, z: Array, positions: Array, rotations: Array) -> float:
        try:
            residuals = self._model.residuals(values, positions, rotations)
        except NoCable:
            return float("inf")
        distances = np.abs(residuals) / self._deviations
        weights = self._measured.pose_information(rotations)
        poses = self._distances(self._measured.pose_errors(positions, rotations), weights)
        return float(z @ z + huber(distances, RESIDUAL_BEND).sum() + huber(poses, POSE_BEND).sum())

    def _system(
        self, values: Array, z: Array, spread: Array, positions: Array, rotations: Array
    ) -> NormalEquations:
        line = self._model.linearised(values, positions, rotations)
        weights = self._weights(line.residuals) / self._deviations**2
        errors = self._measured.pose_errors(positions, rotations)
        pose_weights = self._pose_weights(positions, rotations)
        by_z = line.by_values @ spread
        weighted = weights[..., None] * line.by_pose
        return NormalEquations(
            own=np.swapaxes(by_z, 1, 2) @ (weights[..., None] * by_z),
            prior=z,
            mixed=np.swapaxes(by_z, 1, 2) @ weighted,
            poses=np.swapaxes(line.by_pose, 1, 2) @ weighted + pose_weights,
            pull=np.einsum("nmp,nm,nm->np", by_z, weights, line.residuals),
            pose_pull=np.einsum("nmi,nm->ni", weighted, line.residuals)
            + np.einsum("nij,nj->ni", pose_weights, errors),
        )

    def _pose_weights(self, positions: Array, rotations: Array) -> Array:
        """Information of the measured poses with Huber weights, shape (n, 6, 6)."""
        informations = self._measured.pose_information(rotations)
        errors = self._measured.pose_errors(positions, rotations)
        distances = self._distances(errors, informations)
        return np.asarray(huber_weight(distances, POSE_BEND)[:, None, None] * informations)

    def _weights(self, residuals: Array) -> Array:
        """Huber weight of each residual, shape (n, k)."""
        return huber_weight(np.abs(residuals) / self._deviations, RESIDUAL_BEND)

    def _result(self, values: Array, positions: Array, rotations: Array) -> RigFit:
        spread = np.diag(self._parameters.deviations)
        zero = np.zeros(len(values))
        system = self._system(values, zero, spread, positions, rotations)
        residuals = self._model.residuals(values, positions, rotations)
        return RigFit(
            values,
            positions,
            rotations,
            tuple(name for sensor in self._model.sensors for name in sensor.names),
            residuals,
            read_only(self._deviations),
            self._weights(residuals),
            self._distances(
                self._measured.pose_errors(positions, rotations),
                self._measured.pose_information(rotations),
            ),
            *system.reduced_by_sample(),
            self._common_scores(system, positions, rotations),
            self._tension_squares(system, values, positions, rotations),
        )

    def _common_scores(self, system: NormalEquations, positions: Array, rotations: Array) -> Array:
        """As in `RigFit`; an error of a measured pose pulls the estimated one along."""
        pulls = self._pose_weights(positions, rotations) @ self._measured.common_errors
        return np.asarray(np.sum(system.mixed @ np.linalg.solve(system.poses, pulls), axis=0))

    def _tension_squares(
        self, system: NormalEquations, values: Array, positions: Array, rotations: Array
    ) -> Array:
        """As in `RigFit`; poses follow a part of the errors."""
        line = self._model.linearised(values, positions, rotations)
        weights = self._weights(line.residuals) / self._deviations**2
        followed = line.by_pose @ np.linalg.solve(system.poses, np.swapaxes(line.by_pose, 1, 2))
        left = weights - weights**2 * np.einsum("nkk->nk", followed)
        by_tension = self._model.counted.by_tension(self._parameters.geometry(values))
        return np.asarray(np.sum(left[:, : by_tension.shape[1]] * by_tension**2, axis=0))


# Poses whose rotation was not measured, from cable lengths.


def poses_from_lengths(
    rig: Rig, lengths: Array, measured: RigMeasurements, *, alone: bool = False
) -> tuple[Array, Array]:
    """Poses near home's rotation and the measured positions, with cable lengths near given ones.

    Where the rig differs from its file, lengths alone may rotate the platform far.

    Args:
        rig: With its assumed parameters.
        lengths: From outlet to anchor, shape (n, m), [m].
        measured: The samples, without rotations.
        alone: Whether lengths alone count in the end.

    Returns:
        Positions, world frame, shape (n, 3), [m], and rotations, shape (n, 3, 3).

    Raises:
        NoCable: A measured position is out of the rig's reach.
    """
    vague = np.tile(START_DEVIATION**2 * np.eye(6), (len(lengths), 1, 1))
    data = replace(measured, covariances=vague)
    rotations = np.tile(rig.home.rotation, (len(lengths), 1, 1))
    origins = data.origins(rotations)
    positions = np.where(data.has_position[:, None], origins, rig.home.position)
    found = _nearest_poses(rig, lengths, data, START_TURN, (positions, rotations))
    return _nearest_poses(rig, lengths, data.without_poses(), inf, found) if alone else found


def _nearest_poses(
    rig: Rig, lengths: Array, data: RigMeasurements, turn: float, poses: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Damped least squares from given poses, each damped separately; see `_pose_systems`."""
    damping = np.full(len(lengths), 1e-3)
    here: tuple[Array, ...] = (*poses, *_pose_systems(rig, lengths, data, turn, *poses))
    for _ in range(MOST_STEPS):
        positions, rotations, squares, slopes, normal = here
        damped = normal + damping[:, None, None] * normal * np.eye(6)
        twists = np.asarray(-np.linalg.solve(damped, slopes[..., None]))[..., 0]
        ahead: tuple[Array, ...] = (positions + twists[:, :3], _rotated(rotations, twists[:, 3:]))
        exists = cables_exist(rig, anchors_at(rig, *ahead))
        ahead = chosen_rows(exists, ahead, here)
        ahead += _pose_systems(rig, lengths, data, turn, *ahead)
        better = exists & (ahead[2] <= squares)
        here = chosen_rows(better, ahead, here)
        damping = np.clip(damping * np.where(better, 0.1, 10.0), LEAST_DAMPING, MOST_DAMPING)
        if np.abs(twists).max() < START_TOLERANCE:
            break
    return here[0], here[1]


def _pose_systems(
    rig: Rig,
    lengths: Array,
    data: RigMeasurements,
    turn: float,
    positions: Array,
    rotations: Array,
) -> tuple[Array, Array, Array]:
    """Least squares by lengths, measured positions, and rotations from home.

    Args:
        rig: With its assumed parameters.
        lengths: From outlet to anchor, shape (n, m), [m].
        data: The samples, without rotations.
        turn: Standard deviation of rotations from home, [rad].
        positions: Shape (n, 3), [m].
        rotations: Shape (n, 3, 3).

    Returns:
        Sums of squares, shape (n,), and their normal equations: half the gradient, shape (n, 6),
        and its slopes, shape (n, 6, 6).
    """
    cables = cables_to(rig, anchors_at(rig, positions, rotations))
    off = (cables.lengths - lengths) / START_DEVIATION
    by_twist = -structure_matrix_of(cables, positions) / START_DEVIATION
    apart, rotated = np.zeros((2, len(lengths), 6))
    apart[:, :3] = np.nan_to_num(data.measured_points(positions, rotations) - data.positions)
    from_home = rotations @ rig.home.rotation.T
    rotated[:, 3:] = [rotation_vector_from_matrix(rotation) / turn for rotation in from_home]
    information = data.pose_information(rotations)
    pulls = (information @ apart[..., None])[..., 0]
    squares = np.sum(off**2, axis=1) + np.sum(rotated**2, axis=1) + np.sum(apart * pulls, axis=1)
    normal = by_twist @ np.swapaxes(by_twist, 1, 2) + information
    normal[:, 3:, 3:] += np.eye(3) / turn**2
    slopes = (by_twist @ off[..., None])[..., 0] + pulls + rotated / turn
    return squares, slopes, normal


def _rotated(rotations: Array, turns: Array) -> Array:
    rotated: Array = np.array([matrix_from_rotation_vector(t) for t in turns]) @ rotations
    return rotated
