"""Result file of the tag layout on the platform."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import date
from itertools import product
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from calibration.extrinsics.result import AXES, SCALES, pose_rows
from calibration.report import Section, page_of, table_of
from calibration.results import (
    CalibrationVerdict,
    Issue,
    ResultDocument,
    beyond,
    common_keys,
)
from calibration.statistics import Interval
from calibration.tag_map.bundle_adjustment import (
    FAILED_ERROR,
    GOOD_ERROR,
    SIZE_ERROR,
    TagLayout,
    align_to_nominal,
)
from model.errors import BadInput
from model.files.camera_file import TagDocument
from model.files.documents import AnyNonNegative, PoseDocument, Positive
from model.files.rig_file import RigDocument
from model.pose import Array, Pose, step_between
from model.rig import Tag
from tracking.camera_model import rms
from tracking.detection.tags import mounted_rotated, tag_corners


class TagsResult(ResultDocument):
    """Tags on the platform, in the keys of the rig file's ``tags.platform``."""

    order: ClassVar[int] = 1

    kind: Literal["tags"] = "tags"
    platform: Annotated[list[TagDocument], Field(min_length=2)]
    fixed_tag: int | None = Field(description="kept as in the rig file; null: best fit of all")
    scale: Positive = Field(description="size of the layout relative to the rig file")
    rms_px: AnyNonNegative
    picture_errors_px: dict[str, AnyNonNegative]
    seen: dict[str, int] = Field(description="number of images that show each tag")

    def in_words(self) -> list[tuple[str, str]]:
        """As for every result, unless the fit has failed; rotations: uncertainty only."""
        return [] if self.rms_px > FAILED_ERROR else pose_rows(self.stated)

    def changes_to(self, other: Self) -> dict[str, float]:
        """Shifts and rotations of the other result's tags, along the platform's axes."""
        others = {tag.id: tag.pose() for tag in other.platform}
        changes: dict[str, float] = {}
        for tag in self.platform:
            if tag.id in others:
                changes |= _named(tag.id, step_between(tag.pose(), others[tag.id]))
        return changes

    def apart_mm(self, other: Self) -> float:
        """RMS distance between corners of the tags common to both, [mm].

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
                next_step="compare results for the same platform",
            )
        return float(rms(np.concatenate(gaps))) * 1e3

    def corrected(self, rig: RigDocument) -> RigDocument:
        """The rig file's content with the tags at these poses.

        Their error counts only if all were located: the others keep their nominal poses.

        Raises:
            BadInput: The rig's tags differ in number, size or family.
        """
        self.require_basis(_basis(rig), "sizes or numbers of tags")
        assert rig.tags is not None  # or their basis were another
        measured = {tag.id: tag for tag in self.platform}
        tags = [measured.get(tag.id, tag) for tag in rig.tags.platform]
        is_whole = all(tag.id in measured for tag in rig.tags.platform)
        changes = {"platform": tags, "error_mm": self.error_mm if is_whole else None}
        return rig.model_copy(update={"tags": rig.tags.model_copy(update=changes)})


def tags_result(
    result: TagLayout, verdict: CalibrationVerdict, rig: RigDocument, on: date
) -> TagsResult:
    """The result file's content.

    Args:
        rig: The rig file's content used for the measurement.
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
    """Intervals of all tag poses; rotations are about the platform's axes, from the stated one."""
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
    """Six pose parameters of a tag, [m, rad], by name with unit."""
    scaled = (values * SCALES).tolist()
    return {f"tag_{number}_{axis}": value for axis, value in zip(AXES, scaled, strict=True)}


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
    """Parts of the rig file that the result takes as known."""
    platform: Sequence[TagDocument] = rig.tags.platform if rig.tags else ()
    return {
        "family": rig.tags.family if rig.tags else None,
        "sizes": sorted([tag.id, tag.size_mm] for tag in platform),
    }


# Report.


