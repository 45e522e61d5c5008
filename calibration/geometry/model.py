"""Residuals of measurements at estimated poses and parameters, with derivatives.

All derivatives are analytic: moving an anchor by d shortens its cable by u · d, with u the unit
vector from anchor to exit, for point exits and pulleys; moving outlet and pulley lengthens it.
Each stationary sample has cable lengths and the values of further sensors (`Sensor`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from calibration.geometry.measurements import RigMeasurements
from calibration.geometry.parameters import Parameters, RigGeometry, rig_with
from model.kinematics import Cables, cable_lengths, cables_to
from model.pose import Array, Pose, matrix_from_rotation_vector, skew
from model.rig import Rig
from model.statics.gravity import PRETENSION_SHARE, working_tensions
from model.statics.tension_distribution import TensionInfeasible
from model.winches import WinchMap


class CountedLengths:
    """Cable lengths from drive positions and tensions.

    Attributes:
        paid_out: Unstrained cable since the home counts, rig file's drums, shape (n, m), [m].
    """

    def __init__(self, rig: Rig, counts: Array, tensions: Array) -> None:
        """Uses the winches of the rig file.

        Args:
            rig: As in its file.
            counts: Shape (n, m), [counts].
            tensions: Shape (n, m), [N].

        Raises:
            TensionInfeasible: The rig cannot hold its platform at home.
        """
        winches = WinchMap(rig)
        self.paid_out: Array = (counts - winches.home_counts) / winches.counts_per_metre
        self._tensions, self._at_home = tensions, working_tensions(rig, rig.home).tensions
        self._rig, self._behind = rig, winches.behind_outlet

    def stretch(self, geometry: RigGeometry) -> Array:
        """1 + tension / stiffness, shape (n, m)."""
        stretch: Array = 1.0 + self._tensions / geometry.stiffness
        return stretch

    def stretch_at_home(self, geometry: RigGeometry) -> Array:
        """1 + tension / stiffness at the home pose, shape (m,)."""
        stretch: Array = 1.0 + self._at_home / geometry.stiffness
        return stretch

    def at_home(self, geometry: RigGeometry) -> Array:
        """Unstrained cable at the home counts, shape (m,), [m]."""
        lengths = cable_lengths(rig_with(self._rig, geometry), self._rig.home)
        reaching = (lengths + self._behind) / self.stretch_at_home(geometry)
        unstrained: Array = reaching + geometry.offsets
        return unstrained

    def lengths(self, geometry: RigGeometry) -> Array:
        """Lengths from outlet to anchor with these parameters, shape (n, m), [m]."""
        paid_out = self.paid_out * (1.0 + geometry.drum_scale)
        unstrained = self.at_home(geometry) + paid_out
        lengths: Array = unstrained * self.stretch(geometry) - self._behind
        return lengths

    def by_tension(self, geometry: RigGeometry) -> Array:
        """Derivative of `lengths` by the cables' own tensions, shape (n, m), [m/N]."""
        unstrained = self.at_home(geometry) + self.paid_out * (1.0 + geometry.drum_scale)
        return np.asarray(unstrained / geometry.stiffness)

    def by_compliance(self, geometry: RigGeometry) -> Array:
        """Derivative of `lengths` by the cables' compliance, 1 / stiffness, shape (n, m), [m N]."""
        at_home = self.at_home(geometry)
        unstrained = at_home + self.paid_out * (1.0 + geometry.drum_scale)
        less = (at_home - geometry.offsets) * self._at_home / self.stretch_at_home(geometry)
        change: Array = unstrained * self._tensions - self.stretch(geometry) * less
        return change


@dataclass(frozen=True, slots=True, eq=False)
class RigAtPoses:
    """A rig with given parameters, at n poses.

    Attributes:
        geometry: The parameters.
        positions: World frame, shape (n, 3), [m].
        rotations: ``world_from_platform``, shape (n, 3, 3).
        cables: At the poses.
    """

    geometry: RigGeometry
    positions: Array
    rotations: Array
    cables: Cables

    @classmethod
    def of(cls, rig: Rig, geometry: RigGeometry, positions: Array, rotations: Array) -> RigAtPoses:
        """Computes the cables.

        Raises:
            NoCable: An anchor lies at its outlet or inside its pulley.
        """
        anchors = positions[:, None, :] + np.einsum("nij,mj->nmi", rotations, geometry.anchors)
        return cls(geometry, positions, rotations, cables_to(rig_with(rig, geometry), anchors))

    def by_pose(self, slopes: Array) -> Array:
        """Derivative by the pose's twist of quantities that depend on anchors, shape (n, m, 6).

        Args:
            slopes: Derivative by the anchor in the world, shape (n, m, 3).
        """
        arms = self.cables.anchors - self.positions[:, None, :]
        return np.concatenate([slopes, np.cross(arms, slopes)], axis=-1)

    def by_points(self, slopes: Array, parameters: Parameters) -> Array:
        """Derivative by outlets and anchors of quantities that depend on the vector between them.

        Args:
            slopes: Derivative by the anchor in the world, shape (n, m, 3); by the outlet it has
                the opposite sign.

        Returns:
            Shape (n, m, p).
        """
        n, m, _ = slopes.shape
        by_values, each = np.zeros((n, m, len(parameters))), np.arange(m)
        own = {"outlets": -slopes, "anchors": slopes @ self.rotations}
        for group, columns in parameters.slices().items():
            if group in own:
                for axis in range(3):
                    by_values[:, each, columns.start + 3 * each + axis] = own[group][:, :, axis]
        return by_values


