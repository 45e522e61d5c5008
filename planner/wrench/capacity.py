"""The capacity margin at a pose; its definition is `model.statics.feasibility.capacity_margin`.

Five cables span a facet of the available wrench set: the gains of its normal are zero on them. With
up to eight cables the gains on the others form the vector orthogonal to their rows of the null
space. With more, the row space is projected along the first four of the five cables, one after the
other, for all facets that share them; in the plane that is left, the gains are areas. So a facet
takes as many steps as there are cables.
"""

from __future__ import annotations

import math
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.pose import Array
from model.rig import Rig
from model.scene import Scene
from model.statics.gravity import STANDARD_GRAVITY
from model.statics.wrench_sets import rms_anchor_radius
from planner.costs import external_wrenches
from planner.kernels.jit import kernel
from planner.kernels.primitives import Vector, cross, minus, norm, plus, rotated
from planner.kernels.scene_arrays import World, anchor, exit_point

# The structure matrix with scaled moments, and its factors: pseudo-inverse and null space.


FLAT = 1e-9
"""Smallest over largest diagonal factor below which the cables do not act in every direction."""


@kernel
def structure_columns(
    world: World, rotation: Array, position: Vector, length: float, columns: Array
) -> None:
    """Writes the columns of the structure matrix, moments divided by ``length``, as rows.

    Args:
        rotation: ``world_from_platform``, shape (3, 3).
        position: World frame, [m].
        length: Characteristic length, [m].
        columns: Written, shape (m, 6); NaN where a cable has no exit point.
    """
    for cable in range(len(world.cables)):
        arm = rotated(rotation, anchor(world, cable))
        at = plus(position, arm)
        delta = minus(exit_point(world, cable, at), at)
        size = norm(delta)
        unit = (delta[0] / size, delta[1] / size, delta[2] / size)
        moment = cross(arm, unit)
        columns[cable, 0], columns[cable, 1], columns[cable, 2] = unit
        for k in range(3):
            columns[cable, 3 + k] = moment[k] / length


@kernel
def factored(columns: Array, inverse: Array, basis: Array) -> float:
    """The pseudo-inverse of a structure matrix A and a basis, by Householder reflections.

    Args:
        columns: Aᵀ, shape (m ≥ 6, 6).
        inverse: Written: A⁺, shape (m, 6).
        basis: Written: an orthonormal basis as columns, shape (m, m): six of the row space, then
            those of the null space.

    Returns:
        Smallest over largest absolute diagonal factor; 0 where A contains NaN.
    """
    count = len(columns)
    upper = columns.copy()
    basis[:] = np.eye(count)
    for k in range(6):
        size = 0.0
        for i in range(k, count):
            size += upper[i, k] * upper[i, k]
        size = math.sqrt(size)
        if not size > 0.0:
            return 0.0
        if upper[k, k] > 0.0:
            size = -size
        reflector = np.zeros(count)
        for i in range(k, count):
            reflector[i] = upper[i, k]
        reflector[k] -= size
        scale = 0.0
        for i in range(k, count):
            scale += reflector[i] * reflector[i]
        if scale > 0.0:
            for j in range(k, 6):
                along = 0.0
                for i in range(k, count):
                    along += reflector[i] * upper[i, j]
                for i in range(k, count):
                    upper[i, j] -= 2.0 * along / scale * reflector[i]
            for i in range(count):
                along = 0.0
                for j in range(k, count):
                    along += basis[i, j] * reflector[j]
                for j in range(k, count):
                    basis[i, j] -= 2.0 * along / scale * reflector[j]
    smallest, largest = np.inf, 0.0
    for k in range(6):
        smallest, largest = min(smallest, abs(upper[k, k])), max(largest, abs(upper[k, k]))
    if not smallest > FLAT * largest:
        return 0.0
    # Aᵀ = Q R, hence A⁺ Rᵀ = Q: each row by back substitution.
    for i in range(count):
        for k in range(5, -1, -1):
            value = basis[i, k]
            for j in range(k + 1, 6):
                value -= inverse[i, j] * upper[k, j]
            inverse[i, k] = value / upper[k, k]
    return smallest / largest


Integers = NDArray[np.int64]

_DEPENDENT = 1e-12
_FEW_CABLES = 8
"""Up to this number, facets are taken from the null space."""


