"""Measuring the sources of several cameras at once, as ``cdpr track`` does with more than one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from cdpr.clearance import ClearanceModel
from tracking.cameras_together import CommonPose
from tracking.measured_clearance import clearance_of
from tracking.measurement import PoseMeasurement
from tracking.moments import moments
from tracking.pose_log import LoggedPicture
from tracking.track import NoPlatformSeen


@dataclass(slots=True)
class TogetherCount:
    """What was not taken together so far.

    Attributes:
        without_partner: Pictures to which no other camera has one of about the same time.
        apart: Moments in which a pose was left out as its picture is too far from the others.
        without_speed: Moments in which one was left out as it could not be carried on.
    """

    without_partner: int = 0
    apart: int = 0
    without_speed: int = 0


def track_together(
    streams: Mapping[str, Iterator[LoggedPicture]],
    within: float,
    count: TogetherCount,
    model: ClearanceModel | None = None,
) -> Iterator[tuple[LoggedPicture, dict[str, LoggedPicture]]]:
    """The pose of all cameras, moment by moment, until the last source ends.

    Args:
        streams: What `tracking.track.track` gives for each camera, by the camera's name.
        within: Pictures taken farther than this from the median time of a moment's pictures are
            not taken together with the others, [s].
        count: Kept up to date.
        model: Where obstacles are; the clearance is measured too.

    Returns:
        What all cameras say together, and what each alone that has a picture of the moment.

    Raises:
        NoPlatformSeen: At the end, when no camera gave a pose.
        BadInput: A picture is not of its camera's size.
        CameraMoved: Frame tags are not where they should be.
    """
    poses, reason, common = 0, "the sources have no pictures", CommonPose(within)
    running = {name: _without_end(stream) for name, stream in streams.items()}
    for alone in moments(running, 2.0 * within):
        found = common.of({name: one.observation for name, one in alone.items()})
        count.without_partner += len(alone) == 1
        count.apart, count.without_speed = common.apart, common.without_speed
        clearance = None
        if isinstance(found, PoseMeasurement):
            poses += 1
            clearance = clearance_of(model, found) if model is not None else None
        else:
            reason = found.reason
        yield LoggedPicture(next(iter(alone.values())).name, found, clearance), alone
    if not poses:
        raise NoPlatformSeen(
            f"no camera gives a pose of the platform: {reason}",
            where=f"cameras {', '.join(streams)}",
            next_step="check that the cameras see the platform; `cdpr track` with one source alone"
            " tells more",
        )


def _without_end(stream: Iterator[LoggedPicture]) -> Iterator[LoggedPicture]:
    """A camera that sees nothing at all ends without an error: the others may see."""
    try:
        yield from stream
    except NoPlatformSeen:
        return
