"""Complete calibrations: from images or runs to a result with verdict and report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import inf, radians
from os import PathLike
from pathlib import Path

from calibration.extrinsics.hand_eye import locate_by_motion
from calibration.extrinsics.result import ExtrinsicsOutcome, judged_extrinsics
from calibration.extrinsics.surveyed_tags import Survey, locate_by_frame_tags, require_frame_tags
from calibration.geometry.calibrate import RigCalibration, fit_rig
from calibration.geometry.parameters import DEFAULT_DEVIATIONS, checked_deviations
from calibration.geometry.quality import CHECK_POSES, RigQuality, judge_rig
from calibration.geometry.report import rig_page
from calibration.geometry.result import RigResult, rig_result
from calibration.images import (
    DEFAULT_IMAGES,
    DEFAULT_TAG_IMAGES,
    ImageSet,
    ImageSource,
    open_images,
    open_source,
)
from calibration.intrinsics.calibrate import (
    CameraCalibration,
    fit_camera,
    fit_corners,
    refit_camera,
)
from calibration.intrinsics.lens import AUTO, LENSES
from calibration.intrinsics.quality import CameraQuality, judge_camera
from calibration.intrinsics.readout import (
    ReadoutCalibration,
    ReadoutResult,
    fit_readout,
    judge_readout,
    open_timed_images,
    readout_page,
    readout_result,
)
from calibration.intrinsics.result import CameraResult, camera_page, camera_result
from calibration.results import (
    Calibration,
    CalibrationVerdict,
    Destination,
    require_file_name,
)
from calibration.run_data import poses_by_image, require_reflector_used, rig_measurements
from calibration.tag_map.bundle_adjustment import TagLayout, measure_layout, require_tags
from calibration.tag_map.observations import TagObservations, observe_tags
from calibration.tag_map.result import (
    TagsResult,
    judge_layout,
    layout_facts,
    tags_page,
    tags_result,
)
from calibration.targets.boards import Board, read_corners
from executor.kernels import ready_to_measure
from model.cameras import Camera, Tag
from model.errors import (
    BadInput,
    Fault,
    Refused,
    path_of,
    positive_number,
    require_text,
    require_types,
    sequence_of,
    truth_value,
)
from model.kinematics import NoCable
from model.pose import Pose, point_of, read_only
from model.progress import SILENT, Listener
from model.rig import Rig
from model.scene import require_unaltered
from planner.settings import whole_number

CameraOutcome = Calibration[CameraResult, CameraCalibration, CameraQuality]
TagsOutcome = Calibration[TagsResult, TagLayout, CalibrationVerdict]
ReadoutOutcome = Calibration[ReadoutResult, ReadoutCalibration, CalibrationVerdict]
RigOutcome = Calibration[RigResult, RigCalibration, RigQuality]


def calibrate_camera(
    folder: ImageSet | str | Path,
    board: Board,
    *,
    name: str = "camera",
    wanted: float = 1e-3,
    distance: float | None = None,
    lens: str = AUTO,
    output: Destination | str | Path | None = None,
    listener: Listener = SILENT,
) -> CameraOutcome:
    """Calibrates a camera's matrix and lens distortion from images of a board.

    Args:
        folder: Folder of images of one size, or the images themselves.
        board: `Chessboard`, `Charuco`, `CircleGrid` or `TagGrid` in the images.
        name: Of the camera in the rig file.
        wanted: Required error, 95 %, [m].
        distance: Working distance of the camera, [m]; that of the boards when left out.
        lens: ``five`` coefficients, ``rational``, ``thin-prism`` or ``fisheye``; ``auto`` takes the
            one that fits held-out images best.
        output: Folder for the result file and its report; nothing is written when left out.
        listener: Receives the progress.

    Raises:
        BadInput: Image sizes differ, or too few images show the board.
    """
    require_types((board, Board), (listener, Listener))
    wanted, distance = _required(wanted, distance, lens)
    require_file_name(name, "`name=`")
    source = folder if isinstance(folder, ImageSet) else open_images(path_of(folder))
    to = Destination.of(output).require_free("camera", name)
    with source.reported("detecting the board", listener) as images:
        found = fit_camera(images, board, source.unused, lens)
    if board.needs_lens:
        with source.reported("detecting the board again, with the lens", listener) as images:
            found = refit_camera(found, images, board, lens)
    return _judged_camera(found, name, wanted, distance, to)


def calibrate_camera_from_corners(
    corners: str | Path,
    size: tuple[int, int],
    *,
    name: str = "camera",
    wanted: float = 1e-3,
    distance: float | None = None,
    lens: str = AUTO,
    output: Destination | str | Path | None = None,
) -> CameraOutcome:
    """Calibrates a camera's matrix and lens distortion from corners another program detected.

    Args:
        corners: A CSV file (docs/data-formats.md).
        size: Width and height of the images, [px].
        name: Of the camera in the rig file.
        wanted: Required error, 95 %, [m].
        distance: Working distance of the camera, [m]; that of the boards when left out.
        lens: As for `calibrate_camera`.
        output: Folder for the result file and its report; nothing is written when left out.

    Raises:
        BadInput: The file cannot be read, too few images, or corners outside them.
    """
    wanted, distance = _required(wanted, distance, lens)
    require_file_name(name, "`name=`")
    sides = sequence_of("size", size)
    if len(sides) != 2:
        raise BadInput(f"size must be the width and height of the images in px, it is {size!r}")
    width, height = (whole_number("size", side, 1) for side in sides)
    to = Destination.of(output).require_free("camera", name)
    found = fit_corners(*read_corners(path_of(corners)), (width, height), lens, str(corners))
    return _judged_camera(found, name, wanted, distance, to)


def _required(wanted: float, distance: float | None, lens: str) -> tuple[float, float | None]:
    """Required error and working distance, [m], checked as the name of the lens is."""
    require_text(lens=lens)
    if lens not in (AUTO, *LENSES):
        raise BadInput(f"unknown lens {lens!r}", next_step=f"use {', '.join((AUTO, *LENSES))}")
    needed = positive_number("wanted", wanted, "m")
    return needed, None if distance is None else positive_number("distance", distance, "m")


def _judged_camera(
    found: CameraCalibration, name: str, wanted: float, distance: float | None, to: Destination
) -> CameraOutcome:
    quality = judge_camera(found, wanted, distance)
    result = camera_result(found, quality, name, to.on)
    page, facts = camera_page(found, quality, name, result.date), quality.facts(found)
    return Calibration(result, page, found, quality, facts).saved_in(to.folder)


def locate_camera(
    rig: Rig,
    source: ImageSource,
    *,
    camera: str | None = None,
    poses: Mapping[str, Pose] | str | Path | None = None,
    survey: Survey | None = None,
    pictures: int | None = None,
    wanted: float = 1e-3,
    output: Destination | str | Path | None = None,
    listener: Listener = SILENT,
) -> ExtrinsicsOutcome:
    """Finds a camera's pose in the world, from surveyed frame tags or from the rig's motion.

    Args:
        rig: The robot, with its tags.
        source: A folder of images, a video file, or the index or address of a live
            camera; taken while the camera does not move.
        camera: Which of the rig's cameras took them; the first when left out. Its matrix and
            distortion are taken as known.
        poses: Platform poses by image, a CSV file of them, or a run folder, to use the rig's
            motion; the frame tags are used when left out.
        survey: How well the frame tags were surveyed; each corner to 0.5 mm when left out.
        pictures: Number of images from a video or a camera; 20 when left out.
        wanted: Required error in the work space, 95 %, [m].
        output: Folder for the result file and its report; nothing is written when left out.
        listener: Receives the progress.

    Raises:
        BadInput: There are no tags, or too few images that show them.
    """
    require_types((rig, Rig), (listener, Listener), optional=[(survey, Survey)])
    require_unaltered(rig)
    wanted = positive_number("wanted", wanted, "m")
    taken_by = rig.camera(camera)
    require_file_name(taken_by.name, "cameras")
    if poses is None or isinstance(poses, Mapping):
        known = poses
    else:
        known = poses_by_image(path_of(poses), taken_by.name)
    if known is None:
        require_frame_tags(rig)
    tags = rig.frame_tags if known is None else rig.platform_tags
    opened = open_source(source, taken_by, pictures, DEFAULT_IMAGES)
    to = Destination.of(output).require_free("extrinsics", taken_by.name)
    observations = _observed(rig, taken_by, tags, opened, listener)
    if known is None:
        found = locate_by_frame_tags(rig, taken_by, observations, survey or Survey(0.5e-3, None))
    else:
        found = locate_by_motion(rig, taken_by, observations, known)
    return judged_extrinsics(found, rig, taken_by, wanted, to)


def _observed(
    rig: Rig, camera: Camera, tags: Sequence[Tag], opened: ImageSet, listener: Listener
) -> TagObservations:
    """Corners of the tags in all images."""
    ready_to_measure(listener)
    with opened.reported("detecting tags", listener) as images:
        return observe_tags(images, rig, camera, [tag.id for tag in tags], opened.unused)


def locate_tags(
    rig: Rig,
    source: ImageSource,
    *,
    camera: str | None = None,
    fixed_tag: int | None = None,
    pictures: int | None = None,
    wanted: float = 0.2e-3,
    output: Destination | str | Path | None = None,
    listener: Listener = SILENT,
) -> TagsOutcome:
    """Finds the tags' poses on the platform, from images that show two or more at once.

    Args:
        rig: The robot, with its tags.
        source: A folder of images, a video file, or the index or address of a live
            camera; taken from anywhere.
        camera: Which of the rig's cameras took them; the first when left out. Its matrix and
            distortion are taken as known.
        fixed_tag: Tag kept as in the rig file; when left out, the best fit of all tags is.
        pictures: Number of images from a video or a camera; 40 when left out.
        wanted: Required error of tag corners, 95 %, [m].
        output: Folder for the result file and its report; nothing is written when left out.
        listener: Receives the progress.

    Raises:
        BadInput: There are no tags, or too few images that show them.
    """
    require_types((rig, Rig), (listener, Listener))
    require_unaltered(rig)
    wanted = positive_number("wanted", wanted, "m")
    taken_by = rig.camera(camera)
    require_file_name(rig.name, "name")
    require_tags(rig, fixed_tag)
    opened = open_source(source, taken_by, pictures, DEFAULT_TAG_IMAGES)
    to = Destination.of(output).require_free("tags", rig.name)
    observations = _observed(rig, taken_by, rig.platform_tags, opened, listener)
    found = measure_layout(rig, taken_by, observations, fixed_tag)
    verdict = judge_layout(found, wanted)
    result = tags_result(found, verdict, rig.document, to.on)
    page = tags_page(found, result, verdict)
    return Calibration(result, page, found, verdict, layout_facts(found)).saved_in(to.folder)


def measure_readout(
    rig: Rig,
    source: str | Path,
    *,
    camera: str | None = None,
    rate: float | None = None,
    speed: float | None = None,
    wanted: float = 0.1e-3,
    output: Destination | str | Path | None = None,
    listener: Listener = SILENT,
) -> ReadoutOutcome:
    """Measures a camera's readout time from top row to bottom row (rolling shutter).

    Args:
        rig: The robot; its platform moves in the images and carries tags.
        source: A video, or a folder of consecutive images; taken while the camera is at rest.
        camera: Which of the rig's cameras took them; the first when left out. Its matrix and
            distortion are taken as known.
        rate: Frame rate of a folder, or of a video without times, [Hz]; the camera's when left out.
        speed: Platform speed for which the error is stated, [m/s]; the rig's when left out.
        wanted: Required error, 95 %, [m].
        output: Folder for the result file and its report; nothing is written when left out.
        listener: Receives the progress, and a remark if a video's rate is assumed.

    Raises:
        BadInput: There are no tags, or the images do not determine the readout or are rotated by
            90°.
    """
    require_types((rig, Rig), (listener, Listener))
    require_unaltered(rig)
    wanted = positive_number("wanted", wanted, "m")
    taken_by = rig.camera(camera)
    rate = None if rate is None else positive_number("rate", rate, "Hz")
    speed = rig.motion.speed if speed is None else positive_number("speed", speed, "m/s")
    require_file_name(taken_by.name, "cameras")
    require_tags(rig, None)
    rolling = replace(taken_by, readout=taken_by.readout or inf)  # takes no rotated images
    pictures, known = open_timed_images(path_of(source), rolling, rate, listener)
    to = Destination.of(output).require_free("readout", taken_by.name)
    observations = _observed(rig, taken_by, rig.platform_tags, pictures, listener)
    times = {name: known[name] for name in observations.squares}
    found = fit_readout(rig, taken_by, observations, times)
    verdict = judge_readout(found, wanted, speed)
    result = readout_result(found, verdict, speed, to.on)
    page = readout_page(found, verdict, result.date)
    return Calibration(result, page, found, verdict, found.facts()).saved_in(to.folder)


def calibrate_rig(
    rig: Rig,
    data: str | Path | Sequence[str | Path],
    *,
    deviations: Mapping[str, float] = DEFAULT_DEVIATIONS,
    length_deviation: float = 0.1e-3,
    pose_deviations: tuple[float, float] = (0.1e-3, radians(0.02)),
    without_poses: bool = False,
    reflector: Sequence[float] = (0.0, 0.0, 0.0),
    swivel_deviation: float = radians(0.1),
    imu_deviation: float = radians(0.1),
    tilt: float = radians(5.0),
    wanted: float = 1e-3,
    name: str = "rig",
    rig_file: Path | None = None,
    output: Destination | str | Path | None = None,
    listener: Listener = SILENT,
) -> RigOutcome:
    """Calibrates outlets, anchors, pulleys, drum scales, references and cable stiffness.

    Args:
        rig: As in its file.
        data: Run folders, and CSV files (docs/data-formats.md).
        deviations: Standard deviation of the rig file by parameter group; groups left out are
            taken as known. ``cable_stiffness`` instead of ``stiffness`` fits each cable, and
            ``imu_mounting`` the mounting of an IMU.
        length_deviation: Of a cable's length from the encoders, [m].
        pose_deviations: Of poses beyond those of their file, [m] and [rad], such as of the
            camera's pose: an error of all samples alike, which their number does not reduce.
        without_poses: Use drive positions only, as without a camera.
        reflector: Point whose positions the CSV files contain, platform frame, [m].
        swivel_deviation: Of measured swivel angles, [rad].
        imu_deviation: Of the vertical by an IMU about any axis, [rad].
        tilt: Largest rotation of the platform in use, [rad].
        wanted: Required error, 95 %, [m].
        name: Name of the result.
        rig_file: For messages.
        output: Folder for the result file and its report; nothing is written when left out.
        listener: Receives the progress.

    Raises:
        BadInput: The data cannot be read, are too few, or do not fit the rig file.
    """
    require_types((rig, Rig), (listener, Listener))
    require_unaltered(rig)
    wanted = positive_number("wanted", wanted, "m")
    deviations = checked_deviations(deviations)
    length_deviation = positive_number("length_deviation", length_deviation, "m")
    swivel_deviation = positive_number("swivel_deviation", swivel_deviation, "rad")
    imu_deviation = positive_number("imu_deviation", imu_deviation, "rad")
    tilt = positive_number("tilt", tilt, "rad", or_zero=True)
    of_poses = [
        positive_number("a pose deviation", one, "m, rad")
        for one in sequence_of("pose_deviations", pose_deviations)
    ]
    if len(of_poses) != 2:
        raise BadInput(f"pose_deviations must be two numbers [m, rad], not {len(of_poses)}")
    measured_point = read_only(point_of("reflector", reflector))
    without_poses = truth_value("without_poses", without_poses)
    require_file_name(name, "`name=`")
    given = [data] if isinstance(data, str | PathLike) else sequence_of("data", data)
    paths = [path_of(one) for one in given]
    counted, measured = rig_measurements(rig, paths, measured_point)
    measured = replace(
        measured.with_added_deviation(*of_poses),
        swivel_deviation=swivel_deviation,
        imu_deviation=imu_deviation,
    )
    if without_poses:
        measured = measured.without_poses()
    require_reflector_used(measured, measured_point)
    to = Destination.of(output).require_free("rig", name)
    with listener.waiting("fitting"):
        try:
            found = fit_rig(counted, measured, deviations, length_deviation)
            quality = judge_rig(found, wanted, tilt)
            result = rig_result(found, quality, name, to.on)
        except (Fault, NoCable, Refused) as error:
            raise BadInput(
                f"the measurements do not fit the rig file {rig_file or rig.name}",
                where=", ".join(map(str, paths)),
                why=error.what,
                next_step="check units, the sign of the counts (`direction` of the winches), the"
                f" order of the cables, the homing of the drives, the rig file, and {CHECK_POSES}",
            ) from error
    page, facts = rig_page(found, quality, name, result.date), quality.facts(found)
    return Calibration(result, page, found, quality, facts).saved_in(to.folder)
