"""Parameters of a rig that a calibration estimates, their priors, and changes from the rig file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from model.errors import BadInput, positive_number
from model.pose import Array, read_only, skew
from model.rig import Rig

AXES = ("x", "y", "z")
_OF_ALL_CABLES = {"pulleys": "pulley_radius", "stiffness": "stiffness"}
"""Groups of one parameter, and its name."""
_OF_EACH_CABLE = {
    "drum_scale": "drum",
    "offsets": "offset",
    "cable_stiffness": "stiffness",
    "swivel_zeros": "swivel_zero",
}
"""Groups of one parameter per cable, and its name."""
_POINTS = {"outlets": "outlet", "anchors": "anchor"}
"""Groups of one point per cable, and its name."""

DEFAULT_DEVIATIONS: Mapping[str, float] = MappingProxyType(
    {
        "outlets": 4e-3,
        "anchors": 1e-3,
        "pulleys": 0.5e-3,
        "drum_scale": 0.005,
        "offsets": 2e-3,
        "stiffness": 0.2,
        "swivel_zeros": math.radians(1.0),
    }
)
"""Standard deviation of a rig file's values: [m], [rad]; drum_scale and stiffness are relative."""
_GROUPS = (*DEFAULT_DEVIATIONS, "cable_stiffness", "imu_mounting")
"""All groups, in order; cable_stiffness, instead of stiffness, and imu_mounting are opt-in."""


def checked_deviations(given: Mapping[str, float]) -> dict[str, float]:
    """Standard deviations by group, as a script passes them.

    Raises:
        BadInput: They are not a mapping, a group is unknown, or a number is not positive.
    """
    if not isinstance(given, Mapping):
        raise BadInput(f"deviations must be a mapping by group, it is {given!r}")
    unknown = [group for group in given if group not in _GROUPS]
    if unknown:
        raise BadInput(
            f"unknown parameter group {unknown[0]!r}", next_step=f"use any of: {', '.join(_GROUPS)}"
        )
    return {group: positive_number(f"deviation of {group}", x) for group, x in given.items()}


@dataclass(frozen=True, slots=True, eq=False)
class RigGeometry:
    """Parameters that determine cable lengths and drive counts, for m cables.

    Attributes:
        outlets: World frame, shape (m, 3), [m].
        anchors: Platform frame, shape (m, 3), [m].
        pulley_radius: [m]; 0 for point exits.
        drum_scale: Relative deviation of the cable per count from the rig file's, shape (m,).
        offsets: Unstrained cable at the home counts minus that of the home pose, shape (m,), [m]:
            the error of the homing reference.
        stiffness: Axial, of each cable, shape (m,), [N].
        swivel_zeros: Reading of the swivel encoders at angle 0, shape (m,), [rad].
        imu_mounting: Rotation vector of ``platform_from_imu``, shape (3,), [rad].
    """

    outlets: Array
    anchors: Array
    pulley_radius: float
    drum_scale: Array
    offsets: Array
    stiffness: Array
    swivel_zeros: Array
    imu_mounting: Array


@dataclass(frozen=True, slots=True, eq=False)
class Parameters:
    """Layout of the vector of unknowns; each is a deviation from the rig file.

    That of the stiffness is the logarithm of its ratio to the rig file's, so it stays positive.

    Attributes:
        rig: As in its file.
        groups: Names of the estimated groups, in order.
        deviations: Prior standard deviation of each unknown, shape (p,), [m], [rad] or relative.
        names: Of the p unknowns, such as ``outlet_3_x``.
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
            deviations: Standard deviations by group; groups left out are taken as known.
        """
        groups = tuple(
            group
            for group in _GROUPS
            if group in deviations
            and (group not in ("pulleys", "swivel_zeros") or rig.pulley_radius > 0.0)
        )
        names = tuple(name for group in groups for name in _names(group, rig.cable_count))
        spread = [deviations[group] for group in groups for _ in _names(group, rig.cable_count)]
        return cls(rig, groups, read_only(spread), names)

    def __len__(self) -> int:
        return len(self.names)

    def slices(self) -> dict[str, slice]:
        """Slice of each group in the vector."""
        found, begin = {}, 0
        for group in self.groups:
            end = begin + len(_names(group, self.rig.cable_count))
            found[group], begin = slice(begin, end), end
        return found

    def geometry(self, values: Array) -> RigGeometry:
        """The rig's parameters for values of the unknowns, shape (p,)."""
        m, found = self.rig.cable_count, self.slices()

        def of(group: str, size: int) -> Array:
            return values[found[group]] if group in found else np.zeros(size)

        return RigGeometry(
            outlets=self.rig.outlets + of("outlets", 3 * m).reshape(m, 3),
            anchors=self.rig.anchors + of("anchors", 3 * m).reshape(m, 3),
            pulley_radius=self.rig.pulley_radius + float(of("pulleys", 1)[0]),
            drum_scale=of("drum_scale", m),
            offsets=of("offsets", m),
            stiffness=self.rig.cable_stiffness
            * np.exp(of("stiffness", 1) + of("cable_stiffness", m)),
            swivel_zeros=of("swivel_zeros", m),
            imu_mounting=of("imu_mounting", 3),
        )

    def tension_scores(self, squares: Array) -> Array:
        """Half the gradient of squares by errors of measured tensions, shape (p,), in `deviations`.

        Args:
            squares: Growth of each cable's squares by these errors, shape (m,).
        """
        scores, slices = np.zeros(len(self)), self.slices()
        if "stiffness" in slices:
            scores[slices["stiffness"]] = squares.sum()
        if "cable_stiffness" in slices:
            scores[slices["cable_stiffness"]] = squares
        return np.asarray(scores * self.deviations)


