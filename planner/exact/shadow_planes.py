"""Planes that shut in an obstacle's shadow: what an anchor may not enter, seen from its outlet.

A cable from the outlet A is too near to a convex obstacle exactly when its anchor is in the shadow
of the obstacle grown by the needed distance, a convex set. A plane with the grown obstacle behind
it and A before it (or on it) has the whole shadow behind it: an edge with both anchors before such
a plane is free. Planes are made through A, touching the grown obstacle, and at its front faces; of
all these the few are kept that together prove most of a lattice of positions, best ones first.
The platform's own forbidden set, the obstacle grown by the platform, gets planes the same way.
Which planes are kept decides how often the closed forms are asked, never what the answer is.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from cdpr.poses import Array
from planner.exact.pieces import Piece

_TURNS = 16
_HALVINGS = 20
"""Of a right angle: a plane is turned back from touching by some millionths at most."""
_MOST_PLANES = 12
_MOST_EDGES = 60
_EYE_ROUND_OFF = 1e-13
"""How far ``eye`` may seem past a plane through it, as part of its largest coordinate; a tenth of
what every needed distance has on top."""
_LEAST_GAIN = 0.002
"""Part of the lattice that a further plane must prove."""


def cable_normals(piece: Piece, eye: Array, needed: float, slack: float) -> Array:
    """Candidate unit normals, toward the piece, of planes with ``eye`` before them; shape (k, 3).

    Args:
        piece: The obstacle.
        eye: Where the cable leaves its outlet, world frame, shape (3,), [m].
        needed: Distance by which the piece is grown, [m].
        slack: Room left between ``eye`` and the planes, for exits that move on pulleys, [m].
    """
    tried = [_touching_all_round(piece, eye, needed + slack), piece.faces * -1.0]
    if len(piece.edges) <= _MOST_EDGES:
        tried.append(_touching_edges(piece.edges, eye, needed + slack))
    toward = piece.points - eye
    tried.append(toward / np.linalg.norm(toward, axis=1, keepdims=True))
    normals = np.concatenate(tried)
    normals = normals[np.all(np.isfinite(normals), axis=1)]
    room = piece.least(normals) - needed - normals @ eye
    kept: Array = normals[room >= -_EYE_ROUND_OFF * float(np.abs(eye).max())]
    return kept


def platform_normals(piece: Piece, rotation: Array) -> Array:
    """Candidate unit normals, toward the piece, for the platform; shape (k, 3).

    Args:
        piece: The obstacle.
        rotation: ``world_from_platform``, shape (3, 3).
    """
    signs = np.array([s for s in product((-1.0, 0.0, 1.0), repeat=3) if any(s)])
    compass = signs / np.linalg.norm(signs, axis=1, keepdims=True)
    tried = [compass @ rotation.T, compass @ piece.pose.rotation.T, -piece.faces]
    directions = piece.edges[:, 1] - piece.edges[:, 0]
    if 0 < len(directions) <= _MOST_EDGES:
        crossed = np.cross(directions[:, None, :], rotation.T[None, :, :]).reshape(-1, 3)
        lengths = np.linalg.norm(crossed, axis=1)
        crossed = crossed[lengths > 1e-9] / lengths[lengths > 1e-9][:, None]
        tried += [crossed, -crossed]
    return np.concatenate(tried)


def best_first(proved: Array) -> list[int]:
    """Which planes to keep, the most useful first (greedy cover).

    Args:
        proved: Which plane proves which position, shape (planes, positions), 0 or 1.
    """
    left = np.ones(proved.shape[1])
    chosen: list[int] = []
    while len(chosen) < _MOST_PLANES and len(proved):
        gains = proved @ left
        best = int(np.argmax(gains))
        if gains[best] <= _LEAST_GAIN * len(left):
            break
        chosen.append(best)
        left = left * (1.0 - proved[best])
    return chosen


def _touching_edges(edges: Array, eye: Array, needed: float) -> Array:
    """Normals of the planes through ``eye`` along each edge, ``needed`` before it."""
    along = edges[:, 1] - edges[:, 0]
    lengths = np.linalg.norm(along, axis=1, keepdims=True)
    along = along / np.where(lengths > 0.0, lengths, np.nan)
    away = edges[:, 0] - eye
    across = away - np.sum(away * along, axis=1, keepdims=True) * along
    return _two_tangents(across, np.cross(along, across), needed)


def _two_tangents(across: Array, side: Array, needed: float) -> Array:
    """Unit vectors n in the plane of two perpendicular, equally long vectors: n·across = needed."""
    squared = np.sum(across**2, axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        height = np.sqrt(squared - needed**2)
        normals = [(needed * across + sign * height * side) / squared for sign in (-1.0, 1.0)]
    return np.concatenate(normals)


def _touching_all_round(piece: Piece, eye: Array, needed: float) -> Array:
    """Normals of planes through ``eye`` that touch the grown piece, spread evenly round it.

    For each direction round the line of sight the normal is turned from "forward" to "sideways"
    until the grown piece just stays behind the plane.
    """
    sight = piece.points.mean(axis=0) - eye
    distance = float(np.linalg.norm(sight))
    if distance == 0.0:
        return np.zeros((0, 3))
    sight = sight / distance
    helper = np.eye(3)[int(np.argmin(np.abs(sight)))]
    right = np.cross(sight, helper)
    right /= np.linalg.norm(right)
    up = np.cross(sight, right)
    turns = 2.0 * np.pi * np.arange(_TURNS) / _TURNS
    sideways = np.cos(turns)[:, None] * right + np.sin(turns)[:, None] * up
    low, high = np.zeros(_TURNS), np.full(_TURNS, np.pi / 2.0)
    for _ in range(_HALVINGS):  # the room falls to zero where the plane touches
        middle = (low + high) / 2.0
        normals = np.cos(middle)[:, None] * sight + np.sin(middle)[:, None] * sideways
        behind = piece.least(normals) - needed - normals @ eye >= 0.0
        low, high = np.where(behind, middle, low), np.where(behind, high, middle)
    touching: Array = np.cos(low)[:, None] * sight + np.sin(low)[:, None] * sideways
    return touching
