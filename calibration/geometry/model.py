"""How far cables at estimated poses are from the encoders' lengths, with derivatives.

All derivatives are analytic: moving an anchor by d shortens its cable by u · d, u the direction
from anchor to exit, with point exits and over pulleys alike; moving outlet and pulley lengthens it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from calibration.geometry.measurements import RigMeasurements, nominal_tensions, tension_sigma
from model.kinematics import Cables, cable_lengths, cables_to
from model.pose import Array, read_only
from model.rig import Rig
from model.statics.gravity import working_tensions
from model.winches import WinchMap

# The numbers of a rig that a calibration finds, in named groups, and what the rig file says.


AXES = ("x", "y", "z")
_OF_ALL_CABLES = {"pulleys": "pulley_radius", "stiffness": "stiffness"}
"""Groups of one number, and its name."""

DEFAULT_DEVIATIONS: Mapping[str, float] = MappingProxyType(
    {
        "outlets": 4e-3,
        "anchors": 1e-3,
        "pulleys": 0.5e-3,
        "drum_scale": 0.005,
        "offsets": 2e-3,
        "stiffness": 0.2,
    }
)
"""How far off a rig file may be, one standard deviation: [m]; drum_scale and stiffness as a share.
"""


@dataclass(frozen=True, slots=True, eq=False)
class RigGeometry:
    """What decides how long cables are and what drives count, for m cables.

    Attributes:
        outlets: World frame, shape (m, 3), [m].
        anchors: Platform frame, shape (m, 3), [m].
        pulley_radius: [m]; 0 for point exits.
        drum_scale: Cable paid out for a count, as a share of the rig file's, less 1, shape (m,).
        offsets: Unstrained cable at the home counts beyond what reaches the home pose, shape (m,),
            [m]: by how much the reference was off.
        stiffness: Axial, of a cable, [N].
    """

    outlets: Array
    anchors: Array
    pulley_radius: float
    drum_scale: Array
    offsets: Array
    stiffness: float


@dataclass(frozen=True, slots=True, eq=False)
class Parameters:
    """The layout of the vector of unknowns; each is a deviation from the rig file.

    That of the stiffness is the logarithm of its share: near 0 the share less 1, never negative.

    Attributes:
        rig: As in its file.
        groups: Names of the groups that are looked for, in order.
        deviations: How far off each unknown may be, standard deviation, shape (p,), [m] or share.
        names: Of the unknowns, such as ``outlet_3_x``; p texts.
    """

    rig: Rig
    groups: tuple[str, ...]
    deviations: Array
    names: tuple[str, ...]

    @classmethod
    def of(cls, rig: Rig, deviations: Mapping[str, float]) -> Parameters:
        """The unknowns of a rig.

        Args:
            rig: As in its file.
            deviations: How far off it may be, by group; groups left out are taken as known.
        """
        groups = tuple(
            group
            for group in DEFAULT_DEVIATIONS
            if group in deviations and (group != "pulleys" or rig.pulley_radius > 0.0)
        )
        names = tuple(name for group in groups for name in _names(group, rig.cable_count))
        spread = [deviations[group] for group in groups for _ in _names(group, rig.cable_count)]
        return cls(rig, groups, read_only(spread), names)

    def __len__(self) -> int:
        return len(self.names)

    def slices(self) -> dict[str, slice]:
        """Where each group is in the vector."""
        found, begin = {}, 0
        for group in self.groups:
            end = begin + len(_names(group, self.rig.cable_count))
            found[group], begin = slice(begin, end), end
        return found

    def geometry(self, values: Array) -> RigGeometry:
        """The rig with the unknowns having values, shape (p,), [m] or share."""
        m, found = self.rig.cable_count, self.slices()

        def of(group: str, size: int) -> Array:
            return values[found[group]] if group in found else np.zeros(size)

        return RigGeometry(
            outlets=self.rig.outlets + of("outlets", 3 * m).reshape(m, 3),
            anchors=self.rig.anchors + of("anchors", 3 * m).reshape(m, 3),
            pulley_radius=self.rig.pulley_radius + float(of("pulleys", 1)[0]),
            drum_scale=of("drum_scale", m),
            offsets=of("offsets", m),
            stiffness=self.rig.cable_stiffness * math.exp(float(of("stiffness", 1)[0])),
        )


def _names(group: str, m: int) -> list[str]:
    if group in _OF_ALL_CABLES:
        return [_OF_ALL_CABLES[group]]
    what = {"outlets": "outlet", "anchors": "anchor", "drum_scale": "drum", "offsets": "offset"}
    if group in ("outlets", "anchors"):
        return [f"{what[group]}_{i}_{axis}" for i in range(1, m + 1) for axis in AXES]
    return [f"{what[group]}_{i}" for i in range(1, m + 1)]


def rig_with(rig: Rig, geometry: RigGeometry) -> Rig:
    """The rig file's rig with other outlets, anchors, pulleys and stiffness; its winches stay."""
    return replace(
        rig,
        outlets=read_only(geometry.outlets),
        anchors=read_only(geometry.anchors),
        pulley_radius=geometry.pulley_radius,
        cable_stiffness=geometry.stiffness,
    )


