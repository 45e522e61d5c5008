"""The report of the tags' places on a platform."""

from __future__ import annotations

import numpy as np

from calibration.extrinsics_result import AXES
from calibration.page import Section, page_of, table_of
from calibration.tag_layout import TagLayout
from calibration.tags_result import TagsResult
from calibration.verdict import Verdict


def tags_page(result: TagLayout, document: TagsResult, verdict: Verdict) -> str:
    """The whole page."""
    gauge = "The platform's frame is put where all tags fit the rig file best."
    if result.fixed is not None:
        gauge = f"Tag {result.fixed} is taken to be as in the rig file."
    return page_of(
        f"Tags on the platform of {document.name}",
        f"{document.date}, {len(result.errors)} pictures used",
        verdict,
        [
            Section(
                "Tags against the rig file",
                table_of(
                    change_rows(result),
                    ("tag", "moved [mm]", "turned [°]", "x, y, z [mm]", "seen in"),
                ),
                gauge,
            ),
            Section(
                "Places, with 95 % intervals",
                table_of(_places(document), ("tag", *AXES)),
                "Turns are about the platform's axes, from the stated rotation.",
            ),
            Section(
                "Quality",
                table_of(
                    [
                        ("corners off, RMS", f"{result.reprojection:.3f} px"),
                        ("tags located", f"within {verdict.error * 1e3:.2g} mm (95 %)"),
                        ("size by the rig file", f"{result.scale:.5f}"),
                        ("data", document.data_sha256[:23]),
                    ]
                ),
            ),
            Section(
                "Pictures used",
                table_of((name, f"{error:.3f} px") for name, error in result.errors.items()),
            ),
            Section("Not used", table_of(document.unused.items())),
        ],
    )


def change_rows(result: TagLayout) -> list[tuple[str, str, str, str, str]]:
    """What changed against the rig file, tag by tag."""
    rows = []
    for tag, drawn in zip(result.tags, result.drawn, strict=True):
        shift = (tag.pose.position - drawn.pose.position) * 1e3
        rows.append(
            (
                f"tag {tag.id}",
                f"{np.linalg.norm(shift):.3f}",
                f"{np.degrees(tag.pose.angle_to(drawn.pose)):.3f}",
                ", ".join(f"{value:+.3f}" for value in shift),
                f"{result.seen[tag.id]} pictures",
            )
        )
    return rows


def _places(document: TagsResult) -> list[tuple[str, ...]]:
    told = dict(document.in_words())
    return [
        (f"tag {tag.id}", *(told[f"tag_{tag.id}_{axis}"] for axis in AXES))
        for tag in document.platform
    ]
