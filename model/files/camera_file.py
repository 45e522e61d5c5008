"""The cameras and tags of a rig file."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal, get_args

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field, ValidationInfo, field_validator
from pydantic.config import JsonDict

from model.files.documents import (
    WHOLE_LARGEST,
    AnyNumber,
    Document,
    Finding,
    Name,
    NonNegative,
    Number,
    PoseDocument,
    Positive,
    in_schema,
)

#: Tag detectors: OpenCV, or pyapriltags from the extra `apriltag`.
TagDetectorName = Literal["opencv", "apriltag"]
DETECTORS: tuple[str, ...] = get_args(TagDetectorName)

# Families of fiducial tags that can be printed and detected, as rig files name them.


AprilTagFamily = Literal["tag16h5", "tag25h9", "tag36h10", "tag36h11"]
ArucoDictionary = Literal[
    "4X4_50", "4X4_100", "4X4_250", "4X4_1000",
    "5X5_50", "5X5_100", "5X5_250", "5X5_1000",
    "6X6_50", "6X6_100", "6X6_250", "6X6_1000",
    "7X7_50", "7X7_100", "7X7_250", "7X7_1000",
    "ARUCO_ORIGINAL", "ARUCO_MIP_36H12",
]  # fmt: skip
TagFamily = Literal[AprilTagFamily, ArucoDictionary]

APRILTAG_FAMILIES: tuple[str, ...] = get_args(AprilTagFamily)
#: Other families of the AprilTag project, by how their names begin.
_BITS_OUTSIDE = ("tagStandard", "tagCircle", "tagCustom")
#: All families.
FAMILIES: tuple[str, ...] = APRILTAG_FAMILIES + get_args(ArucoDictionary)


def opencv_dictionary(family: str) -> str:
    """Name of OpenCV's constant for a family, such as ``DICT_APRILTAG_36H11``."""
    if family in APRILTAG_FAMILIES:
        return f"DICT_APRILTAG_{family.removeprefix('tag').upper()}"
    return f"DICT_{family}"


def drawn_upside_down(family: str) -> bool:
    """Whether OpenCV draws the family rotated by 180° against the prints of its own project.

    It does so for the families of the AprilTag project, whose images labs print.
    """
    return family in APRILTAG_FAMILIES


_APRILTAGS = {"tag16h5": 30, "tag25h9": 35, "tag36h10": 2320, "tag36h11": 587}
_NAMED = {"ARUCO_ORIGINAL": 1024, "ARUCO_MIP_36H12": 250}


def tags_in(family: str) -> int:
    """Number of tags in a family; ids count from 0."""
    named = _APRILTAGS | _NAMED
    return named[family] if family in named else int(family.split("_")[1])


# Lens models, as rig files name them.


FISHEYE = "fisheye"
LENSES = ("pinhole", FISHEYE)
"""OpenCV's camera models, by the key `lens`."""
LensName = Literal["pinhole", "fisheye"]
COEFFICIENTS = {LENSES[0]: (0, 4, 5, 8, 12, 14), FISHEYE: (4,)}
"""Numbers of distortion coefficients that a lens model may have."""


def require_coefficients(lens: str, count: int) -> None:
    """Refuses a number of distortion coefficients that OpenCV's model does not have.

    Raises:
        ValueError: The number does not fit the lens model.
    """
    if count not in COEFFICIENTS[lens]:
        *most, last = map(str, COEFFICIENTS[lens])
        listed = f"{', '.join(most)} or {last}" if most else last
        raise ValueError(f"a {lens} lens needs {listed} coefficients, it has {count}")


def _counted(counts: Sequence[int]) -> JsonDict:
    """JSON schema of a list that has one of these numbers of entries."""
    return {"anyOf": [{"minItems": count, "maxItems": count} for count in counts]}


# Covariances of a calibrated camera.


def _is_covariance(rows: list[list[float]], count: int) -> list[list[float]]:
    if len(rows) != count or any(len(row) != count for row in rows):
        raise ValueError(f"needs {count} rows of {count} numbers, symmetric")
    matrix = np.array(rows, dtype=np.float64)
    scale = np.sqrt(np.maximum(np.abs(np.diag(matrix)), 1e-300))
    alike = matrix / np.outer(scale, scale)
    if not np.allclose(alike, alike.T, rtol=1e-6, atol=1e-6):
        raise ValueError(f"needs {count} rows of {count} numbers, symmetric")
    if np.diag(matrix).min() < 0.0 or np.linalg.eigvalsh(alike)[0] < -1e-6:
        raise ValueError("is not a covariance: it has a negative eigenvalue")
    return rows


def _has_six_rows(rows: list[list[float]]) -> list[list[float]]:
    if len(rows) != 6 or len({len(row) for row in rows}) != 1:
        raise ValueError("needs 6 rows, each with one number per lens number of the camera")
    return rows


_six = in_schema(minItems=6, maxItems=6)
_four_or_more = in_schema(minItems=4)

PoseCovariance = Annotated[
    list[Annotated[list[AnyNumber], _six]],
    AfterValidator(lambda rows: _is_covariance(rows, 6)),
    _six,
]
"""Of a pose: position [mm] and rotation about the outer frame's axes [deg], 6 x 6."""
LensMatrix = Annotated[list[Annotated[list[AnyNumber], _four_or_more]], _four_or_more]
LensCovariance = Annotated[
    LensMatrix, AfterValidator(lambda rows: _is_covariance(rows, max(4, len(rows))))
]
"""Of a camera's n numbers in rig file order: fx, fy, cx, cy [px] and distortion, n x n."""
PoseSlopes = Annotated[
    list[Annotated[list[AnyNumber], _four_or_more]], AfterValidator(_has_six_rows), _six
]
"""Derivatives of a pose by a camera's n numbers: position [mm] and rotation [deg], 6 x n."""