class LoadArrays(NamedTuple):
    """Required wrenches and tension limits; moments divided by `length`.

    Attributes:
        low: Smallest tension, [N].
        high: Largest tension, [N].
        length: Characteristic length, [m].
        wrench: Centre of the required wrenches, shape (6,), [N].
        spread: Half widths of the box of wrenches about it, shape (6,), [N].
        lever: Sum of weights times their centres, platform frame, shape (3,), [N·m]: the part of
            the wrench that rotates with the platform.
        facets: Cables that do not span each facet, shape (k, m - 5); none above eight cables.
    """

    low: float
    high: float
    length: float
    wrench: Array
    spread: Array
    lever: Array
    facets: Integers


def build_load(rig: Rig, scene: Scene, rotation: Array) -> LoadArrays:
    """The required wrenches of a rig in a scene at one orientation, shape (3, 3)."""
    length = float(rms_anchor_radius(rig.anchors))
    units = np.repeat([1.0, length], 3)
    box = external_wrenches(rig, scene, rotation)
    few = rig.cable_count <= _FEW_CABLES
    facets = list(combinations(range(rig.cable_count), rig.cable_count - 5)) if few else []
    return LoadArrays(
        low=float(rig.min_tension),
        high=float(rig.max_tension),
        length=length,
        wrench=-box.centre / units,
        spread=box.half_widths / units,
        lever=_lever(rig, scene),
        facets=np.array(facets, dtype=np.int64).reshape(-1, rig.cable_count - 5),
    )


def _lever(rig: Rig, scene: Scene) -> Array:
    moment = rig.mass * rig.centre_of_mass
    moment = moment + scene.load.payload_mass * scene.load.payload_centre
    lever: Array = STANDARD_GRAVITY * moment
    return lever


@kernel
def load_at(load: LoadArrays, rotation: Array) -> LoadArrays:
    """The same load with the platform rotated to ``rotation``, shape (3, 3)."""
    lever = rotated(rotation, (load.lever[0], load.lever[1], load.lever[2]))
    wrench = load.wrench.copy()
    wrench[3], wrench[4], wrench[5] = lever[1] / load.length, -lever[0] / load.length, 0.0
    return LoadArrays(
        load.low, load.high, load.length, wrench, load.spread, load.lever, load.facets
    )


@kernel
def margin_at(world: World, load: LoadArrays, rotation: Array, position: Vector) -> float:
    """The capacity margin, [N]; minus infinity where cables do not act in every direction."""
    count = len(world.cables)
    columns, inverse = np.empty((count, 6)), np.empty((count, 6))
    basis = np.empty((count, count))
    structure_columns(world, rotation, position, load.length, columns)
    if factored(columns, inverse, basis) == 0.0:
        return -np.inf
    return margin_of(load, inverse, basis)


@kernel
def margins(world: World, load: LoadArrays, positions: Array) -> Array:
    """`margin_at` for many positions, shape (k, 3), [m], at the world's orientation."""
    found = np.empty(len(positions))
    for i in range(len(positions)):
        at = (positions[i, 0], positions[i, 1], positions[i, 2])
        found[i] = margin_at(world, load, world.platform[:3], at)
    return found


@kernel
def margin_of(load: LoadArrays, inverse: Array, basis: Array) -> float:
    """The capacity margin, [N], from the factors of the structure matrix."""
    if len(basis) <= _FEW_CABLES:
        return _margin_of_few(load, inverse, basis)
    return _margin_of_many(load, inverse, basis)


@kernel
def _margin_of_few(load: LoadArrays, inverse: Array, basis: Array) -> float:
    size = load.facets.shape[1]
    middle, half = (load.high + load.low) / 2.0, (load.high - load.low) / 2.0
    gains, rows = np.empty(size), np.empty((max(size - 1, 1), size))
    least = np.inf
    for facet in range(len(load.facets)):
        cables = load.facets[facet]
        for i in range(size):
            for j in range(size - 1):
                rows[j, i] = basis[cables[i], 6 + j]
        orthogonal_vector(rows, size, gains)
        total, reach, offset, squared, along, spread = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(size):
            total += gains[i] * gains[i]
            reach += abs(gains[i]) * half
            offset += gains[i] * middle
        if not total > _DEPENDENT * _DEPENDENT:
            continue
        for k in range(6):
            normal = 0.0
            for i in range(size):
                normal += gains[i] * inverse[cables[i], k]
            squared += normal * normal
            along += normal * load.wrench[k]
            spread += abs(normal) * load.spread[k]
        least = min(least, (reach - spread - abs(along - offset)) / math.sqrt(squared))
    return least


