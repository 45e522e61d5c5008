"""The result file of a camera's matrix and lens distortion."""

from __future__ import annotations

from datetime import date
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from calibration.intrinsics.calibrate import CameraCalibration
from calibration.intrinsics.figures import (
    coverage_map,
    radial_pattern,
    residual_arrows,
    tilt_figure,
    uncertainty_figure,
    worst_picture,
)
from calibration.intrinsics.quality import CameraQuality, picture_grid
from calibration.report import Section, interval_rows, page_of, table_of
from calibration.results import ResultDocument, common_keys
from model.errors import BadInput
from model.files.camera_file import CameraDocument, LensCovariance, LensName
from model.files.documents import AnyNonNegative, AnyNumber, Positive
from model.files.rig_file import RigDocument
from model.pose import Array
from tracking.camera_model import rays_of

Pixels = Annotated[int, Field(ge=1, le=16384)]


class CameraResult(ResultDocument):
    """A camera's matrix and distortion, in the keys of the rig file's ``cameras`` section."""

    order: ClassVar[int] = 0
    added: ClassVar[tuple[str, ...]] = ("lens", "lens_covariance")

    kind: Literal["camera"] = "camera"
    width_px: Pixels
    height_px: Pixels
    fx_px: Positive
    fy_px: Positive
    cx_px: AnyNumber
    cy_px: AnyNumber
    distortion: list[AnyNumber]
    lens: LensName = "pinhole"
    lens_covariance: LensCovariance | None = Field(
        default=None, description="of fx_px, fy_px, cx_px, cy_px and distortion"
    )
    rms_px: AnyNonNegative
    distance_m: Positive = Field(description="for which error_mm is stated")
    halves_apart_mm: AnyNonNegative = Field(
        description="difference between two halves of the images"
    )
    covered: AnyNonNegative = Field(description="share of the image covered by the board")
    pictures_used: int
    view_errors_px: dict[str, AnyNonNegative]

    @property
    def matrix(self) -> Array:
        """Camera matrix, shape (3, 3), [px]."""
        return np.array([[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0, 0, 1.0]])

    def apart_mm(self, other: Self) -> float:
        """How far apart points at the distance are seen, RMS over the image, [mm].

        A rotation between both cameras, as their places take it up, does not count.

        Raises:
            BadInput: The images are of different sizes.
        """
        size = (self.width_px, self.height_px)
        if size != (other.width_px, other.height_px):
            raise BadInput(
                f"one camera's images have {size[0]} x {size[1]} px, the other's"
                f" {other.width_px} x {other.height_px} px",
                next_step="compare results for one image size",
            )
        flat = [
            rays_of(r.lens, r.matrix, np.array(r.distortion), picture_grid(size))
            for r in (self, other)
        ]
        rays = [np.column_stack([part, np.ones(len(part))]) for part in flat]
        units = [part / np.linalg.norm(part, axis=1, keepdims=True) for part in rays]
        turn = Rotation.align_vectors(units[0], units[1])[0].as_matrix()
        turned = rays[1] @ turn.T
        squares = np.sum((turned[:, :2] / turned[:, 2:] - flat[0]) ** 2, axis=1)
        return float(np.sqrt(np.mean(squares))) * self.distance_m * 1e3

    def corrected(self, rig: RigDocument) -> RigDocument:
        """The rig file's content with this camera's numbers.

        Raises:
            BadInput: The rig has no camera of this name, or one of another size.
        """
        camera = camera_named(rig, self.name)
        if (camera.width_px, camera.height_px) != (self.width_px, self.height_px):
            raise BadInput(
                f"this result is for images of {self.width_px} x {self.height_px} px, camera"
                f" {self.name!r} takes {camera.width_px} x {camera.height_px} px",
                where=f"calibration {self.kind} {self.name}, {self.date}",
                next_step="calibrate the camera at the image size in use",
            )
        keys = ("fx_px", "fy_px", "cx_px", "cy_px", "distortion", "lens", "lens_covariance")
        changes = {k: getattr(self, k) for k in keys} | {"pose_by_lens": None}
        return with_camera(rig, camera.model_copy(update=changes))


