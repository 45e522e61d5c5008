"""The surface on which a field over a grid is zero, as triangles (marching tetrahedra).

Every cell of the grid is cut into six tetrahedra about its main diagonal; neighbouring cells then
share their cuts, so that the surface has no cracks. Source: Doi & Koide, "An efficient method of
triangulating equi-valued surfaces by using tetrahedral cells", 1991.
"""

from __future__ import annotations

from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from cdpr.poses import Array

Integers = NDArray[np.int64]
_RIM = 1e-9


def zero_surface(axes: tuple[Array, Array, Array], field: Array) -> Array:
    """The boundary of where a field is positive, closed at the sides of the grid.

    Args:
        axes: Coordinates along x, y and z, increasing.
        field: Values at the points, shape (nx, ny, nz); what is not a number counts as negative.

    Returns:
        Triangles, shape (t, 3, 3), counter-clockwise seen from the negative side.
    """
    finite = np.abs(field[np.isfinite(field)])
    largest = float(finite.max(initial=0.0)) or 1.0
    bounded = np.nan_to_num(np.clip(field, -largest, largest), nan=-largest)
    # Zero would put whole corners on the surface; a hair below it, no triangle has an area lost.
    bounded = np.where(bounded == 0.0, -1e-12 * largest, bounded)
    padded = np.pad(bounded, 1, constant_values=-largest)
    sides = [_with_rims(axis) for axis in axes]
    points = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3)
    corners = _cut_tetrahedra(padded)
    return _triangles(points, padded.ravel(), corners)


def _with_rims(axis: Array) -> Array:
    """An axis with one more point at each end, so near that it closes the surface flat."""
    rim = _RIM * (axis[-1] - axis[0])
    return np.concatenate([[axis[0] - rim], axis, [axis[-1] + rim]])


def _cut_tetrahedra(field: Array) -> Integers:
    """Numbers of the corners of all tetrahedra that the surface cuts, shape (k, 4)."""
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
    """One triangle where one corner is apart from three, two where two are from two."""
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
    """The triangles turned so that their normals point away from an inner point each."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    wrong = np.einsum("ki,ki->k", normals, inner - triangles[:, 0]) > 0.0
    turned: Array = np.where(wrong[:, None, None], triangles[:, ::-1], triangles)
    return turned


def enclosed_volume(triangles: Array) -> float:
    """Volume within a closed surface of triangles, shape (t, 3, 3) (divergence theorem)."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    return float(np.einsum("ki,ki->", a, np.cross(b, c)) / 6.0)
