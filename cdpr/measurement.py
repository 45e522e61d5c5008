"""Cameras and calibrations: what `cdpr track` and `cdpr calibrate` do, as functions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import radians
from pathlib import Path

from calibration.extrinsics.surveyed_tags import Survey
from calibration.geometry.model import DEFAULT_DEVIATIONS
from calibration.procedures import CameraOutcome, ExtrinsicsOutcome, RigOutcome, TagsOutcome
from calibration.procedures import calibrate_camera as find_camera
from calibration.procedures import calibrate_rig as find_rig
from calibration.procedures import locate_camera as find_camera_pose
from calibration.procedures import locate_tags as find_tags
from calibration.result_files import load_result
from calibration.results import Destination, ResultDocument
from calibration.targets.board import Board
from drivers.cameras.files import ImageFolder
from drivers.cameras.live import LiveCamera, VideoFile
from executor.cameras.sources import parse_camera_sources, require_camera_source
from executor.track import TrackResult, track_sources
from model.plan import Plan
from model.pose import Pose
from model.progress import SILENT, Listener
from model.rig import Rig
from model.scene import Scene


def open_camera(
    rig: Rig, source: str | int | Path, camera: str | None = None
) -> ImageFolder | VideoFile | LiveCamera:
    """The images of a camera of the rig: iterate over it; a live camera is a context manager too.

    Args:
        rig: Its cameras.
        source: A folder of images, a video file, or the index or address of a live camera.
        camera: Which of the rig's cameras took them; the first when left out.

    Raises:
        BadInput: The source cannot be used, or the rig has no such camera.
        HardwareMissing: The live camera does not open.
    """
    taken_by, path = rig.camera(camera), Path(str(source))
    if path.is_dir():
        return ImageFolder(path, taken_by)
    if path.is_file():
        return VideoFile(path, taken_by)
    require_camera_source(str(source))
    return LiveCamera(str(source), taken_by)


def track(
    rig: Rig,
    source: str | int | Path | Mapping[str, str | int],
    *,
    camera: str | None = None,
    scene: Scene | None = None,
    plan: Plan | None = None,
    pictures: int | None = None,
    overlay: str | Path | None = None,
    listener: Listener = SILENT,
) -> TrackResult:
    """Measures the platform's pose image by image, by one camera or several together.

    Args:
        rig: The robot, with its tags and cameras.
        source: A folder of images, a video file, the index or address of a live camera, or
            ``synthetic``; of several cameras by their names.
        camera: Which of the rig's cameras took a single source; the first when left out.
        scene: Its obstacles, to which the clearance is measured; the plan's when left out.
        plan: Followed by the platform that synthetic cameras see.
        pictures: How many of each camera at most.
        overlay: New folder or video into which the images are drawn with what was measured.
        listener: Receives the progress, and which files are not used.

    Raises:
        NoPlatformSeen: No image gave a pose.
        BadInput: A source cannot be used, or an image is of another size.
    """
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
        overlay=None if overlay is None else Path(overlay),
        listener=listener,
    )


def load_calibration(path: str | Path) -> ResultDocument:
    """Reads a result file of a calibration, for `Rig.with_calibration`.

    Raises:
        BadInput: It cannot be read, is not a calibration result, or was edited.
    """
    return load_result(Path(path))


def calibrate_camera(
    folder: str | Path,
    board: Board,
    *,
    name: str = "camera",
    wanted: float = 1e-3,
    distance: float | None = None,
    lens: str = "auto",
    output: str | Path | None = None,
    listener: Listener = SILENT,
) -> CameraOutcome:
    """Finds a camera's matrix and lens distortion from images of a board.

    Args:
        folder: Of the images, all of one size.
        board: What they show: `Chessboard`, `Charuco`, `CircleGrid` or `TagGrid`.
        name: Of the camera in the rig file.
        wanted: What is good enough, 95 %, [m].
        distance: From which the camera measures, [m]; that of the boards when left out.
        lens: ``five`` coefficients, ``rational``, ``thin-prism`` or ``fisheye``; ``auto`` takes the
            one that fits held-out images best.
        output: Folder for the result file and its report; nothing is written when left out.
        listener: Receives the progress.

    Raises:
        BadInput: Images of different sizes, or too few that show the board.
    """
    return find_camera(
        Path(folder),
        board,
        name=name,
        wanted=wanted,
        distance=distance,
        lens=lens,
        to=_destination(output),
        listener=listener,
    )


def locate_camera(
    rig: Rig,
    source: str | Path,
    *,
    camera: str | None = None,
    poses: Mapping[str, Pose] | str | Path | None = None,
    survey: Survey | None = None,
    wanted: float = 1e-3,
    output: str | Path | None = None,
    listener: Listener = SILENT,
) -> ExtrinsicsOutcome:
    """Finds the pose of a camera, by surveyed tags on the frame or by the rig's own motion.

    Args:
        rig: The robot, with its tags.
        source: A folder of images, a video file, or the index or address of a live camera.
        camera: Which of the rig's cameras took them; the first when left out.
        poses: Of the platform by image, or a CSV file of them, or a run folder: use the rig's
            motion. Left out, the tags on the frame.
        survey: How well the frame tags were surveyed; each corner to 0.5 mm when left out.
        wanted: What is good enough in the work space, 95 %, [m].
        output: Folder for the result file and its report; nothing is written when left out.
        listener: Receives the progress.

    Raises:
        BadInput: There are no tags, or too few images that show them.
    """
    return find_camera_pose(
        rig,
        rig.camera(camera),
        source,
        poses=Path(poses) if isinstance(poses, str) else poses,
        survey=survey,
        wanted=wanted,
        to=_destination(output),
        listener=listener,
    )


def locate_tags(
    rig: Rig,
    source: str | Path,
    *,
    camera: str | None = None,
    fixed_tag: int | None = None,
    wanted: float = 0.2e-3,
    output: str | Path | None = None,
    listener: Listener = SILENT,
) -> TagsOutcome:
    """Finds the poses of the tags on the platform, from images that show two or more at once.

    Args:
        rig: The robot, with its tags.
        source: A folder of images, a video file, or the index or address of a live camera.
        camera: Which of the rig's cameras took them; the first when left out.
        fixed_tag: Is as in the rig file; all fit it best when left out.
        wanted: What is good enough for corners of tags, 95 %, [m].
        output: Folder for the result file and its report; nothing is written when left out.
        listener: Receives the progress.

    Raises:
        BadInput: There are no tags, or too few images that show them.
    """
    return find_tags(
        rig,
        rig.camera(camera),
        source,
        fixed_tag=fixed_tag,
        wanted=wanted,
        to=_destination(output),
        listener=listener,
    )


def calibrate_rig(
    rig: Rig,
    data: Sequence[str | Path],
    *,
    deviations: Mapping[str, float] = DEFAULT_DEVIATIONS,
    length_deviation: float = 0.1e-3,
    pose_deviations: tuple[float, float] = (0.1e-3, radians(0.02)),
    without_poses: bool = False,
    reflector: Sequence[float] = (0.0, 0.0, 0.0),
    tilt: float = radians(5.0),
    wanted: float = 1e-3,
    name: str = "rig",
    output: str | Path | None = None,
    listener: Listener = SILENT,
) -> RigOutcome:
    """Finds outlets, anchors, pulleys, drum scales, references and the cables' stiffness.

    Args:
        rig: As its file describes it.
        data: Run folders, and CSV files (docs/data-formats.md).
        deviations: How far off the rig file may be by group of numbers, one standard deviation;
            groups left out are taken as known.
        length_deviation: Of a cable's length from the encoders, [m].
        pose_deviations: Of poses beside what their file states, [m] and [rad].
        without_poses: Drive positions alone, as without a camera.
        reflector: The point whose positions were measured where no rotation was, platform frame,
            [m].
        tilt: How far the platform will be rotated, [rad].
        wanted: What is good enough, 95 %, [m].
        name: Of the result.
        output: Folder for the result file and its report; nothing is written when left out.
        listener: Receives the progress.

    Raises:
        BadInput: Data cannot be read, are too few, or do not fit the rig file.
    """
    return find_rig(
        rig,
        [Path(path) for path in data],
        deviations=deviations,
        length_deviation=length_deviation,
        pose_deviations=pose_deviations,
        without_poses=without_poses,
        reflector=reflector,
        tilt=tilt,
        wanted=wanted,
        name=name,
        to=_destination(output),
        listener=listener,
    )


def _destination(output: str | Path | None) -> Destination:
    return Destination(None if output is None else Path(output))
