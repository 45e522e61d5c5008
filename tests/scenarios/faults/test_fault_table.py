"""F1–F28, without F15 and F22: faults during motion; all drives stop together and stay stopped."""

from __future__ import annotations

import random
from collections.abc import Sequence
from itertools import permutations
from pathlib import Path

import pytest

from drivers.can_bus import BusSettings
from executor.recording.run_folder import RunEvent
from executor.state_machine import State
from executor.trajectory.setpoints import PreparedRun
from tests.scenarios.faults.bench import SimulatedBench, live, once, simulated
from tests.scenarios.faults.cases import ATTEMPTS, complaints, held_up
from tests.scenarios.faults.drive_cases import ROWS
from tests.scenarios.faults.masters import Masters
from tests.scenarios.faults.random_faults import random_run

#: Those that a process of its own, or real time, could change.
BETWEEN_PROCESSES = (
    "F1 kill -9",
    "F5 three set-points lost",
    "F6 20 % of SYNC lost",
    "F7 a drive falls silent",
    "F8 a drive in fault",
    "F10 bus-off",
    "F11 replies held up for 20 cycles",
    "F19 a cable breaks",
    "F20 the operator stops",
    "D a lost heartbeat is a fault",
)


@pytest.mark.parametrize("name", ROWS)
def test_in_simulated_time(prepared: PreparedRun, tmp_path: Path, name: str) -> None:
    fault = ROWS[name]
    with simulated(
        prepared,
        tmp_path / "run",
        fault.script(),
        bitrate=fault.bitrate,
        behaviour=fault.drives(),
        profile=fault.profile,
    ) as bench:
        ended = bench.run()
        cycle = prepared.checked.table.cycle
        assert complaints(fault, bench, ended, bench.cause, cycle) == []
        assert twice(bench.events()) == []


def twice(events: Sequence[RunEvent]) -> list[str]:
    """Events that another one of the same moment says as well."""
    return [
        event.text
        for event, other in permutations(events, 2)
        if (event.code, event.time_s) == (other.code, other.time_s)
        and other.text.startswith(event.text)
    ]


@pytest.mark.slow
@pytest.mark.real_time
@pytest.mark.parametrize("name", BETWEEN_PROCESSES)
def test_between_processes_in_real_time(
    calm_run: PreparedRun,
    tmp_path: Path,
    name: str,
    masters: Masters,
    between_processes: BusSettings,
) -> None:
    """A computer that holds the drives up ends a run before its fault; then it is done again.

    At 100 Hz: `benchmarks/faults.py` and `make hil`.
    """
    fault = ROWS[name]
    for attempt in range(ATTEMPTS):
        run = tmp_path / f"run {attempt}"
        behaviour = fault.drives()
        with live(
            calm_run, run, fault.script(), between_processes, masters, behaviour=behaviour
        ) as bench:
            ended = bench.run()
            cause = str(bench.outcome.get("cause", ""))
            if held_up(fault, bench, cause):
                continue
            cycle = calm_run.checked.table.cycle
            assert complaints(fault, bench, ended, cause, cycle) == []
            return
    pytest.fail("this computer held the simulated drives up each time")


@pytest.mark.parametrize("seed", range(6))
def test_f1_a_master_that_dies_in_any_cycle(
    prepared: PreparedRun, tmp_path: Path, seed: int
) -> None:
    with simulated(prepared, tmp_path / "run", once(SimulatedBench.kill)) as bench:
        bench.fault_cycle = random.Random(seed).randrange(15, 330)
        assert bench.run() is None
        assert bench.violations() == []
        stop = bench.stop()
        assert stop.time <= 0.050
        assert stop.spread <= 0.010
        assert stop.travel <= 0.001


@pytest.mark.parametrize("seed", range(6))
def test_f28_random_faults_leave_nothing_broken(
    prepared: PreparedRun, tmp_path: Path, seed: int
) -> None:
    """Thousands of them: `python benchmarks/faults.py`."""
    assert random_run(prepared, tmp_path / "run", seed).violations == []


def test_nothing_is_wrong_with_a_run_without_a_fault(prepared: PreparedRun, tmp_path: Path) -> None:
    with simulated(prepared, tmp_path / "run", lambda _bench: None) as bench:
        assert bench.run() is State.FINISHED
        assert bench.violations(mixed_cycles=0.0, rows=0.0) == []
