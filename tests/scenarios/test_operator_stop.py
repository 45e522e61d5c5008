"""STOP in every phase of a run: all drives slow down together along the path, then hold."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.cia402.state_machine import DriveState
from executor.control.path_runs import Outcome
from executor.realtime.scheduling import SimulatedClock
from executor.state_machine import State
from executor.trajectory.setpoints import PreparedRun
from simulation.drives.cia402_rig import SimulatedCia402Rig
from tests.cli.plans import CONFIGS, RIG
from tests.cli.program import call, nothing_written
from tests.scenarios.stage import Stage, at, path_indices, staged

#: Cycles in which the run enables, approaches, speeds up, cruises, slows down at the goal.
PHASES = {"enabling": 1, "approaching": 8, "speeding up": 25, "cruising": 150, "slowing down": 300}


def stop(stage: Stage) -> None:
    stage.board.ask_stop()


def stopped_in(prepared: PreparedRun, path: Path, cycle: int) -> tuple[Stage, Outcome]:
    with staged(prepared, path / "run", at(cycle, stop)) as stage:
        outcome = stage.run()
    return stage, outcome


@pytest.mark.parametrize("phase", PHASES)
def test_a_stop_ends_in_stopped_with_all_drives_holding_under_torque(
    prepared: PreparedRun, tmp_path: Path, phase: str
) -> None:
    stage, outcome = stopped_in(prepared, tmp_path, PHASES[phase])
    assert outcome.state is State.STOPPED
    codes = [event.code for event in stage.events()]
    assert codes.count("stop") == 1
    on_path = phase not in ("enabling", "approaching")
    follows = "slowing down along the path" if on_path else "stopping at once"
    assert outcome.cause == f"stop requested; {follows}"
    assert codes[-1] == "held"
    if phase != "enabling":  # drives that were not enabled yet hold by their brakes
        assert {drive.state for drive in stage.drives} == {DriveState.QUICK_STOP_ACTIVE}
    assert all(len(set(states)) == 1 for states in stage.drive_states), "never one alone"


@pytest.mark.parametrize("phase", ["speeding up", "cruising", "slowing down"])
def test_all_drives_slow_down_together_along_the_path(
    prepared: PreparedRun, tmp_path: Path, phase: str
) -> None:
    _, outcome = stopped_in(prepared, tmp_path, PHASES[phase])
    table = outcome.log.table()
    states = np.array(table.state)
    moving = np.isin(states, [State.MOVING.value, State.STOPPING.value])
    index, inexact, off = path_indices(prepared, table.set_counts[moving])
    assert off.max() <= 2.0, "all drives are at the same path index, to whole counts"
    rates = np.diff(index)
    blur = (inexact[1:] + inexact[:-1])[:-1]
    assert (rates[1:] > -blur).all(), "never backwards"
    assert (rates[1:] <= 1.0 + blur).all(), "never faster than the path was planned"
    stopping = states[moving][2:] == State.STOPPING.value
    assert stopping.sum() > 3
    assert (np.diff(rates)[stopping] <= 2.0 * blur[stopping]).all(), "the rate only falls"
    assert rates[-1] < 0.1 + blur[-1], "down to rest"
    assert index[-1] < len(prepared.checked.table) - 1.0, "before the goal"


@pytest.mark.parametrize("phase", ["approaching", "speeding up", "cruising", "slowing down"])
def test_a_stop_begins_with_the_next_cycle(
    prepared: PreparedRun, tmp_path: Path, phase: str
) -> None:
    stage, outcome = stopped_in(prepared, tmp_path, PHASES[phase])
    after = outcome.log.table().state[PHASES[phase] + 1]
    assert after in (State.STOPPING.value, State.SECURING.value)
    assert not any(event.code == "moving" for event in stage.events()) or phase != "approaching"


def test_a_stop_that_comes_late_in_a_cycle_begins_with_the_next_one(
    prepared: PreparedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def late(stage: Stage) -> None:
        if stage.cycle == PHASES["cruising"]:
            stage.board.ask_stop()

    monkeypatch.setattr(Stage, "wait_to_decide", late)
    with staged(prepared, tmp_path / "run", at(0, lambda _: None)) as stage:
        outcome = stage.run()
    states = list(outcome.log.table().state)
    assert states.index(State.STOPPING.value) == PHASES["cruising"] + 1


def test_a_stop_at_rest_at_the_goal_changes_nothing(prepared: PreparedRun, tmp_path: Path) -> None:
    with staged(prepared, tmp_path / "free", lambda _stage: None) as free:
        assert free.run().state is State.FINISHED
    secured = next(
        c for c, s in enumerate(free.drive_states) if s[0] is DriveState.QUICK_STOP_ACTIVE
    )
    stage, outcome = stopped_in(prepared, tmp_path, secured - 5)
    assert outcome.state is State.FINISHED
    assert {drive.state for drive in stage.drives} == {DriveState.QUICK_STOP_ACTIVE}


def test_ctrl_c_in_the_program_stops_along_the_path_and_exits_130(
    short_plan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cycles, real = 0, SimulatedClock.next_cycle

    def next_cycle(clock: SimulatedClock) -> float:
        nonlocal cycles
        cycles += 1
        if cycles == 150:
            signal.raise_signal(signal.SIGINT)
        return real(clock)

    monkeypatch.setattr(SimulatedClock, "next_cycle", next_cycle)
    run = tmp_path / "run"
    answer = call("run", short_plan, "--rig", RIG, "-o", run, "--fast", "--no-camera")
    assert answer.code == 130, answer
    assert "STOPPED" in answer.out
    summary = json.loads((run / "summary.json").read_text())
    assert summary["verdict"] == "STOPPED"
    assert summary["final_state"] == "stopped"
    assert 5.0 < summary["travelled_mm"] < 55.0
    assert (run / "report.html").is_file()


def test_ctrl_c_before_anything_moves_leaves_no_run_folder(
    short_plan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    switch_on = SimulatedCia402Rig.__init__

    def interrupted(rehearsal: SimulatedCia402Rig, *arguments: Any, **options: Any) -> None:
        switch_on(rehearsal, *arguments, **options)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(SimulatedCia402Rig, "__init__", interrupted)
    with nothing_written(tmp_path):
        answer = call(
            *("run", short_plan, "--rig", RIG, "-o", tmp_path / "run", "--fast", "--no-camera")
        )
    assert answer.code == 130, answer
    assert "stopped before anything moved" in answer.said


@pytest.mark.parametrize("verb", ["plan", "demo"])
def test_ctrl_c_while_planning_ends_with_130_and_writes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verb: str
) -> None:
    def planning(*_: object, **__: object) -> None:
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr("planner.planning.make_plan", planning)
    scene = CONFIGS / "environment_1.yaml"
    rest = (
        [RIG, scene, "-o", tmp_path / "plan.json"] if verb == "plan" else ["-o", tmp_path / "run"]
    )
    with nothing_written(tmp_path):
        answer = call(verb, *rest)
    assert answer.code == 130
    assert "interrupted" in answer.err
