"""Opens the camera of a run, real or synthetic, in its own process."""

from __future__ import annotations

from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING

from cdpr.errors import BadInput, Fault

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from cdpr.poses import Pose
    from cdpr.rig import Camera, Rig
    from cdpr.rig_file import RigDocument
    from cdpr.scene import Scene
    from cdpr.scene_file import SceneDocument
    from drivers.cameras import LiveCamera
    from executor.camera_process import CameraProcess
    from executor.observer import Observer, PictureSource, Trigger
    from simulation.camera import SyntheticCamera
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


@contextmanager
def open_camera(
    rig: Rig, scene: Scene, name: str | None, folder: Path, pictures: int, simulated_time: bool
) -> Iterator[CameraProcess | None]:
    """Starts the camera's process; None without a camera.

    Args:
        rig: The robot; its first camera is used.
        scene: What the camera sees beside it.
        name: From `choose_camera`.
        folder: The run folder.
        pictures: How many are expected; some of them are kept.
        simulated_time: A late picture holds the run up instead of being dropped.
    """
    if name is None:
        yield None
        return
    from executor.camera_process import CameraProcess

    keep_every = max(1, pictures // KEPT_PICTURES)
    make = partial(make_observer, rig.document, scene.document, name, folder, keep_every)
    process = CameraProcess(make, may_wait=simulated_time)
    try:
        yield process
    finally:
        process.close()


def look_at_rest(
    rig: Rig,
    name: str,
    pictures: int,
    true_pose: Callable[[], Pose] | None,
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

    from cdpr.scene import nothing_in_the_way
    from executor.observer import Trigger
    from tracking.tracker import Tracker

    camera = rig.cameras[0]
    source, tracker = _source(rig, nothing_in_the_way(rig), camera, name), Tracker(rig, camera)
    try:
        looks = []
        for frame in range(pictures):
            before_each()
            asked = time.monotonic()
            pose = true_pose() if true_pose is not None else None
            image, _ = source.picture(Trigger(frame, frame / camera.rate, asked, pose))
            looks.append(tracker.observe(image, frame / camera.rate))
        return looks
    finally:
        source.close()


def make_observer(
    rig_document: RigDocument,
    scene_document: SceneDocument,
    name: str,
    folder: Path,
    keep_every: int,
) -> Observer:
    """Builds the observer inside the camera's process."""
    from cdpr.rig import rig_from_document
    from cdpr.scene import scene_from_document
    from executor.observer import Observer
    from executor.run_folder import RunFolder

    rig, scene = rig_from_document(rig_document), scene_from_document(scene_document)
    camera = rig.cameras[0]
    source = _source(rig, scene, camera, name)
    return Observer(rig, scene, camera, source, RunFolder(folder), keep_every)


def _source(rig: Rig, scene: Scene, camera: Camera, name: str) -> PictureSource:
    if name == SYNTHETIC:
        from simulation.simulate import make_synthetic_camera

        return RenderedPictures(make_synthetic_camera(rig, scene, camera))
    from drivers.cameras import LiveCamera

    return LivePictures(LiveCamera(name, camera))


class RenderedPictures:
    """The synthetic camera as the run's source of pictures."""

    def __init__(self, camera: SyntheticCamera) -> None:
        self._camera = camera

    def picture(self, trigger: Trigger) -> tuple[NDArray[np.uint8], float]:
        """Renders the platform where it truly is."""
        if trigger.true_pose is None:
            raise Fault("the synthetic camera was not told where the platform is")
        return self._camera.render(trigger.true_pose, trigger.frame), 0.0

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