@dataclass(frozen=True, slots=True, eq=False)
class Linearised:
    """Measurements linearised at given values and poses, k values per sample.

    Attributes:
        residuals: Predicted minus measured, shape (n, k); of cable lengths [m], of angles [rad].
        by_values: Their derivatives by the unknowns, shape (n, k, p).
        by_pose: By the pose's twist (translation, rotation in the world), shape (n, k, 6).
    """

    residuals: Array
    by_values: Array
    by_pose: Array


class Sensor(ABC):
    """A kind of measurement beside cable lengths.

    Attributes:
        names: Of its k values.
        deviations: Standard deviations, shape (n, k), [rad]; infinite where nothing was measured.
    """

    names: tuple[str, ...]
    deviations: Array

    @abstractmethod
    def residuals(self, state: RigAtPoses) -> Array:
        """As in `Linearised`; 0 where nothing was measured."""

    @abstractmethod
    def linearised(self, state: RigAtPoses) -> Linearised:
        """Residuals with derivatives."""


class Swivels(Sensor):
    """Swivel angles of the pulleys, which rotate about their feed directions to the anchors."""

    def __init__(self, parameters: Parameters, measured: RigMeasurements) -> None:
        """The angles are zero with the rig file's platform at home."""
        rig, axes = parameters.rig, parameters.rig.feed_directions
        self._parameters, self._measured = parameters, measured.swivels
        home = rig.home.apply(rig.anchors) - rig.outlets
        radial = home - np.sum(home * axes, axis=1, keepdims=True) * axes
        self._x = radial / np.linalg.norm(radial, axis=1, keepdims=True)
        self._y = np.cross(axes, self._x)
        self._known = np.isfinite(measured.swivels)
        self.deviations = np.where(self._known, measured.swivel_deviation, np.inf)
        self.names = tuple(f"swivel {i}" for i in range(1, rig.cable_count + 1))

    def residuals(self, state: RigAtPoses) -> Array:
        """Predicted minus measured angles, wrapped to ±π."""
        x, y = self._across(state)
        apart = np.arctan2(y, x) + state.geometry.swivel_zeros - self._measured
        return np.where(self._known, np.mod(apart + np.pi, 2.0 * np.pi) - np.pi, 0.0)

    def linearised(self, state: RigAtPoses) -> Linearised:
        """An anchor's motion across the pulley's plane rotates it; in the plane it does not."""
        x, y = (part[..., None] for part in self._across(state))
        slopes = (x * self._y - y * self._x) / (x**2 + y**2)
        by_values = state.by_points(slopes, self._parameters)
        zeros, each = self._parameters.slices().get("swivel_zeros"), np.arange(slopes.shape[1])
        if zeros is not None:
            by_values[:, each, zeros.start + each] = 1.0
        return Linearised(self.residuals(state), by_values, state.by_pose(slopes))

    def _across(self, state: RigAtPoses) -> tuple[Array, Array]:
        """Anchors from their outlets, across the feed directions, shape (n, m) both, [m]."""
        offset = state.cables.anchors - state.geometry.outlets
        return np.sum(offset * self._x, axis=-1), np.sum(offset * self._y, axis=-1)


