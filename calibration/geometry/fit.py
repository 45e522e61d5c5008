"""Robust damped least-squares fit of a rig's parameters and the platform's poses.

The pose of each sample is eliminated (Schur complement), so the cost is linear in the number of
samples. Unknowns are in standard deviations of the rig file, which acts as a prior on each.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from calibration.geometry.measurements import RigMeasurements
from calibration.geometry.model import RigModel
from calibration.geometry.parameters import Parameters
from calibration.statistics import huber, huber_weight
from model.errors import Fault
from model.kinematics import ForwardSolution, NoCable, forward_kinematics
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

    @property
    def cables(self) -> Array:
        """Residuals of the cable lengths alone, shape (n, m), [m]."""
        return self.residuals[:, : self.residuals.shape[1] - len(self.sensors)]

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
            parameters: The unknowns.
            measured: Stationary samples.
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
        positions, rotations = self._initial_poses()
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

    def _initial_poses(self) -> tuple[Array, Array]:
        """Measured poses; missing ones and missing rotations from forward kinematics.

        Forward kinematics uses the rig file and starts at the previous pose.
        """
        rig, counted = self._parameters.rig, self._model.counted
        lengths = counted.lengths(self._parameters.geometry(np.zeros(len(self._parameters))))
        positions, rotations = self._measured.positions.copy(), self._measured.rotations.copy()
        unknown = np.flatnonzero(~(self._posed & self._rotated))
        for k, found in zip(unknown, poses_from_lengths(rig, lengths[unknown]), strict=True):
            rotations[k] = found.pose.rotation
            positions[k] = found.pose.position
            if self._posed[k]:
                positions[k] = self._measured.positions[k]
                positions[k] -= rotations[k] @ self._measured.reflector
        return positions, rotations

    def _pose_errors(self, positions: Array, rotations: Array) -> Array:
        """Estimated minus measured poses, shape (n, 6), [m, rad]; 0 where not measured."""
        errors = np.zeros((len(positions), 6))
        points = self._measured.measured_points(positions, rotations)
        errors[:, :3] = points - self._measured.positions
        turns = rotations @ np.swapaxes(self._measured.rotations, 1, 2)
        for k in np.flatnonzero(self._posed & self._rotated):
            errors[k, 3:] = rotation_vector_from_matrix(turns[k])
        errors[~self._posed] = 0.0
        return errors

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
        poses = self._distances(self._pose_errors(positions, rotations), weights)
        return float(z @ z + huber(distances, RESIDUAL_BEND).sum() + huber(poses, POSE_BEND).sum())

    def _system(
        self, values: Array, z: Array, spread: Array, positions: Array, rotations: Array
    ) -> NormalEquations:
        line = self._model.linearised(values, positions, rotations)
        weights = self._weights(line.residuals) / self._deviations**2
        errors = self._pose_errors(positions, rotations)
        informations = self._measured.pose_information(rotations)
        share = huber_weight(self._distances(errors, informations), POSE_BEND)
        pose_weights = share[:, None, None] * informations
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
                self._pose_errors(positions, rotations), self._measured.pose_information(rotations)
            ),
            *system.reduced_by_sample(),
        )


def poses_from_lengths(rig: Rig, lengths: Array) -> list[ForwardSolution]:
    """Forward kinematics of samples, each started at the last pose, at home, or anywhere.

    Args:
        rig: With its assumed parameters.
        lengths: From outlet to anchor, shape (n, m), [m].

    Raises:
        Fault: No start leads to a pose.
    """
    found: list[ForwardSolution] = []
    for wanted in lengths:
        tries = []
        for start in (found[-1].pose if found else rig.home, rig.home):
            with suppress(Fault):
                tries.append(forward_kinematics(rig, wanted, start, tolerance=START_TOLERANCE))
        if not tries:
            tries = [forward_kinematics(rig, wanted, tolerance=START_TOLERANCE)]
        found.append(min(tries, key=lambda solution: solution.worst))
    return found


def _rotated(rotations: Array, turns: Array) -> Array:
    rotated: Array = np.array([matrix_from_rotation_vector(t) for t in turns]) @ rotations
    return rotated
