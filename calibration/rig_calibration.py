"""Finds a rig's numbers from drive positions at rest, and how well they are known."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calibration.interval import Interval
from calibration.rig_fit import RigFit
from calibration.rig_held_out import HeldOut, held_out
from calibration.rig_measurements import RigMeasurements
from calibration.rig_model import RigModel
from calibration.rig_observability import Observability, identified, sentences
from calibration.rig_outliers import without_outliers
from calibration.rig_parameters import Parameters, RigGeometry, rig_with
from calibration.rig_uncertainty import RigUncertainty, uncertainty_of_rig
from cdpr.cables import cables_to
from cdpr.errors import BadInput
from cdpr.kinematics import poses_near
from cdpr.poses import Array
from cdpr.rig import Rig
from cdpr.statics.working import working_tensions
from cdpr.winches import WinchMap

FEWEST_PLACES = 10
"""Fewer say too little to be fitted at all."""


@dataclass(frozen=True, eq=False)
class RigCalibration:
    """A rig's numbers from measurements.

    Attributes:
        parameters: The unknowns and the rig file.
        measured: What they are from, without places that contradict the others.
        fit: The best fit that leaves what cannot be identified as in the rig file.
        observability: What the data tell.
        uncertainty: Of the unknowns.
        held_out: Places left out of fits.
        length_deviation: Of a cable's length as a drive tells it, its tension measured, [m].
    """

    parameters: Parameters
    measured: RigMeasurements
    fit: RigFit
    observability: Observability
    uncertainty: RigUncertainty
    held_out: HeldOut
    length_deviation: float

    @property
    def rig(self) -> Rig:
        """As its file tells it."""
        return self.parameters.rig

    @cached_property
    def geometry(self) -> RigGeometry:
        """The rig as found."""
        return self.parameters.geometry(self.fit.values)

    @cached_property
    def at_home_counts(self) -> Array:
        """Unstrained cable at the rig file's home counts, shape (m,), [m]."""
        return RigModel(self.parameters, self.measured).counted.at_home(self.geometry)

    @cached_property
    def not_identified(self) -> list[str]:
        """What the data do not tell, in words."""
        return sentences(self.observability, self.parameters)

    @cached_property
    def intervals(self) -> dict[str, Interval]:
        """What was found, by name with unit, 95 %."""
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
        half_widths = self.uncertainty.half_widths
        for group, place in self.parameters.slices().items():
            if group == "stiffness":
                found["stiffness_n"] = self._stiffness()
                continue
            values, unit, scale = tables[group]
            widths = half_widths[place] * scale
            rows = zip(self.parameters.names[place], values, widths, strict=True)
            found |= {f"{n}{unit}": Interval(float(v), float(w)) for n, v, w in rows}
        return found

    def _stiffness(self) -> Interval:
        """Of the cables, [N]: its logarithm is as uncertain to both sides, itself is not."""
        width = float(self.uncertainty.half_widths[self.parameters.slices()["stiffness"]][0])
        stiffness = self.geometry.stiffness
        return Interval.between(stiffness * math.exp(-width), stiffness * math.exp(width))

    def position_error(self, positions: Array, rotations: Array) -> Array:
        """How far off the platform may be where its drives are told to bring it, 95 %.

        Args:
            positions: World frame, shape (k, 3), [m].
            rotations: ``world_from_platform``, shape (k, 3, 3).

        Returns:
            Along the worst direction, shape (k,), [m].
        """
        there = _sent_to(self.rig, positions, rotations)
        line = RigModel(self.parameters, there).linearised(self.fit.values, positions, rotations)
        moved = -np.linalg.pinv(line.by_pose) @ line.by_values
        return self.uncertainty.worst(moved[:, :3])

    def reached(self, positions: Array, rotations: Array) -> Array:
        """Where the platform truly goes when the rig file's numbers are to bring it to poses.

        Args:
            positions: World frame, shape (k, 3), [m].
            rotations: ``world_from_platform``, shape (k, 3, 3).

        Returns:
            Shape (k, 3), [m].
        """
        there = _sent_to(self.rig, positions, rotations)
        lengths = RigModel(self.parameters, there).counted.by(self.geometry)
        rig = rig_with(self.rig, self.geometry)
        return poses_near(rig, lengths, positions, rotations, steps=10)[0]


def calibrate_rig(
    rig: Rig,
    measured: RigMeasurements,
    deviations: Mapping[str, float],
    length_deviation: float,
) -> RigCalibration:
    """Finds the numbers of a rig.

    Args:
        rig: As its file tells it.
        measured: Places at rest.
        deviations: How far off the rig file may be by group of numbers; groups left out are taken
            as known.
        length_deviation: Of a cable's length as a drive tells it, its tension measured, [m].

    Raises:
        BadInput: Too few places, a pose outside the rig, or nothing to look for.
        Fault: The measurements cannot be fitted.
    """
    if len(measured) < FEWEST_PLACES:
        raise BadInput(
            f"only {len(measured)} places at rest, {FEWEST_PLACES} are needed and 60 are good",
            where="calibrate rig",
            next_step="measure in more places: `cdpr calibrate poses` plans them",
        )
    _require_within(rig, measured)
    parameters = Parameters.of(rig, deviations)
    if not len(parameters):
        raise BadInput(
            "there is nothing to look for",
            where="calibrate rig",
            why="every group of numbers is taken as known",
            next_step="leave out --known for one of them",
        )
    fit, observability = identified(parameters, measured, length_deviation)
    agreeing = without_outliers(measured, fit, FEWEST_PLACES)
    if len(agreeing) < len(measured):
        measured = agreeing
        fit, observability = identified(parameters, measured, length_deviation)
    return RigCalibration(
        parameters,
        measured,
        fit,
        observability,
        uncertainty_of_rig(parameters, measured, fit, observability),
        held_out(parameters, measured, length_deviation),
        length_deviation,
    )


def _require_within(rig: Rig, measured: RigMeasurements) -> None:
    """Poses are where the platform can be: numbers in another unit are not.

    Raises:
        BadInput: One is outside the box around outlets, home and workspace.
    """
    corners = np.vstack([rig.outlets, rig.workspace_lower, rig.workspace_upper, rig.home.position])
    lower, upper = corners.min(axis=0), corners.max(axis=0)
    outside = ((measured.positions < lower) | (measured.positions > upper)).any(axis=1)
    if outside.any():
        k = int(np.argmax(outside))
        raise BadInput(
            f"the pose ({_mm(measured.positions[k])}) is outside the rig, whose outlets and"
            f" workspace reach from ({_mm(lower)}) to ({_mm(upper)})",
            where=measured.names[k],
            why="another unit or frame, or a pose that was mistaken",
            next_step="check units and axes of x_mm, y_mm, z_mm, or leave out the line",
        )


def _mm(point: Array) -> str:
    return ", ".join(f"{x * 1e3:.4g}" for x in point) + " mm"


def _sent_to(rig: Rig, positions: Array, rotations: Array) -> RigMeasurements:
    """Places with the drive positions of poses, by the rig file and under the tensions of home."""
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