class Verticals(Sensor):
    """The vertical in the frame of an IMU on the platform: two angles, about axes across it."""

    names = ("IMU 1", "IMU 2")

    def __init__(self, parameters: Parameters, measured: RigMeasurements) -> None:
        """The IMU's axes are the platform's, up to its mounting rotation."""
        known = np.asarray(np.isfinite(measured.verticals).all(axis=1))
        upwards = np.where(known[:, None], measured.verticals, np.eye(3)[2])
        self._across = np.linalg.svd(upwards[:, None, :])[2][:, 1:]
        self._across[~known] = 0.0
        deviation = np.where(known, measured.imu_deviation, np.inf)
        self.deviations = np.stack([deviation, deviation], axis=1)
        self._parameters = parameters

    def residuals(self, state: RigAtPoses) -> Array:
        """The vertical of the pose along axes across the measured one."""
        upwards = self._world_from_imu(state)[:, 2]
        return np.asarray((self._across @ upwards[..., None])[..., 0])

    def linearised(self, state: RigAtPoses) -> Linearised:
        """Depends only on the rotations of the platform and of the IMU on it."""
        world_from_imu = self._world_from_imu(state)
        turns = np.cross(self._across, world_from_imu[:, None, 2])
        n, k, _ = turns.shape
        by_values, by_pose = np.zeros((n, k, len(self._parameters))), np.zeros((n, k, 6))
        by_pose[:, :, 3:] = turns @ np.swapaxes(world_from_imu, 1, 2)
        columns = self._parameters.slices().get("imu_mounting")
        if columns is not None:
            around = skew(state.geometry.imu_mounting)
            mounted = matrix_from_rotation_vector(state.geometry.imu_mounting)
            left = np.eye(3) + around / 2.0 + around @ around / 6.0  # left Jacobian of SO(3)
            by_values[:, :, columns] = turns @ mounted.T @ left
        return Linearised(self.residuals(state), by_values, by_pose)

    def _world_from_imu(self, state: RigAtPoses) -> Array:
        return state.rotations @ matrix_from_rotation_vector(state.geometry.imu_mounting)


class RigModel:
    """Measurement model of a rig with unknown parameters, at n poses: cable lengths first.

    Attributes:
        sensors: Further sensors.
    """

    def __init__(self, parameters: Parameters, measured: RigMeasurements) -> None:
        """Takes the measurements; missing tensions are filled in by `nominal_tensions`.

        Where some are missing, the data do not determine the cables' stiffness.

        Raises:
            TensionInfeasible: The rig cannot hold its platform at home.
        """
        self.parameters = parameters
        self._tension_known = np.isfinite(measured.tensions)
        self._stretch_is_known = bool(self._tension_known.all())
        tensions = nominal_tensions(parameters.rig, measured)
        self.counted = CountedLengths(parameters.rig, measured.counts, tensions)
        self.sensors: list[Sensor] = []
        if np.isfinite(measured.swivels).any():
            self.sensors.append(Swivels(parameters, measured))
        if np.isfinite(measured.verticals).any():
            self.sensors.append(Verticals(parameters, measured))

    def deviations(self, length_deviation: float) -> Array:
        """Standard deviation of every measurement, shape (n, k); see `length_deviations`."""
        lengths = self.length_deviations(length_deviation)
        return np.concatenate([lengths, *(one.deviations for one in self.sensors)], axis=1)

    def length_deviations(self, length_deviation: float) -> Array:
        """Standard deviation of the lengths from the encoders, shape (n, m), [m].

        Args:
            length_deviation: With measured tensions, [m]; missing ones add the uncertainty of the
                stretch at the rig file's stiffness.
        """
        rig, nominal = self.parameters.rig, self.parameters.geometry(np.zeros(len(self.parameters)))
        stretched = tension_sigma(rig) / rig.cable_stiffness * self.counted.lengths(nominal)
        added = np.where(self._tension_known, 0.0, stretched)
        deviations: Array = np.hypot(length_deviation, added)
        return deviations

    def residuals(self, values: Array, positions: Array, rotations: Array) -> Array:
        """As in `Linearised`."""
        state = self._state(values, positions, rotations)
        lengths = state.cables.lengths - self.counted.lengths(state.geometry)
        return np.concatenate([lengths, *(one.residuals(state) for one in self.sensors)], axis=1)

    def linearised(self, values: Array, positions: Array, rotations: Array) -> Linearised:
        """The model and its derivatives.

        Args:
            values: Of the unknowns, shape (p,).
            positions: World frame, shape (n, 3), [m].
            rotations: ``world_from_platform``, shape (n, 3, 3).

        Raises:
            NoCable: An anchor lies at its outlet or inside its pulley.
        """
        state = self._state(values, positions, rotations)
        parts = [self._lengths(state), *(one.linearised(state) for one in self.sensors)]
        return Linearised(
            np.concatenate([part.residuals for part in parts], axis=1),
            np.concatenate([part.by_values for part in parts], axis=1),
            np.concatenate([part.by_pose for part in parts], axis=1),
        )

    def _lengths(self, state: RigAtPoses) -> Linearised:
        """Cable lengths: that of the pose minus that from the encoder."""
        geometry, rig = state.geometry, self.parameters.rig
        at_home = RigAtPoses.of(rig, geometry, rig.home.position[None], rig.home.rotation[None])
        stretch = self.counted.stretch(geometry)
        counted = (stretch / self.counted.stretch_at_home(geometry))[..., None]
        by_values = self._by_geometry(state)
        by_values -= counted * self._by_geometry(at_home)
        each, slices = np.arange(rig.cable_count), self.parameters.slices()
        if "drum_scale" in slices:
            by_values[:, each, slices["drum_scale"].start + each] = -self.counted.paid_out * stretch
        if "offsets" in slices:
            by_values[:, each, slices["offsets"].start + each] = -stretch
        if self._stretch_is_known:
            by_logarithm = self.counted.by_compliance(geometry) / geometry.stiffness
            if "stiffness" in slices:
                by_values[:, :, slices["stiffness"].start] = by_logarithm
            if "cable_stiffness" in slices:
                by_values[:, each, slices["cable_stiffness"].start + each] = by_logarithm
        residuals = state.cables.lengths - self.counted.lengths(geometry)
        return Linearised(residuals, by_values, state.by_pose(-state.cables.directions))

    def _by_geometry(self, state: RigAtPoses) -> Array:
        """Derivative of geometric cable lengths by the unknowns, shape (n, m, p)."""
        by_values = state.by_points(-state.cables.directions, self.parameters)
        pulleys = self.parameters.slices().get("pulleys")
        if pulleys is not None:
            rig = rig_with(self.parameters.rig, state.geometry)
            by_values[:, :, pulleys.start] = _by_pulley_radius(rig, state.cables)
        return by_values

    def _state(self, values: Array, positions: Array, rotations: Array) -> RigAtPoses:
        return RigAtPoses.of(
            self.parameters.rig, self.parameters.geometry(values), positions, rotations
        )


