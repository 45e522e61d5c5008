"""A simulated rig with the interfaces of a real one: drives, platform, cameras."""

from __future__ import annotations

from typing import TYPE_CHECKING

from model.lazy import lazy_names

if TYPE_CHECKING:
    from simulation.camera.camera import SyntheticCamera
    from simulation.factory import make_rehearsal, make_synthetic_camera
    from simulation.ground_truth import rig_as_built
    from simulation.plant import Plant
    from simulation.rig import SimulatedRig

__all__ = [
    "Plant",
    "SimulatedRig",
    "SyntheticCamera",
    "make_rehearsal",
    "make_synthetic_camera",
    "rig_as_built",
]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "simulation.camera.camera": "SyntheticCamera",
            "simulation.factory": "make_rehearsal make_synthetic_camera",
            "simulation.ground_truth": "rig_as_built",
            "simulation.plant": "Plant",
            "simulation.rig": "SimulatedRig",
        },
    )
