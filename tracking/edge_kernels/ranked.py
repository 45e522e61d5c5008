"""The value of a rank among unsorted ones."""

from __future__ import annotations

from cdpr.compiled import compiled
from cdpr.poses import Array


@compiled
def ranked(values: Array, count: int, rank: int) -> float:
    """The value that would stand at ``rank`` if the first ``count`` were sorted; reorders them."""
    low, high = 0, count - 1
    while low < high:
        pivot = values[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if rank <= j:
            high = j
        elif rank >= i:
            low = i
        else:
            break
    return float(values[rank])
