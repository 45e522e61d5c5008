"""Settings by name, as a script or the command line asks for them."""

from __future__ import annotations

import math

import pytest

from model.errors import BadInput
from planner.settings import (
    OBJECTIVES,
    OptimalSettings,
    PlannerSettings,
    PlanningOptions,
    TurningSettings,
    settings_from_options,
)


def test_nothing_asked_gives_the_planner_we_recommend_for_the_shortest_path() -> None:
    assert settings_from_options(PlanningOptions()) == OptimalSettings(weights=OBJECTIVES["length"])


def test_units_of_options_become_si() -> None:
    options = PlanningOptions(budget_ms=20.0, longest_mm=800.0, free_rotation=True, seed=3)
    settings = settings_from_options(options)
    assert isinstance(settings, TurningSettings)
    assert (settings.budget, settings.longest, settings.seed) == (0.02, 0.8, 3)


def test_weights_are_a_mapping_or_texts() -> None:
    by_name = settings_from_options(PlanningOptions(weight={"length": 1.0, "clearance": 2.0}))
    by_text = settings_from_options(PlanningOptions(weight=["length=1", "clearance=2"]))
    assert by_name == by_text


def test_the_papers_planners_have_their_own_cost_and_variant() -> None:
    settings = settings_from_options(PlanningOptions(planner="adaptive", mode="paper"))
    assert isinstance(settings, PlannerSettings)
    assert (settings.sampler, settings.cost, settings.mode) == ("adaptive", "kinematic", "paper")


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"planner": "best"}, "unknown planner 'best'"),
        ({"cost": "time"}, "'time' is not an objective"),
        ({"weight": {"time": 1.0}}, "'time' is not an objective"),
        ({"weight": ["length=1", "length=2"]}, "twice"),
        ({"weight": ["length=1"], "cost": "length"}, "contradict each other"),
        ({"budget_ms": 1.0, "rounds": (1,)}, "contradict each other"),
        ({"mode": "paper"}, "does not take --mode"),
        ({"planner": "adaptive", "rounds": (3,)}, "does not take --rounds"),
        ({"planner": "adaptive", "cost": "clearance"}, "has no cost 'clearance'"),
        ({"budget_ms": math.nan}, "budget"),
    ],
)
def test_contradictions_are_refused(options: dict[str, object], named: str) -> None:
    with pytest.raises(BadInput, match=named):
        settings_from_options(PlanningOptions(**options))  # type: ignore[arg-type]
