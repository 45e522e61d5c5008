"""After a fault the record states the row that was sent, and what the cables carry."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.cia402.pdo import RPDO1_BASE
from executor.recording.tables import CycleTable
from executor.state_machine import State
from executor.trajectory.setpoints import PreparedRun
from tests.scenarios.faults.bench import Script, once, simulated
from tests.scenarios.faults.cases import TABLE, incoming, late
from tests.scenarios.faults.fault_bus import lose_next
from tests.scenarios.stage import CRUISING, concluded
from tests.scenarios.test_faults import jump_in_table

#: Distance of drives at rest from their last set-points, [counts].
FOLLOWED = 12


def recorded(
    prepared: PreparedRun, path: Path, script: Script
) -> tuple[CycleTable, dict[str, Any], State]:
    """The cycles, the summary and the final state of a run with a fault."""
    setpoints = prepared.checked.table.setpoints
    kept = setpoints.copy()
    with simulated(prepared, path, script) as bench:
        outcome = bench.stage.run()
        found = outcome.log.table(), concluded(bench.stage, outcome), outcome.state
    if setpoints.flags.writeable:  # for the next run
        setpoints[:] = kept
        setpoints.setflags(write=False)
    return found


def tension_check(summary: dict[str, Any]) -> dict[str, Any]:
    (check,) = (one for one in summary["checks"] if one["name"] == "tension")
    return check


FAULTS: dict[str, Callable[[], Script]] = {
    "a late cycle": late(2.0),
    "a bus fault found after the frames were sent": TABLE["F13 another SYNC"].script,
    "a set-point that the gate denies": lambda: once(lambda bench: jump_in_table(bench.stage)),
}


@pytest.mark.parametrize("name", FAULTS)
def test_row_and_travel_are_those_last_sent(
    prepared: PreparedRun, tmp_path: Path, name: str
) -> None:
    cycles, summary, state = recorded(prepared, tmp_path / "run", FAULTS[name]())
    assert state is State.LATCHED
    table, rows = prepared.checked.table, cycles.path_index
    stopped = np.array(cycles.state) == State.LATCHED.value
    assert stopped.sum() > 5
    assert CRUISING - 20 < rows[-1] < len(table) - 1
    assert (cycles.set_counts[stopped] == table.setpoints[rows[stopped]]).all()
    assert np.abs(cycles.actual_counts - cycles.set_counts)[stopped].max() <= FOLLOWED
    assert summary["travelled_mm"] == pytest.approx(table.travelled[rows[-1]] * 1e3, abs=1e-6)
    assert cycles.planned[-1] == pytest.approx(table.positions[rows[-1]])
    assert summary["encoder_error_mm"]["max"] < 0.05, "a row is 0.2 mm"


@pytest.mark.parametrize(("node", "words"), [(4, "went slack: 0.00 N"), (7, "Cable 6 pulled")])
def test_a_cable_that_a_stop_leaves_beyond_its_limits_fails_the_run(
    prepared: PreparedRun, tmp_path: Path, node: int, words: str
) -> None:
    """Three cycles in which one drive rests and the others follow, then a stop of all."""
    script = incoming(lambda: lose_next({RPDO1_BASE + node}, 3))()
    cycles, summary, state = recorded(prepared, tmp_path / "run", script)
    assert state is State.LATCHED
    following = np.isfinite(cycles.following_error)
    assert np.isfinite(cycles.tensions[-1]).all()
    worst = summary["tension_n"]
    assert worst["max"] == pytest.approx(np.nanmax(cycles.tensions))
    assert worst["min"] == pytest.approx(np.nanmin(cycles.tensions))
    check = tension_check(summary)
    assert not check["passed"]
    assert words in check["text"]
    assert np.isnan(cycles.following_tensions[~following]).all()
    assert (cycles.following_tensions == cycles.tensions)[following].all()


def test_the_tension_of_a_drive_that_does_not_answer_is_known_until_then(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    script = TABLE["F7 a drive falls silent"].script()
    cycles, summary, state = recorded(prepared, tmp_path / "run", script)
    assert state is State.LATCHED
    silent = cycles.missing > 0
    assert np.isfinite(cycles.tensions[-1]).tolist() == [True] * 3 + [False] + [True] * 4
    assert (np.isnan(cycles.tensions[:, 3]) == silent)[150:].all()
    last = cycles.time[~silent][-1]
    assert tension_check(summary)["text"].endswith(f"; that of cable 4 only until {last:.2f} s.")


def test_a_drive_without_torque_measures_no_tension(prepared: PreparedRun, tmp_path: Path) -> None:
    script = TABLE["F8 a drive in fault"].script()
    cycles, _, state = recorded(prepared, tmp_path / "run", script)
    assert state is State.LATCHED
    assert np.isfinite(cycles.tensions[-1]).tolist() == [True] * 2 + [False] + [True] * 5


def test_after_a_path_stop_for_a_fault_tensions_are_known_to_the_end(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    script = TABLE["F18 a cable is overloaded"].script()
    cycles, summary, state = recorded(prepared, tmp_path / "run", script)
    assert state is State.LATCHED
    assert cycles.state[-1] == State.SECURING.value
    assert np.isnan(cycles.following_error[-1])
    assert np.isfinite(cycles.tensions[-1]).all()
    assert not tension_check(summary)["passed"]


def test_drives_that_hold_after_a_run_without_a_fault_measure_no_tension(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    """So samples at rest, for the calibration of a rig, last while the drives follow."""
    cycles, summary, state = recorded(prepared, tmp_path / "run", lambda _bench: None)
    assert state is State.FINISHED
    known = np.isfinite(cycles.tensions)
    assert (known == np.isfinite(cycles.following_error)[:, None]).all()
    assert not known[-1].any()
    assert "known" not in tension_check(summary)["text"]
