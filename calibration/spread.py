"""A few of many things that come one after the other, spread over all of them."""

from __future__ import annotations

from typing import Generic, TypeVar

T = TypeVar("T")


class Spread(Generic[T]):
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
        """So many as were wanted, in their order; all where there were no more."""
        last, wanted = len(self._kept) - 1, min(self._wanted, len(self._kept))
        places = [round(k * last / max(wanted - 1, 1)) for k in range(wanted)]
        return [self._kept[place] for place in places]
