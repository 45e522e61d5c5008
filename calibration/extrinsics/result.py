"""Extrinsic calibration of a camera: pose, covariance, verdict, result file and report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from itertools import product
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from calibration.intrinsics.result import camera_named, with_camera
from calibration.report import Section, page_of, table_of
from calibration.results import (
    Calibration,
    CalibrationVerdict,
    Destination,
    Issue,
    ResultDocument,
    beyond,
    common_keys,
)
from calibration.statistics import Interval, rms_bound, student_factor
from model.cameras import Z_95
from model.files.camera_file import PoseCovariance, PoseSlopes
from model.files.documents import AnyNonNegative, PoseDocument, Vector
from model.files.rig_file import RigDocument
from model.pose import Array, Pose, points_by_twist, step_between
from model.rig import Camera, Rig
from tracking.camera_model import rms


@dataclass(frozen=True, slots=True, eq=False)
class ExtrinsicCalibration:
    """A camera's calibrated pose in the world.

    Attributes:
        camera: The camera at its new pose.
        by: ``frame tags``, ``rig motion`` or ``another camera``.
        covariance: Of position [m] and rotation vector [rad] along the world's axes, shape (6, 6).
        half_widths: Of the 95 % intervals of the same, shape (6,).
        by_lens: Derivatives of the pose by the lens's n parameters, shape (6, n), [m, rad]; None
            where their errors are unknown.
        points: Points in the world for which the error is stated, shape (n, 3), [m].
        tag_errors: RMS corner error of each tag, by number, [px].
        pictures: Number of images used.
        unused: Why each other image is not used, by name.
        issues: Issues beside precision.
        data_hash: Of the observations.
        reference_camera: The other camera, where the pose was found by one.
        is_contradictory: Whether the data contradict each other: then the stated error is
            meaningless.
        details: Human-readable facts about the data.
    """

    camera: Camera
    by: Literal["frame tags", "rig motion", "another camera"]
    covariance: Array
    half_widths: Array
    by_lens: Array | None
    points: Array
    tag_errors: Mapping[int, float]
    pictures: int
    unused: Mapping[str, str]
    issues: tuple[Issue, ...]
    data_hash: str
    reference_camera: str | None = None
    is_contradictory: bool = False
    details: tuple[tuple[str, str], ...] = ()

    @property
    def world_from_camera(self) -> Pose:
        """The pose of the camera in the world."""
        return self.camera.world_from_camera

    @property
    def stated_covariance(self) -> Array:
        """The covariance scaled to the half widths (1.96 deviations), (6, 6), [m, rad]."""
        return scaled_to(self.covariance, self.half_widths)

    @property
    def error(self) -> float:
        """Error of measured points of the work space, 95 %, RMS, [m]."""
        return self._error_by(self.stated_covariance)

    @property
    def is_limited_by_lens(self) -> bool:
        """Whether the camera's lens causes the larger part of the error."""
        if self.by_lens is None or self.camera.lens_covariance is None:
            return False
        by_lens = self._error_by(self.by_lens @ self.camera.lens_covariance @ self.by_lens.T)
        return by_lens**2 > 0.5 * self.error**2

    def _error_by(self, covariance: Array) -> float:
        """The error that a covariance of the pose causes, [m]."""
        arms = self.points - self.world_from_camera.position
        slopes = np.concatenate(points_by_twist(arms))
        return float(np.sqrt(3.0)) * rms_bound(covariance, slopes)  # of all axes


def workspace_corners(rig: Rig) -> Array:
    """Corners of the workspace box of the platform's origin, shape (8, 3), [m]."""
    ends = zip(rig.workspace_lower, rig.workspace_upper, strict=True)
    return np.array(list(product(*ends)))


def judge_extrinsics(result: ExtrinsicCalibration, wanted: float) -> CalibrationVerdict:
    """The verdict on a camera's pose.

    Args:
        wanted: Required error in the work space, [m].
    """
    issues, error = list(result.issues), result.error
    if not error <= wanted and not result.is_contradictory:
        more = "survey more tags, all around the camera's view"
        if result.by == "rig motion":
            more = "take images at more poses, far apart and rotated up to 20° in every direction"
        if result.by == "another camera":
            more = "take more pairs of images, and calibrate the other camera's extrinsics better"
        if result.is_limited_by_lens:
            more = (
                "calibrate the camera's lens with more images, all over the image: it causes most"
            )
        what = f"points of the workspace are measured within {beyond(error, wanted)}"
        issues.append(Issue(what, more))
    return CalibrationVerdict.of(error, wanted, "in the workspace", issues)


def nearest_to_median(poses: Sequence[Pose]) -> Pose:
    """The pose whose position is nearest to the median of all."""
    middle = np.median([pose.position for pose in poses], axis=0)
    return min(poses, key=lambda pose: float(np.linalg.norm(pose.position - middle)))