@kernel
def orthogonal_vector(rows: Array, size: int, found: Array) -> None:
    """The generalised cross product: orthogonal to size - 1 rows, its norm their volume.

    Args:
        rows: Shape (size - 1, size) or more.
        size: Number of components, 1 to 3.
        found: Written, shape (size,); zeros where the rows are dependent.
    """
    if size == 1:
        found[0] = 1.0
    elif size == 2:
        found[0], found[1] = rows[0, 1], -rows[0, 0]
    else:
        found[0] = rows[0, 1] * rows[1, 2] - rows[0, 2] * rows[1, 1]
        found[1] = rows[0, 2] * rows[1, 0] - rows[0, 0] * rows[1, 2]
        found[2] = rows[0, 0] * rows[1, 1] - rows[0, 1] * rows[1, 0]


@kernel
def _margin_of_many(load: LoadArrays, inverse: Array, basis: Array) -> float:
    """As `margin_of`, for any number of cables.

    A facet's normal n, in coordinates of the row space, gives each quantity as n times a vector:
    the gain of a cable, a component of the wrench normal, the required wrench from the middle of
    the available ones. These m + 7 vectors are projected; the normal is never formed.
    """
    count = len(basis)
    middle = (load.high + load.low) / 2.0
    first, second = np.empty((6, count + 7)), np.empty((5, count + 7))
    third, fourth = np.empty((4, count + 7)), np.empty((3, count + 7))
    plane, shares = np.empty((2, count + 7)), np.empty(count + 7)
    for k in range(6):
        first[k, :] = 0.0
        for i in range(count):
            first[k, i] = basis[i, k]
            first[k, count + 6] -= middle * basis[i, k]
            for j in range(6):
                first[k, count + j] += basis[i, k] * inverse[i, j]
        for j in range(6):
            first[k, count + 6] += first[k, count + j] * load.wrench[j]
    least = np.inf
    for a in range(count - 4):
        one = _projected(first, a, shares, second)
        if not one > _DEPENDENT:
            continue
        for b in range(a + 1, count - 3):
            two = one * _projected(second, b, shares, third)
            if not two > _DEPENDENT:
                continue
            for c in range(b + 1, count - 2):
                three = two * _projected(third, c, shares, fourth)
                if not three > _DEPENDENT:
                    continue
                for d in range(c + 1, count - 1):
                    four = three * _projected(fourth, d, shares, plane)
                    if four > _DEPENDENT:
                        least = min(least, _least_in_plane(load, plane, d + 1, four))
    return least


@kernel
def _projected(vectors: Array, pivot: int, shares: Array, found: Array) -> float:
    """Writes vectors, as columns, projected along one of them, in one coordinate less.

    Returns:
        The norm of that one; 0, with nothing written, where it is zero.
    """
    squared = 0.0
    for k in range(len(vectors)):
        squared += vectors[k, pivot] * vectors[k, pivot]
    size = math.sqrt(squared)
    if not size > 0.0:
        return 0.0
    # Reflected onto the first axis, which is then left out.
    head = vectors[0, pivot]
    head += size if head > 0.0 else -size
    scale = 2.0 / (squared - vectors[0, pivot] * vectors[0, pivot] + head * head)
    for i in range(vectors.shape[1]):
        shares[i] = head * vectors[0, i]
    for k in range(1, len(vectors)):
        part = vectors[k, pivot]
        for i in range(vectors.shape[1]):
            shares[i] += part * vectors[k, i]
    for k in range(1, len(vectors)):
        part = scale * vectors[k, pivot]
        for i in range(vectors.shape[1]):
            found[k - 1, i] = vectors[k, i] - part * shares[i]
    return size


@kernel
def _least_in_plane(load: LoadArrays, plane: Array, begin: int, volume: float) -> float:
    """The least margin at the facets of four cables and each one from ``begin`` on.

    Args:
        plane: The vectors of `_margin_of_many`, projected along the four, shape (2, m + 7).
        begin: The first cable that may be the fifth.
        volume: That of the four.
    """
    count = plane.shape[1] - 7
    half, least = (load.high - load.low) / 2.0, np.inf
    for e in range(begin, count):
        x, y = plane[0, e], plane[1, e]
        if not volume * math.sqrt(x * x + y * y) > _DEPENDENT:
            continue
        reach, squared, spread = 0.0, 0.0, 0.0
        for i in range(count):
            reach += abs(y * plane[0, i] - x * plane[1, i])
        for k in range(6):
            normal = y * plane[0, count + k] - x * plane[1, count + k]
            squared += normal * normal
            spread += abs(normal) * load.spread[k]
        off = abs(y * plane[0, count + 6] - x * plane[1, count + 6])
        least = min(least, (half * reach - spread - off) / math.sqrt(squared))
    return least
