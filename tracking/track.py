"""Measuring a whole source of pictures, as ``cdpr track`` does."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

from cdpr.errors import BadInput
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
    """What came of a source so far."""

    pictures: int = 0
    poses: int = 0


def track(
    source: Iterable[Picture],
    tracker: Tracker,
    count: TrackCount | None = None,
    give_up_after: int | None = None,
) -> Iterator[LoggedPicture]:
    """Measures picture after picture.

    Args:
        source: Pictures in order of time.
        tracker: Keeps the last pose between pictures.
        count: Kept up to date while pictures are measured.
        give_up_after: Ends a source without an end after so many pictures without any pose.

    Raises:
        NoPlatformSeen: At the end, when no picture gave a pose.
        BadInput: A picture is not of the camera's size.
        CameraMoved: The frame tags are not where they should be.
    """
    count = count or TrackCount()
    reasons: Counter[str] = Counter()
    last: Picture | None = None
    for picture in source:
        observation = tracker.observe(picture.image, picture.time)
        count.pictures += 1
        if isinstance(observation, PoseMeasurement):
            count.poses += 1
        else:
            reasons[_reason(observation)] += 1
            last = picture
        yield LoggedPicture(picture.name, observation)
        if count.poses == 0 and count.pictures == give_up_after:
            break
    if count.poses == 0:
        raise _nothing_seen(tracker, count.pictures, reasons, last)


def _reason(observation: NoPose) -> str:
    return observation.reason


def _nothing_seen(
    tracker: Tracker, pictures: int, reasons: Counter[str], last: Picture | None
) -> NoPlatformSeen:
    where = f"camera {tracker.camera.name!r}"
    if last is None:
        return NoPlatformSeen("the source has no pictures", where=where)
    wanted = ", ".join(map(str, tracker.expected_tags))
    instead = what_else_is_seen(last.image, tracker.rig.tag_family, tracker.expected_tags)
    return NoPlatformSeen(
        f"none of {pictures} picture{'s' if pictures != 1 else ''} gives a pose of the platform:"
        f" {reasons.most_common(1)[0][0]}",
        where=where,
        why=f"expected are {tracker.rig.tag_family} tags {wanted}; {last.name} shows {instead}",
        next_step="check that the camera sees the platform, that the light suffices and that the"
        " rig file names the family and numbers of the printed tags",
        values={"pictures": pictures, "family": tracker.rig.tag_family, "expected": wanted},
    )
