"""Run data for calibration: poses by image and stationary samples."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from calibration.geometry.measurements import (
    Recording,
    RigMeasurements,
    at_rest,
    joined,
    read_rig_data,
)
from calibration.geometry.result import require_same_nominal
from executor.recording.run_folder import RunFolder
from model.errors import BadInput, InvalidFile, Problem
from model.files.csv_table import CsvTable
from model.files.reading import is_folder
from model.pose import Array, Pose, interpolate, matrix_from_quaternion
from model.rig import Rig


def poses_by_image(path: Path, camera: str) -> Mapping[str, Pose]:
    """Platform poses by image, from a CSV file or the encoders of a run folder.

    Raises:
        BadInput: It cannot be read, or the camera took no images in the run.
    """
    return poses_of_run(path, camera) if is_folder(path) else read_poses(path)


def poses_of_run(folder: Path, camera: str) -> dict[str, Pose]:
    """Encoder poses at the times when a run's saved camera images were taken.

    Raises:
        BadInput: The camera took no images in this run.
    """
    run = RunFolder.open(folder)
    cycles, alone = run.cycles(), run.poses_by_camera()
    used = [one["name"] for one in run.summary().get("cameras", [])]
    names = [name for name in used if name in alone or not alone]
    if camera not in names:
        raise BadInput(
            f"camera {camera!r} took no images in this run",
            where=str(folder),
            next_step=f"name one of its cameras with `camera=`: {', '.join(names)}",
        )
    samples = alone[camera] if alone else run.poses()
    times, known = cycles.time, cycles.has_encoder_pose
    poses = {}
    for time, picture in zip(samples.time, samples.picture, strict=True):
        after = int(np.searchsorted(times, time))
        beside = [after - 1, after]
        if not picture or not 0 < after < len(times) or not known[beside].all():
            continue
        ends = [
            Pose.from_quaternion(cycles.encoder[row], cycles.encoder_rotation[row])
            for row in beside
        ]
        share = float((time - times[after - 1]) / (times[after] - times[after - 1]))
        poses[Path(picture).name] = interpolate(ends[0], ends[1], share)
    return poses


# CSV file of platform poses by image name, with units in its column names.


COLUMNS = ("picture", "x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz")
"""As in the pose log of `cdpr track`; other columns are ignored."""


def read_poses(path: Path) -> dict[str, Pose]:
    """Reads ``world_from_platform`` by image; rows without a pose are left out.

    Raises:
        BadInput: The file cannot be read, or a column or a value is missing.
        InvalidFile: With every invalid row.
    """
    table = CsvTable(path)
    table.require(COLUMNS)
    names, *columns = (table.texts(name) for name in COLUMNS)
    states = table.texts("status") if "status" in table.names else None
    poses: dict[str, Pose] = {}
    problems = []
    for row, (name, *values) in enumerate(zip(names, *columns, strict=True)):
        picture = Path(name).name
        kept = states is None or (picture and states[row] == "ok")
        if not kept or not any(values):  # a log's row without a pose, or without a kept image
            continue
        found = _pose(values)
        if isinstance(found, str):
            problems.append(Problem(picture, found, table.line(row), 1))
        elif not picture or picture in poses:
            what = "this image appears twice" if picture else "no image is named"
            problems.append(Problem(picture, what, table.line(row), 1))
        else:
            poses[picture] = found
    if problems:
        raise InvalidFile(str(path), problems)
    return poses


def _pose(values: list[str]) -> Pose | str:
    """The pose, or a message about what is wrong with it."""
    try:
        numbers = np.array([float(value) for value in values])
    except ValueError:
        return f"{', '.join(values)} are not seven numbers"
    if not all(map(math.isfinite, numbers)):
        return "a number is not finite"
    length = float(np.linalg.norm(numbers[3:]))
    if abs(length - 1.0) > 1e-3:
        return f"qw, qx, qy, qz must have length 1; the length is {length:.4g}"
    return Pose.from_quaternion(numbers[:3] / 1e3, numbers[3:] / length)


# Encoder positions and poses at rest, for the rig's geometry.


def rig_measurements(
    rig: Rig, data: Sequence[Path], reflector: Array | None = None
) -> tuple[Rig, RigMeasurements]:
    """The rig with the counts of its drives, and its stationary samples.

    Args:
        rig: As in its file.
        data: Run folders, and CSV files (docs/data-formats.md).
        reflector: Point whose positions the CSV files contain, platform frame, shape (3,), [m];
            the origin when left out.

    Raises:
        BadInput: A file cannot be read, is of another rig, or is named twice; or there is none.
    """
    if not data:
        raise BadInput(
            "`data=` names no run folder and no CSV file",
            where="calibrate rig",
            next_step="check the folder from which they are listed",
        )
    _require_once(data)
    runs = [(str(path), RunFolder.open(path).rig()) for path in data if is_folder(path)]
    counted = require_same_nominal(rig, runs)
    m = rig.cable_count
    parts = [
        _at_rest(path) if is_folder(path) else read_rig_data(path, m, reflector) for path in data
    ]
    return counted, joined(parts)


def require_reflector_used(measured: RigMeasurements, reflector: Array) -> None:
    """Refuses a measured point that applies to no sample, or to files of two kinds.

    Raises:
        BadInput: No CSV file with positions is used, or only some contain rotations.
    """
    if not reflector.any():
        return
    used = measured.has_position & measured.reflectors.any(axis=1)
    if not used.any():
        raise BadInput(
            "`reflector=` is for positions in CSV files; none are used",
            where="reflector",
            next_step="leave it out, or pass a CSV file with x_mm, y_mm, z_mm",
        )
    rotated = measured.has_rotation[used]
    if rotated.any() and not rotated.all():
        raise BadInput(
            "`reflector=` is for one tracker, but only some of the CSV files have rotations",
            where="reflector",
            why="poses with and without rotations may be those of different points",
            next_step="write all positions for the platform's origin and leave it out, or pass"
            " files of one kind",
        )


def _require_once(data: Sequence[Path]) -> None:
    """Refuses a file given twice: each sample must count once."""
    named: dict[Path, Path] = {}
    for path in data:
        if path.resolve() in named:
            raise BadInput(
                f"{path} is given twice",
                where="DATA",
                why=f"it is the same as {named[path.resolve()]}",
                next_step="pass each file and each run once",
            )
        named[path.resolve()] = path


def _at_rest(run: Path) -> RigMeasurements:
    """Stationary samples of a run."""
    folder = RunFolder.open(run)
    cycles, poses = folder.cycles(), folder.poses()
    good = poses.ok
    rotations = [matrix_from_quaternion(q) for q in poses.rotation[good]]
    return at_rest(
        str(run),
        Recording(
            time=cycles.time,
            setpoints=cycles.set_counts.astype(np.float64),
            counts=cycles.actual_counts.astype(np.float64),
            tensions=cycles.following_tensions,
            pose_times=poses.time[good],
            positions=poses.position[good],
            rotations=np.array(rotations).reshape(-1, 3, 3),
            covariances=poses.covariance[good],
        ),
    )
