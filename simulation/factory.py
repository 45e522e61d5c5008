"""The simulated rig for the drives that a rig file names, and its camera."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import can

from model.errors import BadInput
from model.pose import Pose
from model.rig import Camera, Rig
from model.scene import Load, Scene
from simulation.drives.behaviour import STRICT, DriveBehaviour
from simulation.drives.eds_file import eds_of
from simulation.ground_truth import camera_as_built, rig_as_built, simulation_of
from simulation.rig import SimulatedRig

if TYPE_CHECKING:
    from simulation.camera.camera import SyntheticCamera


def make_rehearsal(
    rig: Rig,
    bus: can.BusABC,
    start_pose: Pose,
    load: Load | None = None,
    *,
    behaviour: DriveBehaviour = STRICT,
    eds: Path | None = None,
) -> SimulatedRig[Any]:
    """Simulated drives of a rig's kind.

    Args:
        rig: As the next three, for `SimulatedRig`.
        bus: The drives' end.
        start_pose: ``world_from_platform``.
        load: What the platform carries.
        behaviour: Of CiA 402 drives, where the standards leave a choice.
        eds: EDS file of CiA 402 drives; left out, that of their profile.

    Raises:
        BadInput: The EDS file cannot be used, or the drives are no CiA 402 drives and have none.
    """
    check_drives(rig, behaviour, eds)
    # The protocol's library is loaded only for those who need it.
    if rig.document.drives.type == "odrive":
        from simulation.drives.odrive import SimulatedOdriveRig

        return SimulatedOdriveRig(rig, bus, start_pose, load)
    from simulation.drives.cia402_rig import SimulatedCia402Rig

    return SimulatedCia402Rig(rig, bus, start_pose, load, behaviour=behaviour, eds=eds)


def check_drives(rig: Rig, behaviour: DriveBehaviour, eds: Path | None) -> None:
    """Whether a rig's drives can be simulated so; arguments and errors as for `make_rehearsal`."""
    if rig.document.drives.type != "odrive":
        eds_of(rig, eds)
    elif eds is not None or behaviour != STRICT:
        raise BadInput(
            "simulated ODrives have neither an EDS file nor selectable behaviours",
            where="drives.type",
            next_step="leave out --eds and --drive-behaviour",
        )


def make_synthetic_camera(rig: Rig, scene: Scene, camera: Camera) -> SyntheticCamera:
    """The camera as it truly is, before the rig as it was truly built.

    Args:
        rig: The robot, with the ``simulation`` section of its file.
        scene: Its obstacles.
        camera: One of the rig's, as the rig file describes it.

    Raises:
        BadInput: The rig has no tags, or the true lens cannot be.
    """
    from simulation.camera.camera import SyntheticCamera

    truth, optics = camera_as_built(rig, camera)
    number = [one.name for one in rig.cameras].index(camera.name)
    seed = simulation_of(rig).seed + number  # no two cameras have the same noise
    return SyntheticCamera(rig_as_built(rig), scene, truth, seed, optics)
