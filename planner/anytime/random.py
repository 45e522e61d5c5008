"""Random numbers for compiled searches: one word of state, the same on every machine.

Source: Steele, Lea & Flood, "Fast splittable pseudorandom number generators", 2014 (SplitMix64).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planner.kernels.jit import leaf
from planner.kernels.primitives import Vector

State = NDArray[np.uint64]

_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_FIRST = np.uint64(0xBF58476D1CE4E5B9)
_SECOND = np.uint64(0x94D049BB133111EB)
_UNIT = 2.0**-53


def seeded(seed: int) -> State:
    """The state for a seed, shape (1,); kernels advance it in place."""
    return np.array([seed % 2**64], dtype=np.uint64)


@leaf
def uniform(state: State) -> float:
    """A number in [0, 1)."""
    state[0] += _GAMMA
    mixed = state[0]
    mixed = (mixed ^ (mixed >> np.uint64(30))) * _FIRST
    mixed = (mixed ^ (mixed >> np.uint64(27))) * _SECOND
    mixed = mixed ^ (mixed >> np.uint64(31))
    return float(mixed >> np.uint64(11)) * _UNIT


@leaf
def below(state: State, count: int) -> int:
    """A whole number in 0 … count - 1."""
    return int(uniform(state) * count)


@leaf
def direction(state: State) -> Vector:
    """A unit vector, uniform on the sphere."""
    height = 2.0 * uniform(state) - 1.0
    turn = 2.0 * math.pi * uniform(state)
    radius = math.sqrt(max(0.0, 1.0 - height * height))
    return (radius * math.cos(turn), radius * math.sin(turn), height)
