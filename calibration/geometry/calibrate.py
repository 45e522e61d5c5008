"""Calibrates a rig's parameters from stationary samples, with their uncertainty."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np

from calibration.geometry.fit import RigFit
from calibration.geometry.identifiability import (
    HeldOut,
    Observability,
    RigUncertainty,
    held_out,
    identified,
    pose_scales,
    sentences,
    uncertainty_of_rig,
)
from calibration.geometry.measurements import RigMeasurements
from calibration.geometry.model import RigModel
from calibration.geometry.parameters import Parameters, RigGeometry, rig_with
from calibration.statistics import Interval
from model.errors import BadInput
from model.kinematics import cables_to, settled_poses_near
from model.pose import Array, matrix_from_rotation_vector, read_only
from model.rig import Rig
from model.statics.gravity import working_tensions
from model.winches import WinchMap

# Outlier rejection: samples with a cable that slipped on its drum or a wrong pose.


FAR_OFF = 4.0
"""A sample is rejected if its error is this many times the median,"""
OFF = 2.0
"""and this many times the stated standard deviation."""
MOST_SCATTER = 20.0
"""Poses that scatter more, relative to what is stated, are wrong rather than noisy, such as in
another unit: they keep their weights."""


def without_outliers(measured: RigMeasurements, fit: RigFit, fewest: int) -> RigMeasurements:
    """The samples without outliers, which are listed as unused.

    Args:
        fit: Robust fit of all samples.
        fewest: Nothing is rejected if fewer samples than this would remain.
    """
    residuals, m = fit.residuals / fit.deviations, fit.cables.shape[1]
    misfits = _misfits(fit, residuals, measured)
    usual = float(np.median(misfits))
    bad = misfits > max(FAR_OFF * usual, OFF)
    if not bad.any() or len(measured) - int(bad.sum()) < fewest:
        return measured
    unused = dict(measured.unused)
    for k in np.flatnonzero(bad):
        worst = int(np.argmax(np.abs(residuals[k])))
        off = float(abs(fit.residuals[k, worst]))
        if fit.pose_misfits[k] > abs(residuals[k, worst]):
            points = measured.measured_points(fit.positions, fit.rotations)
            apart = float(np.linalg.norm(points[k] - measured.positions[k]))
            what = f"pose is {apart * 1e3:.3g} mm"
        elif worst < m:
            what = f"cable {worst + 1} is {off * 1e3:.3g} mm"
        else:
            what = f"{fit.sensors[worst - m]} is {math.degrees(off):.3g}°"
        times = misfits[k] / usual
        unused[measured.names[k]] = (
            f"contradicts the others: {what} off, {times:.3g} times the usual error"
        )
    return replace(measured, unused=unused).part(~bad)


def _misfits(fit: RigFit, residuals: Array, measured: RigMeasurements) -> Array:
    """Error of each sample, RMS in standard deviations, shape (n,)."""
    freedom = np.maximum(np.isfinite(fit.deviations).sum(axis=1) - measured.unmeasured, 1)
    squares = np.sum(residuals**2, axis=1) + fit.pose_misfits**2
    misfits: Array = np.sqrt(squares / freedom)
    return misfits


# The calibration.


FEWEST_SAMPLES = 10
"""Minimum number of samples for a fit."""
UNKNOWN_SHARE = 0.5
"""A parameter is unknown if this share of its square lies in unknown directions."""
DEGREE = math.degrees(1.0)
CLOSE_TOGETHER = 0.1
"""Poses are, if they spread over no more than this share of the box around the rig on any axis."""
MOST_APART = math.radians(45.0)
"""An IMU's vertical farther from that of the pose is in other axes, [rad]."""


