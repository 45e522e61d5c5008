"""What the search of poses is told: the seed and how long it may go on."""

from __future__ import annotations

from dataclasses import dataclass

from planner.anytime import AnytimeSettings


@dataclass(frozen=True, slots=True, kw_only=True)
class TurningSettings(AnytimeSettings):
    """Settings of the search; moves that turn take longer to decide, so its budget is larger."""

    budget: float = 0.500
