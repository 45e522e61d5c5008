"""Distances of cables and platform from obstacles and from each other, at one pose.

A cable is the straight segment from its exit to its anchor, with the rig's cable radius; the
platform is its box; pulley wheels are not bodies. Distances are between surfaces. Where bodies
overlap they are negative: minus a translation that separates them. Each is proved by a separating
plane (`model.distances`) and is at most 0.1 µm below the true one, never above.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from model.distances import (
    ConvexBody,
    Separation,
    box_body,
    convex_bodies,
    segment_body,
    segment_box_points,
    segment_pair_points,
    separation,
)
from model.kinematics import Cables, cables_at, cables_to
from model.pose import Array, Pose
from model.rig import Rig
from model.scene import Scene

# Distances of cables from each other and from the platform, for one pose or many at once.
#
# At its anchor a cable touches the platform, so the platform is compared with the part of each
# cable farther than a stub from its anchor. The stub is a quarter of the platform's shortest side;
# a clearance c then means that the cable leaves the platform at an angle of at least
# arcsin(c / stub). For the same reason, two cables that share an anchor (or an outlet) are compared
# without a stub at that end: they touch there.


_STUB_SHARE = 0.25
_SAME = 1e-6
"""Ends nearer to each other are the same, [m]."""
_TOUCHING = 1e-9
"""Distance that may be round-off, [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class Gaps:
    """Distances between surfaces of bodies that belong to the robot.

    Attributes:
        distances: Shape (..., k), [m]; negative where they overlap.
        first_points: On the first body, world frame, shape (..., k, 3), [m].
        second_points: On the second body, world frame, shape (..., k, 3), [m].
    """

    distances: Array
    first_points: Array
    second_points: Array


class SelfModel:
    """The pairs of bodies compared on one rig.

    Attributes:
        pairs: The cables of each compared pair, counted from 0, shape (p, 2).
        stub: Length of cable at its anchor that may be near the platform, [m].
        stubs: Length left out of both cables of each pair at the anchors and at the outlets, shape
            (p, 2), [m]; 0 where these are apart.
    """

    def __init__(self, rig: Rig) -> None:
        """Finds the pairs of cables and the ends that they share, where they touch."""
        self.rig = rig
        self.stub = _STUB_SHARE * 2.0 * float(np.min(rig.half_size))
        pairs = np.array(list(combinations(range(rig.cable_count), 2)), dtype=np.int64)
        self.pairs: NDArray[np.int64] = pairs.reshape(-1, 2)
        ends = np.stack([rig.anchors, rig.outlets], axis=1)
        apart = np.linalg.norm(ends[self.pairs[:, 0]] - ends[self.pairs[:, 1]], axis=-1)
        self.stubs: Array = np.where(apart <= 2.0 * rig.cable_radius + _SAME, self.stub, 0.0)

    def cable_pairs(self, cables: Cables) -> Gaps:
        """Distances of the cable pairs in `pairs`; ``cables`` of one pose or a batch."""
        radius = self.rig.cable_radius
        a, b = (self._parts(cables, self.pairs[:, side]) for side in (0, 1))
        on_a, on_b = segment_pair_points(*a, *b)
        distances = np.linalg.norm(on_a - on_b, axis=-1) - 2.0 * radius
        return Gaps(distances, on_a, on_b)

    def to_platform(self, cables: Cables, positions: Array, rotations: Array) -> Gaps:
        """Distances of each cable, beyond its stub, to the platform.

        Args:
            cables: Of one pose or a batch.
            positions: Of the platform, shape (..., 3), [m].
            rotations: ``world_from_platform``, shape (..., 3, 3) or (3, 3).
        """
        half, radius = self.rig.half_size, self.rig.cable_radius
        start = cables.anchors + self.stub * cables.directions
        origin = positions[..., None, :]
        start, end = (start - origin) @ rotations, (cables.exits - origin) @ rotations
        on_cable, in_box = segment_box_points(start, end, half)
        distances = np.linalg.norm(on_cable - in_box, axis=-1)
        touching = distances <= _TOUCHING
        distances[touching] = -_depths(start[touching], end[touching], half)
        distances -= radius
        rotated = np.swapaxes(rotations, -1, -2)
        return Gaps(distances, on_cable @ rotated + origin, in_box @ rotated + origin)

    def _parts(self, cables: Cables, chosen: NDArray[np.int64]) -> tuple[Array, Array]:
        along = cables.directions[..., chosen, :]
        start = cables.anchors[..., chosen, :] + self.stubs[:, :1] * along
        end = cables.exits[..., chosen, :] - self.stubs[:, 1:] * along
        return start, end


def _depths(start: Array, end: Array, half_size: Array) -> Array:
    """The shortest translations that separate segments from a box about the origin.

    The sum of segment and box has faces parallel to those of the box, and to the segment and an
    edge of the box. The shortest way out leads through one of them.

    Args:
        start: Frame of the box, shape (k, 3), [m].
        end: Frame of the box, shape (k, 3), [m].
        half_size: Half extents of the box, shape (3,), [m].

    Returns:
        Shape (k,), [m]; 0 where they are apart.
    """
    faces = np.broadcast_to(np.eye(3), (len(start), 3, 3))
    across = np.cross((end - start)[:, None, :], faces)
    size = np.linalg.norm(across, axis=-1, keepdims=True)
    # An edge parallel to the segment spans no face with it.
    across = np.where(size > _TOUCHING, across / np.where(size > _TOUCHING, size, 1.0), faces)
    normals = np.concatenate([faces, across], axis=1)
    along = np.stack([normals @ point[..., None] for point in (start, end)])[..., 0]
    nearest = np.maximum(along.min(axis=0), -along.max(axis=0))
    depths: Array = (np.abs(normals) @ half_size - nearest).min(axis=-1)
    return np.maximum(depths, 0.0)


PLATFORM = "platform"


def cable_name(index: int) -> str:
    """Displayed name of a cable: it counts from 1, ``index`` from 0."""
    return f"cable {index + 1}"


@dataclass(frozen=True, slots=True, eq=False)
class Nearest:
    """The distance between two bodies.

    Attributes:
        first: Name of a cable or the platform.
        second: Name of an obstacle, a cable or the platform.
        distance: Between the surfaces, [m]; 0 or less where they touch.
        first_point: On the first body, world frame, shape (3,), [m].
        second_point: On the second body, world frame, shape (3,), [m].
    """

    first: str
    second: str
    distance: float
    first_point: Array
    second_point: Array


class RobotBodies:
    """The robot at one pose as convex bodies: m cables and then the platform.

    Attributes:
        cables: The cables at the pose.
    """

    def __init__(self, rig: Rig, pose: Pose) -> None:
        """The robot at ``pose`` (``world_from_platform``)."""
        self.rig = rig
        self.pose = pose
        self.cables = cables_at(rig, pose)
        self._made: dict[int, ConvexBody] = {}

    @cached_property
    def corners(self) -> Array:
        """Corners of the platform in the world, shape (8, 3), [m]."""
        return self.pose.apply(self.rig.platform_corners)

    def reach(self, directions: Array) -> Array:
        """Largest reach of each body along its own directions, cables without their radius.

        Args:
            directions: World frame, shape (..., m + 1, 3).

        Returns:
            Shape (..., m + 1), [m].
        """
        along = directions[..., :-1, :]
        ends = np.maximum(
            np.einsum("...i,...i", along, self.cables.exits),
            np.einsum("...i,...i", along, self.cables.anchors),
        )
        platform = np.max(directions[..., -1, :] @ self.corners.T, axis=-1)
        return np.concatenate([ends, platform[..., None]], axis=-1)

    def body(self, index: int) -> ConvexBody:
        """Body ``index``: a cable (as a line), or the platform for index m."""
        if index not in self._made:
            self._made[index] = (
                box_body(self.rig.half_size, self.pose)
                if index == self.rig.cable_count
                else segment_body(self.cables.exits[index], self.cables.anchors[index])
            )
        return self._made[index]


class ShiftedBodies:
    """The robot at one orientation with its origin anywhere in the hull of some positions.

    For point exits only, which do not move with the platform.
    """

    def __init__(self, rig: Rig, rotation: Array, positions: Array) -> None:
        """Stores the extreme points.

        Args:
            rig: The robot, with point exits.
            rotation: ``world_from_platform``, shape (3, 3).
            positions: Of the origin, shape (k, 3), [m].
        """
        self._exits = rig.outlets
        self._arms = rig.anchors @ rotation.T
        self._corners = rig.platform_corners @ rotation.T
        self._positions = positions

    def reach(self, directions: Array) -> Array:
        """As `RobotBodies.reach`, over all positions.

        A cable's ends reach farthest at one of the positions, and so does the cable.
        """
        shifts = np.max(directions @ self._positions.T, axis=-1)
        along = directions[..., :-1, :]
        ends = np.maximum(
            np.einsum("...i,...i", along, self._exits),
            np.einsum("...i,...i", along, self._arms) + shifts[..., :-1],
        )
        platform = np.max(directions[..., -1, :] @ self._corners.T, axis=-1) + shifts[..., -1]
        return np.concatenate([ends, platform[..., None]], axis=-1)


class ClearanceModel:
    """Distances of one rig in one scene.

    It caches the separating planes of the last pose: a plane bounds the distance from below at the
    next pose too, so most bodies are ruled out without computing their distance. The bounds are
    exact; the cache changes the time, not the result. Each thread needs a model of its own: a bound
    read while another thread stores a plane may be wrong.
    """

    def __init__(self, rig: Rig, scene: Scene) -> None:
        """Builds the obstacles once.

        Args:
            rig: The robot.
            scene: Its obstacles; clearances, start and goal are not used.
        """
        self.rig = rig
        self.obstacle_names = tuple(obstacle.name for obstacle in scene.obstacles)
        self._body_names = (*(cable_name(i) for i in range(rig.cable_count)), PLATFORM)
        self._radii = np.append(np.full(rig.cable_count, rig.cable_radius), 0.0)
        self._self = SelfModel(rig)
        self._obstacles = [
            _ObstacleDistances(convex_bodies(o.shape, o.pose), rig) for o in scene.obstacles
        ]

    def obstacles(self, pose: Pose) -> tuple[Nearest, ...]:
        """The body nearest to each obstacle, in the order of the scene.

        Args:
            pose: ``world_from_platform``.
        """
        bodies = RobotBodies(self.rig, pose)
        return tuple(
            self._named(name, *obstacle.nearest(bodies, self._radii))
            for name, obstacle in zip(self.obstacle_names, self._obstacles, strict=True)
        )

    def near(self, pose: Pose, within: float) -> tuple[tuple[Nearest, ...], ...]:
        """For each obstacle, the nearest body and then the others that are hardly farther away.

        Args:
            pose: ``world_from_platform``.
            within: Largest distance beyond that of the nearest, [m].
        """
        bodies = RobotBodies(self.rig, pose)
        return tuple(
            tuple(
                self._named(name, body, found)
                for body, found in obstacle.near(bodies, self._radii, within)
            )
            for name, obstacle in zip(self.obstacle_names, self._obstacles, strict=True)
        )

    def smallest(self, pose: Pose) -> Nearest | None:
        """The smallest distance to any obstacle; None in a scene without obstacles."""
        return min(self.obstacles(pose), key=lambda n: n.distance, default=None)

    def at_least(self, middle: Pose, positions: Array, wanted: float) -> float:
        """A lower bound of obstacle distances while the platform translates; point exits only.

        Args:
            middle: A pose of the translation; gives the orientation, and planes where the cached
                ones do not suffice.
            positions: The platform's origin stays in their hull, shape (k, 3), [m].
            wanted: Bound to prove; larger ones are not tried, [m].

        Returns:
            The bound, [m]; ``wanted`` or more where the proof succeeds.
        """
        bodies = RobotBodies(self.rig, middle)
        shifted = ShiftedBodies(self.rig, middle.rotation, positions)
        least = np.inf
        for obstacle in self._obstacles:
            needed = min(wanted, least)  # of the others no more where one is nearer
            least = min(least, obstacle.at_least(bodies, shifted, self._radii, needed))
        return least

    def self_clearance(self, pose: Pose) -> Nearest:
        """The smallest distance between cables, or between a cable and the platform.

        See `model.clearance` for what is compared.
        """
        cables = cables_at(self.rig, pose)
        to_platform = self._smallest_to_platform(cables, pose)
        if not len(self._self.pairs):
            return to_platform
        gaps = self._self.cable_pairs(cables)
        k = int(np.argmin(gaps.distances))
        first, second = (self._body_names[int(i)] for i in self._self.pairs[k])
        between = _nearest_of(gaps, k, first, second)
        return min(between, to_platform, key=lambda n: n.distance)

    def self_clearances(self, positions: Array, rotations: Array) -> Array:
        """`self_clearance` at many poses, shape (k,), [m].

        Args:
            positions: Of the platform, shape (k, 3), [m].
            rotations: ``world_from_platform``, shape (k, 3, 3).
        """
        anchors = positions[:, None, :] + self.rig.anchors @ np.swapaxes(rotations, -1, -2)
        cables = cables_to(self.rig, anchors)
        to_platform = self._self.to_platform(cables, positions, rotations).distances
        between = self._self.cable_pairs(cables).distances
        smallest: Array = np.concatenate([to_platform, between], axis=-1).min(axis=-1)
        return smallest

    def _smallest_to_platform(self, cables: Cables, pose: Pose) -> Nearest:
        gaps = self._self.to_platform(cables, pose.position, pose.rotation)
        k = int(np.argmin(gaps.distances))
        return _nearest_of(gaps, k, self._body_names[k], PLATFORM)

    def _named(self, obstacle: str, body: int, found: Separation) -> Nearest:
        radius = float(self._radii[body])
        return Nearest(
            first=self._body_names[body],
            second=obstacle,
            distance=found.distance - radius,
            first_point=found.first_point + radius * found.normal,
            second_point=found.second_point,
        )


def _nearest_of(gaps: Gaps, k: int, first: str, second: str) -> Nearest:
    points = gaps.first_points[k], gaps.second_points[k]
    return Nearest(first, second, float(gaps.distances[k]), *points)


class _ObstacleDistances:
    """One obstacle: its convex pieces, and the last separating plane of each piece and body."""

    def __init__(self, pieces: tuple[ConvexBody, ...], rig: Rig) -> None:
        self.pieces = pieces
        bodies = RobotBodies(rig, rig.home)
        middles = (bodies.cables.exits + bodies.cables.anchors) / 2.0
        middles = np.concatenate([middles, rig.home.position[None, :]])
        centres = np.array([piece.points.mean(axis=0) for piece in pieces])
        toward = centres[:, None, :] - middles[None, :, :]
        self._planes = toward / np.maximum(np.linalg.norm(toward, axis=-1)[..., None], 1e-9)
        self._reach = np.stack(
            [p.extent(-planes) for p, planes in zip(pieces, self._planes, strict=True)]
        )

    def nearest(self, bodies: RobotBodies, radii: Array) -> tuple[int, Separation]:
        """The nearest body and its distance; cable radii count for the order only."""
        bounds = self._bounds(bodies, radii)
        order = np.argsort(bounds, axis=None).tolist()
        count = bounds.shape[1]
        best_body, best = self._distance(bodies, *divmod(order[0], count))
        smallest = best.distance - radii[best_body]
        for flat in order[1:]:
            piece, body = divmod(flat, count)
            if bounds[piece, body] >= smallest:
                break
            _, found = self._distance(bodies, piece, body)
            if found.distance - radii[body] < smallest:
                best_body, best, smallest = body, found, found.distance - radii[body]
        return best_body, best

    def near(
        self, bodies: RobotBodies, radii: Array, within: float
    ) -> list[tuple[int, Separation]]:
        """Bodies up to ``within`` [m] farther away than the nearest, in order of distance."""
        nearest_body, nearest = self.nearest(bodies, radii)
        limit = nearest.distance - radii[nearest_body] + within
        found = {nearest_body: nearest}
        for piece, body in np.argwhere(self._bounds(bodies, radii) <= limit).tolist():
            _, one = self._distance(bodies, piece, body)
            if one.distance - radii[body] <= limit and (
                body not in found or one.distance < found[body].distance
            ):
                found[body] = one
        return sorted(found.items(), key=lambda item: item[1].distance - radii[item[0]])

    def at_least(
        self, bodies: RobotBodies, shifted: ShiftedBodies, radii: Array, wanted: float
    ) -> float:
        """A lower bound of the distance to all shifted bodies, from one plane per pair."""
        bounds = self._bounds(shifted, radii)
        for piece, body in np.argwhere(bounds < wanted).tolist():
            self._distance(bodies, piece, body)
            bounds = self._bounds(shifted, radii)
            if bounds[piece, body] < wanted:
                break
        return float(bounds.min())

    def _bounds(self, bodies: RobotBodies | ShiftedBodies, radii: Array) -> Array:
        """Lower bounds of distances from the last planes, shape (pieces, bodies), [m]."""
        bounds: Array = -self._reach - bodies.reach(self._planes) - radii
        return bounds

    def _distance(self, bodies: RobotBodies, piece: int, body: int) -> tuple[int, Separation]:
        found = separation(bodies.body(body), self.pieces[piece])
        self._planes[piece, body] = found.normal
        self._reach[piece, body] = self.pieces[piece].extent(-found.normal)
        return body, found
