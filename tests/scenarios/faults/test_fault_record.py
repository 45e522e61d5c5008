"""After a fault the record states the row that was sent."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from executor.recording.tables import CycleTable
from executor.state_machine import State
from executor.trajectory.setpoints import PreparedRun
from tests.scenarios.faults.bench import Script, once, simulated
from tests.scenarios.faults.cases import TABLE, late
from tests.scenarios.stage import concluded
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
    assert 100 < rows[-1] < len(table) - 1
    assert (cycles.set_counts[stopped] == table.setpoints[rows[stopped]]).all()
    assert np.abs(cycles.actual_counts - cycles.set_counts)[stopped].max() <= FOLLOWED
    assert summary["travelled_mm"] == pytest.approx(table.travelled[rows[-1]] * 1e3, abs=1e-6)
    assert cycles.planned[-1] == pytest.approx(table.positions[rows[-1]])
    assert summary["encoder_error_mm"]["max"] < 0.05, "a row is 0.2 mm"
