"""The result file of the tags' places on the platform."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from calibration.extrinsics_result import AXES, SCALES, pose_rows
from calibration.interval import Interval
from calibration.result_file import ResultDocument, common_keys
from calibration.tag_layout import TagLayout
from calibration.verdict import Verdict
from cdpr.document_types import NonNegative, PoseDocument, Positive
from cdpr.errors import BadInput
from cdpr.poses import Array, Pose, rotation_vector_from_matrix
from cdpr.rig import Tag
from cdpr.rig_file import RigDocument, TagDocument
from tracking.marks import tag_corners


class TagsResult(ResultDocument):
    """Tags on the platform, in the keys of the rig file's ``tags.platform``."""

    order: ClassVar[int] = 1

    kind: Literal["tags"] = "tags"
    platform: Annotated[list[TagDocument], Field(min_length=2)]
    fixed_tag: int | None = Field(description="that is as in the rig file; null: all fit it best")
    scale: Positive = Field(description="size of the layout by that of the rig file")
    rms_px: NonNegative
    picture_errors_px: dict[str, NonNegative]
    seen: dict[str, int] = Field(description="in how many pictures each tag was")

    def in_words(self) -> list[tuple[str, str]]:
        """As of every result; turns are from the stated rotation, so that only doubt is told."""
        return pose_rows(self.stated)

    def changes_to(self, other: Self) -> dict[str, float]:
        """How far the other result's tags are off, and how turned about the platform's axes."""
        others = {tag.id: tag.pose() for tag in other.platform}
        changes: dict[str, float] = {}
        for tag in self.platform:
            if tag.id in others:
                changes |= _named(tag.id, _difference(others[tag.id], tag.pose()))
        return changes

    def apart_mm(self, other: Self) -> float:
        """How far apart corners of tags that both have are, RMS, [mm].

        Raises:
            BadInput: They have no tag in common.
        """
        corners = {tag.id: tag_corners(_plain(tag)) for tag in other.platform}
        gaps = [
            tag_corners(_plain(tag)) - corners[tag.id] for tag in self.platform if tag.id in corners
        ]
        if not gaps:
            raise BadInput(
                "the results have no tag in common",
                where=f"calibration {self.kind} {self.name}, {self.date}",
                next_step="compare results for one platform",
            )
        return float(np.sqrt(np.mean(np.sum(np.concatenate(gaps) ** 2, axis=1)))) * 1e3

    def corrected(self, rig: RigDocument) -> RigDocument:
        """The rig file's content with the tags at these places.

        Raises:
            BadInput: The rig has tags of other numbers, sizes or families.
        """
        self.require_basis(_basis(rig), "sizes or numbers of tags")
        assert rig.tags is not None  # or their basis were another
        placed = {tag.id: tag for tag in self.platform}
        tags = [placed.get(tag.id, tag) for tag in rig.tags.platform]
        return rig.model_copy(update={"tags": rig.tags.model_copy(update={"platform": tags})})


def tags_result(result: TagLayout, verdict: Verdict, rig: RigDocument, on: date) -> TagsResult:
    """The result with its quality.

    Args:
        result: What was found.
        verdict: What it is good for.
        rig: The rig file's content that it was found with.
        on: The date.
    """
    unseen = {f"tag {number}": why for number, why in result.unseen.items()}
    return TagsResult(
        **common_keys(
            rig.name,
            on,
            result.data_hash,
            tag_intervals(result),
            verdict,
            {**result.unused, **unseen},
            _basis(rig),
        ),
        platform=[_document(tag) for tag in result.tags],
        fixed_tag=result.fixed,
        scale=result.scale,
        rms_px=result.reprojection,
        picture_errors_px={name: float(error) for name, error in result.errors.items()},
        seen={str(number): count for number, count in result.seen.items()},
    )


def tag_intervals(result: TagLayout) -> dict[str, Interval]:
    """All tags' numbers; turns are about the platform's axes, from the stated rotation."""
    found: dict[str, Interval] = {}
    widths = result.half_widths.reshape(-1, 6) * SCALES
    for tag, own in zip(result.tags, widths, strict=True):
        values = _named(tag.id, np.concatenate([tag.pose.position, np.zeros(3)]))
        found |= {
            name: Interval(value, float(width))
            for (name, value), width in zip(values.items(), own, strict=True)
        }
    return found


def _named(number: int, values: Array) -> dict[str, float]:
    """Six numbers of a tag, [m, rad], by name with unit."""
    scaled = (values * SCALES).tolist()
    return {f"tag_{number}_{axis}": value for axis, value in zip(AXES, scaled, strict=True)}


def _difference(pose: Pose, from_: Pose) -> Array:
    turn = rotation_vector_from_matrix(pose.rotation @ from_.rotation.T)
    return np.concatenate([pose.position - from_.position, turn])


def _plain(tag: TagDocument) -> Tag:
    return Tag(tag.id, tag.size_mm / 1e3, tag.pose())


def _document(tag: Tag) -> TagDocument:
    pose = PoseDocument.of(tag.pose)
    return TagDocument(
        id=tag.id,
        size_mm=round(tag.size * 1e3, 9),
        position_mm=pose.position_mm,
        rotation_wxyz=pose.rotation_wxyz,
    )


def _basis(rig: RigDocument) -> dict[str, Any]:
    """What the result takes as known."""
    platform: Sequence[TagDocument] = rig.tags.platform if rig.tags else ()
    return {
        "family": rig.tags.family if rig.tags else None,
        "sizes": sorted([tag.id, tag.size_mm] for tag in platform),
    }
