"""Opens the cameras of a run, real or synthetic, each in its own process."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.live import LiveCamera
from executor.cameras.client import CameraClient, samples_at_rest, wait_until_ready
from executor.cameras.live_image import ImageBoard, memory_for
from executor.cameras.multi_camera import RunCameras
from executor.cameras.process import (
    KEPT_IMAGES,
    CameraProcess,
    CameraWorker,
    FrameRequest,
    ImageSource,
)
from executor.cameras.sources import SYNTHETIC, cycles_per_image
from executor.kernels import ready_to_measure
from executor.realtime.shared_memory import SharedMemory
from executor.recording.run_folder import RunFolder
from model.clearance import ClearanceModel
from model.errors import Fault
from model.files.rig_file import RigDocument
from model.files.scene_file import SceneDocument
from model.pose import Array, Pose, interpolate
from model.progress import Listener
from model.rig import Camera, Rig, rig_from_document
from model.scene import Scene, empty_scene, scene_from_document
from tracking.measurement import MOST_TURN, Observation

#: Rate of progress reports without a camera, [Hz].
PROGRESS_RATE = 10.0

if TYPE_CHECKING:  # a real camera loads no simulator, and its process no planner
    from executor.trajectory.setpoints import PreparedRun
    from simulation.camera.camera import ImageSequence


@contextmanager
def open_cameras(
    prepared: PreparedRun,
    sources: Mapping[Camera, str],
    folder: Path,
    check_stop: Callable[[], None],
    *,
    simulated_time: bool,
    listener: Listener,
) -> Iterator[RunCameras | None]:
    """Starts a process for each camera; None without one.

    Args:
        sources: From `resolve_cameras`.
        folder: The run folder, which keeps about `KEPT_IMAGES` of each camera's images.
        check_stop: Called repeatedly; an exception ends the opening.
        simulated_time: The run waits for late images instead of dropping them.
        listener: Receives the wait, and a remark on what cannot be measured.

    Raises:
        CdprError: A camera cannot be used.
    """
    if not sources:
        yield None
        return
    rig, scene, table = prepared.rig, prepared.scene, prepared.checked.table
    report_unmeasured_rotation(rig, table.rotations, listener)
    pictures = len(table) // cycles_per_image(asked_rate(sources), table.cycle)
    keep_every = max(1, pictures // KEPT_IMAGES)
    ready_to_measure(listener, only_missing=True)
    with ExitStack() as stack:
        processes, lives = {}, {}
        for camera, source in sources.items():
            live = lives[camera] = memory_for(camera)
            stack.callback(live.close)
            arguments = (camera.name, source, folder, keep_every)
            make = partial(
                make_worker,
                rig.document,
                scene.document,
                *arguments,
                named=len(sources) > 1,
                live=live,
            )
            process = CameraProcess(camera.name, make, may_wait=simulated_time)
            stack.callback(process.close)
            processes[camera] = process
        names = ", ".join(camera.name for camera in sources)
        with listener.waiting(f"opening camera {names}"):
            wait_until_ready(list(processes.values()), check_stop)
        yield RunCameras(
            [
                CameraClient(process, sources[camera], lives[camera].descriptor)
                for camera, process in processes.items()
            ],
            ClearanceModel(rig, scene),
            scene.obstacle_clearance,
            asked_rate(sources),
        )


def report_unmeasured_rotation(rig: Rig, rotations: Array, listener: Listener) -> None:
    """Remarks on a plan that rotates the platform farther than cameras measure it.

    Args:
        rotations: ``world_from_platform`` along the plan, shape (n, 3, 3).
    """
    cosine = (np.einsum("nij,ij->n", rotations, rig.home.rotation).min() - 1.0) / 2.0
    angle, limit = np.degrees([np.arccos(np.clip(cosine, -1.0, 1.0)), MOST_TURN])
    if angle >= limit:
        listener.remark(
            f"the plan rotates the platform by up to {angle:.4g}° from its home pose; cameras"
            f" measure it below {limit:g}° only, and no clearance beyond"
        )


def asked_rate(sources: Mapping[Camera, str]) -> float:
    """Common frame rate of the cameras, [Hz]: that of the slowest, or of progress without any."""
    return min((camera.rate for camera in sources), default=PROGRESS_RATE)


def make_worker(
    rig_document: RigDocument,
    scene_document: SceneDocument,
    camera_name: str,
    source: str,
    folder: Path | None,
    keep_every: int,
    *,
    named: bool,
    live: SharedMemory | None = None,
) -> CameraWorker:
    """Makes the worker, inside its camera's process."""
    rig, scene = rig_from_document(rig_document), scene_from_document(scene_document)
    camera = rig.camera(camera_name)
    ready_to_measure()
    pictures = _source(rig, scene, camera, source)
    kept = None if folder is None else RunFolder(folder)
    board = None if live is None else ImageBoard(live)
    return CameraWorker(rig, camera, pictures, kept, keep_every, named=named, live=board)


