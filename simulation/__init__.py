"""A simulated rig with the interfaces of a real one: drives, platform, cameras."""

from __future__ import annotations

from typing import TYPE_CHECKING

from model.lazy import lazy_names

if TYPE_CHECKING:
    from simulation.camera.camera import SyntheticCamera
    from simulation.factory import make_rehearsal, make_synthetic_camera, open_rehearsal
    from simulation.ground_truth import PowerLoss, rig_as_built
    from simulation.plant import Plant
    from simulation.rig import SimulatedRig

__all__ = [
    "Plant",
    "PowerLoss",
    "SimulatedRig",
    "SyntheticCamera",
    "make_rehearsal",
    "make_synthetic_camera",
    "open_rehearsal",
    "rig_as_built",
]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "simulation.camera.camera": "SyntheticCamera",
            "simulation.factory": "make_rehearsal make_synthetic_camera open_rehearsal",
            "simulation.ground_truth": "PowerLoss rig_as_built",
            "simulation.plant": "Plant",
            "simulation.rig": "SimulatedRig",
        },
    )
