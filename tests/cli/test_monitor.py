"""Output of `cdpr monitor` for a status, without a run."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import typer
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from cdpr.cli.operate.monitor import _lines, _view
from executor.remote.client import status_text
from executor.remote.status import RunStatus, WinchStatus
from executor.state_machine import CycleRecord, LoopEvent, State
from executor.supervision import LocalRequests
from model.rig import load_rig
from tests.cli.plans import RIG
from tests.cli.program import call, one_message


def status(**changes: Any) -> dict[str, Any]:
    return {
        "process": 77,
        "rig": "gachon_8_6",
        "bus": "virtual cdpr",
        "folder": "runs/[first]",
        "simulated_time": False,
        "state": "holding",
        "cause": None,
        "elapsed_s": 1.2,
        "cycle": 120,
        "row": 100.5,
        "rows": 323,
        "path_mm": 10.0,
        "path_length_mm": 58.3,
        "next_stop": {"name": "goal", "distance_mm": 48.3, "seconds": 4.8},
        "feed_percent": 0.0,
        "wished": {"stop": False, "hold": True, "speed_percent": 50},
        "lateness_ms": 0.06,
        "worst_lateness_ms": 0.2,
        "following_error_mm": None,
        "lost_replies": 3,
        "rejected_frames": 2,
        "error_frames": 1,
        "drives": [
            {
                "node": 12,
                "state": "operation enabled",
                "torque": "enabled",
                "position_counts": -4711,
                "set_counts": -4708,
                "tension_n": 20.5,
            }
        ],
        "measured": None,
        "cameras": [
            {
                "name": "side",
                "source": "rtsp://x/[y]",
                "pictures": 12,
                "poses": 3,
                "dropped": 4,
                "pictures_per_second": 9.8,
                "measuring_ms": 5.31,
                "tags": [301, 305],
                "trouble": "gave no answer for 2 s",
            }
        ],
        "events": [{"time_s": 0.05, "code": "broken", "text": "what [drives] reported"}],
        **changes,
    }


def live(report: dict[str, Any]) -> str:
    console = Console(file=io.StringIO(), force_terminal=True, width=160, no_color=True)
    console.print(_view(report))
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


@pytest.mark.parametrize("shown", [live, status_text])
def test_everything_of_a_run_is_shown_as_it_is(shown: Any) -> None:
    text = shown(status())
    for part in (
        *("holding", "gachon_8_6", "77", "runs/[first]", "10.0 of 58.3 mm", "0 % of 50 %"),
        *("late 0.06 ms, at most 0.20 ms", "following error – mm", "3 lost replies"),
        *("12", "operation enabled", "-4711", "-3", "20.50", "broken", "what [drives] reported"),
        "camera side (rtsp://x/[y]), 9.8 images/s, 5.3 ms, 2 tags, 3 of 12 with a pose, 4",
        "4 dropped, gave no answer for 2 s",
    ):
        assert part.lower() in text.lower(), part


@pytest.mark.parametrize("shown", [live, status_text])
def test_no_tension_is_shown_of_a_drive_without_torque(shown: Any) -> None:
    """Its cable may hang from the brake under any tension; 0.00 N looked like a slack one."""
    (drive,) = status()["drives"]
    text = shown(status(drives=[drive | {"torque": "none", "tension_n": 0.0}]))
    row = next(line for line in text.splitlines() if "-4711" in line)
    assert "–" in row
    assert "0.00" not in row
    assert "20.50" in shown(status(drives=[drive | {"torque": "holding"}]))


def test_a_tension_is_red_only_where_it_is_known_and_beyond_its_limits() -> None:
    rig, (drive,) = load_rig(RIG), status()["drives"]
    robot: Any = SimpleNamespace(rig=rig, scene=None, required_clearance=0.01)
    now: Any = SimpleNamespace(pose=rig.home, nearest=None)

    def styles(**changes: object) -> str:
        console = Console(file=io.StringIO(), force_terminal=True, width=160)
        console.print(_view(status(drives=[drive | changes]), (robot, now)))
        assert isinstance(console.file, io.StringIO)
        return console.file.getvalue()

    assert "\x1b[1;31m" in styles(tension_n=0.0)
    assert "\x1b[1;31m" not in styles(tension_n=0.0, torque="none")


@pytest.mark.parametrize("shown", [live, status_text])
def test_a_run_that_is_prepared_or_in_simulated_time_is_shown_too(shown: Any) -> None:
    nothing = dict.fromkeys(("elapsed_s", "cycle", "row", "path_mm", "feed_percent", "lateness_ms"))
    assert "preparing" in shown(status(state="preparing", drives=[], events=[], **nothing))
    assert "simulated time" in shown(status(simulated_time=True, lateness_ms=None))


@pytest.mark.parametrize("shown", [live, status_text])
def test_a_session_of_jogs_has_no_progress_to_show(shown: Any) -> None:
    nothing = dict.fromkeys(("row", "rows", "path_mm", "path_length_mm", "next_stop"))
    assert shown(status(**nothing))


@pytest.mark.parametrize("shown", [live, status_text])
def test_winches_that_move_without_a_path_are_shown_as_a_run_is(shown: Any) -> None:
    rig = load_rig(RIG)
    report = WinchStatus(rig, LocalRequests(), simulated_time=False)
    before = report.as_dict()
    report.take_folder(Path("runs/[first]"))
    assert before.keys() == status().keys()
    assert "preparing" in shown(before)
    report.take_release()
    assert "releasing" in shown(report.as_dict()).lower()
    for cycle in range(3):
        report.take_cycle(replace(_record(cycle), index=25.0))
    report.take_event(LoopEvent(1, 50.01, "moving", "winding in"))
    now = report.as_dict()
    assert now.keys() == status().keys()
    assert {key for key, value in now.items() if value is None} == {
        *("path_mm", "path_length_mm", "next_stop", "cause", "measured")
    }
    assert now["elapsed_s"] == pytest.approx(0.02)
    assert now["events"] == [{"time_s": 0.01, "code": "moving", "text": "winding in"}]
    assert now["lateness_ms"] == pytest.approx(0.5)
    assert (now["rejected_frames"], now["error_frames"]) == (10, 14)
    text = shown(now).lower()
    for part in (
        "moving",
        "25 % done",
        "operation enabled",
        "-4711",
        "-3",
        "1 lost",
        "10 rejected, 14 error frames",
        "100 %",
        "runs/[first]",
    ):
        assert part in text, part
    assert f"{rig.winches[7].torque_constant / 2:.2f}" in text


def _record(cycle: int) -> CycleRecord:
    return CycleRecord(
        cycle=cycle,
        at=50.0 + 0.01 * cycle,
        state=State.MOVING,
        index=float(cycle),
        rate=1.0,
        targets=(-4708,) * 8,
        actual=(-4711,) * 8,
        torques=(500,) * 8,
        words=(0x0637,) * 8,
        missing=cycle % 2,
        rejected=5 * cycle,
        error_frames=7 * cycle,
        following_error=0.001,
        lateness=0.05,
        tension_known=(True,) * 8,
    )


@pytest.mark.parametrize(
    ("last", "code", "text"),
    [
        ({"state": "finished"}, 0, "ended: finished"),
        ({"state": "stopped", "cause": "stop requested"}, 130, "ended: stopped, stop requested"),
        ({"state": "latched", "cause": "cable 6 is slack"}, 1, "latched, cable 6 is slack"),
        ({}, 1, "without a final status; last state holding"),
    ],
)
def test_the_monitor_ends_as_the_run_did(
    last: dict[str, Any], code: int, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(typer.Exit) as ended:
        _lines(iter([status(), status(**last)]), as_json=False)
    assert ended.value.exit_code == code
    assert text in capsys.readouterr().out.splitlines()[-1]


class Table:
    """Rows 1 mm apart, of 1 s each, with stops at some."""

    def __init__(self, rows: int, stops: list[int]) -> None:
        self.travelled, self.cycle = 1e-3 * np.arange(rows), 1.0
        self.dwells = [SimpleNamespace(first=row) for row in stops]

    def __len__(self) -> int:
        return len(self.travelled)


@given(
    stops=st.dictionaries(st.integers(1, 98), st.sampled_from(["goal", "stop 1"]), max_size=4),
    row=st.floats(0.0, 99.0),
)
def test_the_next_stop_is_ahead_whatever_its_name(stops: dict[int, str], row: float) -> None:
    table = Table(100, sorted(stops))
    scene = SimpleNamespace(stops=[SimpleNamespace(name=stops[at]) for at in sorted(stops)])
    prepared: Any = SimpleNamespace(rig=None, checked=SimpleNamespace(table=table), scene=scene)
    run = RunStatus(prepared, Path(), LocalRequests(), simulated_time=True)
    shown = run._next_stop(row, 1e-3 * row)
    at, name = min([one for one in stops.items() if one[0] >= row], default=(99, "goal"))
    assert shown["name"] == name
    assert shown["distance_mm"] == pytest.approx(at - row, abs=0.051)
    assert shown["seconds"] == pytest.approx(at - row, abs=0.051)


def test_a_layout_that_exists_is_kept_and_no_option_named_that_there_is_not(tmp_path: Path) -> None:
    layout = tmp_path / "layout.json"
    layout.write_text("mine")
    answer = call("monitor", "--foxglove-layout", layout)
    one_message(answer, 2, "exists already", "choose another name")
    assert "--force" not in answer.err
    assert layout.read_text() == "mine"
