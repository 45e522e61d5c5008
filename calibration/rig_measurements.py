"""What a rig's calibration is made from: drive positions at rest, tensions, and poses if known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from calibration.data_hash import data_hash
from cdpr.poses import Array, read_only

SHORTEST_REST = 0.4
"""The drives are told to stand still for longer before it counts as rest, [s]."""
SETTLING = 0.2
"""What comes sooner after they stopped does not count, [s]."""

_ARRAYS = ("counts", "tensions", "positions", "rotations", "covariances")


@dataclass(frozen=True, slots=True, eq=False)
class RigMeasurements:
    """The platform at rest in n places, with m cables.

    Attributes:
        names: Of the places, n texts.
        counts: Drive positions, shape (n, m), [counts].
        tensions: Shape (n, m), [N]; NaN where they were not measured.
        positions: World frame, shape (n, 3), [m]; NaN where the pose is not known.
        rotations: ``world_from_platform``, shape (n, 3, 3); NaN where the pose is not known.
        covariances: Of position and rotation vector about world axes, shape (n, 6, 6).
        unused: Why others were left out, by name.
    """

    names: tuple[str, ...]
    counts: Array
    tensions: Array
    positions: Array
    rotations: Array
    covariances: Array
    unused: Mapping[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def posed(self) -> NDArray[np.bool_]:
        """Where the pose was measured, shape (n,)."""
        return np.asarray(np.isfinite(self.positions).all(axis=1))

    @property
    def data_hash(self) -> str:
        """Hash of all numbers."""
        numbers = (self.counts, self.tensions, self.positions, self.rotations)
        return data_hash(np.round(values, 12).tobytes() for values in numbers)

    def part(self, chosen: NDArray[np.bool_]) -> RigMeasurements:
        """Some of the places."""
        return RigMeasurements(
            names=tuple(n for n, yes in zip(self.names, chosen.tolist(), strict=True) if yes),
            unused=self.unused,
            **{key: read_only(getattr(self, key)[chosen]) for key in _ARRAYS},
        )

    def with_doubt(self, deviations: Array) -> RigMeasurements:
        """The same, poses less certain: errors that all pictures of a place have in common.

        Args:
            deviations: Of camera and tags, shape (6,), [m, rad].
        """
        more = self.covariances + np.diag(np.square(deviations))
        return replace(self, covariances=read_only(more))

    def without_poses(self) -> RigMeasurements:
        """The same drive positions, as if nobody had looked at the platform."""
        positions, rotations = (np.full_like(a, np.nan) for a in (self.positions, self.rotations))
        return replace(self, positions=positions, rotations=rotations)


def joined(parts: Sequence[RigMeasurements]) -> RigMeasurements:
    """Several sources as one; a place with the numbers of an earlier one is told as unused."""
    arrays = {
        key: read_only(np.concatenate([getattr(part, key) for part in parts])) for key in _ARRAYS
    }
    names = tuple(name for part in parts for name in part.names)
    unused = {name: why for part in parts for name, why in part.unused.items()}
    first: dict[bytes, str] = {}
    new = np.ones(len(names), dtype=bool)
    for k, name in enumerate(names):
        numbers = b"".join(arrays[key][k].tobytes() for key in _ARRAYS[:-1])
        earlier = first.setdefault(numbers, name)
        if earlier is not name:
            new[k] = False
            unused[name] = f"has the same numbers as {earlier}"
    return RigMeasurements(names=names, unused=unused, **arrays).part(new)


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """What was recorded of one run.

    Attributes:
        time: Of the cycles, shape (n,), [s].
        asked: Set-points, shape (n, m), [counts].
        counts: Drive positions, shape (n, m), [counts].
        tensions: Shape (n, m), [N].
        seen: Times of the pictures that gave a pose, shape (k,), [s].
        positions: Measured there, world frame, shape (k, 3), [m].
        rotations: ``world_from_platform``, shape (k, 3, 3).
        covariances: Shape (k, 6, 6), [m, rad].
    """

    time: Array
    asked: Array
    counts: Array
    tensions: Array
    seen: Array
    positions: Array
    rotations: Array
    covariances: Array


def at_rest(name: str, run: Recording) -> RigMeasurements:
    """The places at which the platform stood still, each with the means of what was measured.

    Pictures of one place have their errors in common: their mean is no more certain than each.

    Args:
        name: Of the run, for the places' names.
        run: What was recorded.
    """
    names, rows, unused = [], [], {}
    for number, (begin, end) in enumerate(_rests(run), start=1):
        place = f"{name}, rest {number}"
        cycles = (run.time >= begin) & (run.time <= end)
        pictures = (run.seen >= begin) & (run.seen <= end)
        if len(run.seen) and not pictures.any():
            unused[place] = "no picture taken there gave a pose"
            continue
        names.append(place)
        means = (run.counts[cycles].mean(axis=0), run.tensions[cycles].mean(axis=0))
        rows.append((*means, *_mean_pose(run, pictures)))
    m = run.counts.shape[1]
    shapes = ((-1, m), (-1, m), (-1, 3), (-1, 3, 3), (-1, 6, 6))
    arrays = {
        key: read_only(np.array([row[i] for row in rows]).reshape(shape))
        for i, (key, shape) in enumerate(zip(_ARRAYS, shapes, strict=True))
    }
    return RigMeasurements(names=tuple(names), unused=unused, **arrays)


def _rests(run: Recording) -> list[tuple[float, float]]:
    """From when to when the drives were told to stand still, without the time of settling."""
    still = np.all(np.diff(run.asked, axis=0) == 0.0, axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(np.int8)))
    found = [(run.time[a], run.time[b]) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return [(a + SETTLING, b) for a, b in found if b - a >= SHORTEST_REST]


def _mean_pose(run: Recording, pictures: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
    if not pictures.any():
        return np.full(3, np.nan), np.full((3, 3), np.nan), np.eye(6)
    mean = run.rotations[pictures].mean(axis=0)
    left, _, right = np.linalg.svd(mean)  # the rotation nearest to the mean of some near ones
    turned = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    covariance = run.covariances[pictures].mean(axis=0)
    return run.positions[pictures].mean(axis=0), turned, covariance
