"""The simulated rig for the drives that a rig file names, and its camera."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import can

from cdpr.poses import Pose
from cdpr.rig import Camera, Rig
from cdpr.scene import Load, Scene
from simulation.as_built import camera_as_built, rig_as_built, simulation_of
from simulation.simulated_rig import SimulatedRig

if TYPE_CHECKING:
    from simulation.camera import SyntheticCamera


def make_rehearsal(
    rig: Rig, bus: can.BusABC, start_pose: Pose, load: Load | None = None
) -> SimulatedRig[Any]:
    """Simulated drives of a rig's kind; arguments and errors as for `SimulatedRig`."""
    # The protocol's library is loaded only for those who need it.
    if rig.document.drives.type == "odrive":
        from simulation.odrive_rehearsal import OdriveRehearsal

        return OdriveRehearsal(rig, bus, start_pose, load)
    from simulation.rehearsal import Rehearsal

    return Rehearsal(rig, bus, start_pose, load)


def make_synthetic_camera(rig: Rig, scene: Scene, camera: Camera) -> SyntheticCamera:
    """The camera as it truly is, before the rig as it was truly built.

    Args:
        rig: The robot, with the ``simulation`` section of its file.
        scene: Its obstacles.
        camera: One of the rig's, as the rig file describes it.

    Raises:
        BadInput: The rig has no tags, or the true lens cannot be.
    """
    from simulation.camera import SyntheticCamera

    truth, optics = camera_as_built(rig, camera)
    number = [one.name for one in rig.cameras].index(camera.name)
    seed = simulation_of(rig).seed + number  # no two cameras have the same noise
    return SyntheticCamera(rig_as_built(rig), scene, truth, seed, optics)
