"""Executors in processes of their own, for faults that only real ones have."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.can_bus import BusSettings
from tests.cli.plans import RIG
from tests.scenarios.faults.masters import Masters


@pytest.fixture(scope="session")
def masters(short_plan: Path) -> Iterator[Masters]:
    """They run the short plan."""
    starting = Masters(short_plan, RIG)
    yield starting
    starting.close()


@pytest.fixture(scope="session")
def between_processes() -> BusSettings:
    """A bus that no other test run on this machine hears."""
    return BusSettings("udp_multicast", f"239.74.163.25:{20000 + (os.getpid() * 13) % 20000}")
