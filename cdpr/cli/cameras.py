"""Opens the cameras of a run, real or synthetic, each in its own process."""

from __future__ import annotations

from contextlib import ExitStack, contextmanager
from functools import partial
from typing import TYPE_CHECKING

from cdpr.cli.camera_choice import SYNTHETIC, named_camera
from cdpr.errors import Fault, StoppedByOperator

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from cdpr.rig import Camera, Rig
    from cdpr.rig_file import RigDocument
    from cdpr.scene import Scene
    from cdpr.scene_file import SceneDocument
    from drivers.cameras import LiveCamera
    from executor.observer import Observer, PictureSource, Trigger
    from executor.run_cameras import RunCameras
    from executor.wishes import WishBoard
    from simulation.motion import Film

#: About so many pictures of a run are kept for its report.
KEPT_PICTURES = 12


@contextmanager
def open_cameras(
    rig: Rig,
    scene: Scene,
    eyes: Mapping[Camera, str],
    folder: Path,
    pictures: int,
    board: WishBoard,
    *,
    simulated_time: bool,
    quiet: bool,
) -> Iterator[RunCameras | None]:
    """Starts a process for each camera; None without one.

    Args:
        rig: The robot.
        scene: What the cameras see beside it.
        eyes: From `choose_cameras`.
        folder: The run folder.
        pictures: How many are expected of each; some of them are kept.
        board: A stop that is wished here ends the opening.
        simulated_time: A late picture holds the run up instead of being dropped.
        quiet: Nothing shows that it waits.

    Raises:
        StoppedByOperator: A stop was wished before all were open.
        CdprError: A camera cannot be used, for the reason told.
    """
    if not eyes:
        yield None
        return
    from cdpr.clearance import ClearanceModel
    from cdpr.cli.compiling import ready_for_processes
    from cdpr.cli.output import spinner
    from executor.camera_eye import CameraEye
    from executor.camera_process import CameraProcess
    from executor.camera_start import wait_until_ready
    from executor.run_cameras import RunCameras

    keep_every = max(1, pictures // KEPT_PICTURES)
    ready_for_processes(not quiet)
    with ExitStack() as stack:
        processes = {}
        for camera, source in eyes.items():
            place = (camera.name, source, folder, keep_every)
            make = partial(make_observer, rig.document, scene.document, *place, named=len(eyes) > 1)
            process = CameraProcess(camera.name, make, may_wait=simulated_time)
            stack.callback(process.close)
            processes[camera] = process
        names = ", ".join(camera.name for camera in eyes)
        with spinner(f"opening camera {names}", not quiet):
            wait_until_ready(list(processes.values()), partial(require_no_stop, board))
        yield RunCameras(
            [CameraEye(process, eyes[camera]) for camera, process in processes.items()],
            ClearanceModel(rig, scene),
            scene.obstacle_clearance,
            asked_rate(eyes),
        )


def asked_rate(eyes: Mapping[Camera, str]) -> float:
    """How often all cameras are asked for a picture: as often as the slowest takes one, [Hz]."""
    return min(camera.rate for camera in eyes)


def require_no_stop(board: WishBoard) -> None:
    """The last look at the board before something is begun.

    Raises:
        StoppedByOperator: A stop is wished.
    """
    if board.read().stop:
        raise StoppedByOperator(
            "stopped before anything moved", next_step="run it again when all is well"
        )


def make_observer(
    rig_document: RigDocument,
    scene_document: SceneDocument,
    camera_name: str,
    source: str,
    folder: Path | None,
    keep_every: int,
    *,
    named: bool,
) -> Observer:
    """Builds the observer inside its camera's process."""
    from cdpr.cli.compiling import ready_to_measure
    from cdpr.rig import rig_from_document
    from cdpr.scene import scene_from_document
    from executor.observer import Observer
    from executor.run_folder import RunFolder

    rig, scene = rig_from_document(rig_document), scene_from_document(scene_document)
    camera = named_camera(rig, camera_name)
    ready_to_measure(shown=False)
    pictures = _source(rig, scene, camera, source)
    kept = None if folder is None else RunFolder(folder)
    return Observer(rig, camera, pictures, kept, keep_every, named=named)


def _source(rig: Rig, scene: Scene, camera: Camera, name: str) -> PictureSource:
    if name == SYNTHETIC:
        from simulation.motion import Film
        from simulation.simulate import make_synthetic_camera

        return RenderedPictures(Film(make_synthetic_camera(rig, scene, camera)))
    from drivers.cameras import LiveCamera

    return LivePictures(LiveCamera(name, camera))


class RenderedPictures:
    """The synthetic camera as the run's source of pictures."""

    def __init__(self, film: Film) -> None:
        self._film = film

    def picture(self, trigger: Trigger) -> tuple[NDArray[np.uint8], float]:
        """Renders the platform where it truly is."""
        if trigger.true_pose is None:
            raise Fault("the synthetic camera was not told where the platform is")
        return self._film.picture(trigger.time, trigger.true_pose, trigger.frame), 0.0

    def close(self) -> None:
        """Nothing to let go of."""


class LivePictures:
    """A real camera as the run's source of pictures."""

    def __init__(self, camera: LiveCamera) -> None:
        self._camera = camera

    def picture(self, trigger: Trigger) -> tuple[NDArray[np.uint8], float]:
        """The next picture, and how long after the trigger it arrived."""
        frame = self._camera.read()
        return frame.image, frame.time - trigger.asked

    def close(self) -> None:
        """Lets go of the camera."""
        self._camera.close()