def widths_of(covariance: Array, without: Sequence[Array]) -> Array:
    """Half widths of 95 % intervals, from scatter or jackknife.

    Args:
        covariance: From the scatter, shape (k, k).
        without: Changes of the k parameters when each part of the data is left out.

    Returns:
        The larger of both, shape (k,).
    """
    by_scatter = Z_95 * np.sqrt(np.diag(covariance))
    count = len(without)
    if count < 3:
        return np.asarray(by_scatter)
    spread = np.array(without) - np.mean(without, axis=0)
    by_parts = np.sqrt((count - 1) / count * np.sum(spread**2, axis=0))
    quantile = student_factor(count - 1)
    return np.asarray(np.maximum(by_scatter, quantile * by_parts))


def scaled_to(covariance: Array, half_widths: Array) -> Array:
    """A covariance, shape (k, k), scaled to half widths of 95 % intervals, shape (k,)."""
    scales = half_widths / Z_95 / np.sqrt(np.diag(covariance))
    return np.asarray(covariance * np.outer(scales, scales))


# Result file.


AXES = ("x_mm", "y_mm", "z_mm", "turn_x_deg", "turn_y_deg", "turn_z_deg")
"""Pose parameters: position, and rotations about the outer frame's axes from the stated one."""
SCALES = np.array([1e3, 1e3, 1e3, *([float(np.degrees(1.0))] * 3)])


class ExtrinsicsResult(ResultDocument):
    """A camera's pose, in the keys of the rig file's ``cameras`` section."""

    order: ClassVar[int] = 2

    kind: Literal["extrinsics"] = "extrinsics"
    by: Literal["frame tags", "rig motion", "another camera"]
    world_from_camera: PoseDocument
    points_mm: Annotated[list[Vector], Field(min_length=1)] = Field(
        description="positions in the world for which error_mm is stated"
    )
    tag_errors_px: dict[str, AnyNonNegative] = Field(description="RMS corner error of each tag")
    pictures: int
    pose_covariance: PoseCovariance | None = Field(
        default=None, description="of world_from_camera, mm and deg, position before rotation"
    )
    pose_by_lens: PoseSlopes | None = Field(
        default=None, description="how errors of the lens move it: a column for each of its numbers"
    )
    reference_camera: str | None = Field(
        default=None, description="the other camera, whose lens and pose were taken as known"
    )

    @property
    def follows(self) -> str:
        """The other camera: its pose is applied before."""
        return self.reference_camera or ""

    def in_words(self) -> list[tuple[str, str]]:
        """As for every result; rotations are relative to the stated one: uncertainty only."""
        return pose_rows(self.stated)

    def changes_to(self, other: Self) -> dict[str, float]:
        """Shift and rotation of the other result's camera, along the world's axes."""
        mine, theirs = self.world_from_camera.pose(), other.world_from_camera.pose()
        numbers = step_between(mine, theirs) * SCALES
        return dict(zip(AXES, numbers.tolist(), strict=True))

    def apart_mm(self, other: Self) -> float:
        """RMS distance between points seen at `points_mm` by both results, [mm]."""
        points = np.array(self.points_mm) / 1e3
        seen = self.world_from_camera.pose().inverse().apply(points)
        gaps = other.world_from_camera.pose().apply(seen) - points
        return float(rms(gaps)) * 1e3

    def corrected(self, rig: RigDocument) -> RigDocument:
        """The rig file's content with the camera at this pose.

        Raises:
            BadInput: The rig has no such camera, or its tags, the camera's parameters, or the other
                camera's differ.
        """
        camera = camera_named(rig, self.name)
        basis = _basis(rig, self.name, self.by, self.reference_camera)
        self.require_basis(basis, f"parameters of the camera or {self.by}")
        keys = ("world_from_camera", "pose_covariance", "pose_by_lens")
        return with_camera(rig, camera.model_copy(update={k: getattr(self, k) for k in keys}))


_NOT_OF_THE_LENS = (
    *("world_from_camera", "rate_hz", "pose_covariance", "error_mm", "readout_ms"),
    *("latency_ms", "lens_covariance", "pose_by_lens"),
)
_OF_ANOTHER_CAMERA = (
    *("name", "lens", "fx_px", "fy_px", "cx_px", "cy_px", "distortion", "world_from_camera"),
)


def extrinsics_result(
    result: ExtrinsicCalibration, verdict: CalibrationVerdict, rig: RigDocument, on: date
) -> ExtrinsicsResult:
    """The result file's content.

    Args:
        rig: The rig file's content used for the calibration.
    """
    name = result.camera.name
    return ExtrinsicsResult(
        **common_keys(
            name,
            on,
            result.data_hash,
            pose_intervals(result),
            verdict,
            result.unused,
            _basis(rig, name, result.by, result.reference_camera),
        ),
        by=result.by,
        world_from_camera=PoseDocument.of(result.world_from_camera),
        points_mm=[[float(x) * 1e3 for x in point] for point in result.points],
        reference_camera=result.reference_camera,
        tag_errors_px={str(k): float(v) for k, v in result.tag_errors.items()},
        pictures=result.pictures,
        pose_covariance=(result.stated_covariance * np.outer(SCALES, SCALES)).tolist(),
        pose_by_lens=(
            None if result.by_lens is None else (result.by_lens * SCALES[:, None]).tolist()
        ),
    )


