"""Loads or compiles Numba kernels before a motion, so that no drive or camera waits.

Only these functions load Numba: a real-time process on a real bus does not need it.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import simulation
import tracking
from model.progress import SILENT, Listener

if TYPE_CHECKING:
    from model.jit import KernelSet


def ready_to_measure(listener: Listener = SILENT) -> None:
    """Loads the tag edge detector, so that no image waits for it."""
    from model.jit import compilation
    from tracking.edges import refine

    with compilation(_edges(), "the tag edge detector", "up to a minute", listener):
        refine.load_kernels()


def ready_to_simulate(listener: Listener = SILENT) -> None:
    """Loads the equilibrium solver of the simulated platform, so that no drive waits."""
    from model.jit import compilation
    from simulation import plant

    with compilation(_platform(), "the simulated platform", "about ten seconds", listener):
        plant.load_kernels()


def ready_for_camera_processes(listener: Listener = SILENT) -> None:
    """Compiles the tag edge detector once, for processes that then only load it."""
    from model import jit

    if not jit.is_compiled(_edges()):
        ready_to_measure(listener)


def ready_for_simulating_process(listener: Listener = SILENT) -> None:
    """Compiles the simulated platform once, for a process that then only loads it."""
    from model import jit

    if not jit.is_compiled(_platform()):
        ready_to_simulate(listener)


def _edges() -> KernelSet:
    from model.jit import KernelSet

    return KernelSet("edges", (Path(tracking.__path__[0]) / "edges",))


def _platform() -> KernelSet:
    from model.jit import KernelSet

    return KernelSet("platform", (Path(simulation.__path__[0]) / "equilibrium",))
