"""What the search is told that may turn the platform."""

from __future__ import annotations

from dataclasses import dataclass

from planner.anytime import AnytimeSettings


@dataclass(frozen=True, slots=True, kw_only=True)
class TurningSettings(AnytimeSettings):
    """Settings of the search that may turn the platform; its moves take longer to decide."""

    budget: float = 0.500
