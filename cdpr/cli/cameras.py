"""Opens the cameras of a run, real or synthetic, each in its own process."""

from __future__ import annotations

from contextlib import ExitStack, contextmanager
from functools import partial
from typing import TYPE_CHECKING

from cdpr.cli.camera_choice import SYNTHETIC, named_camera
from cdpr.errors import Fault

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from cdpr.poses import Pose
    from cdpr.rig import Camera, Rig
    from cdpr.rig_file import RigDocument
    from cdpr.scene import Scene
    from cdpr.scene_file import SceneDocument
    from drivers.cameras import LiveCamera
    from executor.observer import Observer, PictureSource, Trigger
    from executor.run_cameras import RunCameras
    from simulation.motion import Film
    from tracking.measurement import Observation

#: About so many pictures of a run are kept for its report.
KEPT_PICTURES = 12


@contextmanager
def open_cameras(
    rig: Rig,
    scene: Scene,
    eyes: Mapping[Camera, str],
    folder: Path,
    pictures: int,
    simulated_time: bool,
) -> Iterator[RunCameras | None]:
    """Starts a process for each camera; None without one.

    Args:
        rig: The robot.
        scene: What the cameras see beside it.
        eyes: From `choose_cameras`.
        folder: The run folder.
        pictures: How many are expected of each; some of them are kept.
        simulated_time: A late picture holds the run up instead of being dropped.
    """
    if not eyes:
        yield None
        return
    from cdpr.clearance import ClearanceModel
    from executor.camera_eye import CameraEye
    from executor.camera_process import CameraProcess
    from executor.run_cameras import RunCameras

    keep_every = max(1, pictures // KEPT_PICTURES)
    with ExitStack() as stack:
        processes = {}
        for camera, source in eyes.items():
            place = (camera.name, source, folder, keep_every)
            make = partial(make_observer, rig.document, scene.document, *place, named=len(eyes) > 1)
            process = CameraProcess(camera.name, make, may_wait=simulated_time)
            stack.callback(process.close)
            processes[camera] = process
        for process in processes.values():
            process.require_ready()
        yield RunCameras(
            [CameraEye(process, eyes[camera]) for camera, process in processes.items()],
            ClearanceModel(rig, scene),
            scene.obstacle_clearance,
            asked_rate(eyes),
        )


def asked_rate(eyes: Mapping[Camera, str]) -> float:
    """How often all cameras are asked for a picture: as often as the slowest takes one, [Hz]."""
    return min(camera.rate for camera in eyes)


def look_at_rest(
    rig: Rig,
    name: str,
    pictures: int,
    true_pose: Pose | None,
    before_each: Callable[[], None],
) -> list[Observation]:
    """Pictures of a platform that stands still, each measured.

    Args:
        rig: The robot; its first camera is used.
        name: From `choose_camera`.
        pictures: How many.
        true_pose: Where the simulated platform is.
        before_each: Called before each picture; what it raises ends the looking.
    """
    import time

    from cdpr.cli.compiling import ready_to_measure
    from cdpr.scene import nothing_in_the_way
    from executor.observer import Trigger
    from tracking.tracker import Tracker

    ready_to_measure(shown=True)
    camera = rig.cameras[0]
    source, tracker = _source(rig, nothing_in_the_way(rig), camera, name), Tracker(rig, camera)
    try:
        looks = []
        for frame in range(pictures):
            before_each()
            asked = time.monotonic()
            image, _ = source.picture(Trigger(frame, frame / camera.rate, asked, true_pose))
            looks.append(tracker.observe(image, frame / camera.rate))
        return looks
    finally:
        source.close()


def make_observer(
    rig_document: RigDocument,
    scene_document: SceneDocument,
    camera_name: str,
    source: str,
    folder: Path,
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
    return Observer(rig, camera, pictures, RunFolder(folder), keep_every, named=named)


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
