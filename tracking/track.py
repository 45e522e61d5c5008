"""Measuring a whole source of pictures, as ``cdpr track`` does."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from time import monotonic
from typing import Protocol

from cdpr.clearance import ClearanceModel
from cdpr.errors import BadInput
from tracking.measured_clearance import MeasuredClearance, clearance_of
from tracking.measurement import NoPose, PoseMeasurement
from tracking.other_tags import what_else_is_seen
from tracking.picture import Image
from tracking.pose_log import LoggedPicture
from tracking.tracker import Tracker


class Picture(Protocol):
    """A picture of a source, such as a `drivers.cameras.Frame`."""

    @property
    def time(self) -> float:
        """When it was taken, [s]."""
        ...

    @property
    def image(self) -> Image:
        """Grey picture."""
        ...

    @property
    def name(self) -> str:
        """File or number."""
        ...


class NoPlatformSeen(BadInput):
    """Not one picture of a source gave a pose."""

    code = "no_platform_seen"


@dataclass(slots=True)
class TrackCount:
    """What came of a source so far, and how long each picture took to measure, [s]."""

    pictures: int = 0
    poses: int = 0
    seconds: list[float] = field(default_factory=list)


def track(
    source: Iterable[Picture],
    tracker: Tracker,
    count: TrackCount | None = None,
    give_up_after: int | None = None,
    model: ClearanceModel | None = None,
    on_picture: Callable[[Picture, LoggedPicture], None] | None = None,
) -> Iterator[LoggedPicture]:
    """Measures picture after picture.

    Args:
        source: Pictures in order of time.
        tracker: Keeps the last pose between pictures.
        count: Kept up to date while pictures are measured.
        give_up_after: Ends a source without an end after so many pictures without any pose.
        model: Where obstacles are; the clearance is measured too.
        on_picture: Told every picture with what was measured in it.

    Raises:
        NoPlatformSeen: At the end, when no picture gave a pose.
        BadInput: A picture is not of the camera's size.
        CameraMoved: The frame tags are not where they should be.
    """
    count = count or TrackCount()
    reasons: Counter[str] = Counter()
    last: Picture | None = None
    seen: set[int] = set()
    for picture in source:
        start = monotonic()
        observation = tracker.observe(picture.image, picture.time)
        count.seconds.append(monotonic() - start)
        count.pictures += 1
        clearance: MeasuredClearance | None = None
        if isinstance(observation, PoseMeasurement):
            count.poses += 1
            clearance = clearance_of(model, observation) if model is not None else None
        else:
            reasons[_reason(observation)] += 1
            seen.update(observation.seen)
            last = picture
        logged = LoggedPicture(picture.name, observation, clearance)
        if on_picture is not None:
            on_picture(picture, logged)
        yield logged
        if count.poses == 0 and count.pictures == give_up_after:
            break
    if count.poses == 0:
        raise _nothing_seen(tracker, count.pictures, reasons, last, seen)


def _reason(observation: NoPose) -> str:
    return observation.reason


def _nothing_seen(
    tracker: Tracker, pictures: int, reasons: Counter[str], last: Picture | None, seen: set[int]
) -> NoPlatformSeen:
    where = f"camera {tracker.camera.name!r}"
    if last is None:
        return NoPlatformSeen("the source has no pictures", where=where)
    wanted = ", ".join(map(str, tracker.expected_tags))
    instead = what_else_is_seen(last.image, tracker.rig.tag_family, tracker.expected_tags)
    next_step = (
        "check that the camera sees the platform, that the light suffices and that the rig file"
        " names the family and numbers of the printed tags"
    )
    if len(seen & {tag.id for tag in tracker.rig.platform_tags}) > 1:
        next_step = "check size_mm, position_mm and rotation_wxyz of tags.platform in the rig file"
    return NoPlatformSeen(
        f"none of {pictures} picture{'s' if pictures != 1 else ''} gives a pose of the platform:"
        f" {reasons.most_common(1)[0][0]}",
        where=where,
        why=f"expected are {tracker.rig.tag_family} tags {wanted}; {last.name} shows {instead}",
        next_step=next_step,
        values={"pictures": pictures, "family": tracker.rig.tag_family, "expected": wanted},
    )
