"""Cameras and tags of a rig, and calibration results that replace numbers of its file."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np

from model.errors import BadInput, require_text
from model.files.camera_file import CameraDocument, Gamma, TagDocument
from model.files.reading import docs_page
from model.files.rig_file import RigDocument
from model.pose import Array, Pose, ReadOnly, read_only
from model.progress import Listener


@dataclass(frozen=True, slots=True, eq=False)
class Tag:
    """A fiducial tag in the frame of its carrier (x right, y up, z out of the print).

    Attributes:
        id: Number in its family.
        size: Side of the black square, [m].
        pose: ``platform_from_tag`` or ``world_from_tag``.
    """

    id: int
    size: float
    pose: Pose


Z_95 = 1.96
"""Half width of the 95 % interval of a normal distribution, in standard deviations."""


@dataclass(frozen=True, slots=True, eq=False)
class Camera(ReadOnly):
    """A calibrated camera.

    Attributes:
        name: Name in the rig file.
        width: Image width, [px].
        height: Image height, [px].
        matrix: Camera matrix, shape (3, 3), [px].
        distortion: OpenCV coefficients of the lens, shape (k,).
        world_from_camera: Pose; x right, y down, z along the view.
        rate: Frame rate, [Hz].
        lens: One of `model.files.camera_file.LENSES`.
        pose_covariance: Of ``world_from_camera``: position [m] and rotation vector [rad] along the
            world's axes, shape (6, 6); None where the rig file does not state it.
        lens_covariance: Of its n numbers fx, fy, cx, cy [px] and distortion, shape (n, n); None
            where the rig file does not state it.
        pose_by_lens: Derivatives of ``world_from_camera``, which was calibrated with them, by
            these numbers, shape (6, n), [m, rad]; None where unknown.
        error: Error of measured platform and cables, 95 %, from everything that images share,
            [m]; None where the operator does not state it.
        readout: From the exposure of the top row to that of the bottom row, [s]; images are stamped
            with the time of the middle row.
        latency: From the middle of an image's exposure to its arrival, [s].
        gamma: How grey levels encode light: "srgb", or the exponent of light to grey levels.
    """

    name: str
    width: int
    height: int
    matrix: Array
    distortion: Array
    world_from_camera: Pose
    rate: float
    lens: str = "pinhole"
    pose_covariance: Array | None = None
    lens_covariance: Array | None = None
    pose_by_lens: Array | None = None
    error: float | None = None
    readout: float = 0.0
    latency: float = 0.0
    gamma: Gamma = 1.0

    def row_times(self, pixels: Array) -> Array:
        """Exposure times of rows relative to the middle row.

        Args:
            pixels: Shape (..., 2), [px].

        Returns:
            Shape (...), [s].
        """
        return np.asarray(self.readout * ((pixels[..., 1] + 0.5) / self.height - 0.5))

    def require_unrotated(self, where: str) -> None:
        """Refuses an image that had to be rotated by 90° if rows are exposed in turn.

        Raises:
            BadInput: The camera has a rolling shutter.
        """
        if self.readout != 0.0:
            raise BadInput(
                f"the image has to be rotated by 90° for camera {self.name!r}, which cannot be"
                " combined with readout_ms",
                where=where,
                why="the sensor's rows are columns of that image, so its rows have no single"
                " exposure time",
                next_step="remove the orientation from the files (of images EXIF, of videos the"
                " rotation) and calibrate again, or record in landscape",
            )


def tag_from(document: TagDocument) -> Tag:
    """The tag that a rig file describes."""
    return Tag(id=document.id, size=document.size_mm / 1000.0, pose=document.pose())


def camera_by_name(cameras: Sequence[Camera], name: str | None, where: str) -> Camera:
    """The camera of a name; the first when no name is given.

    Args:
        name: Of the camera in the rig file.
        where: The rig, for messages.

    Raises:
        BadInput: There is none of this name, or none at all.
    """
    if name is not None:
        require_text(name=name)
    names = [camera.name for camera in cameras]
    if not names:
        raise BadInput(
            "the rig file has no camera",
            where=where,
            next_step="add `tags` and `cameras`, as in the example of"
            f" {docs_page('rig-file.md')} (Tags and cameras)",
        )
    if name is None:
        return cameras[0]
    if name not in names:
        raise BadInput(
            f"unknown camera {name!r}",
            where=where,
            next_step=f"name one of: {', '.join(names)}",
        )
    return cameras[names.index(name)]


def exchanged_sources(name: str, other: str) -> tuple[str, str]:
    """Cause and next step where the images of a camera seem to be those of another one."""
    return (
        f"the image source of {name!r} seems to be that of {other!r}",
        f"exchange the sources of cameras {name!r} and {other!r} (a single source is named"
        f" {other}=SOURCE), and do not calibrate them again",
    )


OTHER_SIZE = (
    "the images are from another camera, or were cropped or scaled",
    "use full-size images of this camera, or calibrate it at this size",
)
"""Cause and next step where images are not of a camera's size."""


