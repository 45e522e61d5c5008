"""Self clearance along whole edges: cable to cable and cable to platform, proved by bounds.

Two cables whose anchors move by the same d, exits at rest, stay images of each other under a map
that is affine: x ↦ x + s f(x) d, where f is 0 at both exits and 1 at both anchors. A plane between
the cables, normal n and room g, becomes a plane with room g / ‖n − φ (d·n) ∇f‖, φ = s / (1 + s
d·∇f), after the share s of the edge (Sherman–Morrison); φ is monotone and the norm convex in it, so
the smallest room is at an end. What the map leaves out, exits that move on pulleys and anchors that
turn, is taken off as a bound of motion. Where the bound does not decide, the edge is halved.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cdpr.cables import cables_at
from cdpr.poses import Array, Pose, interpolate
from cdpr.rig import Rig
from cdpr.self_clearance import SelfModel
from planner.swept import anchor_motion, exit_motion

_SHORTEST = 1e-5
"""Edges shorter than this, [m], are no longer halved but refused."""


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """One pose: gaps with what bounds them nearby; p pairs, m cables."""

    pair_gaps: Array
    normals: Array
    gradients: Array
    platform_gaps: Array
    free_lengths: Array


class SelfEdges:
    """Whether cables stay clear of each other and of the platform along an edge."""

    def __init__(self, rig: Rig, required: float) -> None:
        """Prepares the pairs.

        Args:
            rig: The robot.
            required: Smallest allowed distance, [m].
        """
        self.rig = rig
        self.required = required
        self._model = SelfModel(rig)
        self._states: dict[bytes, _State] = {}
        # From an anchor on the platform a cable only gets farther away: its stub's end is nearest.
        self._on_platform = np.all(np.abs(rig.anchors) <= rig.half_size + 1e-9, axis=1)
        self._arm = np.linalg.norm(rig.anchors, axis=1)

    def clear(self, start: Pose, end: Pose) -> bool:
        """Whether the required distance is kept everywhere from ``start`` to ``end``."""
        before, after = self._state(start), self._state(end)
        if self._smallest(before) < self.required or self._smallest(after) < self.required:
            return False
        middle = interpolate(start, end, 0.5)
        if self._holds(before, start, middle) and self._holds(after, end, middle):
            return True
        if start.distance_to(end) + start.angle_to(end) < _SHORTEST:
            return False
        return self.clear(start, middle) and self.clear(middle, end)

    def _state(self, pose: Pose) -> _State:
        key = pose.position.tobytes() + pose.rotation.tobytes()
        state = self._states.get(key)
        if state is None:
            state = self._states[key] = self._computed(pose)
        return state

    def _computed(self, pose: Pose) -> _State:
        cables = cables_at(self.rig, pose)
        gaps = self._model.cable_pairs(cables)
        between = gaps.second_points - gaps.first_points
        lengths = np.linalg.norm(between, axis=-1, keepdims=True)
        to_platform = self._model.to_platform(cables, pose.position, pose.rotation)
        i, j = self._model.pairs.T
        # The affine f with f = 0 at both exits and 1 at both anchors: three differences give ∇f.
        rows = np.stack(
            [
                cables.anchors[i] - cables.exits[i],
                cables.anchors[j] - cables.exits[i],
                cables.exits[j] - cables.exits[i],
            ],
            axis=1,
        )
        return _State(
            pair_gaps=gaps.distances,
            normals=between / np.maximum(lengths, 1e-12),
            gradients=_solved(rows, np.array([1.0, 1.0, 0.0])),
            platform_gaps=to_platform.distances,
            free_lengths=np.linalg.norm(cables.anchors - cables.exits, axis=-1),
        )

    def _smallest(self, state: _State) -> float:
        return float(min(state.pair_gaps.min(initial=np.inf), state.platform_gaps.min()))

    def _holds(self, state: _State, at: Pose, to: Pose) -> bool:
        """Whether the bounds from one pose prove the way to another."""
        exits = exit_motion(self.rig, at, to)
        turning = anchor_motion(self.rig, at, to) - at.distance_to(to)
        left_out = exits + turning
        if np.any(self._platform_room(state, at, to, exits) < self.required):
            return False
        return bool(np.all(self._pair_room(state, at, to, left_out) >= self.required))

    def _pair_room(self, state: _State, at: Pose, to: Pose, left_out: Array) -> Array:
        moved = to.position - at.position
        along = state.normals @ moved
        stretch = 1.0 + state.gradients @ moved
        usable = stretch > 0.1
        share = along / np.where(usable, stretch, 1.0)
        tilted = state.normals - share[:, None] * state.gradients
        radii = 2.0 * self.rig.cable_radius
        by_map = (state.pair_gaps + radii) / np.maximum(1.0, np.linalg.norm(tilted, axis=-1))
        # Without the map: two points of cables that move by d at one end move apart by at most d.
        by_motion = state.pair_gaps + radii - np.linalg.norm(moved)
        i, j = self._model.pairs.T
        room: Array = np.where(usable, np.maximum(by_map, by_motion), by_motion)
        room = room - radii - left_out[i] - left_out[j]
        return room

    def _platform_room(self, state: _State, at: Pose, to: Pose, exits: Array) -> Array:
        """A cable's point at the arc a moves past the platform by at most a times its turn."""
        travel = anchor_motion(self.rig, at, to) + exits
        angle = at.angle_to(to) if not np.array_equal(at.rotation, to.rotation) else 0.0
        turn = travel / np.maximum(state.free_lengths - travel, 1e-9) + angle
        whole = travel + angle * (self._arm + state.free_lengths)
        moves = np.where(self._on_platform, self._model.stub * turn, whole)
        room: Array = state.platform_gaps - moves
        return room


def _solved(rows: Array, values: Array) -> Array:
    """Gradients g with rows · g = values, shape (p, 3, 3) → (p, 3), by Cramer's rule.

    Exits and anchors that lie in a plane have no such map; their gradients are made so large that
    the bound from it says nothing.
    """
    a, b, c = rows[:, 0], rows[:, 1], rows[:, 2]
    bc, ca, ab = np.cross(b, c), np.cross(c, a), np.cross(a, b)
    determinant = np.einsum("pi,pi->p", a, bc)
    solved = values[0] * bc + values[1] * ca + values[2] * ab
    flat = np.abs(determinant) < 1e-12
    gradients: Array = solved / np.where(flat, 1.0, determinant)[:, None]
    return np.where(flat[:, None], 1e12, gradients)
