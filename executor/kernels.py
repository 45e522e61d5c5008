"""Loads or compiles Numba kernels before a motion, so that no drive or camera waits.

Only these functions load Numba: a real-time process on a real bus does not need it.
"""

from __future__ import annotations

from pathlib import Path

import simulation
import tracking
from model.progress import SILENT, Listener


def ready_to_measure(listener: Listener = SILENT, *, only_missing: bool = False) -> None:
    """Loads the tag edge detector, so that no image waits for it.

    Args:
        only_missing: Only compiles it, if necessary: other processes then load it.
    """
    from model.jit import KernelSet, compilation

    task = KernelSet("edges", (Path(tracking.__path__[0]) / "edges",))
    with compilation(task, "the tag edge detector", "up to a minute", listener) as is_compiled:
        if not (only_missing and is_compiled):
            from tracking.edges import refine

            refine.load_kernels()


def ready_to_simulate(listener: Listener = SILENT, *, only_missing: bool = False) -> None:
    """Loads the equilibrium solver of the simulated platform, so that no drive waits.

    Args:
        only_missing: As for `ready_to_measure`.
    """
    from model.jit import KernelSet, compilation

    task = KernelSet("platform", (Path(simulation.__path__[0]) / "equilibrium",))
    with compilation(task, "the simulated platform", "about ten seconds", listener) as is_compiled:
        if not (only_missing and is_compiled):
            from simulation import plant

            plant.load_kernels()
