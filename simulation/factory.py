"""Creates the simulated rig for a rig file's drives, and its synthetic cameras."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import can

from drivers.can_bus import BusSettings, open_bus
from drivers.factory import nodes_present
from model.errors import BadInput, Refused
from model.pose import Pose
from model.rig import Camera, Rig
from model.scene import Load, Scene
from simulation.drives.behaviour import STRICT, DriveBehaviour
from simulation.drives.eds_file import eds_of
from simulation.ground_truth import PowerLoss, camera_as_built, rig_as_built, simulation_of
from simulation.rig import SimulatedRig

if TYPE_CHECKING:
    from simulation.camera.camera import SyntheticCamera


def make_rehearsal(
    rig: Rig,
    bus: can.BusABC,
    start_pose: Pose,
    load: Load | None = None,
    *,
    lost_power: PowerLoss | None = None,
    behaviour: DriveBehaviour = STRICT,
    eds: Path | None = None,
) -> SimulatedRig[Any]:
    """Simulated drives of the rig's type.

    Args:
        rig: This and the next three as for `SimulatedRig`.
        bus: The drives' end.
        start_pose: ``world_from_platform``.
        load: Payload of the platform.
        lost_power: Effect of a power loss, applied at that pose.
        behaviour: Of CiA 402 drives, within the standards.
        eds: EDS file of CiA 402 drives (default: that of their profile).

    Raises:
        BadInput: The EDS file cannot be used, or the drives are not CiA 402 drives.
        Fault: The platform has no equilibrium there.
    """
    check_drives(rig, behaviour, eds)
    rehearsal: SimulatedRig[Any]
    if rig.document.drives.type == "odrive":
        from simulation.drives.odrive import SimulatedOdriveRig

        rehearsal = SimulatedOdriveRig(rig, bus, start_pose, load)
    else:
        from simulation.drives.cia402_rig import SimulatedCia402Rig

        rehearsal = SimulatedCia402Rig(rig, bus, start_pose, load, behaviour=behaviour, eds=eds)
    if lost_power is not None:
        lost_power.apply_to(rig, rehearsal.plant, [drive.motor for drive in rehearsal.drives])
    return rehearsal


@contextmanager
def open_rehearsal(
    rig: Rig,
    start_pose: Pose | None = None,
    load: Load | None = None,
    *,
    lost_power: PowerLoss | None = None,
    behaviour: DriveBehaviour = STRICT,
    eds: Path | None = None,
) -> Iterator[SimulatedRig[Any]]:
    """Simulated drives on the rig's bus, closed at the end; `SimulatedRig.serve` runs them.

    Args:
        rig: The robot and its bus.
        start_pose: ``world_from_platform`` (default: home).
        load: Payload of the platform.
        lost_power: Effect of a power loss, applied at that pose.
        behaviour: Of CiA 402 drives, within the standards.
        eds: EDS file of CiA 402 drives (default: that of their profile).

    Raises:
        BadInput: As for `make_rehearsal`, or python-can has no such interface.
        HardwareMissing: The bus cannot be opened.
        Refused: Drives with the same node ids already answer.
        Fault: The bus failed, or the platform has no equilibrium.
    """
    settings = BusSettings.of(rig)
    with open_bus(settings) as bus:
        if present := sorted(nodes_present(rig, bus)):
            raise Refused(
                f"drives with node ids {', '.join(map(str, present))} already answer",
                where=str(settings),
                why="two drives with the same node id answer each request twice",
                next_step="end the other `cdpr sim`, disconnect the real drives, or pass another"
                " `channel=`",
            )
        start = start_pose or rig.home
        yield make_rehearsal(
            rig, bus, start, load, lost_power=lost_power, behaviour=behaviour, eds=eds
        )


def check_drives(rig: Rig, behaviour: DriveBehaviour = STRICT, eds: Path | None = None) -> None:
    """Checks the arguments of `make_rehearsal`; errors as there."""
    if rig.document.drives.type != "odrive":
        eds_of(rig, eds)
    elif eds is not None or behaviour != STRICT:
        raise BadInput(
            "simulated ODrives have neither an EDS file nor selectable behaviours",
            where="drives.type",
            next_step="leave out --eds and --drive-behaviour",
        )


def make_synthetic_camera(rig: Rig, scene: Scene, camera: Camera) -> SyntheticCamera:
    """The true camera in front of the rig as built.

    Args:
        rig: The robot, with the ``simulation`` section of its file.
        scene: Obstacles.
        camera: One of the rig's, as the rig file describes it.

    Raises:
        BadInput: The rig has no tags, or the true lens is invalid.
    """
    from simulation.camera.camera import SyntheticCamera

    truth, optics = camera_as_built(rig, camera)
    number = [one.name for one in rig.cameras].index(camera.name)
    seed = simulation_of(rig).seed + number  # no two cameras have the same noise
    return SyntheticCamera(rig_as_built(rig), scene, truth, seed, optics)
