"""What `cdpr monitor` shows of a status, without a run."""

from __future__ import annotations

import io
from typing import Any

import pytest
from rich.console import Console

from cdpr.cli.monitor import _plain, _view


def status(**changes: Any) -> dict[str, Any]:
    return {
        "process": 77,
        "rig": "gachon_8_6",
        "bus": "virtual cdpr",
        "folder": "runs/[first]",
        "simulated_time": False,
        "state": "holding",
        "elapsed_s": 1.2,
        "cycle": 120,
        "row": 100.5,
        "rows": 323,
        "path_mm": 10.0,
        "path_length_mm": 58.3,
        "feed_percent": 0.0,
        "wished": {"stop": False, "hold": True, "speed_percent": 50},
        "lateness_ms": 0.06,
        "worst_lateness_ms": 0.2,
        "following_error_mm": None,
        "lost_replies": 3,
        "drives": [
            {
                "node": 12,
                "state": "operation enabled",
                "position_counts": -4711,
                "set_counts": -4708,
                "tension_n": 20.5,
            }
        ],
        "events": [{"time_s": 0.05, "code": "broken", "text": "what [drives] told"}],
        **changes,
    }


def live(told: dict[str, Any]) -> str:
    console = Console(file=io.StringIO(), force_terminal=True, width=160, no_color=True)
    console.print(_view(told))
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


@pytest.mark.parametrize("shown", [live, _plain])
def test_everything_of_a_run_is_shown_as_it_is(shown: Any) -> None:
    text = shown(status())
    for part in (
        *("holding", "gachon_8_6", "77", "runs/[first]", "10.0 of 58.3 mm", "0 % of 50 %"),
        *("late 0.06 ms, at most 0.20 ms", "following error – mm", "3 lost replies"),
        *("12", "operation enabled", "-4711", "-3", "20.50", "broken", "what [drives] told"),
    ):
        assert part.lower() in text.lower(), part


@pytest.mark.parametrize("shown", [live, _plain])
def test_a_run_that_is_prepared_or_in_simulated_time_is_shown_too(shown: Any) -> None:
    nothing = dict.fromkeys(("elapsed_s", "cycle", "row", "path_mm", "feed_percent", "lateness_ms"))
    assert "preparing" in shown(status(state="preparing", drives=[], events=[], **nothing))
    assert "simulated time" in shown(status(simulated_time=True, lateness_ms=None))
