"""Settings by name, as a script or the command line asks for them."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest

from model.errors import BadInput
from planner.settings import (
    OBJECTIVES,
    OptimalSettings,
    PlannerSettings,
    PlanningOptions,
    TurningSettings,
    Weights,
    settings_from_options,
)


def test_nothing_asked_gives_the_planner_we_recommend_for_the_shortest_path() -> None:
    assert settings_from_options(PlanningOptions()) == OptimalSettings(weights=OBJECTIVES["length"])


def test_options_of_the_recommended_planner_become_its_settings() -> None:
    options = PlanningOptions(budget=0.02, longest=0.8, free_rotation=True, seed=3)
    settings = settings_from_options(options)
    assert isinstance(settings, TurningSettings)
    assert (settings.budget, settings.longest, settings.seed) == (0.02, 0.8, 3)


@pytest.mark.parametrize("kind", [OptimalSettings, TurningSettings])
@pytest.mark.parametrize(
    ("given", "to_try"),
    [
        ({"rounds": 3}, "rounds=100"),
        ({"rounds": 250}, "rounds=2500"),
        ({"rounds": 2**31 - 1}, "rounds=2147483647"),
        ({"budget": 0.001}, "budget=0.5"),
        ({"budget": 0.5}, "budget=5"),
    ],
)
def test_a_longer_search_is_offered_with_a_value_to_try(kind, given, to_try) -> None:
    assert f"`{to_try}`" in kind(**given).longer


def test_weights_are_numbers_of_any_type_by_name() -> None:
    settings = settings_from_options(
        PlanningOptions(weights={"length": np.float32(1.0), "clearance": Fraction(2)})  # type: ignore[dict-item]
    )
    assert settings == OptimalSettings(weights=Weights(length=1.0, clearance=2.0))


def test_the_papers_planners_have_their_own_cost_and_variant() -> None:
    settings = settings_from_options(PlanningOptions(planner="adaptive", mode="paper"))
    assert isinstance(settings, PlannerSettings)
    assert (settings.sampler, settings.cost, settings.mode) == ("adaptive", "kinematic", "paper")


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"planner": "best"}, "unknown planner 'best'"),
        ({"cost": "time"}, "'time' is not an objective"),
        ({"weights": {"time": 1.0}}, "'time' is not an objective"),
        ({"weights": ["length=1"]}, "a mapping"),
        ({"weights": "length=1"}, "a mapping"),
        ({"weights": {"length": "1"}}, "the weight of length must be a number"),
        ({"weights": {"length": None}}, "the weight of length must be a number"),
        ({"weights": {"length": 1e300}}, "the weight of length"),
        ({"weights": {"length": 1.0}, "cost": "length"}, "`cost=` and `weights=` contradict"),
        ({"budget": 1.0, "rounds": (1,)}, "`budget=` and `rounds=` contradict each other"),
        ({"mode": "paper"}, "does not take `mode=`"),
        ({"planner": "adaptive", "rounds": (3,)}, "does not take `rounds=`"),
        ({"planner": "adaptive", "longest": 9.0, "weights": {"length": 1.0}}, "`longest=`, `wei"),
        ({"planner": "adaptive", "cost": "clearance"}, "has no cost 'clearance'"),
        ({"planner": "adaptive", "cost": "beauty"}, "'beauty' is not an objective"),
        ({"planner": ["optimal"]}, "the planner must be text"),
        ({"cost": ["length"]}, "the cost must be text"),
        ({"cost": ""}, "'' is not an objective"),
        ({"planner": "adaptive", "mode": ""}, "unknown mode ''"),
        ({"budget": math.nan}, "budget"),
        ({"budget": 1e300}, "budget"),
        ({"longest": 1e300}, "longest path"),
    ],
)
def test_contradictions_are_refused(options: dict[str, object], named: str) -> None:
    with pytest.raises(BadInput, match=named):
        settings_from_options(PlanningOptions(**options))  # type: ignore[arg-type]
