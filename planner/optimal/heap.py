"""A heap in two arrays: the entry of the smallest key first."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner.exact.compiled import kernel

Array = NDArray[np.float64]
Integers = NDArray[np.int64]


@kernel
def push(
    keys: Array,
    entries: Integers,
    count: int,
    key: float,
    value: float,
    first: int,
    second: int,
) -> tuple[Array, Integers, int]:
    """Adds an entry; returns the arrays, which grow when they are full, and the new count.

    Args:
        keys: What is ordered by, and a value that goes with it, shape (k, 2).
        entries: Two numbers of each entry, shape (k, 2).
        count: Entries so far.
        key: Of the new entry.
        value: Likewise.
        first: Likewise.
        second: Likewise.
    """
    if count == len(keys):
        more_keys, more_entries = np.empty((2 * count, 2)), np.empty((2 * count, 2), dtype=np.int64)
        more_keys[:count], more_entries[:count] = keys, entries
        keys, entries = more_keys, more_entries
    at = count
    while at > 0:
        above = (at - 1) // 2
        if keys[above, 0] <= key:
            break
        _copy(keys, entries, above, at)
        at = above
    keys[at, 0], keys[at, 1] = key, value
    entries[at, 0], entries[at, 1] = first, second
    return keys, entries, count + 1


@kernel
def pop(keys: Array, entries: Integers, count: int) -> int:
    """Takes the first entry out; returns the new count."""
    last = count - 1
    key, at = keys[last, 0], 0
    while True:
        below = 2 * at + 1
        if below >= last:
            break
        if below + 1 < last and keys[below + 1, 0] < keys[below, 0]:
            below += 1
        if keys[below, 0] >= key:
            break
        _copy(keys, entries, below, at)
        at = below
    _copy(keys, entries, last, at)
    return last


@kernel
def _copy(keys: Array, entries: Integers, source: int, target: int) -> None:
    keys[target, 0], keys[target, 1] = keys[source, 0], keys[source, 1]
    entries[target, 0], entries[target, 1] = entries[source, 0], entries[source, 1]