def tags_page(result: TagLayout, document: TagsResult, verdict: CalibrationVerdict) -> str:
    """The report page."""
    gauge = "The platform frame is the best fit of all tags to the rig file."
    if result.fixed is not None:
        gauge = f"Tag {result.fixed} is kept as in the rig file."
    quality = [
        ("reprojection error, RMS", f"{result.reprojection:.3f} px"),
        ("tags located", f"within {verdict.error * 1e3:.2g} mm (95 %)"),
        ("size relative to the rig file", f"{result.scale:.5f}"),
        ("data", document.data_sha256[:23]),
    ]
    if result.has_failed:
        sections = [Section("Quality", table_of([quality[0], quality[-1]]))]
    else:
        sections = [
            Section(
                "Tags against the rig file",
                table_of(
                    change_rows(result),
                    ("tag", "moved [mm]", "rotated [°]", "x, y, z [mm]", "seen in"),
                ),
                gauge,
            ),
            Section(
                "Poses, with 95 % intervals",
                table_of(_pose_rows(document), ("tag", *AXES)),
                "Rotations are about the platform's axes, relative to the stated one.",
            ),
            Section("Quality", table_of(quality)),
        ]
    return page_of(
        f"Tags on the platform of {document.name}",
        f"{document.date}, {len(result.errors)} images used",
        verdict,
        [
            *sections,
            Section(
                "Images used",
                table_of((name, f"{error:.3f} px") for name, error in result.errors.items()),
            ),
            Section("Not used", table_of(document.unused.items())),
        ],
    )


def change_rows(result: TagLayout) -> list[tuple[str, str, str, str, str]]:
    """Changes from the rig file, one row per tag."""
    rows = []
    for tag, nominal in zip(result.tags, result.nominal, strict=True):
        shift = (tag.pose.position - nominal.pose.position) * 1e3
        rows.append(
            (
                f"tag {tag.id}",
                f"{np.linalg.norm(shift):.3f}",
                f"{np.degrees(tag.pose.angle_to(nominal.pose)):.3f}",
                ", ".join(f"{value:+z.3f}" for value in shift),
                f"{result.seen[tag.id]} images",
            )
        )
    return rows


def layout_facts(found: TagLayout) -> list[tuple[str, str]]:
    """Human-readable details beside the estimates."""
    used = f"{len(found.errors)} used, reprojection error {found.reprojection:.3f} px RMS"
    if found.has_failed:
        return [("images", used)]
    moved = [
        (name, f"moved {shift} mm, rotated {turn}° from the rig file; {count}")
        for name, shift, turn, _, count in change_rows(found)
    ]
    return [("images", used), *moved]


def _pose_rows(document: TagsResult) -> list[tuple[str, ...]]:
    text = dict(document.in_words())
    return [
        (f"tag {tag.id}", *(text[f"tag_{tag.id}_{axis}"] for axis in AXES))
        for tag in document.platform
    ]


# Verdict.


GOOD_IMAGES, GOOD_VIEWS = 12, 4
"""Required images in all, and of each tag."""
GOOD_SIDES_DEG = 40.0
FAR_MM, FAR_DEG = 10.0, 8.0
"""A tag farther off than this was mounted elsewhere, or this is another platform."""


def judge_layout(result: TagLayout, wanted: float) -> CalibrationVerdict:
    """The verdict on a layout.

    Args:
        wanted: Required error of tag corners, [m].
    """
    error = result.error
    if cause := _wrong_rig_file(result):
        issues = [cause]
    else:
        issues = [*_image_issues(result), *_fit_issues(result)]
        if not result.has_failed:
            issues += _layout_issues(result)
            if not error <= wanted:
                issues.append(_too_inaccurate(error, wanted))
    return CalibrationVerdict.of(error, wanted, "in the tags' positions", issues)


def _too_inaccurate(error: float, wanted: float) -> Issue:
    what = f"tags are located within {beyond(error, wanted)}"
    return Issue(what, "take more images, closer, sharp and from all sides")


def _image_issues(result: TagLayout) -> list[Issue]:
    issues = []
    if len(result.errors) < GOOD_IMAGES:
        what = f"{len(result.errors)} images show two tags or more; {GOOD_IMAGES} are required"
        issues.append(Issue(what, "take 20 images from all sides, two or three tags in each"))
    for number, why in result.unseen.items():
        step = f"take images that show tag {number} together with others"
        issues.append(Issue(f"tag {number} {why}", step))
    for number, count in result.seen.items():
        if count < GOOD_VIEWS:
            what = f"tag {number} is in {count} images; {GOOD_VIEWS} are required"
            issues.append(Issue(what, f"take more images of tag {number} with its neighbours"))
    return issues


def _fit_issues(result: TagLayout) -> list[Issue]:
    """That the tags do not fit the images, and the sizes that would."""
    if result.reprojection <= GOOD_ERROR:
        return []
    what = f"the reprojection error is {result.reprojection:.2f} px"
    sizes = {
        tag.id: f"tag {tag.id} is {tag.size * 1e3:.1f} mm wide, not {own.size * 1e3:g} mm"
        for tag, own in zip(result.resized or (), result.nominal, strict=False)
        if abs(tag.size / own.size - 1.0) > SIZE_ERROR
    }
    if not sizes:
        step = (
            "check sizes and numbers of the tags, that they lie flat, and the camera's parameters"
        )
        return [Issue(what, step)]
    which = ", ".join(map(str, sizes))
    step = f"measure the black square of tag {which} and correct size_mm in the rig file"
    return [Issue(f"{what}; the images fit if {' and '.join(sizes.values())}", step)]


