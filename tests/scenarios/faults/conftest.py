"""Executors in separate processes, for faults that only real processes have."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.can_bus import BusSettings
from executor.trajectory.setpoints import PreparedRun, prepare
from model.plan import load_plan
from model.rig import load_rig
from planner.check import verify
from tests.cli.plans import rig_with_long_cycles
from tests.scenarios.faults.masters import Masters


@pytest.fixture(scope="session")
def calm_rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The paper's rig in cycles so long that a busy computer seldom spoils one."""
    return rig_with_long_cycles(tmp_path_factory.mktemp("calm"), cycle_ms=50)


@pytest.fixture(scope="session")
def calm_run(short_plan: Path, calm_rig: Path) -> PreparedRun:
    """The short plan on that rig."""
    return prepare(verify(load_plan(short_plan)), load_rig(calm_rig))


@pytest.fixture(scope="session")
def masters(short_plan: Path, calm_rig: Path) -> Iterator[Masters]:
    """They run the short plan on that rig."""
    starting = Masters(short_plan, calm_rig)
    yield starting
    starting.close()


@pytest.fixture(scope="session")
def between_processes() -> BusSettings:
    """A bus not used by other test runs on this machine."""
    return BusSettings("udp_multicast", f"239.74.163.25:{20000 + (os.getpid() * 13) % 20000}")