@dataclass(frozen=True, eq=False)
class RigCalibration:
    """A rig's parameters estimated from measurements.

    Attributes:
        parameters: The unknowns and the rig file.
        measured: The samples used, without outliers, with deviations by `pose_scales`.
        fit: Best fit; unidentifiable directions are left as in the rig file.
        observability: Directions that the data determine.
        uncertainty: Of the unknowns.
        length_deviation: Of a cable's length from the encoder, with measured tension, [m].
        pose_scales: Ratios of the deviations of measured positions and rotations to the stated
            ones, shape (2,).
    """

    parameters: Parameters
    measured: RigMeasurements
    fit: RigFit
    observability: Observability
    uncertainty: RigUncertainty
    length_deviation: float
    pose_scales: Array

    @property
    def rig(self) -> Rig:
        """As in its file."""
        return self.parameters.rig

    @cached_property
    def geometry(self) -> RigGeometry:
        """The estimated parameters."""
        return self.parameters.geometry(self.fit.values)

    @cached_property
    def held_out(self) -> HeldOut:
        """Cross-validation errors, from five fits without some of the samples.

        Raises:
            Fault: A part of the measurements cannot be fitted.
        """
        return held_out(self.parameters, self.measured, self.length_deviation)

    @cached_property
    def at_home_counts(self) -> Array:
        """Unstrained cable at the rig file's home counts, shape (m,), [m]."""
        return RigModel(self.parameters, self.measured).counted.at_home(self.geometry)

    @cached_property
    def not_identified(self) -> list[str]:
        """Sentences about what the data do not determine."""
        return sentences(self.observability, self.parameters) + self._missing_tensions()

    def _missing_tensions(self) -> list[str]:
        """Sentences about the tensions missing for the stiffness of each cable."""
        columns = self.parameters.slices().get("cable_stiffness")
        if columns is None:
            return []
        tensions = self.measured.tensions
        missing = int((~np.isfinite(tensions)).any(axis=1).sum())
        if missing:
            return [
                f"for the stiffness of each cable, tensions are missing at {missing} poses: use run"
                " folders, or the columns tension_1_n …"
            ]
        unknown = np.sum(self.observability.unknown[columns] ** 2, axis=1) > UNKNOWN_SHARE
        return [
            f"for the stiffness of cable {i + 1}, tensions that differ more are missing: they are"
            f" {tensions[:, i].min():.3g} to {tensions[:, i].max():.3g} N"
            for i in np.flatnonzero(unknown)
        ]

    @cached_property
    def intervals(self) -> dict[str, Interval]:
        """Estimates with 95 % intervals, by name with unit."""
        geometry, m = self.geometry, self.rig.cable_count
        found: dict[str, Interval] = {}
        drums = np.array([w.drum_mm_per_rev for w in self.rig.document.winches])
        tables: dict[str, tuple[Array, str, Array]] = {
            "outlets": (geometry.outlets.ravel() * 1e3, "_mm", np.full(3 * m, 1e3)),
            "anchors": (geometry.anchors.ravel() * 1e3, "_mm", np.full(3 * m, 1e3)),
            "pulleys": (np.array([geometry.pulley_radius * 1e3]), "_mm", np.array([1e3])),
            "drum_scale": (drums * (1.0 + geometry.drum_scale), "_mm_per_rev", drums),
            "offsets": (geometry.offsets * 1e3, "_mm", np.full(m, 1e3)),
        }
        tables["swivel_zeros"] = (np.degrees(geometry.swivel_zeros), "_deg", np.full(m, DEGREE))
        tables["imu_mounting"] = (np.degrees(geometry.imu_mounting), "_deg", np.full(3, DEGREE))
        half_widths = self.uncertainty.half_widths
        for group, columns in self.parameters.slices().items():
            names = self.parameters.names[columns]
            if group in ("stiffness", "cable_stiffness"):
                one = [geometry.stiffness.mean()] if group == "stiffness" else geometry.stiffness
                rows = zip(names, one, np.exp(half_widths[columns]), strict=True)
                # The interval is symmetric in the logarithm of the stiffness.
                found |= {f"{n}_n": Interval.by_factor(float(s), float(w)) for n, s, w in rows}
                continue
            values, unit, scale = tables[group]
            rows = zip(names, values, half_widths[columns] * scale, strict=True)
            found |= {f"{n}{unit}": Interval(float(v), float(w)) for n, v, w in rows}
        return found

    def error_of(self, group: str) -> float | None:
        """Error of a group's coordinates, 95 %, RMS, [m]; None if it is not estimated.

        Args:
            group: ``outlets`` or ``anchors``.
        """
        columns = self.parameters.slices().get(group)
        if columns is None:
            return None
        return float(np.sqrt(np.mean(self.uncertainty.half_widths[columns] ** 2)))

    def position_errors(self, positions: Array, rotations: Array) -> tuple[Array, Array, Array]:
        """Position errors of the platform at commanded poses, 95 %.

        Args:
            positions: World frame, shape (k, 3), [m].
            rotations: ``world_from_platform``, shape (k, 3, 3).

        Returns:
            As by `RigUncertainty.worst`, and the parts that errors common to all measured poses
            and errors of measured tensions cause, shape (k,) each, [m].
        """
        there = _sent_to(self.rig, positions, rotations)
        line = RigModel(self.parameters, there).linearised(self.fit.values, positions, rotations)
        moved = -np.linalg.pinv(line.by_pose) @ line.by_values
        by_values, found = moved[:, :3], self.uncertainty
        return (
            found.worst(by_values),
            found.worst_by_common(by_values),
            found.worst_by_tensions(by_values),
        )

    def reached(self, positions: Array, rotations: Array) -> Array:
        """Positions that the platform reaches when the rig file's parameters command poses.

        Args:
            positions: World frame, shape (k, 3), [m].
            rotations: ``world_from_platform``, shape (k, 3, 3).

        Returns:
            Shape (k, 3), [m].
        """
        there = _sent_to(self.rig, positions, rotations)
        lengths = RigModel(self.parameters, there).counted.lengths(self.geometry)
        rig = rig_with(self.rig, self.geometry)
        return settled_poses_near(rig, lengths, positions, rotations)[0]


