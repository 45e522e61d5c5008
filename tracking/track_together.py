"""Measuring the sources of several cameras at once, as ``cdpr track`` does with more than one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from cdpr.clearance import ClearanceModel
from tracking.cameras_together import CommonPose
from tracking.measured_clearance import clearance_of
from tracking.measurement import PoseMeasurement
from tracking.pose_log import LoggedPicture
from tracking.track import NoPlatformSeen


def track_together(
    streams: Mapping[str, Iterator[LoggedPicture]],
    within: float,
    model: ClearanceModel | None = None,
) -> Iterator[tuple[LoggedPicture, dict[str, LoggedPicture]]]:
    """The pose of all cameras, picture by picture, until one source ends.

    Args:
        streams: What `tracking.track.track` gives for each camera, by the camera's name.
        within: Pictures taken farther apart in time than this are not taken together, [s].
        model: Where obstacles are; the clearance is measured too.

    Returns:
        What all cameras say together, and each alone.

    Raises:
        NoPlatformSeen: At the end, when no camera gave a pose.
        BadInput: A picture is not of its camera's size.
        CameraMoved: Frame tags are not where they should be.
    """
    count, reason, common = 0, "the sources have no pictures", CommonPose(within)
    running = {name: _without_end(stream) for name, stream in streams.items()}
    for group in zip(*running.values(), strict=False):
        alone = dict(zip(running, group, strict=True))
        found = common.of({name: one.observation for name, one in alone.items()})
        clearance = None
        if isinstance(found, PoseMeasurement):
            count += 1
            clearance = clearance_of(model, found) if model is not None else None
        else:
            reason = found.reason
        yield LoggedPicture(group[0].name, found, clearance), alone
    if not count:
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