def camera_result(
    result: CameraCalibration, quality: CameraQuality, name: str, on: date
) -> CameraResult:
    """The result with its quality.

    Args:
        result: What was found.
        quality: What it is good for.
        name: Of the camera in the rig file.
        on: The date.
    """
    m = result.matrix
    return CameraResult(
        **common_keys(name, on, result.data_hash, result.intervals, quality.verdict, result.unused),
        width_px=result.size[0],
        height_px=result.size[1],
        fx_px=float(m[0, 0]),
        fy_px=float(m[1, 1]),
        cx_px=float(m[0, 2]),
        cy_px=float(m[1, 2]),
        distortion=[float(x) for x in result.distortion],
        lens=result.lens.kind,
        lens_covariance=result.uncertainty.stated_covariance.tolist(),
        rms_px=result.error,
        distance_m=quality.distance,
        halves_apart_mm=quality.halves * 1e3,
        covered=quality.covered,
        pictures_used=len(result.views),
        view_errors_px={k: float(v) for k, v in result.view_errors.items()},
    )


def camera_named(rig: RigDocument, name: str) -> CameraDocument:
    """A camera of a rig file.

    Raises:
        BadInput: It has none of this name; those that it has are listed.
    """
    for camera in rig.cameras:
        if camera.name == name:
            return camera
    names = ", ".join(camera.name for camera in rig.cameras) or "none"
    raise BadInput(
        f"no camera {name!r}",
        where=f"rig {rig.name}",
        why=f"the rig's cameras: {names}",
        next_step="name one of them, or add the camera to the rig file",
    )


def with_camera(rig: RigDocument, changed: CameraDocument) -> RigDocument:
    """The rig file's content with a camera in place of that of its name."""
    cameras = [changed if camera.name == changed.name else camera for camera in rig.cameras]
    return rig.model_copy(update={"cameras": cameras})


# The report of a camera calibration.


def camera_page(result: CameraCalibration, quality: CameraQuality, name: str, date: str) -> str:
    """The whole page."""
    lead = (
        f"{date}, {result.size[0]} × {result.size[1]} px, {len(result.views)} images used,"
        f" {len(result.unused)} not"
    )
    covered = f"{quality.covered:.0%} of the image's cells contain corners"
    tilted = "A dot per image: vertical for forward and backward, horizontal for left and right."
    sure = (
        "Half widths of the 95 % intervals of points seen there, without what a rotation of the"
        " camera takes up."
    )
    arrows = "From where a corner is expected towards where it was detected."
    along = (
        "Mean error away from the principal point, in rings with as many corners each; bars are 95"
        " % of the mean. A lens that the model fits has none."
    )
    used = "Error, corners, and change of fx without the image."
    return page_of(
        f"Calibration of camera {name}",
        lead,
        quality.verdict,
        [
            Section("Parameters, with 95 % intervals", _numbers(result, quality)),
            Section("Where the board was seen", coverage_map(result, quality), covered),
            Section("How sure pixels are", uncertainty_figure(result, quality), sure),
            Section("Errors of corners", residual_arrows(result), arrows),
            Section("Errors along the radius", radial_pattern(result), along),
            *worst_picture(result),
            Section("How the board was tilted", tilt_figure(quality), tilted),
            Section("Images used", _pictures(result), used),
            Section("Images not used", table_of(result.unused.items())),
        ],
    )


def _numbers(result: CameraCalibration, quality: CameraQuality) -> str:
    verdict = quality.verdict
    return table_of(
        [
            *interval_rows(result.intervals),
            ("lens model", f"{result.lens.name}, errors along the radius {quality.radial:.0%}"),
            ("corners off, RMS", f"{result.error:.3f} px"),
            (f"a point {verdict.where}", f"within {verdict.error * 1e3:.2g} mm (95 %)"),
            ("boards were", f"{quality.nearest:.3g} to {quality.farthest:.3g} m away"),
            ("two halves of the pictures", f"{quality.halves * 1e3:.2g} mm apart there"),
            ("the board's bow", f"{quality.bow * 1e3:.2g} mm, {quality.bent:.0%} of the errors"),
            ("data", result.data_hash[:23]),
        ]
    )


def _pictures(result: CameraCalibration) -> str:
    """Error of each picture, and how much of the focal length hangs on it."""
    change = result.uncertainty.without[:, 0]
    rows = [
        (name, f"{error:.3f} px", f"{len(seen.corners)}", f"{without:+z.2f} px")
        for (name, error), seen, without in zip(
            result.view_errors.items(), result.views.values(), change, strict=True
        )
    ]
    return table_of(rows, ("image", "error, RMS", "corners", "fx without it"))