def cause_of_size(
    camera: Camera, sizes: Collection[tuple[int, int]], cameras: Iterable[Camera]
) -> tuple[str, str]:
    """The same, for images that may be those of another camera.

    Args:
        camera: The camera that should have taken them.
        sizes: Widths and heights of the images, [px].
        cameras: Of the rig.
    """
    for other in cameras:
        if (other.width, other.height) in sizes:
            return exchanged_sources(camera.name, other.name)
    return OTHER_SIZE


def camera_from(document: CameraDocument) -> Camera:
    """The camera that a rig file describes."""
    matrix = [
        [document.fx_px, 0.0, document.cx_px],
        [0.0, document.fy_px, document.cy_px],
        [0.0, 0.0, 1.0],
    ]
    return Camera(
        name=document.name,
        width=document.width_px,
        height=document.height_px,
        matrix=read_only(matrix),
        distortion=read_only(document.distortion),
        world_from_camera=document.world_from_camera.pose(),
        rate=document.rate_hz,
        lens=document.lens,
        pose_covariance=_scaled(document.pose_covariance, np.outer(_SCALES, _SCALES)),
        lens_covariance=_scaled(document.lens_covariance, np.ones(1)),
        pose_by_lens=_scaled(document.pose_by_lens, _SCALES[:, None]),
        error=None if document.error_mm is None else document.error_mm / 1e3,
        readout=document.readout_ms / 1e3,
        latency=document.latency_ms / 1e3,
        gamma=document.gamma,
    )


_SCALES = np.array([1e-3] * 3 + [np.pi / 180.0] * 3)


def generic_camera(size: tuple[int, int], name: str = "camera") -> Camera:
    """A camera without distortion and with a horizontal field of view of about 53°.

    Args:
        size: Width and height of its images, [px].
    """
    width, height = size
    matrix = np.array([[width, 0.0, width / 2], [0.0, width, height / 2], [0.0, 0.0, 1.0]])
    return Camera(name, width, height, matrix, np.zeros(5), Pose.level([0.0, 0.0, 0.0]), 10.0)


def is_camera_matrix(matrix: Array) -> bool:
    """Whether entries of a 3 x 3 matrix below the diagonal are 0, and the last one is 1."""
    return bool(np.allclose(matrix[[1, 2, 2, 2], [0, 0, 1, 2]], [0.0, 0.0, 0.0, 1.0], 0.0, 1e-9))


_OUTER = 0.1
"""Share of an image's width or height within which, from an edge, a principal point is doubtful."""


def _principal_point_doubt(camera: CameraDocument) -> str:
    """Why a camera's principal point is doubtful; empty if it is near the image's middle."""
    width, height = camera.width_px, camera.height_px
    if _off_middle(camera, height, width) < min(_OUTER, _off_middle(camera, width, height) / 3.0):
        return (
            f"the principal point ({camera.cx_px:g}, {camera.cy_px:g}) px is that of an image of"
            f" {height} x {width} px; check whether width and height, {width} x {height} px, are"
            " exchanged"
        )
    x, y = camera.cx_px / width, camera.cy_px / height
    if min(x, y, 1.0 - x, 1.0 - y) >= _OUTER:
        return ""
    where = "outside" if min(x, y, 1.0 - x, 1.0 - y) < 0.0 else "at the edge of"
    return (
        f"the principal point ({camera.cx_px:g}, {camera.cy_px:g}) px is {where} the image of"
        f" {width} x {height} px; check the file, unless the image is cropped"
    )


def _off_middle(camera: CameraDocument, width: int, height: int) -> float:
    """Distance of the principal point from the middle of an image, as a share of its sides."""
    return max(abs(camera.cx_px / width - 0.5), abs(camera.cy_px / height - 0.5))