def _layout_issues(result: TagLayout) -> list[Issue]:
    issues = []
    if np.degrees(result.sides) < GOOD_SIDES_DEG:
        what = (
            f"all images are taken from within {np.degrees(result.sides):.0f}°;"
            f" {GOOD_SIDES_DEG:.0f}° is required"
        )
        issues.append(Issue(what, "take images from all sides, all different"))
    if abs(result.scale - 1.0) > SIZE_ERROR:
        direction = "larger" if result.scale > 1.0 else "smaller"
        what = f"the layout is {abs(result.scale - 1.0):.1%} {direction} than in the rig file"
        issues.append(Issue(what, "measure the black squares and correct size_mm in the rig file"))
        scaled = [_scaled(tag, result.scale) for tag in result.nominal]
        if _fits(result.tags, scaled):
            return issues
    for tag, own in zip(result.tags, result.nominal, strict=True):
        if _is_far(own, tag):
            shift, turn = own.pose.distance_to(tag.pose) * 1e3, own.pose.angle_to(tag.pose)
            what = f"tag {tag.id} is {shift:.1f} mm and {np.degrees(turn):.1f}° from the rig file"
            step = f"check the position and rotation of tag {tag.id} in the rig file"
            issues.append(Issue(what, step))
    return issues


# What is wrong in the rig file, if its tags fit once that is corrected.


def _is_far(nominal: Tag, tag: Tag) -> bool:
    shift, turn = nominal.pose.distance_to(tag.pose), nominal.pose.angle_to(tag.pose)
    return shift * 1e3 > FAR_MM or np.degrees(turn) > FAR_DEG


def _wrong_rig_file(result: TagLayout) -> Issue | None:
    """The one mistake in the rig file that explains why tags are far from it; else None."""
    tags = result.resized or result.tags
    if (result.has_failed and not result.resized) or _fits(tags, result.nominal):
        return None
    rotated = mounted_rotated(result.nominal, result.family, lambda other: _fits(tags, other))
    if rotated is not None:
        return Issue(*rotated)
    if _fits(tags, [_read_as_xyzw(tag) for tag in result.nominal]):
        what = "all tags fit if the numbers of rotation_wxyz are read as x, y, z, w"
        return Issue(what, "write w first in the rotation_wxyz of tags.platform in the rig file")
    return _exchanged(tags, result.nominal)


def _fits(tags: Sequence[Tag], nominal: Sequence[Tag]) -> bool:
    """Whether no tag is far from its nominal pose, both in the best common frame."""
    shift, _ = align_to_nominal(tags, nominal, None)
    aligned = (replace(tag, pose=shift.compose(tag.pose)) for tag in tags)
    return not any(_is_far(own, tag) for own, tag in zip(nominal, aligned, strict=True))


def _scaled(tag: Tag, factor: float) -> Tag:
    return replace(tag, pose=Pose(factor * tag.pose.position, tag.pose.rotation))


def _read_as_xyzw(tag: Tag) -> Tag:
    pose = Pose.from_quaternion(tag.pose.position, np.roll(tag.pose.quaternion, 1))
    return replace(tag, pose=pose)


def _exchanged(tags: Sequence[Tag], nominal: Sequence[Tag]) -> Issue | None:
    """That tags are at the poses of others, if all fit so; the order with fewest changes."""
    here, there = (np.array([tag.pose.position for tag in which]) for which in (tags, nominal))
    found = []
    for tag, other in product(tags, nominal):
        shift = other.pose.compose(tag.pose.inverse())
        gaps = np.linalg.norm(shift.apply(here)[:, None] - there, axis=-1)
        order = np.argmin(gaps, axis=1).tolist()
        others = [nominal[k] for k in order]
        if len(set(order)) == len(order) and _fits(tags, others):
            pairs = zip(tags, others, strict=True)
            found.append([(own, one) for own, one in pairs if own.id != one.id])
    if not found:
        return None
    moved = min(found, key=len)
    where = " and ".join(f"tag {own.id} is at the pose of tag {one.id}" for own, one in moved)
    is_sized = all(abs(own.size / one.size - 1.0) < SIZE_ERROR for own, one in moved)
    which = "ids" if is_sized else "position_mm and rotation_wxyz"
    numbers = " and ".join(str(own.id) for own, _ in moved)
    step = f"exchange the {which} of tags {numbers} in the rig file, or the prints"
    return Issue(f"all tags fit if {where}", step)
