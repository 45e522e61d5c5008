"""Hold, resume and speed in a run: along the path, smoothly, and never past a stop or a fault."""

from __future__ import annotations

from collections.abc import Callable
from itertools import groupby
from pathlib import Path

import numpy as np
import pytest

from drivers.cia402.state_machine import DriveState
from executor.control.path_runs import Outcome
from executor.recording import recorder
from executor.state_machine import State
from executor.trajectory.setpoints import PreparedRun
from model.pose import moved
from tests.scenarios.stage import Stage, at, path_indices, staged

Does = Callable[[Stage], object]
HELD_AT = 150
HOLD: Does = lambda stage: stage.board.ask_hold(True)  # noqa: E731
RESUME: Does = lambda stage: stage.board.ask_hold(False)  # noqa: E731
STOP: Does = lambda stage: stage.board.ask_stop()  # noqa: E731


def speed(percent: int) -> Does:
    return lambda stage: stage.board.ask_speed(percent)


def run(prepared: PreparedRun, path: Path, **script: Does) -> tuple[Stage, Outcome]:
    """A run in which something happens in the cycles `c<number>`."""
    by_cycle = {int(name[1:]): does for name, does in script.items()}

    def happens(stage: Stage) -> None:
        by_cycle.get(stage.cycle, lambda _stage: None)(stage)

    with staged(prepared, path / "run", happens) as stage:
        return stage, stage.run()


def states(outcome: Outcome) -> list[str]:
    return [name for name, _ in groupby(outcome.log.table().state)]


def rates_on_path(prepared: PreparedRun, outcome: Outcome) -> tuple[np.ndarray, np.ndarray]:
    """Rows per cycle from the set-points sent, and their uncertainty."""
    table = outcome.log.table()
    on_path = np.isin(table.state, ["moving", "holding", "stopping"])
    index, inexact, off = path_indices(prepared, table.set_counts[on_path])
    assert off.max() <= 2.0, "all drives are at the same path index, to whole counts"
    return np.diff(index), inexact[1:] + inexact[:-1]


