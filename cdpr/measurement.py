"""For scripts: what `cdpr track` does, cameras, and calibration results."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from calibration.result_files import load_result
from calibration.results import ResultDocument
from drivers.cameras.files import ImageFolder
from drivers.cameras.live import LiveCamera, VideoFile
from executor.cameras.sources import parse_camera_sources, require_camera_source
from executor.track import TrackResult, track_sources
from model.errors import path_of, require_functions, require_types
from model.files.reading import is_folder
from model.plan import Plan
from model.progress import SILENT, Listener
from model.rig import Rig
from model.scene import Scene, require_unaltered
from planner.settings import whole_number


def open_camera(
    rig: Rig, source: str | int | Path, camera: str | None = None
) -> ImageFolder | VideoFile | LiveCamera:
    """The images of one of the rig's cameras, as an iterable and context manager.

    The end of the ``with`` block, which only a live camera needs, releases the camera.

    Args:
        rig: The robot with its cameras.
        source: A folder of images, a video file, or the index or address of a live camera.
        camera: Name of the rig's camera that took them (default: the first).

    Raises:
        BadInput: The source cannot be used, or the rig has no such camera.
        HardwareMissing: The live camera does not open.
    """
    require_types((rig, Rig))
    taken_by, path = rig.camera(camera), path_of(str(source))
    if is_folder(path):
        return ImageFolder(path, taken_by, cameras=rig.cameras)
    if path.is_file():
        return VideoFile(path, taken_by, cameras=rig.cameras)
    require_camera_source(str(source))
    return LiveCamera(str(source), taken_by, cameras=rig.cameras)


def track(
    rig: Rig,
    source: str | int | Path | Mapping[str, str | int | Path],
    *,
    camera: str | None = None,
    scene: Scene | None = None,
    plan: Plan | None = None,
    pictures: int | None = None,
    overlay: str | Path | None = None,
    stopped: Callable[[], bool] = lambda: False,
    keep: Callable[[TrackResult], None] = lambda _partial: None,
    listener: Listener = SILENT,
) -> TrackResult:
    """Measures the platform's pose image by image, with one camera or several fused.

    Args:
        rig: The robot, with its tags and cameras.
        source: A folder of images, a video file, the index or address of a live camera, or
            ``synthetic``; for several cameras, a mapping by name.
        camera: Name of the rig's camera for a single source (default: the first).
        scene: Obstacles to which the clearance is measured (default: the plan's).
        plan: Path of the platform in synthetic images.
        pictures: Largest number of images per camera.
        overlay: New folder or video for the images with the measurements drawn in.
        stopped: Called before each image; True ends tracking, such as that of a live camera.
        keep: Called with what was measured before an error or Ctrl-C ends tracking, unless no image
            gave a pose; the error is then raised.
        listener: Receives the progress, and the files that are not used.

    Raises:
        NoPlatformSeen: No image gave a pose.
        BadInput: A source cannot be used, or an image has another size.
    """
    require_types((rig, Rig), (listener, Listener), optional=((scene, Scene), (plan, Plan)))
    require_unaltered(rig, scene, plan)
    require_functions(stopped=stopped, keep=keep)
    if pictures is not None:
        pictures = whole_number("pictures", pictures, least=1)
    if isinstance(source, Mapping):
        sources = [f"{name}={one}" for name, one in source.items()]
    else:
        sources = [str(source)]
    return track_sources(
        rig,
        parse_camera_sources(rig, sources, camera),
        scene=scene,
        plan=plan,
        pictures=pictures,
        overlay=None if overlay is None else path_of(overlay),
        stopped=stopped,
        keep=keep,
        listener=listener,
    )


def load_calibration(path: str | Path) -> ResultDocument:
    """Reads a result file of a calibration, for `Rig.with_calibration`.

    Raises:
        BadInput: It cannot be read, is not a calibration result, or was edited.
    """
    return load_result(path_of(path))
