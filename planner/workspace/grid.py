"""Regular grids over a box, or over one plane of it, on which maps are computed."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from model.errors import BadInput
from model.pose import Array, read_only
from model.rig import Rig

AXES = "xyz"
MOST_POINTS = 20_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Positions of the platform's origin, world frame.

    Attributes:
        name: For files and titles, such as ``slice_z_445``.
        axes: Coordinates along x, y and z, increasing, [m].
        normal: For a slice, the index of the axis normal to it; None for a volume.
    """

    name: str
    axes: tuple[Array, Array, Array]
    normal: int | None = None

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of points along each axis."""
        x, y, z = (len(axis) for axis in self.axes)
        return x, y, z

    @property
    def count(self) -> int:
        """Number of points."""
        return int(np.prod(self.shape))

    def points(self, first: int, last: int) -> Array:
        """The points of index ``first`` to ``last - 1``, z fastest; shape (k, 3), [m]."""
        index = np.unravel_index(np.arange(first, last), self.shape)
        return np.stack([a[i] for a, i in zip(self.axes, index, strict=True)], axis=-1)


def volume(name: str, lower: Array, upper: Array, step: float) -> Grid:
    """A grid over a box, both ends of every side included.

    Args:
        lower: Corner, world frame, shape (3,), [m].
        step: Largest distance between neighbours along an axis, [m].

    Raises:
        BadInput: The step is not positive or gives more than `MOST_POINTS` points.
    """
    x, y, z = (_axis(low, high, step) for low, high in zip(lower, upper, strict=True))
    return _limited(Grid(name, (x, y, z)), step)


def slice_through(axis: int, value: float, lower: Array, upper: Array, step: float) -> Grid:
    """A grid over the plane of a box where a coordinate has a value [m].

    Raises:
        BadInput: As for `volume`, or the plane does not meet the box.
    """
    letter = AXES[axis]
    if not lower[axis] - 1e-9 <= value <= upper[axis] + 1e-9:
        low, high = lower[axis] * 1e3, upper[axis] * 1e3
        raise BadInput(
            f"the slice {letter}={value * 1e3:g} is outside the region"
            f" ({letter} from {low:g} to {high:g} mm)",
            next_step=f"choose a value between {low:g} and {high:g} mm, in Python in metres",
        )
    sides = [_axis(low, high, step) for low, high in zip(lower, upper, strict=True)]
    sides[axis] = read_only([value])
    name = f"slice_{letter}_{value * 1e3:g}".replace("-", "minus_")
    return _limited(Grid(name, (sides[0], sides[1], sides[2]), normal=axis), step)


def parsed_slice(text: str) -> tuple[int, float]:
    """Index of the axis and the value [m] of a slice such as ``z=445`` (mm).

    Raises:
        BadInput: The text does not have that form.
    """
    letter, _, number = text.partition("=")
    try:
        value = float(number)
    except ValueError:
        value = np.nan
    if letter.strip() not in tuple(AXES) or not np.isfinite(value):
        raise BadInput(
            f"{text!r} is not a slice",
            next_step="write the axis and its value in mm, such as --slice z=445",
        )
    return AXES.index(letter.strip()), value / 1000.0


def frame_box(rig: Rig) -> tuple[Array, Array]:
    """Corners of the axis-aligned bounding box of all outlets and the workspace box, [m]."""
    corners = np.vstack([rig.outlets, rig.workspace_lower, rig.workspace_upper])
    return corners.min(axis=0), corners.max(axis=0)


def _axis(low: float, high: float, step: float) -> Array:
    if not 0.0 < step < np.inf:
        raise BadInput(f"the step must be above 0 mm, it is {step * 1e3:g} mm")
    if not low < high:
        raise BadInput(f"the region has no extent from {low * 1e3:g} to {high * 1e3:g} mm")
    cells = (high - low) / step - 1e-9
    if cells > MOST_POINTS:
        raise _too_many(step)
    return read_only(np.linspace(low, high, max(1, int(np.ceil(cells))) + 1))


def _limited(grid: Grid, step: float) -> Grid:
    if grid.count > MOST_POINTS:
        raise _too_many(step)
    return grid


def _too_many(step: float) -> BadInput:
    return BadInput(
        f"a step of {step * 1e3:g} mm gives more than {MOST_POINTS} points",
        next_step="choose a larger step or a smaller region",
    )


# The surface on which a field over a grid is zero, as triangles (marching tetrahedra).
#
# Every cell of the grid is cut into six tetrahedra about its main diagonal; neighbouring cells then
# share their cuts, so the surface has no cracks. Source: Doi & Koide, "An efficient method of
# triangulating equi-valued surfaces by using tetrahedral cells", 1991.


Integers = NDArray[np.int64]
_RIM = 1e-9


def zero_surface(axes: tuple[Array, Array, Array], field: Array) -> Array:
    """The boundary of the region where a field is positive, closed at the sides of the grid.

    Args:
        axes: Coordinates along x, y and z, increasing.
        field: Values at the points, shape (nx, ny, nz); NaN counts as negative.

    Returns:
        Triangles, shape (t, 3, 3), counter-clockwise seen from the negative side.
    """
    finite = np.abs(field[np.isfinite(field)])
    largest = float(finite.max(initial=0.0)) or 1.0
    bounded = np.nan_to_num(np.clip(field, -largest, largest), nan=-largest)
    # Exactly zero puts corners on the surface; slightly below, no triangle degenerates.
    bounded = np.where(bounded == 0.0, -1e-12 * largest, bounded)
    padded = np.pad(bounded, 1, constant_values=-largest)
    sides = [_with_rims(axis) for axis in axes]
    points = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3)
    corners = _cut_tetrahedra(padded)
    return _triangles(points, padded.ravel(), corners)


def _with_rims(axis: Array) -> Array:
    """An axis with an extra point at each end, so near that it closes the surface flat."""
    rim = _RIM * (axis[-1] - axis[0])
    return np.concatenate([[axis[0] - rim], axis, [axis[-1] + rim]])


def _cut_tetrahedra(field: Array) -> Integers:
    """Indices of the corners of all tetrahedra that the surface cuts, shape (k, 4)."""
    shape = field.shape
    strides = np.array([shape[1] * shape[2], shape[2], 1], dtype=np.int64)
    last = [np.arange(n - 1, dtype=np.int64) for n in shape]
    cells = np.stack(np.meshgrid(*last, indexing="ij"), axis=-1).reshape(-1, 3) @ strides
    positive = field.ravel() > 0.0
    found = []
    for order in permutations(range(3)):
        offsets = np.concatenate([[0], np.cumsum(strides[list(order)])])
        corners = cells[:, None] + offsets
        count = positive[corners].sum(axis=1)
        found.append(corners[(count > 0) & (count < 4)])
    return np.concatenate(found)


def _triangles(points: Array, field: Array, corners: Integers) -> Array:
    """One triangle where the surface separates one corner from three, two for two from two."""
    order = np.argsort(-field[corners], axis=1, kind="stable")
    sorted_corners = np.take_along_axis(corners, order, axis=1)
    positive = (field[corners] > 0.0).sum(axis=1)
    one, two, three = (sorted_corners[positive == n] for n in (1, 2, 3))
    pieces = [
        _between(points, field, one, ((0, 1), (0, 2), (0, 3))),
        _between(points, field, three, ((0, 3), (1, 3), (2, 3))),
        _between(points, field, two, ((0, 2), (0, 3), (1, 3))),
        _between(points, field, two, ((0, 2), (1, 3), (1, 2))),
    ]
    inner = [points[part[:, 0]] for part in (one, three, two, two)]
    return _outward(np.concatenate(pieces), np.concatenate(inner))


def _between(
    points: Array, field: Array, corners: Integers, edges: tuple[tuple[int, int], ...]
) -> Array:
    """Where the field is zero on edges of tetrahedra, shape (k, 3, 3)."""
    starts, ends = (corners[:, [edge[side] for edge in edges]] for side in (0, 1))
    share = field[starts] / (field[starts] - field[ends])
    crossings: Array = points[starts] + share[..., None] * (points[ends] - points[starts])
    return crossings


def _outward(triangles: Array, inner: Array) -> Array:
    """The triangles, oriented so that each normal points away from its inner point."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    wrong = np.einsum("ki,ki->k", normals, inner - triangles[:, 0]) > 0.0
    oriented: Array = np.where(wrong[:, None, None], triangles[:, ::-1], triangles)
    return oriented
