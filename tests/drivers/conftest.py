"""Rigs, and benches with a master and simulated drives on one bus."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.can_bus import BusSettings
from drivers.factory import make_drive_group
from model.rig import Rig, load_rig
from simulation.drives.cia402_rig import SimulatedCia402Rig
from tests.drivers.drive_bench import Bench, SteppedClock, free_udp_channel, three_on_a_bus

ROOT = Path(__file__).resolve().parents[2]
_CHANNELS = itertools.count()


@pytest.fixture(scope="session")
def rig() -> Rig:
    return load_rig(ROOT / "configs" / "gachon_8_6.yaml")


@pytest.fixture(scope="session")
def pulley_rig() -> Rig:
    return load_rig(ROOT / "configs" / "hall_10_6.yaml")


@pytest.fixture
def bench(rig: Rig) -> Iterator[Bench]:
    """All in one thread; time advances with SYNC."""
    settings = BusSettings("virtual", f"drivers-{next(_CHANNELS)}")
    with three_on_a_bus(settings) as (master, drives, ear):
        rehearsal = SimulatedCia402Rig(rig, drives, rig.home)
        yield Bench(rig, make_drive_group(rig, master, rehearsal.pump), rehearsal, ear)


@pytest.fixture(params=["virtual", "udp_multicast"])
def served_bench(request: pytest.FixtureRequest, rig: Rig) -> Iterator[Bench]:
    """The drives answer in their own thread, as on a real bus."""
    kind = request.param
    channel = free_udp_channel() if kind == "udp_multicast" else f"served-{next(_CHANNELS)}"
    clock = SteppedClock(rig.document.bus.cycle_ms / 1000.0)
    stop = threading.Event()
    with three_on_a_bus(BusSettings(kind, channel)) as (master, drives, ear):
        rehearsal = SimulatedCia402Rig(rig, drives, rig.home)
        server = threading.Thread(
            target=rehearsal.serve, args=(stop.is_set,), kwargs={"clock": clock}
        )
        server.start()
        try:
            bench = Bench(rig, make_drive_group(rig, master), rehearsal, ear)
            bench.before_cycle = clock.tick
            bench.reply_timeout = 5.0  # the most a lost frame costs; replies end the wait
            yield bench
        finally:
            stop.set()
            server.join()
