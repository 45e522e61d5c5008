"""How far cables at estimated poses are from the lengths that the drives tell, with derivatives.

All derivatives are analytic: moving an anchor by d shortens its cable by u · d, u the direction
from anchor to exit, with point exits and over pulleys alike; moving outlet and pulley lengthens it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.rig_measurements import RigMeasurements
from calibration.rig_parameters import CountedLengths, Parameters, RigGeometry, rig_with
from calibration.rig_tensions import likely_tensions, tension_doubt
from cdpr.cables import Cables, cables_to
from cdpr.poses import Array
from cdpr.rig import Rig


@dataclass(frozen=True, slots=True, eq=False)
class Linearised:
    """The model at given values and poses.

    Attributes:
        residuals: Cable at the pose less the cable that the drive tells, shape (n, m), [m].
        by_values: Their derivative by the unknowns, shape (n, m, p).
        by_pose: By the pose's twist (translation, rotation in the world), shape (n, m, 6).
    """

    residuals: Array
    by_values: Array
    by_pose: Array


class RigModel:
    """Lengths of cables of a rig with unknown numbers, at n poses."""

    def __init__(self, parameters: Parameters, measured: RigMeasurements) -> None:
        """Takes the measurements; tensions that were not measured are those of `likely_tensions`.

        Where some were not measured, nothing tells of the cables' stiffness.

        Raises:
            TensionInfeasible: The rig cannot hold its platform at home.
        """
        self.parameters = parameters
        self._told = np.isfinite(measured.tensions)
        self._stretch_is_told = bool(self._told.all())
        tensions = likely_tensions(parameters.rig, measured)
        self.counted = CountedLengths(parameters.rig, measured.counts, tensions)

    def length_deviations(self, length_deviation: float) -> Array:
        """How far off the lengths may be that drives tell, shape (n, m), [m].

        Args:
            length_deviation: With tensions that were measured, [m]; others add what they may
                stretch a cable of the rig file's stiffness.
        """
        rig, drawn = self.parameters.rig, self.parameters.geometry(np.zeros(len(self.parameters)))
        stretched = tension_doubt(rig) / rig.cable_stiffness * self.counted.by(drawn)
        deviations: Array = np.hypot(length_deviation, np.where(self._told, 0.0, stretched))
        return deviations

    def residuals(self, values: Array, positions: Array, rotations: Array) -> Array:
        """As in `Linearised`."""
        geometry = self.parameters.geometry(values)
        lengths = self._cables(geometry, positions, rotations).lengths
        residuals: Array = lengths - self.counted.by(geometry)
        return residuals

    def linearised(self, values: Array, positions: Array, rotations: Array) -> Linearised:
        """The model and its derivatives.

        Args:
            values: Of the unknowns, shape (p,).
            positions: World frame, shape (n, 3), [m].
            rotations: ``world_from_platform``, shape (n, 3, 3).

        Raises:
            NoCable: An anchor lies at its outlet or inside its pulley.
        """
        geometry = self.parameters.geometry(values)
        cables = self._cables(geometry, positions, rotations)
        arms = cables.anchors - positions[:, None, :]
        by_pose = -np.concatenate([cables.directions, np.cross(arms, cables.directions)], axis=-1)
        home = self.parameters.rig.home
        at_home = self._cables(geometry, home.position[None], home.rotation[None])
        stretch = self.counted.stretch(geometry)
        counted = (stretch / self.counted.stretch_at_home(geometry))[..., None]
        by_values = self._by_geometry(geometry, cables, rotations)
        by_values -= counted * self._by_geometry(geometry, at_home, home.rotation[None])
        each, places = np.arange(cables.lengths.shape[1]), self.parameters.slices()
        if "drum_scale" in places:
            by_values[:, each, places["drum_scale"].start + each] = -self.counted.paid_out * stretch
        if "offsets" in places:
            by_values[:, each, places["offsets"].start + each] = -stretch
        if "stiffness" in places and self._stretch_is_told:
            by_values[:, :, places["stiffness"].start] = (
                self.counted.by_compliance(geometry) / geometry.stiffness
            )
        return Linearised(cables.lengths - self.counted.by(geometry), by_values, by_pose)

    def _by_geometry(self, geometry: RigGeometry, cables: Cables, rotations: Array) -> Array:
        """Derivative of cables' lengths by the unknowns, without what drives count, (n, m, p)."""
        away = cables.directions
        n, m = cables.lengths.shape
        by_values, each = np.zeros((n, m, len(self.parameters))), np.arange(m)
        for group, place in self.parameters.slices().items():
            if group == "pulleys":
                by_values[:, :, place.start] = _by_pulley_radius(self._rig(geometry), cables)
            elif group in ("outlets", "anchors"):
                inward = -np.einsum("nji,nmj->nmi", rotations, away)
                own = away if group == "outlets" else inward
                for axis in range(3):
                    by_values[:, each, place.start + 3 * each + axis] = own[:, :, axis]
        return by_values

    def _rig(self, geometry: RigGeometry) -> Rig:
        return rig_with(self.parameters.rig, geometry)

    def _cables(self, geometry: RigGeometry, positions: Array, rotations: Array) -> Cables:
        anchors = positions[:, None, :] + np.einsum("nij,mj->nmi", rotations, geometry.anchors)
        return cables_to(self._rig(geometry), anchors)


def _by_pulley_radius(rig: Rig, cables: Cables) -> Array:
    """Derivative of lengths by the radius of the pulleys, shape (n, m); see `cdpr.cables`."""
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