def fit_rig(
    rig: Rig,
    measured: RigMeasurements,
    deviations: Mapping[str, float],
    length_deviation: float,
) -> RigCalibration:
    """Calibrates the parameters of a rig.

    Args:
        rig: As in its file.
        deviations: Standard deviation of the rig file by parameter group; groups left out are
            taken as known.
        length_deviation: Of a cable's length from the encoder, with measured tension, [m].

    Raises:
        BadInput: Too few samples, a pose outside the rig, or nothing to estimate.
        Fault: The measurements cannot be fitted.
    """
    if len(measured) < FEWEST_SAMPLES:
        raise BadInput(
            f"only {len(measured)} stationary samples; {FEWEST_SAMPLES} required, 60 recommended",
            where="calibrate rig",
            next_step="measure at more poses: `cdpr calibrate poses` plans them",
        )
    _require_within(rig, measured)
    _require_sensors(rig, measured, deviations)
    swivels = np.isfinite(measured.swivels).any()
    estimated = {g: d for g, d in deviations.items() if swivels or g != "swivel_zeros"}
    parameters = Parameters.of(rig, estimated)
    if not len(parameters):
        raise BadInput(
            "there is nothing to calibrate",
            where="calibrate rig",
            why="every group of parameters is taken as known",
            next_step="leave out --known for one of them, in Python add it to deviations=",
        )
    fit, observability = identified(parameters, measured, length_deviation)
    agreeing = without_outliers(measured, fit, FEWEST_SAMPLES)
    if len(agreeing) < len(measured):
        measured = agreeing
        fit, observability = identified(parameters, measured, length_deviation)
    scales = pose_scales(measured, fit, observability)
    if 1.0 < scales.max() <= MOST_SCATTER:
        measured = measured.with_scaled_deviations(scales)
        fit, observability = identified(parameters, measured, length_deviation)
    return RigCalibration(
        parameters,
        measured,
        fit,
        observability,
        uncertainty_of_rig(parameters, measured, fit, observability),
        length_deviation,
        read_only(scales),
    )


def _require_within(rig: Rig, measured: RigMeasurements) -> None:
    """Refuses poses that the platform cannot reach, such as in a wrong unit.

    Until a rig is calibrated, poses at the edge of its workspace are a little outside, and the
    reflector may be so anyway: both have as much room as the platform and the reflector reach.
    Poses close together have none: in metres, they would all be near the world's origin.
    """
    corners = np.vstack([rig.outlets, rig.workspace_lower, rig.workspace_upper, rig.home.position])
    lower, upper = corners.min(axis=0), corners.max(axis=0)
    known = measured.positions[measured.has_position]
    if len(known) and (np.ptp(known, axis=0) > CLOSE_TOGETHER * (upper - lower)).any():
        room = rig.reach + float(np.linalg.norm(measured.reflectors, axis=1).max())
        lower, upper = lower - room, upper + room
    outside = ((measured.positions < lower) | (measured.positions > upper)).any(axis=1)
    if outside.any():
        k = int(np.argmax(outside))
        raise BadInput(
            f"the pose ({_mm(measured.positions[k])}) is outside the rig, which reaches from"
            f" ({_mm(lower)}) to ({_mm(upper)})",
            where=measured.names[k],
            why="a wrong unit or frame, or a false pose",
            next_step="check units and axes of x_mm, y_mm, z_mm, or leave out the line",
        )


