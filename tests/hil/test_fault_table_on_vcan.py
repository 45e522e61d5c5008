"""The fault table over a CAN bus of the kernel, the executor in a process of its own."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.can_bus import BusSettings
from executor.trajectory.setpoints import PreparedRun, prepare
from model.plan import load_plan
from model.rig import load_rig
from planner.check import verify
from tests.cli.plans import RIG
from tests.scenarios.faults.bench import live
from tests.scenarios.faults.cases import TABLE, complaints, held_up, row
from tests.scenarios.faults.drive_cases import ROWS
from tests.scenarios.faults.masters import ForkedMasters

BLUR_S = 0.010  # executor and drives share one slow processor
SOON = (
    "F5 three set-points lost",
    "F6 20 % of SYNC lost",
    "F7 a drive falls silent",
)
"""In the subset, too."""
OF_DRIVES = (
    "D a lost heartbeat is a fault",
    "D SDO answers take 300 ms",
    "D no optional object",
)
"""Of the rows about drives, those in which the bus could make a difference."""

pytestmark = pytest.mark.hil


@pytest.fixture(scope="module")
def prepared(short_plan: Path) -> PreparedRun:
    return prepare(verify(load_plan(short_plan)), load_rig(RIG))


@pytest.fixture(scope="module")
def masters(prepared: PreparedRun) -> Iterator[ForkedMasters]:
    starting = ForkedMasters(prepared)
    yield starting
    starting.close()


def cases() -> Iterator[object]:
    """What can be done to an executor in another process."""
    for name in (*TABLE, *OF_DRIVES):
        if ROWS[name].live:
            yield pytest.param(name, marks=[] if name in SOON else [pytest.mark.slow])


@pytest.mark.parametrize("name", list(cases()))
def test_a_fault(
    prepared: PreparedRun,
    masters: ForkedMasters,
    channel: str,
    artefacts: Path,
    tmp_path: Path,
    name: str,
) -> None:
    fault, settings = ROWS[name], BusSettings("socketcan", channel)
    run, behaviour = tmp_path / "run", fault.drives()
    with live(prepared, run, fault.script(), settings, masters, behaviour=behaviour) as bench:
        bench.blur = BLUR_S
        ended = bench.run()
        cause = str(bench.outcome.get("cause", ""))
        assert not held_up(fault, bench, cause), cause
        found = complaints(fault, bench, ended, cause, prepared.checked.table.cycle)
        line = row(name, fault, "vcan", bench, ended, cause, found)
    with (artefacts / "faults.json").open("a") as file:
        file.write(json.dumps(line, ensure_ascii=False) + "\n")
    assert found == []