Pixels = Annotated[int, Field(ge=64, le=16384)]
Latency = Annotated[float, Field(ge=0.0, le=5000.0)]
Gamma = Literal["srgb"] | Annotated[float, Field(ge=1.0, le=4.0)]
Readout = Annotated[float, Field(ge=-1000.0, le=1000.0)]


class TagDocument(PoseDocument):
    """One fiducial tag: its centre and orientation (x right, y up, z out of the print)."""

    id: Annotated[int, Field(ge=0, le=WHOLE_LARGEST)]
    size_mm: Positive = Field(description="side of the black square")


class TagsDocument(Document):
    """The tags on the platform (platform frame) and, optionally, on the frame (world)."""

    family: TagFamily = "tag36h11"
    detector: TagDetectorName = Field(
        default="opencv", description="apriltag: pyapriltags, of the extra `apriltag`"
    )
    platform: Annotated[list[TagDocument], Field(min_length=1)]
    frame: list[TagDocument] = []
    error_mm: NonNegative | None = Field(
        default=None,
        description="position error of the platform's tag corners, 95 %; calibrations write it",
    )

    @field_validator("family", mode="before")
    @classmethod
    def _bits_inside(cls, family: object) -> object:
        if isinstance(family, str) and family.startswith(_BITS_OUTSIDE):
            raise ValueError(
                f"{family[:60]} has data bits outside its border, which is not supported: state"
                " tag36h11, and print the tags with `cdpr calibrate print PDF --rig RIG`"
            )
        return family

    def ids(self) -> list[tuple[tuple[str | int, ...], int]]:
        """Number of every tag, with its key in the rig file."""
        return [
            (("tags", group, i, "id"), tag.id)
            for group, tags in (("platform", self.platform), ("frame", self.frame))
            for i, tag in enumerate(tags)
        ]

    def misfits(self) -> list[Finding]:
        """Tags that the family does not have."""
        count = tags_in(self.family)
        what = f"{self.family} has the tags 0 to {count - 1}"
        return [(key, what) for key, number in self.ids() if number >= count]


class CameraDocument(Document):
    """One camera: intrinsics (OpenCV) and pose (x right, y down, z along the view)."""

    model_config = ConfigDict(
        json_schema_extra={
            "if": {"properties": {"lens": {"const": FISHEYE}}, "required": ["lens"]},
            "then": {
                "properties": {"distortion": _counted(COEFFICIENTS[FISHEYE])},
                "required": ["distortion"],
            },
            "else": {"properties": {"distortion": _counted(COEFFICIENTS["pinhole"])}},
        }
    )

    name: Annotated[Name, in_schema(pattern="^[^/=.][^/=]*$")]
    width_px: Pixels
    height_px: Pixels
    fx_px: Positive
    fy_px: Positive
    cx_px: Number
    cy_px: Number
    lens: LensName = Field(default="pinhole", description="OpenCV's model of the lens")
    distortion: Annotated[list[Number], Field(max_length=14)] = Field(
        default=[],
        description="OpenCV order: k1 k2 p1 p2 k3 …; fisheye: k1 k2 k3 k4",
        validate_default=True,
    )
    world_from_camera: PoseDocument
    lens_covariance: LensMatrix | None = Field(
        default=None,
        description="of fx_px, fy_px, cx_px, cy_px and distortion; calibrations write it",
    )
    pose_covariance: PoseCovariance | None = Field(
        default=None, description="of world_from_camera, mm and deg; calibrations write it"
    )
    pose_by_lens: PoseSlopes | None = Field(
        default=None,
        description="derivatives of world_from_camera by the numbers of lens_covariance, mm and"
        " deg; calibrations write it",
    )
    error_mm: NonNegative | None = Field(
        default=None,
        description="error of measured platform and cables, 95 %, from everything that images"
        " share; used where calibrations do not state all of it",
    )
    rate_hz: Positive = 10.0
    readout_ms: Readout = Field(
        default=0.0,
        description="from the exposure of the top row to that of the bottom row (rolling shutter);"
        " 0: all rows at once, negative: from the bottom up",
    )
    latency_ms: Latency = Field(
        default=0.0,
        description="from the middle of an image's exposure to its arrival in a live camera's"
        " program",
    )
    gamma: Gamma = Field(
        default=1.0,
        description="how grey levels encode light: srgb (webcams), an exponent, or 1 for linear",
    )

    @field_validator("distortion")
    @classmethod
    def _opencv_count(cls, distortion: list[float], info: ValidationInfo) -> list[float]:
        require_coefficients(info.data.get("lens", LENSES[0]), len(distortion))
        return distortion

    @field_validator("lens_covariance", "pose_by_lens")
    @classmethod
    def _one_a_number(
        cls, rows: list[list[float]] | None, info: ValidationInfo
    ) -> list[list[float]] | None:
        if rows is None or "distortion" not in info.data:  # a wrong one has no number to compare
            return rows
        count = 4 + len(info.data["distortion"])
        if info.field_name == "lens_covariance":
            return _is_covariance(rows, count)
        if len(rows[0]) != count:
            raise ValueError(f"needs {count} numbers per row: fx, fy, cx, cy and distortion")
        return rows
