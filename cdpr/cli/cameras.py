"""Opens the cameras of a run, real or synthetic, each in its own process."""

from __future__ import annotations

from contextlib import ExitStack, contextmanager
from functools import partial
from typing import TYPE_CHECKING

from cdpr.errors import BadInput, Fault

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

SYNTHETIC = "synthetic"
#: About so many pictures of a run are kept for its report.
KEPT_PICTURES = 12


def named_camera(rig: Rig, name: str | None) -> Camera:
    """The rig's camera of a name; its first when no name is given.

    Raises:
        BadInput: The rig has none of this name, or none at all.
    """
    names = [camera.name for camera in rig.cameras]
    if not names:
        raise BadInput(
            "the rig file has no camera", where=rig.name, next_step="add a `cameras` section"
        )
    if name is None:
        return rig.cameras[0]
    if name not in names:
        raise BadInput(
            f"no camera {name!r}", where=rig.name, next_step=f"name one of: {', '.join(names)}"
        )
    return rig.cameras[names.index(name)]


def choose_camera(rig: Rig, wanted: str | None, without: bool, in_process: bool) -> str | None:
    """Where pictures come from: ``synthetic``, a camera's index or address, or None.

    Raises:
        BadInput: The wish cannot be met; nothing is left out silently.
    """
    if without:
        if wanted is not None:
            raise BadInput(
                "--camera and --no-camera contradict each other", next_step="leave one of them out"
            )
        return None
    if not rig.cameras or not rig.platform_tags:
        raise BadInput(
            "the rig file has no camera or no tags",
            where=rig.name,
            next_step="add cameras and tags to the rig file, or pass --no-camera",
        )
    if wanted is None:
        if not in_process:
            raise BadInput(
                "no camera was named",
                where="--camera",
                why="the drives are not simulated in this process, so no picture can be rendered",
                next_step="pass --camera INDEX for a real camera, or --no-camera",
            )
        return SYNTHETIC
    if wanted == SYNTHETIC and not in_process:
        raise BadInput(
            "the synthetic camera needs drives that are simulated in this process",
            where="--camera",
            next_step="use the interface 'virtual', a real camera, or --no-camera",
        )
    return wanted


def choose_cameras(
    rig: Rig, wanted: list[str], without: bool, in_process: bool
) -> dict[Camera, str]:
    """Which of the rig's cameras look at a run, and where the pictures of each come from.

    Args:
        rig: Its cameras.
        wanted: One source, or for each of several cameras ``NAME=SOURCE``; ``synthetic`` alone, as
            nothing at all, stands for all of them.
        without: No camera is wanted.
        in_process: The drives are simulated in this process.

    Raises:
        BadInput: The wish cannot be met; nothing is left out silently.
    """
    from cdpr.cli.track_sources import eyes_of

    if not wanted:
        source = choose_camera(rig, None, without, in_process)
        return {} if source is None else dict.fromkeys(rig.cameras, source)
    if wanted == [SYNTHETIC]:
        choose_camera(rig, SYNTHETIC, without, in_process)
        return dict.fromkeys(rig.cameras, SYNTHETIC)
    if rig.cameras:
        eyes = eyes_of(rig, wanted, None, "--camera")
        for source in eyes.values():
            choose_camera(rig, source, without, in_process)
        return eyes
    choose_camera(rig, wanted[0], without, in_process)
    return {}


def looked_with(eyes: Mapping[Camera, str]) -> str:
    """The cameras of a run and their sources, in a few words."""
    return ", ".join(f"{camera.name} ({source})" for camera, source in eyes.items())


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