def _source(rig: Rig, scene: Scene, camera: Camera, name: str) -> ImageSource:
    if name == SYNTHETIC:  # a real camera loads no simulator
        from simulation.camera.camera import ImageSequence
        from simulation.factory import make_synthetic_camera

        synthetic = make_synthetic_camera(rig, scene, camera)
        true = synthetic.camera.latency
        return RenderedImages(ImageSequence(synthetic), camera.latency, true)
    return LiveImages(LiveCamera(name, camera, cameras=rig.cameras))


class RenderedImages:
    """The synthetic camera as a source of images, which arrive when they are requested.

    Args:
        film: Its images.
        latency: As the rig file states it, [s].
        true_latency: Of the images, [s].
    """

    def __init__(self, film: ImageSequence, latency: float, true_latency: float) -> None:
        self._film, self._latency, self._true_latency = film, latency, true_latency
        self._poses: list[tuple[float, Pose]] = []

    def image(self, trigger: FrameRequest) -> tuple[NDArray[np.uint8], float]:
        """Renders the platform at its true pose, of the true latency ago."""
        now = trigger.poses
        if now.true is None:
            raise Fault("the synthetic camera has no platform pose")
        known = self._poses[-1][0] if self._poses else -math.inf
        self._poses += [pose for pose in trigger.true_poses if pose[0] > known]
        if not self._poses or self._poses[-1][0] < now.time:
            self._poses.append((now.time, now.true))
        exposed = now.time - self._true_latency
        image = self._film.image(exposed, self._pose_at(exposed), trigger.frame)
        return image, -self._latency

    def _pose_at(self, time: float) -> Pose:
        """Interpolated; before the first image the platform was at rest."""
        while len(self._poses) > 1 and self._poses[1][0] <= time:
            self._poses.pop(0)
        before, first = self._poses[0]
        if time <= before or len(self._poses) == 1:
            return first
        after, second = self._poses[1]
        return interpolate(first, second, (time - before) / (after - before))

    @property
    def unused(self) -> tuple[int, int]:
        """None: each comes in time and whole."""
        return 0, 0

    def close(self) -> None:
        """Nothing to close."""


class LiveImages:
    """A real camera as a source of images."""

    def __init__(self, camera: LiveCamera) -> None:
        self._camera = camera

    def image(self, trigger: FrameRequest) -> tuple[NDArray[np.uint8], float]:
        """The next image, and the middle of its exposure after the request, [s]."""
        frame = self._camera.read()
        return frame.image, frame.time - trigger.poses.at

    @property
    def unused(self) -> tuple[int, int]:
        """Numbers of images not used so far, as they came late, or were truncated."""
        return self._camera.late, self._camera.truncated

    def close(self) -> None:
        """Closes the camera."""
        self._camera.close()


def measure_at_rest(
    rig: Rig,
    camera_source: tuple[Camera, str],
    pictures: int,
    true_pose: Pose | None,
    check_stop: Callable[[], None],
    listener: Listener,
) -> list[Observation]:
    """Opens a camera, takes images of a platform at rest and measures each.

    Args:
        camera_source: From `choose_one_camera`.
        true_pose: Of the simulated platform.
        check_stop: Called repeatedly; an exception ends it.
        listener: Receives the opening of the camera.
    """
    camera, source = camera_source
    scene = empty_scene(rig).document
    make = partial(
        make_worker, rig.document, scene, camera.name, source, None, pictures, named=False
    )
    period = 1.0 / camera.rate if source == SYNTHETIC else None
    with closing(CameraProcess(camera.name, make, may_wait=False)) as process:
        with listener.waiting(f"opening camera {camera.name}"):
            wait_until_ready([process], check_stop)
        return samples_at_rest(process, pictures, period, true_pose, check_stop)
