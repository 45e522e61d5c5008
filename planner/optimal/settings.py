"""What the search is told that keeps the orientation of the start."""

from __future__ import annotations

from dataclasses import dataclass

from planner.anytime import AnytimeSettings


@dataclass(frozen=True, slots=True, kw_only=True)
class OptimalSettings(AnytimeSettings):
    """Settings of the search that keeps the orientation of the start."""
