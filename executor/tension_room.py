"""How much tension is left while winches move without a path: they slow down, and stop. Pure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from executor.safety.watch import Finding, Reaction

#: Cycles in a row beyond the limit, all winches at rest, that end the motion.
OVER_CYCLES = 5
#: Near the limit all go on more slowly, down to this share of their speed; beyond it none goes on.
CREEP = 0.05


class TensionRoom:
    """What is left to the limit of the tension, and whether it is used up."""

    def __init__(self, target: float, limit: float) -> None:
        """All of it is left.

        Args:
            target: Up to this tension winches go on at their speed, [N].
            limit: Beyond this one none goes on, [N].
        """
        self._target, self._limit = target, limit
        self._cycles = 0

    def share(self, tensions: Sequence[float]) -> float:
        """Of their speed at which winches go on, by the tensions [N] now; asked once a cycle."""
        most = float(np.max(tensions))
        # "Not at most", so that a tension that is no number counts as too large.
        over = not most <= self._limit
        self._cycles = self._cycles + 1 if over else 0
        room = (self._limit - most) / (self._limit - self._target)
        return 0.0 if over else min(1.0, max(CREEP, room))

    def used_up(self, tensions: Sequence[float]) -> list[Finding]:
        """Cables that carry more than the limit, and did so for too long."""
        if self._cycles < OVER_CYCLES:
            return []
        return [
            Finding(
                Reaction.PATH_STOP,
                "over_tension",
                f"cable {cable} carries {tension:.1f} N, more than {self._limit:.1f} N",
                cable,
            )
            for cable, tension in enumerate(tensions, start=1)
            if not tension <= self._limit
        ]
