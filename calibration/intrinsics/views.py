"""A few of many things that come one after the other, spread over all of them."""

from __future__ import annotations

from typing import Generic, TypeVar

import numpy as np

from model.pose import Array

T = TypeVar("T")


class EvenSample(Generic[T]):
    """Keeps up to twice as many things as are wanted, at equal distances."""

    def __init__(self, wanted: int) -> None:
        """Nothing was added yet.

        Args:
            wanted: How many to choose in the end, at most.
        """
        self._wanted, self._every, self._count = wanted, 1, 0
        self._kept: list[T] = []

    def add(self, thing: T) -> None:
        """The next one."""
        if self._count % self._every == 0:
            self._kept.append(thing)
        self._count += 1
        if len(self._kept) == 2 * self._wanted:
            self._kept, self._every = self._kept[::2], 2 * self._every

    def chosen(self) -> list[T]:
        """The wanted number, in their order; all where there were no more."""
        last, wanted = len(self._kept) - 1, min(self._wanted, len(self._kept))
        places = [round(k * last / max(wanted - 1, 1)) for k in range(wanted)]
        return [self._kept[place] for place in places]


# Images between which nothing moved: copies, or images of what stood still.
#
# They err alike, and together they show no more than one. A copy that was saved again as JPEG has
# its corners elsewhere by as much as noise moves them, so one limit finds both.


SAME_VIEW = 0.1
"""Corners that nothing moved are nearer than that to each other in two images, RMS, [px]."""


def is_duplicate_view(corners: Array, before: Array) -> bool:
    """Whether the same corners are in the same places, shape (..., 2) both, [px]."""
    return bool(np.mean(np.sum((corners - before) ** 2, axis=-1)) < SAME_VIEW**2)


def as_in(first: str) -> str:
    """Why an image is not used that shows the same as another, named ``first``."""
    return f"duplicates {first}: nothing moved in between"
