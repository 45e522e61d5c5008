"""Which pictures of several cameras belong to one moment."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping

from tracking.pose_log import LoggedPicture


def moments(
    streams: Mapping[str, Iterator[LoggedPicture]], within: float
) -> Iterator[dict[str, LoggedPicture]]:
    """Puts the pictures of all cameras in order of time, those of one moment together.

    A moment has the oldest picture that is left and, of each other camera, the one nearest to it:
    taken no later than ``within`` after it, and nearer to the pictures of this moment than to
    those that follow them.

    Args:
        streams: What each camera measured, by its name, each in order of time.
        within: See above, [s].

    Returns:
        By the cameras' names, in their order; each picture in one moment, until all streams end.
    """
    queues: dict[str, deque[LoggedPicture]] = {name: deque() for name in streams}
    open_streams = dict(streams)
    while True:
        # Round after round, so that live cameras are read in turn: no one's two pictures in a row.
        for wanted in (1, 2):
            for name in [n for n in open_streams if len(queues[n]) < wanted]:
                picture = next(open_streams[name], None)
                if picture is None:
                    del open_streams[name]
                else:
                    queues[name].append(picture)
        if not any(queues.values()):
            return
        members = _of_one_moment(queues, within)
        yield {name: queues[name].popleft() for name in queues if name in members}


def _of_one_moment(queues: Mapping[str, deque[LoggedPicture]], within: float) -> list[str]:
    """The cameras whose oldest pictures belong together, the oldest first."""
    by_age = sorted((n for n, queue in queues.items() if queue), key=lambda n: _time(queues[n][0]))
    members = by_age[:1]
    for name in by_age[1:]:
        time = _time(queues[name][0])
        if time - _time(queues[members[0]][0]) > within:
            break
        if any(_is_nearer_to_the_next(queues[member], time) for member in members):
            break
        members.append(name)
    return members


def _is_nearer_to_the_next(queue: deque[LoggedPicture], time: float) -> bool:
    return len(queue) > 1 and _time(queue[1]) - time < time - _time(queue[0])


def _time(picture: LoggedPicture) -> float:
    return picture.observation.time