def _names(group: str, m: int) -> list[str]:
    if group in _OF_ALL_CABLES:
        return [_OF_ALL_CABLES[group]]
    if group in _POINTS:
        return [f"{_POINTS[group]}_{i}_{axis}" for i in range(1, m + 1) for axis in AXES]
    if group in _OF_EACH_CABLE:
        return [f"{_OF_EACH_CABLE[group]}_{i}" for i in range(1, m + 1)]
    return [f"{group}_{axis}" for axis in AXES]


def rig_with(rig: Rig, geometry: RigGeometry) -> Rig:
    """The rig with these outlets, anchors, pulleys and stiffness; its winches are unchanged."""
    return replace(
        rig,
        outlets=read_only(geometry.outlets),
        anchors=read_only(geometry.anchors),
        pulley_radius=geometry.pulley_radius,
        cable_stiffness=geometry.stiffness,
    )


_UNITS = {
    **dict.fromkeys(("drum_scale", "stiffness", "cable_stiffness"), "percent"),
    **dict.fromkeys(("swivel_zeros", "imu_mounting"), "deg"),
}
"""Unit in the option of a group; mm for the others."""


def option_of(group: str) -> str:
    """Option of `cdpr calibrate rig` with the standard deviation of a group."""
    return f"--{group.replace('_', '-').removeprefix('cable-')}-{_UNITS.get(group, 'mm')}"


def deviation_text(group: str, value: float) -> str:
    """Deviation from the rig file as text; of a stiffness it is the logarithm."""
    if _UNITS.get(group) == "deg":
        return f"{math.degrees(abs(value)):.3g}°"
    if group in ("stiffness", "cable_stiffness"):
        return f"{math.exp(value):.3g} times that of the rig file, as a logarithm"
    if group == "drum_scale":
        return f"{abs(value) * 1e2:.3g} % from the rig file"
    return f"{abs(value) * 1e3:.3g} mm from the rig file"


def common_changes(parameters: Parameters, values: Array, covariance: Array) -> tuple[Array, Array]:
    """Displacement, rotation and growth that the outlets share, the latter with the drums.

    Measured positions with a wrong scale or in another frame change a rig in this way.

    Args:
        values: Of the unknowns, shape (p,).
        covariance: Of the values, without that of the rig file, shape (p, p).

    Returns:
        The best fit, shape (7,), [m], [rad] and relative, and its covariance, shape (7, 7); by
        independent errors of the rig file and those of the values. 0 without outlets.
    """
    slices, rig = parameters.slices(), parameters.rig
    if "outlets" not in slices:
        return np.zeros(7), np.eye(7)
    centred = rig.outlets - rig.outlets.mean(axis=0)
    slopes = np.zeros((len(parameters), 7))
    of_outlets = np.zeros((*centred.shape, 7))
    of_outlets[..., :3] = np.eye(3)
    of_outlets[..., 3:6] = -skew(centred)
    of_outlets[..., 6] = centred
    slopes[slices["outlets"]] = of_outlets.reshape(-1, 7)
    if "drum_scale" in slices:
        slopes[slices["drum_scale"], 6] = 1.0
    rows = slopes.any(axis=1)
    whole = covariance[np.ix_(rows, rows)] + np.diag(parameters.deviations[rows] ** 2)
    weighted = np.linalg.solve(whole, slopes[rows])
    spread = np.linalg.inv(slopes[rows].T @ weighted)
    return spread @ weighted.T @ values[rows], spread


CONTRADICTION = 4.0
"""This many standard deviations from the rig file are significant."""
LEAST_CHANCE = 1e-3
"""Cables differ if chance explains the differences with a lower probability."""


@dataclass(frozen=True, slots=True)
class Compliance:
    """Estimate of the cables' compliance, 1 / stiffness; of the mean if they differ.

    Attributes:
        nominal: Of the rig file, to first order about the fit, [1/N].
        estimated: From the data, [1/N].
        deviation: Standard deviation of the difference, [1/N].
    """

    nominal: float
    estimated: float
    deviation: float

    @property
    def contradicts(self) -> bool:
        """Whether the data contradict the rig file."""
        return abs(self.estimated - self.nominal) > CONTRADICTION * self.deviation

    def __str__(self) -> str:
        """The estimated stiffness as text."""
        if self.estimated > 0.0:
            return f"about {1.0 / self.estimated:.2g} N"
        return "too high to determine"


@dataclass(frozen=True, slots=True)
class CableCompliances:
    """Estimate of each cable's own compliance.

    Attributes:
        estimated: Shape (m,), [1/N].
        chance: Probability of such differences by chance (p-value).
    """

    estimated: Array
    chance: float

    @property
    def contradict(self) -> bool:
        """Whether one compliance for all cables does not explain the data."""
        return self.chance < LEAST_CHANCE

    def __str__(self) -> str:
        """The estimated stiffnesses as text."""
        estimated = (
            f"{1.0 / c:.2g} N" if c > 0.0 else "too high to determine" for c in self.estimated
        )
        return ", ".join(estimated)
