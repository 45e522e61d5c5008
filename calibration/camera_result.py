"""The result file of a camera's matrix and lens distortion."""

from __future__ import annotations

from datetime import date
from typing import Annotated, ClassVar, Literal, Self

import cv2
import numpy as np
from pydantic import Field

from calibration.camera import CameraCalibration
from calibration.camera_verdict import CameraQuality, picture_grid
from calibration.result_file import ResultDocument, common_keys
from cdpr.document_types import NonNegative, Number, Positive
from cdpr.errors import BadInput
from cdpr.poses import Array
from cdpr.rig_file import CameraDocument, RigDocument

Pixels = Annotated[int, Field(ge=1)]


class CameraResult(ResultDocument):
    """A camera's matrix and distortion, in the keys of the rig file's ``cameras`` section."""

    order: ClassVar[int] = 0

    kind: Literal["camera"] = "camera"
    width_px: Pixels
    height_px: Pixels
    fx_px: Positive
    fy_px: Positive
    cx_px: Number
    cy_px: Number
    distortion: list[Number]
    rms_px: NonNegative
    distance_m: Positive = Field(description="for which error_mm is stated")
    halves_apart_mm: NonNegative = Field(description="as two halves of the pictures see a point")
    covered: NonNegative = Field(description="share of the picture in which the board was seen")
    pictures_used: int
    view_errors_px: dict[str, NonNegative]

    @property
    def matrix(self) -> Array:
        """Camera matrix, shape (3, 3), [px]."""
        return np.array([[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0, 0, 1.0]])

    def apart_mm(self, other: Self) -> float:
        """How far apart points at the distance are seen, RMS over the picture, [mm].

        Raises:
            BadInput: The pictures are of different sizes.
        """
        size = (self.width_px, self.height_px)
        if size != (other.width_px, other.height_px):
            raise BadInput(
                f"one camera's pictures have {size[0]} x {size[1]} px, the other's"
                f" {other.width_px} x {other.height_px} px",
                next_step="compare results for one size of pictures",
            )
        flat = [
            cv2.undistortPoints(
                picture_grid(size).reshape(-1, 1, 2), r.matrix, np.array(r.distortion)
            ).reshape(-1, 2)
            for r in (self, other)
        ]
        squares = np.sum((flat[1] - flat[0]) ** 2, axis=1)
        return float(np.sqrt(np.mean(squares))) * self.distance_m * 1e3

    def corrected(self, rig: RigDocument) -> RigDocument:
        """The rig file's content with this camera's numbers.

        Raises:
            BadInput: The rig has no camera of this name, or one of another size.
        """
        camera = camera_named(rig, self.name)
        if (camera.width_px, camera.height_px) != (self.width_px, self.height_px):
            raise BadInput(
                f"this result is for pictures of {self.width_px} x {self.height_px} px, camera"
                f" {self.name!r} takes {camera.width_px} x {camera.height_px} px",
                where=f"calibration {self.kind} {self.name}, {self.date}",
                next_step="calibrate the camera in the size that it is used in",
            )
        keys = ("fx_px", "fy_px", "cx_px", "cy_px", "distortion")
        return with_camera(rig, camera.model_copy(update={k: getattr(self, k) for k in keys}))


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