def _by_pulley_radius(rig: Rig, cables: Cables) -> Array:
    """Derivative of lengths by the radius of the pulleys, shape (n, m); see `model.kinematics`."""
    radius, feed = rig.pulley_radius, rig.feed_directions
    offset = cables.anchors - rig.outlets
    along = np.sum(offset * feed, axis=-1)
    reach = np.linalg.norm(offset - along[..., None] * feed, axis=-1)
    outward = reach - radius
    square = outward**2 + along**2
    straight = np.sqrt(square - radius**2)
    turning = along / square - (1.0 + radius * outward / square) / straight
    wrapped = (cables.lengths - straight) / radius
    by_radius: Array = wrapped - radius * turning - reach / straight
    return by_radius


# Errors of measured tensions, and tensions of samples without measured ones.


def tension_variance(
    rig: Rig, geometry: RigGeometry, measured: RigMeasurements, positions: Array, rotations: Array
) -> float:
    """Variance of measured tensions, [N²], by the forces on the platform, which is at rest.

    The force of the cables is that of the weight at every pose: independent errors of tensions
    scatter it. Moments would show them, too, but errors of the anchors as much.

    Args:
        rig: As in its file.
        positions: Of the platform, world frame, shape (n, 3), [m].
        rotations: ``world_from_platform``, shape (n, 3, 3).

    Returns:
        0 where tensions are missing in some samples.
    """
    if not np.isfinite(measured.tensions).all():
        return 0.0
    directions = RigAtPoses.of(rig, geometry, positions, rotations).cables.directions
    forces = np.sum(measured.tensions[..., None] * directions, axis=1)
    squares = np.sum((forces - forces.mean(axis=0)) ** 2)
    return float(squares) / (rig.cable_count * max(len(measured) - 1, 1))


def tension_sigma(rig: Rig) -> float:
    """Standard deviation of tensions that were not measured, [N].

    In a rig that differs from its file, cables pull against each other. None was slack, so the
    lowest allowed tension is taken to be two standard deviations below the pretension.
    """
    return PRETENSION_SHARE * (rig.max_tension - rig.min_tension) / 2.0


def nominal_tensions(rig: Rig, measured: RigMeasurements) -> Array:
    """Measured tensions; where missing, the working tensions of the pose, shape (n, m), [N].

    Where the pose is unknown, or infeasible for the rig file's cables, they are those of home:
    `tension_sigma` covers both.

    Args:
        rig: As in its file.

    Raises:
        TensionInfeasible: The rig cannot hold its platform at home.
    """
    known = np.isfinite(measured.tensions)
    likely = np.tile(working_tensions(rig, rig.home).tensions, (len(measured), 1))
    rotations = measured.first_rotations(rig)
    positions = measured.origins(rotations)
    for k in np.flatnonzero(measured.has_position & ~known.all(axis=1)):
        with suppress(TensionInfeasible):
            likely[k] = working_tensions(rig, Pose(positions[k], rotations[k])).tensions
    return np.where(known, measured.tensions, likely)
