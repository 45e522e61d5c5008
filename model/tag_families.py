"""Families of fiducial tags that can be printed and detected, by their names in rig files."""

from __future__ import annotations

from typing import Literal, get_args

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