class CountedLengths:
    """Cable lengths from drive positions and tensions.

    Attributes:
        paid_out: Unstrained cable since the home counts by the rig file's drums, shape (n, m), [m].
    """

    def __init__(self, rig: Rig, counts: Array, tensions: Array) -> None:
        """Takes the rig file's winches.

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

    def by(self, geometry: RigGeometry) -> Array:
        """Lengths from outlet to anchor with other numbers of the rig, shape (n, m), [m]."""
        paid_out = self.paid_out * (1.0 + geometry.drum_scale)
        unstrained = self.at_home(geometry) + paid_out
        lengths: Array = unstrained * self.stretch(geometry) - self._behind
        return lengths

    def by_compliance(self, geometry: RigGeometry) -> Array:
        """Derivative of `by` by the cables' compliance, 1 / stiffness, shape (n, m), [m N]."""
        at_home = self.at_home(geometry)
        unstrained = at_home + self.paid_out * (1.0 + geometry.drum_scale)
        less = (at_home - geometry.offsets) * self._at_home / self.stretch_at_home(geometry)
        change: Array = unstrained * self._tensions - self.stretch(geometry) * less
        return change


@dataclass(frozen=True, slots=True, eq=False)
class Linearised:
    """The model at given values and poses.

    Attributes:
        residuals: Cable at the pose less the cable from the encoder, shape (n, m), [m].
        by_values: Their derivative by the unknowns, shape (n, m, p).
        by_pose: By the pose's twist (translation, rotation in the world), shape (n, m, 6).
    """

    residuals: Array
    by_values: Array
    by_pose: Array


class RigModel:
    """Lengths of cables of a rig with unknown numbers, at n poses."""

    def __init__(self, parameters: Parameters, measured: RigMeasurements) -> None:
        """Takes the measurements; tensions that were not measured are those of `nominal_tensions`.

        Where some were not measured, nothing shows the cables' stiffness.

        Raises:
            TensionInfeasible: The rig cannot hold its platform at home.
        """
        self.parameters = parameters
        self._told = np.isfinite(measured.tensions)
        self._stretch_is_told = bool(self._told.all())
        tensions = nominal_tensions(parameters.rig, measured)
        self.counted = CountedLengths(parameters.rig, measured.counts, tensions)

    def length_deviations(self, length_deviation: float) -> Array:
        """Standard deviation of the lengths from the encoders, shape (n, m), [m].

        Args:
            length_deviation: With tensions that were measured, [m]; others add what they may
                stretch a cable of the rig file's stiffness.
        """
        rig, drawn = self.parameters.rig, self.parameters.geometry(np.zeros(len(self.parameters)))
        stretched = tension_sigma(rig) / rig.cable_stiffness * self.counted.by(drawn)
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
