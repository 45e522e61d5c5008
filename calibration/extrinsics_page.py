"""The report of a camera's place."""

from __future__ import annotations

import numpy as np

from calibration.extrinsics import ExtrinsicCalibration
from calibration.extrinsics_result import ExtrinsicsResult
from calibration.page import Section, page_of, table_of
from calibration.verdict import Verdict
from cdpr.poses import Array, Pose, rotation_vector_from_matrix


def extrinsics_page(
    result: ExtrinsicCalibration, document: ExtrinsicsResult, verdict: Verdict, before: Pose
) -> str:
    """The whole page.

    Args:
        result: What was found.
        document: As it is written.
        verdict: What it is good for.
        before: ``world_from_camera`` of the rig file.
    """
    pose = document.world_from_camera
    turn = "turns are about the world's axes, from the stated rotation"
    quaternion = ", ".join(f"{q:.6f}" for q in pose.rotation_wxyz)
    tags = [(f"tag {k}", f"{error:.3f} px") for k, error in result.tag_errors.items()]
    return page_of(
        f"Place of camera {document.name}",
        f"{document.date}, by {result.by}, {result.pictures} pictures used",
        verdict,
        [
            Section(
                "Where the camera stands, with 95 % intervals",
                table_of(
                    [
                        *document.in_words(),
                        ("rotation_wxyz", quaternion),
                        ("work space", f"seen within {verdict.error * 1e3:.2g} mm (95 %)"),
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
            Section("Not used", table_of(result.unused.items())),
        ],
    )


def moved_rows(before: Pose, after: Pose) -> list[tuple[str, str]]:
    """How far a pose is from another, for people."""
    shift = (after.position - before.position) * 1e3
    turn = np.degrees(rotation_vector_from_matrix(after.rotation @ before.rotation.T))
    return [
        ("moved", f"{before.distance_to(after) * 1e3:.2f} mm ({_listed(shift)})"),
        ("turned", f"{np.degrees(before.angle_to(after)):.3f}° ({_listed(turn)})"),
    ]


def _listed(values: Array) -> str:
    return ", ".join(f"{value:+.2f}" for value in values)
