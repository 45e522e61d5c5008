"""Whole calibrations: from images or runs to a judged result and its report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import radians
from pathlib import Path

import numpy as np

from calibration.extrinsics.hand_eye import locate_by_motion
from calibration.extrinsics.result import (
    ExtrinsicCalibration,
    ExtrinsicsResult,
    extrinsics_page,
    extrinsics_result,
    judge_extrinsics,
    place_facts,
)
from calibration.extrinsics.surveyed_tags import Survey, locate_by_frame_tags, require_frame_tags
from calibration.geometry.calibrate import RigCalibration, fit_rig
from calibration.geometry.parameters import DEFAULT_DEVIATIONS
from calibration.geometry.quality import RigQuality, judge_rig
from calibration.geometry.report import rig_page
from calibration.geometry.result import RigResult, rig_result
from calibration.intrinsics.calibrate import CameraCalibration, fit_camera, fit_corners
from calibration.intrinsics.lens import AUTO
from calibration.intrinsics.quality import CameraQuality, judge_camera
from calibration.intrinsics.readout import (
    ReadoutCalibration,
    ReadoutResult,
    fit_readout,
    judge_readout,
    readout_page,
    readout_result,
)
from calibration.intrinsics.result import CameraResult, camera_page, camera_result
from calibration.pictures import (
    USUAL_PICTURES,
    USUAL_TAG_PICTURES,
    Pictures,
    PicturesFrom,
    opened_pictures,
    pictures_in,
    timed_pictures,
)
from calibration.results import (
    Calibration,
    CalibrationVerdict,
    Destination,
    require_file_name,
)
from calibration.run_data import poses_by_picture, rig_measurements
from calibration.tag_map.bundle_adjustment import TagLayout, measure_layout, require_tags
from calibration.tag_map.observations import sights_of
from calibration.tag_map.result import (
    TagsResult,
    judge_layout,
    layout_facts,
    tags_page,
    tags_result,
)
from calibration.targets.boards import Board, read_corners
from executor.kernels import ready_to_measure
from model.errors import BadInput, Fault, Refused
from model.kinematics import NoCable
from model.pose import Pose, read_only
from model.progress import SILENT, Listener
from model.rig import Camera, Rig

CameraOutcome = Calibration[CameraResult, CameraCalibration, CameraQuality]
ExtrinsicsOutcome = Calibration[ExtrinsicsResult, ExtrinsicCalibration, CalibrationVerdict]
TagsOutcome = Calibration[TagsResult, TagLayout, CalibrationVerdict]
ReadoutOutcome = Calibration[ReadoutResult, ReadoutCalibration, CalibrationVerdict]
RigOutcome = Calibration[RigResult, RigCalibration, RigQuality]


def calibrate_camera(
    folder: Pictures | str | Path,
    board: Board,
    *,
    name: str = "camera",
    wanted: float = 1e-3,
    distance: float | None = None,
    lens: str = AUTO,
    output: Destination | str | Path | None = None,
    listener: Listener = SILENT,
) -> CameraOutcome:
    """Finds a camera's matrix and lens distortion from images of a board.

    Args:
        folder: Of the images, all of one size; or the images.
        board: What they show: `Chessboard`, `Charuco`, `CircleGrid` or `TagGrid`.
        name: Of the camera in the rig file.
        wanted: What is good enough, 95 %, [m].
        distance: From which the camera measures, [m]; that of the boards when left out.
        lens: ``five`` coefficients, ``rational``, ``thin-prism`` or ``fisheye``; ``auto`` takes the
            one that fits held-out images best.
        output: Folder for the result file and its report; nothing is written when left out.
        listener: Receives how far it is.

    Raises:
        BadInput: Images of different sizes, or too few that show the board.
    """
    require_file_name(name, "--name")
    source = folder if isinstance(folder, Pictures) else pictures_in(Path(folder))
    to = Destination.of(output)
    to.require_free("camera", name)
    with source.reported("detecting the board", listener) as images:
        found = fit_camera(images, board, source.unused, lens)
    return _judged_camera(found, name, wanted, distance, to)


def calibrate_camera_from_corners(
    corners: Path,
    size: tuple[int, int],
    *,
    name: str = "camera",
    wanted: float = 1e-3,
    distance: float | None = None,
    lens: str = AUTO,
    output: Destination | str | Path | None = None,
) -> CameraOutcome:
    """Finds a camera's matrix and lens distortion from corners that another program detected.

    Args:
        corners: A CSV file (docs/data-formats.md).
        size: Width and height of the images, [px].
        name: Of the camera.
        wanted: What is good enough, 95 %, [m].
        distance: From which the camera measures, [m].
        lens: One of `calibration.intrinsics.lens.LENSES`, or `AUTO`.
        output: Folder for the result.

    Raises:
        BadInput: The file cannot be read, or as of `fit_corners`.
    """
    require_file_name(name, "--name")
    to = Destination.of(output)
    to.require_free("camera", name)
    found = fit_corners(read_corners(corners), size, lens, str(corners))
    return _judged_camera(found, name, wanted, distance, to)


def _judged_camera(
    found: CameraCalibration, name: str, wanted: float, distance: float | None, to: Destination
) -> CameraOutcome:
    quality = judge_camera(found, wanted, distance)
    result = camera_result(found, quality, name, to.on)
    page, facts = camera_page(found, quality, name, result.date), quality.facts(found)
    return Calibration(result, page, found, quality, facts).saved_in(to.folder)


def locate_camera(
    rig: Rig,
    source: PicturesFrom,
    *,
    camera: str | None = None,
    poses: Mapping[str, Pose] | str | Path | None = None,
    survey: Survey | None = None,
    wanted: float = 1e-3,
    output: Destination | str | Path | None = None,
    listener: Listener = SILENT,
) -> ExtrinsicsOutcome:
    """Finds where a camera is, by surveyed tags on the frame or by the rig's own motion.

    Args:
        rig: The robot, with its tags.
        source: A folder of images, a video file, or the index or address of a live
            camera; taken while the camera does not move.
        camera: Which of the rig's cameras took them; the first when left out. Its matrix and
            distortion hold.
        poses: The platform's by image, or a CSV file of them, or a run folder: go by the rig's
            motion. Left out, by the tags on the frame.
        survey: How well the frame tags were surveyed; each corner to 0.5 mm when left out.
        wanted: What is good enough in the work space, 95 %, [m].
        output: Folder for the result file and its report; nothing is written when left out.
        listener: Receives how far it is.

    Raises:
        BadInput: There are no tags, or too few images that show them.
    """
    taken_by = rig.camera(camera)
    require_file_name(taken_by.name, "cameras")
    known = poses_by_picture(Path(poses), taken_by.name) if isinstance(poses, str | Path) else poses
    if known is None:
        require_frame_tags(rig)
    tags = rig.frame_tags if known is None else rig.platform_tags
    pictures, to = opened_pictures(source, taken_by, USUAL_PICTURES), Destination.of(output)
    to.require_free("extrinsics", taken_by.name)
    ready_to_measure(listener)
    with pictures.reported("detecting tags", listener) as images:
        sights = sights_of(images, rig, taken_by, [tag.id for tag in tags], pictures.unused)
    if known is None:
        found = locate_by_frame_tags(rig, taken_by, sights, survey or Survey(0.5e-3, None))
    else:
        found = locate_by_motion(rig, taken_by, sights, known)
    verdict = judge_extrinsics(found, wanted)
    result = extrinsics_result(found, verdict, rig.document, to.on)
    page = extrinsics_page(found, result, verdict, taken_by.world_from_camera)
    facts = place_facts(found, taken_by.world_from_camera)
    return Calibration(result, page, found, verdict, facts).saved_in(to.folder)


def locate_tags(
    rig: Rig,
    source: PicturesFrom,
    *,
    camera: str | None = None,
    fixed_tag: int | None = None,
    wanted: float = 0.2e-3,
    output: Destination | str | Path | None = None,
    listener: Listener = SILENT,
) -> TagsOutcome:
    """Finds where the tags are on the platform, from images that show two or more at once.

    Args:
        rig: The robot, with its tags.
        source: A folder of images, a video file, or the index or address of a live
            camera; taken from anywhere.
        camera: Which of the rig's cameras took them; the first when left out. Its matrix and
            distortion hold.
        fixed_tag: Is as in the rig file; all fit it best when left out.
        wanted: What is good enough for corners of tags, 95 %, [m].
        output: Folder for the result file and its report; nothing is written when left out.
        listener: Receives how far it is.

    Raises:
        BadInput: There are no tags, or too few images that show them.
    """
    taken_by = rig.camera(camera)
    require_file_name(rig.name, "name")
    require_tags(rig, fixed_tag)
    pictures, to = opened_pictures(source, taken_by, USUAL_TAG_PICTURES), Destination.of(output)
    to.require_free("tags", rig.name)
    ready_to_measure(listener)
    with pictures.reported("detecting tags", listener) as images:
        numbers = [tag.id for tag in rig.platform_tags]
        sights = sights_of(images, rig, taken_by, numbers, pictures.unused)
    found = measure_layout(rig, taken_by, sights, fixed_tag)
    verdict = judge_layout(found, wanted)
    result = tags_result(found, verdict, rig.document, to.on)
    page = tags_page(found, result, verdict)
    return Calibration(result, page, found, verdict, layout_facts(found)).saved_in(to.folder)


def measure_readout(
    rig: Rig,
    camera: Camera,
    source: Path,
    *,
    rate: float | None = None,
    speed: float | None = None,
    wanted: float = 0.1e-3,
    output: Destination | str | Path | None = None,
    listener: Listener = SILENT,
) -> ReadoutOutcome:
    """Finds how long a camera takes from its top row to its bottom row (rolling shutter).

    Args:
        rig: The robot; its platform moves in the images and carries tags.
        camera: Its matrix and distortion hold; it stands still.
        source: A video, or a folder of images one after the other.
        rate: Images a second of a folder; the camera's when left out.
        speed: Of the platform, for which the error is stated, [m/s]; the rig's when left out.
        wanted: What is good enough, 95 %, [m].
        output: Folder for the result file and its report; nothing is written when left out.
        listener: Receives how far it is.

    Raises:
        BadInput: There are no tags, or the images do not determine the readout.
    """
    require_file_name(camera.name, "cameras")
    require_tags(rig, None)
    pictures, to = timed_pictures(source, camera, rate), Destination.of(output)
    to.require_free("readout", camera.name)
    ready_to_measure(listener)
    with pictures.reported("detecting tags", listener) as images:
        numbers = [tag.id for tag in rig.platform_tags]
        sights = sights_of(images, rig, camera, numbers, pictures.unused)
    times = {name: float(name.split(" s ")[0]) for name in sights.squares}
    found = fit_readout(rig, camera, sights, times)
    speed = rig.motion.speed if speed is None else speed
    verdict = judge_readout(found, wanted, speed)
    result = readout_result(found, verdict, speed, to.on)
    page = readout_page(found, verdict, result.date)
    return Calibration(result, page, found, verdict, found.facts()).saved_in(to.folder)


def calibrate_rig(
    rig: Rig,
    data: Sequence[str | Path],
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
    """Finds outlets, anchors, pulleys, drum scales, references and the cables' stiffness.

    Args:
        rig: As in its file.
        data: Run folders, and CSV files (docs/data-formats.md).
        deviations: How far off the rig file may be by group of numbers, one standard deviation;
            groups left out are taken as known. ``cable_stiffness`` in place of ``stiffness`` finds
            that of each cable, and ``imu_mounting`` that of an IMU.
        length_deviation: Of a cable's length from the encoders, [m].
        pose_deviations: Of poses, added to that of their file, [m] and [rad].
        without_poses: Drive positions alone, as without a camera.
        reflector: The point of positions without rotations, platform frame, [m].
        swivel_deviation: Of measured swivel angles, [rad].
        imu_deviation: Of the vertical by an IMU about any axis, [rad].
        tilt: How far the platform will be rotated, [rad].
        wanted: What is good enough, 95 %, [m].
        name: Of the result.
        rig_file: Named in messages.
        output: Folder for the result file and its report; nothing is written when left out.
        listener: Receives how far it is.

    Raises:
        BadInput: Data cannot be read, are too few, or do not fit the rig file.
    """
    require_file_name(name, "--name")
    counted, measured = rig_measurements(rig, [Path(path) for path in data])
    length, turn = pose_deviations
    measured = replace(
        measured.with_doubt(np.array([length] * 3 + [turn] * 3)),
        reflector=read_only(reflector),
        swivel_deviation=swivel_deviation,
        imu_deviation=imu_deviation,
    )
    if without_poses:
        measured = measured.without_poses()
    to = Destination.of(output)
    to.require_free("rig", name)
    with listener.waiting("fitting"):
        try:
            found = fit_rig(counted, measured, deviations, length_deviation)
            quality = judge_rig(found, wanted, tilt)
            result = rig_result(found, quality, name, to.on)
        except (Fault, NoCable, Refused) as error:
            raise BadInput(
                f"the measurements do not fit the rig file {rig_file or rig.name}",
                where=", ".join(map(str, data)),
                why=error.what,
                next_step="check units, the order of the cables, the homing of the drives and"
                " the rig file",
            ) from error
    page, facts = rig_page(found, quality, name, result.date), quality.facts(found)
    return Calibration(result, page, found, quality, facts).saved_in(to.folder)
