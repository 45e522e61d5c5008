"""Part of the campaign: every environment is planned, checked and run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks import campaign as benchmark
from benchmarks.campaign import PlanResult, RunResult, campaign, failures, table
from model.rig import load_rig
from tests.cli.plans import rig_for_long_runs

GOOD_PLAN = PlanResult(1, 10.0, 0, "", True, 10.5, 0.0, 700.0, 3.0, 1.0)
GOOD_RUN = RunResult(1, 10.0, 0, True, "PASSED", 0.01, 0.1, -0.05, 9.0)


@pytest.mark.slow
@pytest.mark.parametrize("environment", [1, 2, 3])
def test_a_seed_of_an_environment_holds_all_that_is_asked(
    environment: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the camera, which other scenarios have."""
    rig = load_rig(rig_for_long_runs(tmp_path))
    monkeypatch.setattr(benchmark, "load_rig", lambda _path: rig)
    results = campaign([environment], [3], [10.0, 20.0], 1, 0, lambda _result: None)
    assert failures(results) == []
    assert len(results) == 3


@pytest.mark.parametrize(
    "bad",
    [
        replace(GOOD_PLAN, problem="no path within 5000 samples"),
        replace(GOOD_PLAN, passed=False),
        replace(GOOD_PLAN, clearance_proved_mm=9.99),
        replace(GOOD_PLAN, goal_error_m=2e-6),
        replace(GOOD_RUN, verdict="FAILED"),
        replace(GOOD_RUN, following_mm=0.11),
        replace(GOOD_RUN, following_mm=float("nan")),
        replace(GOOD_RUN, tag_rms_mm=1.01),
        replace(GOOD_RUN, tag_rms_mm=float("nan")),
        replace(GOOD_RUN, beyond_mm=0.001),
        replace(GOOD_RUN, beyond_mm=float("nan")),
    ],
)
def test_the_campaign_notices_each_thing_that_does_not_hold(bad: PlanResult | RunResult) -> None:
    assert failures([GOOD_PLAN, GOOD_RUN]) == []
    assert len(failures([GOOD_PLAN, bad])) == 1
    assert "| 1 | 10 |" in table([GOOD_PLAN, bad])