def lens_remarks(own: CameraDocument, new: CameraDocument, file: str, assumed: str) -> list[str]:
    """What is assumed or doubtful about a camera's new lens, and what remains to be done.

    Args:
        own: The camera with its former lens.
        new: The same camera with the lens of a file.
        assumed: What the file does not state and what is assumed instead; empty if nothing.
    """
    remarks = [f"{file} has no {assumed}"] if assumed else []
    if doubt := _principal_point_doubt(new):
        remarks.append(f"{file}: {doubt}")
    what = f"the pose of camera {own.name!r} was found with another lens"
    remarks.append(f"{what}; calibrate it with `cdpr calibrate extrinsics`")
    return remarks + _left_out_operator_error(own, new)


def _scaled(rows: list[list[float]] | None, scales: Array) -> Array | None:
    return None if rows is None else read_only(np.array(rows) * scales)


# Calibration results, applied to a rig file.


@runtime_checkable
class CalibrationResult(Protocol):
    """A result of `calibration`, which `Rig.with_calibration` applies."""

    @property
    def order(self) -> int:
        """Results of lower order are applied first: those of higher order depend on them."""

    @property
    def kind(self) -> str:
        """What was calibrated, such as ``camera``."""

    @property
    def name(self) -> str:
        """Which of its kind, such as the camera's name."""

    @property
    def follows(self) -> str:
        """Name of the result of its kind that is applied before, if given; empty for none."""

    @property
    def date(self) -> str:
        """Date of the calibration, ISO 8601."""

    @property
    def verdict(self) -> str:
        """What it is good for, in a sentence."""

    @property
    def good_enough(self) -> bool:
        """Whether its verdict is good."""

    def corrected(self, rig: RigDocument) -> RigDocument:
        """The rig file's content with this result applied."""


@runtime_checkable
class FinishedCalibration(Protocol):
    """A calibration with its fit and its report, of which the result is applied."""

    @property
    def result(self) -> CalibrationResult:
        """As written to the file."""


_OF_THE_RIG = ("rig", "tags")
"""Kinds of which a rig has one result: its name is free."""
Result = TypeVar("Result", bound=CalibrationResult)


def in_order(results: Iterable[Result]) -> list[Result]:
    """Calibration results in the order in which they are applied."""
    waiting = sorted(results, key=lambda one: one.order)
    ordered = []
    while waiting:
        left = {(one.kind, one.name) for one in waiting}
        free = (k for k, one in enumerate(waiting) if (one.kind, one.follows) not in left)
        ordered.append(waiting.pop(next(free, 0)))  # in a circle, one is refused by its basis
    return ordered


def corrected(
    document: RigDocument, results: Sequence[CalibrationResult], listener: Listener
) -> RigDocument:
    """A rig file's content with results applied; as `Rig.with_calibration`."""
    seen: dict[tuple[str, str], CalibrationResult] = {}
    for result in results:
        what = (result.kind, "" if result.kind in _OF_THE_RIG else result.name)
        if first := seen.get(what):
            both = f"{first.name!r} of {first.date} and {result.name!r} of {result.date}"
            raise BadInput(
                f"two results of kind {result.kind}: {both}",
                where="--calibration, in Python rig.with_calibration()",
                next_step="pass only the current one",
            )
        seen[what] = result
    better = document
    for result in in_order(results):
        better = result.corrected(better)
    for remark in left_out_errors(document.cameras, better.cameras):
        listener.remark(remark)
    for result in results:
        if not result.good_enough:
            text = f"{result.kind} {result.name}, {result.date}: {result.verdict}"
            listener.remark(f"calibration {text}")
    return better


def left_out_errors(before: Sequence[CameraDocument], after: Sequence[CameraDocument]) -> list[str]:
    """Remarks on errors that a new lens left out: they were stated for another one.

    Args:
        before: The cameras with their former lenses.
        after: The same cameras in the same order.
    """
    pairs = list(zip(before, after, strict=True))
    remarks = [
        f"the pose of camera {own.name!r} was found with another lens, so its error is left out;"
        " calibrate it with `cdpr calibrate extrinsics`"
        for own, new in pairs
        if lacks_pose_error(own, new)
    ]
    return remarks + [remark for own, new in pairs for remark in _left_out_operator_error(own, new)]


def lacks_pose_error(own: CameraDocument, new: CameraDocument) -> bool:
    """Whether a new lens left out the error of a camera's pose."""
    return own.pose_covariance is not None and new.pose_covariance is None


def _left_out_operator_error(own: CameraDocument, new: CameraDocument) -> list[str]:
    if own.error_mm is None or new.error_mm is not None:
        return []
    return [
        f"error_mm of camera {own.name!r}, {own.error_mm:g}, was stated for another lens and is"
        " left out; unless calibrations state all errors, state it again in a rig file with the new"
        " lens"
    ]
