"""A rig with pulleys that differs from its file, and the readings of its sensors.

No formula is from `calibration`: angles use scipy's rotations, lengths the complex plane of each
pulley. Tensions are random within the rig's limits, as with a different load at each pose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from calibration.geometry.measurements import RigMeasurements
from model.pose import Array
from model.rig import Rig
from model.statics.gravity import working_tensions

LENGTH_NOISE, POSITION_NOISE, TURN_NOISE = 0.1e-3, 0.2e-3, 0.5e-3
ANGLE_NOISE = float(np.radians(0.1))
"""Noise of swivel angles, and of the IMU's vertical, [rad]."""
SPREAD: Mapping[str, tuple[float, int]] = {
    "outlets": (4e-3, 3),
    "anchors": (1e-3, 3),
    "drum_scale": (0.005, 1),
    "offsets": (2e-3, 1),
    "stiffness": (0.2, 1),
    "swivel_zeros": (float(np.radians(1.0)), 1),
}
"""Standard deviation of a cable's parameters, [m], [rad] or relative, and their number."""


@dataclass(frozen=True)
class BuiltRig:
    """Ground truth of a rig: deviations from its file, in the units of a calibration.

    Attributes:
        rig: As in its file.
        off: By group, values of all cables in order; stiffness as a logarithm.
    """

    rig: Rig
    off: Mapping[str, Array]

    @property
    def stiffness(self) -> Array:
        """E·A of each cable, shape (m,), [N]."""
        return np.asarray(self.rig.cable_stiffness * np.exp(self.off["stiffness"]))

    def values(self, groups: Sequence[str]) -> Array:
        """The true values of a calibration's unknowns."""
        return np.concatenate([self.off[group.removeprefix("cable_")] for group in groups])


def built_rig(rig: Rig, seed: int, imu_mounting_deg: float = 1.0, alike: bool = False) -> BuiltRig:
    """A rig with random errors.

    Args:
        rig: As in its file.
        seed: Of the errors.
        imu_mounting_deg: Standard deviation of the IMU's mounting rotation.
        alike: All cables have the same stiffness.
    """
    random, m = np.random.default_rng(seed), rig.cable_count
    off = {g: size * random.standard_normal(k * m) for g, (size, k) in SPREAD.items()}
    if alike:
        off["stiffness"][:] = off["stiffness"][0]
    off["pulleys"] = 0.5e-3 * random.standard_normal(1)
    off["imu_mounting"] = np.radians(imu_mounting_deg) * random.standard_normal(3)
    return BuiltRig(rig, off)


def measured(
    built: BuiltRig, count: int, seed: int, noise: float = 1.0, steady: int | None = None
) -> RigMeasurements:
    """All measurements of a rig at random poses, tilted by up to 8 degrees.

    Args:
        built: The truth.
        count: Number of poses.
        seed: Of the poses and the noise.
        noise: Of all measurements, relative to the usual.
        steady: Number of a cable with the same tension at all poses.
    """
    random, rig, off = np.random.default_rng(seed), built.rig, built.off
    m, span = rig.cable_count, rig.workspace_upper - rig.workspace_lower
    outlets = rig.outlets + off["outlets"].reshape(m, 3)
    anchors = rig.anchors + off["anchors"].reshape(m, 3)
    radius = rig.pulley_radius + off["pulleys"][0]
    turns = Rotation.from_rotvec(np.radians(8.0) * random.uniform(-1.0, 1.0, (count, 3)))
    positions = rig.workspace_lower + random.uniform(0.1, 0.9, (count, 3)) * span
    home = rig.home.apply(anchors) - outlets
    vectors = turns.as_matrix() @ anchors.T
    vectors = positions[:, None] + np.swapaxes(vectors, 1, 2) - outlets

    tensions = random.uniform(rig.min_tension, rig.max_tension, (count, m))
    if steady is not None:
        tensions[:, steady - 1] = tensions[0, steady - 1]
    behind = np.array([w.drum_to_outlet for w in rig.winches])
    at_home = (_lengths(home, rig.feed_directions, radius) + behind) / (
        1.0 + working_tensions(rig, rig.home).tensions / built.stiffness
    )
    lengths = _lengths(vectors, rig.feed_directions, radius)
    lengths = lengths + noise * LENGTH_NOISE * random.standard_normal((count, m))
    unstrained = (lengths + behind) / (1.0 + tensions / built.stiffness)
    paid_out = (unstrained - at_home - off["offsets"]) / (1.0 + off["drum_scale"])
    winches = np.array([[w.home_counts, w.counts_per_metre] for w in rig.winches]).T

    drawn = rig.home.apply(rig.anchors) - rig.outlets
    swivels = np.array([_angles(drawn, vector, rig.feed_directions) for vector in vectors])
    swivels = swivels + off["swivel_zeros"]
    swivels = swivels + noise * ANGLE_NOISE * random.standard_normal((count, m))
    mounting = Rotation.from_rotvec(off["imu_mounting"])
    shaken = Rotation.from_rotvec(noise * ANGLE_NOISE * random.standard_normal((count, 3)))
    verticals = shaken.apply((turns * mounting).inv().apply([0.0, 0.0, 1.0]))

    seen = Rotation.from_rotvec(noise * TURN_NOISE * random.standard_normal((count, 3))) * turns
    return RigMeasurements(
        names=tuple(f"sample {k}" for k in range(count)),
        counts=winches[0] + winches[1] * paid_out,
        tensions=tensions,
        positions=positions + noise * POSITION_NOISE * random.standard_normal((count, 3)),
        rotations=seen.as_matrix(),
        covariances=np.tile(np.diag([POSITION_NOISE**2] * 3 + [TURN_NOISE**2] * 3), (count, 1, 1)),
        swivels=swivels,
        verticals=verticals,
        swivel_deviation=ANGLE_NOISE,
        imu_deviation=ANGLE_NOISE,
    )


def only(data: RigMeasurements, *sensors: str) -> RigMeasurements:
    """The measurements with some of their sensors: ``swivels``, ``verticals``."""
    empty = {key: np.empty((0, 0)) for key in ("swivels", "verticals") if key not in sensors}
    return replace(data, **empty)  # type: ignore[arg-type]


def _lengths(vectors: Array, axes: Array, radius: float) -> Array:
    """From outlets over pulleys to anchors: arc and tangent in the plane of each pulley.

    The plane's real axis points from the outlet to the pulley's centre, its imaginary axis along
    the feed; the cable enters the pulley at 0.
    """
    along = np.sum(vectors * axes, axis=-1)
    across = np.linalg.norm(np.cross(vectors, axes), axis=-1)
    anchor = across + 1j * along
    to_anchor = anchor - radius
    straight = np.sqrt(np.abs(to_anchor) ** 2 - radius**2)
    leaves = np.angle(to_anchor / (radius - 1j * straight))  # radius and tangent at right angles
    arc = np.mod(np.pi - leaves, 2.0 * np.pi)
    return np.asarray(radius * arc + straight)


def _angles(before: Array, after: Array, axes: Array) -> Array:
    """Rotation about each axis from the plane through one vector to another, [rad]."""
    x, y = (
        vector - np.sum(vector * axes, axis=1, keepdims=True) * axes for vector in (before, after)
    )
    sine, cosine = np.sum(np.cross(x, y) * axes, axis=1), np.sum(x * y, axis=1)
    return np.asarray(np.arctan2(sine, cosine))