def _require_sensors(rig: Rig, measured: RigMeasurements, deviations: Mapping[str, float]) -> None:
    """Checks that the rig has what sensors measure, and that an IMU's axes fit the platform's."""
    if np.isfinite(measured.swivels).any() and not rig.pulley_radius:
        raise BadInput(
            "the data have swivel angles, but the rig file has no pulleys",
            where="calibrate rig",
            next_step="add `pulleys` to the rig file, or leave out the columns swivel_1_deg …",
        )
    known = np.isfinite(measured.verticals).all(axis=1)
    if "imu_mounting" in deviations and not known.any():
        raise BadInput(
            "the IMU's mounting cannot be found: no data have its columns",
            where="calibrate rig",
            next_step="add the columns accel_x_m_s2, accel_y_m_s2, accel_z_m_s2, or leave out"
            " --imu-mounting-deg, in Python imu_mounting in deviations=",
        )
    upwards = measured.first_rotations(rig)[:, 2]
    apart = np.arccos(np.clip(np.sum(upwards * measured.verticals, axis=1), -1.0, 1.0))
    wrong = np.flatnonzero(apart > MOST_APART)
    if len(wrong):
        k = int(wrong[0])
        raise BadInput(
            f"the IMU's vertical is {math.degrees(apart[k]):.0f}° from that of the pose",
            where=measured.names[k],
            why="its axes are not the platform's, or its sign is inverted",
            next_step="give accelerations in the platform's axes; at rest, an accelerometer reads"
            " +9.81 m/s² along an axis that points up",
        )


def _mm(point: Array) -> str:
    return ", ".join(f"{x * 1e3:.4g}" for x in point) + " mm"


def _sent_to(rig: Rig, positions: Array, rotations: Array) -> RigMeasurements:
    """Samples with the drive positions of poses, by the rig file and with the home tensions."""
    anchors = positions[:, None, :] + np.einsum("kij,mj->kmi", rotations, rig.anchors)
    winches, tensions = WinchMap(rig), working_tensions(rig, rig.home).tensions
    counts = winches.counts(winches.unstrained(cables_to(rig, anchors).lengths, tensions))
    return RigMeasurements(
        names=("",) * len(positions),
        counts=counts,
        tensions=np.tile(tensions, (len(counts), 1)),
        positions=positions,
        rotations=rotations,
        covariances=np.zeros((len(positions), 6, 6)),
    )


_INSET = 0.15
"""The workspace is assessed at its centre and this share inside its corners."""


def workspace_poses(rig: Rig, tilt: float) -> tuple[Array, Array]:
    """Poses at the centre and near the corners of the workspace, rotated about ±x and ±y.

    Args:
        rig: As in its file.
        tilt: Angle of rotation, [rad]; 0 for the orientation of home only.

    Returns:
        Positions, shape (k, 3), [m], and rotations, shape (k, 3, 3).
    """
    centre = (rig.workspace_lower + rig.workspace_upper) / 2.0
    half = (0.5 - _INSET) * (rig.workspace_upper - rig.workspace_lower)
    corners = np.array(list(product((-1.0, 1.0), repeat=3))) * half
    positions = centre + np.concatenate([np.zeros((1, 3)), corners])
    axes = [(1, 0), (-1, 0), (0, 1), (0, -1)] if tilt else [(0, 0)]
    turns = [matrix_from_rotation_vector((tilt * x, tilt * y, 0.0)) for x, y in axes]
    rotations = np.array(turns) @ rig.home.rotation
    pairs = list(product(range(len(positions)), range(len(rotations))))
    return (
        np.array([positions[i] for i, _ in pairs]),
        np.array([rotations[j] for _, j in pairs]),
    )
