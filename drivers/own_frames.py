"""Tells frames that only a master sends apart: ours, and those of another master. No bus."""

from __future__ import annotations


class OwnFrames:
    """What was sent, so that a bus on which a sender hears itself does not look like two masters.

    On such a bus each frame that was sent excuses one that comes in.
    """

    #: Frames of one identifier that may be on their way back; lost ones excuse no more than these.
    MOST_CREDIT = 8

    def __init__(self, ids: frozenset[int], *, hears_itself: bool) -> None:
        """Takes the identifiers to watch and whether the bus brings back what was sent."""
        self._ids = ids
        self._credit: dict[int, int] | None = dict.fromkeys(ids, 0) if hears_itself else None

    def sent(self, can_id: int) -> None:
        """Notes a frame that was sent."""
        if self._credit is not None and can_id in self._credit:
            self._credit[can_id] = min(self.MOST_CREDIT, self._credit[can_id] + 1)

    def is_foreign(self, can_id: int) -> bool:
        """Whether a frame that came in is another master's."""
        if can_id not in self._ids:
            return False
        if self._credit is None:
            return True
        if self._credit[can_id] > 0:
            self._credit[can_id] -= 1
            return False
        return True