def pose_intervals(result: ExtrinsicCalibration) -> dict[str, Interval]:
    """Intervals of the pose; rotations are about the world's axes, from the stated one."""
    values = np.concatenate([result.world_from_camera.position, np.zeros(3)]) * SCALES
    widths = result.half_widths * SCALES
    return {
        name: Interval(float(value), float(width))
        for name, value, width in zip(AXES, values, widths, strict=True)
    }


def pose_rows(stated: Mapping[str, Interval]) -> list[tuple[str, str]]:
    """Human-readable pose intervals; rotations from the stated one are 0 by definition."""
    return [
        (name, interval.half_width_text if "turn_" in name else str(interval))
        for name, interval in stated.items()
    ]


def _basis(rig: RigDocument, name: str, by: str, reference: str | None) -> dict[str, Any]:
    """Parts of the rig file that the result takes as known.

    Args:
        rig: The rig file's content.
        by: See `ExtrinsicCalibration`.
        reference: The other camera, if any.
    """
    camera = camera_named(rig, name).model_dump(mode="json")
    of_camera = {k: v for k, v in camera.items() if k not in _NOT_OF_THE_LENS}
    if of_camera["lens"] == "pinhole":  # the default is no part of a basis
        del of_camera["lens"]
    if reference is not None:
        other = camera_named(rig, reference).model_dump(mode="json")
        return {"camera": of_camera, "others": [{k: other[k] for k in _OF_ANOTHER_CAMERA}]}
    tags = rig.tags.model_dump(mode="json") if rig.tags else {}
    which = "frame" if by == "frame tags" else "platform"
    return {"camera": of_camera, "family": tags.get("family"), "tags": tags.get(which)}


# Report.


def extrinsics_page(
    result: ExtrinsicCalibration,
    document: ExtrinsicsResult,
    verdict: CalibrationVerdict,
    before: Pose,
) -> str:
    """The report page.

    Args:
        document: The result file's content.
        before: ``world_from_camera`` of the rig file.
    """
    pose = document.world_from_camera
    turn = "rotations are about the world's axes, relative to the stated one"
    quaternion = ", ".join(f"{q:.6f}" for q in pose.rotation_wxyz)
    tags = [(f"tag {k}", f"{error:.3f} px") for k, error in result.tag_errors.items()]
    return page_of(
        f"Pose of camera {document.name}",
        f"{document.date}, by {result.by}, {result.pictures} images used",
        verdict,
        [
            Section(
                "Camera pose, with 95 % intervals",
                table_of(
                    [
                        *document.in_words(),
                        ("rotation_wxyz", quaternion),
                        ("workspace", f"measured within {verdict.error * 1e3:.2g} mm (95 %)"),
                        ("data", document.data_sha256[:23]),
                    ]
                ),
                turn,
            ),
            Section(
                "Against the rig file",
                table_of(moved_rows(before, result.world_from_camera)),
            ),
            Section("Tags", table_of(tags), "RMS error of their corners."),
            *([Section("Poses", table_of(result.details))] if result.details else []),
            Section("Not used", table_of(result.unused.items())),
        ],
    )


def extrinsics_facts(found: ExtrinsicCalibration, before: Pose) -> list[tuple[str, str]]:
    """Human-readable details beside the estimates; ``before`` is the rig file's pose."""
    return [
        ("by", f"{found.by}, {found.pictures} images"),
        *((f"tag {k}", f"{error:.3f} px") for k, error in found.tag_errors.items()),
        *found.details,
        *moved_rows(before, found.world_from_camera),
    ]


ExtrinsicsOutcome = Calibration[ExtrinsicsResult, ExtrinsicCalibration, CalibrationVerdict]


def judged_extrinsics(
    found: ExtrinsicCalibration, rig: Rig, camera: Camera, wanted: float, to: Destination
) -> ExtrinsicsOutcome:
    """A finished calibration of a camera's pose, written to a folder where one is given.

    Args:
        camera: As in the rig file.
        wanted: Required error in the work space, 95 %, [m].
        to: Where to write it.
    """
    verdict, before = judge_extrinsics(found, wanted), camera.world_from_camera
    result = extrinsics_result(found, verdict, rig.document, to.on)
    page = extrinsics_page(found, result, verdict, before)
    made = Calibration(result, page, found, verdict, extrinsics_facts(found, before))
    return made.saved_in(to.folder)


def moved_rows(before: Pose, after: Pose) -> list[tuple[str, str]]:
    """Human-readable difference between two poses."""
    step = step_between(before, after) * SCALES
    return [
        ("moved", f"{before.distance_to(after) * 1e3:.2f} mm ({_listed(step[:3])})"),
        ("rotated", f"{np.degrees(before.angle_to(after)):.3f}° ({_listed(step[3:])})"),
    ]


def _listed(values: Array) -> str:
    return ", ".join(f"{value:+z.2f}" for value in values)