def test_a_hold_rests_on_the_path_under_power_and_a_resume_continues_to_the_goal(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    seen: list[tuple[DriveState, ...]] = []

    def look(stage: Stage) -> None:
        seen.append(tuple(drive.state for drive in stage.drives))

    (tmp_path / "plain").mkdir()
    _, plain = run(prepared, tmp_path / "plain")
    (tmp_path / "held").mkdir()
    stage, outcome = run(prepared, tmp_path / "held", c150=HOLD, c300=look, c399=look, c400=RESUME)
    assert outcome.state is State.FINISHED
    assert states(outcome) == [
        *("enabling", "approaching", "moving", "holding", "moving", "securing"),
    ]
    assert {state for states_ in seen for state in states_} == {DriveState.OPERATION_ENABLED}
    codes = [event.code for event in stage.events()]
    assert codes == ["enabled", "moving", "hold", "resume", "held"]
    rates, blur = rates_on_path(prepared, outcome)
    assert (rates > -blur).all(), "never backwards"
    assert (rates <= 1.0 + blur).all(), "never faster than the path was planned"
    table = outcome.log.table()
    resting = table.set_counts[300:400]
    assert (resting == resting[0]).all(), "at rest it stays at rest"
    assert (table.set_counts[-1] == plain.log.table().set_counts[-1]).all(), "the same goal"


@pytest.mark.parametrize(("cycle", "said"), [(160, "slowing down"), (300, "at rest")])
def test_a_stop_says_whether_the_platform_was_at_rest(
    prepared: PreparedRun, tmp_path: Path, cycle: int, said: str
) -> None:
    stage, outcome = run(prepared, tmp_path, c150=HOLD, **{f"c{cycle}": STOP})
    assert outcome.state is State.STOPPED
    (text,) = (event.text for event in stage.events() if event.code == "stop")
    assert text.startswith(f"stop requested; {said}")
    assert outcome.cause == text


def test_speeds_are_kept_and_change_smoothly(prepared: PreparedRun, tmp_path: Path) -> None:
    stage, outcome = run(prepared, tmp_path, c100=speed(50), c250=speed(10), c400=speed(100))
    assert outcome.state is State.FINISHED
    reported = [event.text for event in stage.events() if event.code == "speed"]
    assert [text.split(": ")[1] for text in reported] == [
        f"{share} of the planned speed" for share in ("50%", "10%", "100%")
    ]
    rates, _ = rates_on_path(prepared, outcome)
    moving = int(np.flatnonzero(np.array(outcome.log.table().state) == "moving")[0])
    assert np.mean(rates[200 - moving : 240 - moving]) == pytest.approx(0.5, abs=0.02)
    assert np.mean(rates[340 - moving : 390 - moving]) == pytest.approx(0.1, abs=0.01)
    assert np.mean(rates[440 - moving : 460 - moving]) == pytest.approx(1.0, abs=0.02)
    records = outcome.log.table()
    assert np.nanmax(records.following_error) < 2e-3


def test_a_speed_that_was_requested_while_holding_counts_from_the_resume_on(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    stage, outcome = run(prepared, tmp_path, c150=HOLD, c200=speed(20), c260=RESUME)
    assert outcome.state is State.FINISHED
    rates, _ = rates_on_path(prepared, outcome)
    moving = int(np.flatnonzero(np.array(outcome.log.table().state) == "moving")[0])
    assert np.mean(rates[320 - moving : 380 - moving]) == pytest.approx(0.2, abs=0.01)
    assert [e.code for e in stage.events()] == ["enabled", "moving", "hold", "resume", "held"]


def test_a_hold_that_was_requested_before_the_motion_rests_at_its_start(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    _, outcome = run(prepared, tmp_path, c0=HOLD, c200=STOP)
    assert outcome.state is State.STOPPED
    assert "holding" in states(outcome)
    assert outcome.log.table().travelled[-1] < 1e-3


@pytest.mark.parametrize("cycle", [152, 300], ids=["while slowing down", "at rest"])
def test_a_stop_ends_a_hold(prepared: PreparedRun, tmp_path: Path, cycle: int) -> None:
    stage, outcome = run(prepared, tmp_path, **{"c150": HOLD, f"c{cycle}": STOP})
    assert outcome.state is State.STOPPED
    assert {drive.state for drive in stage.drives} == {DriveState.QUICK_STOP_ACTIVE}
    rates, blur = rates_on_path(prepared, outcome)
    assert (rates > -blur).all()


def test_a_resume_does_not_undo_a_stop(prepared: PreparedRun, tmp_path: Path) -> None:
    def both(stage: Stage) -> None:
        STOP(stage)
        RESUME(stage)

    _, outcome = run(prepared, tmp_path, c150=HOLD, c250=both, c255=RESUME)
    assert outcome.state is State.STOPPED


def test_a_fault_while_holding_is_latched(prepared: PreparedRun, tmp_path: Path) -> None:
    def tear(stage: Stage) -> None:
        stage.rehearsal.per_newton[5] = 0.0

    stage, outcome = run(prepared, tmp_path, c150=HOLD, c250=tear, c400=RESUME)
    assert outcome.state is State.LATCHED
    assert "broken" in outcome.cause
    assert states(outcome)[-2:] == ["holding", "latched"]
    assert {drive.state for drive in stage.drives} == {DriveState.QUICK_STOP_ACTIVE}


def test_a_hold_at_the_very_end_waits_there_and_finishes_after_the_resume(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    rows = len(prepared.checked.table)
    _, outcome = run(prepared, tmp_path, c318=HOLD, c700=RESUME)
    assert rows < 400
    assert outcome.state is State.FINISHED
    assert states(outcome)[-2:] == ["moving", "securing"] or states(outcome)[-2] == "holding"


def test_the_status_tells_what_happens(prepared: PreparedRun, tmp_path: Path) -> None:
    seen = []

    def look(stage: Stage) -> None:
        assert stage.status is not None
        seen.append(stage.status.as_dict())

    run(prepared, tmp_path, c0=look, c100=look, c150=HOLD, c300=look, c310=STOP)
    before, moving, holding = seen
    assert before["state"] == "preparing"
    assert before["drives"] == []
    assert moving["state"] == "moving"
    assert moving["feed_percent"] == 100.0
    assert [d["node"] for d in moving["drives"]] == list(range(1, 9))
    assert {d["state"] for d in moving["drives"]} == {"operation enabled"}
    assert all(4.0 < d["tension_n"] < 101.0 for d in moving["drives"])
    assert holding["state"] == "holding"
    assert holding["feed_percent"] == 0.0
    assert holding["wished"] == {"stop": False, "hold": True, "speed_percent": 100}
    assert 0.0 < moving["path_mm"] < holding["path_mm"] < holding["path_length_mm"]
    assert [event["code"] for event in holding["events"]] == ["enabled", "moving", "hold"]


def test_parts_of_a_record_are_those_of_the_whole_and_an_hour_is_small(
    prepared: PreparedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever is allocated at a time; a rig may be held overnight."""
    monkeypatch.setattr(recorder, "_CHUNK", 7)
    (tmp_path / "run").mkdir()
    log = run(prepared, tmp_path / "run")[1].log
    whole = log.table().csv_rows().splitlines()
    for first in (0, 1, 6, 7, 8, len(log) - 1, len(log)):
        for end in {min(first + count, len(log)) for count in (0, 1, 7, 20)}:
            assert log.table(first, end).csv_rows().splitlines() == whole[first:end]
    assert sum(chunk.nbytes for chunk in log._chunks) / len(log) < 300.0


def test_the_approach_keeps_the_paths_acceleration_and_jerk(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    """From nearly as far as the start tolerance allows."""
    rig, start = prepared.rig, prepared.scene.start
    beside = moved(start, np.array([0.0, 0.0, -0.9 * rig.motion.start_tolerance, 0.0, 0.0, 0.0]))
    with staged(prepared, tmp_path / "run", lambda _stage: None, beside) as stage:
        outcome = stage.run()
    assert outcome.state is State.FINISHED, outcome.cause
    table = outcome.log.table()
    per_metre = np.array([winch.counts_per_metre for winch in rig.winches])
    cables = table.set_counts[: table.state.index("moving")] / per_metre
    assert np.abs(cables[-1] - cables[0]).max() > 0.5 * rig.motion.start_tolerance
    window = 5  # cycles, as single ones show only whole counts
    for order, limit in ((2, rig.motion.acceleration), (3, rig.motion.jerk)):
        differences = cables
        for _ in range(order):
            differences = differences[window:] - differences[:-window]
        assert np.abs(differences).max() <= limit * (window * rig.cycle) ** order


def test_a_hold_requested_before_the_motion_waits_at_the_start_of_the_path(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    with staged(prepared, tmp_path / "run", at(150, lambda s: s.board.ask_hold(False))) as stage:
        stage.board.ask_hold(True)
        outcome = stage.run()
        events = stage.events()
    assert outcome.state is State.FINISHED, outcome.cause
    table = outcome.log.table()
    assert states(outcome) == ["enabling", "approaching", "holding", "moving", "securing"]
    first, resumed = table.state.index("holding"), table.state.index("moving")
    assert resumed > 140
    assert (table.set_counts[first:resumed] == prepared.checked.table.counts[0]).all()
    assert [event.code for event in events] == ["enabled", "moving", "hold", "resume", "held"]
    assert events[2].text == "feed hold; at rest"
