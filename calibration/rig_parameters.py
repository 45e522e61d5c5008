"""The numbers of a rig that a calibration finds, in named groups, and what the rig file says."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from cdpr.kinematics import cable_lengths
from cdpr.poses import Array, read_only
from cdpr.rig import Rig
from cdpr.statics.working import working_tensions
from cdpr.winches import WinchMap

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
        rig: As its file tells it.
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
            rig: As its file tells it.
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
    """Cable lengths that drive positions and tensions tell.

    Attributes:
        paid_out: Unstrained cable since the home counts by the rig file's drums, shape (n, m), [m].
    """

    def __init__(self, rig: Rig, counts: Array, tensions: Array) -> None:
        """Takes the rig file's winches.

        Args:
            rig: As its file tells it.
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
