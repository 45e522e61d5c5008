"""Images of several cameras are grouped by their times, and none is lost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from tracking.fusion import synchronize_frames
from tracking.measurement import NoPose
from tracking.pose_log import LoggedImage

TIMES = st.lists(st.integers(0, 60), max_size=20, unique=True).map(sorted)


def grouped(times: Mapping[str, Sequence[float]], within: float) -> list[dict[str, float]]:
    streams = {
        name: iter([LoggedImage("", NoPose(time, "")) for time in own])
        for name, own in times.items()
    }
    return [
        {name: one.observation.time for name, one in moment.items()}
        for moment in synchronize_frames(streams, within)
    ]


@given(times=st.tuples(TIMES, TIMES, TIMES), within=st.integers(0, 20))
def test_every_image_is_in_one_frame_set_and_frame_sets_are_in_order(
    times: tuple[list[int], list[int], list[int]], within: int
) -> None:
    cameras = dict(zip("abc", times, strict=True))
    found = grouped(cameras, within)
    for name, own in cameras.items():
        assert [moment[name] for moment in found if name in moment] == own
    assert all(max(moment.values()) - min(moment.values()) <= within for moment in found)
    for one, two in pairwise(found):
        assert max(one.values()) <= min(two.values())


@given(a=TIMES, b=TIMES, within=st.integers(0, 20))
def test_pictures_that_are_nearest_to_each_other_are_together(
    a: list[int], b: list[int], within: int
) -> None:
    found = grouped({"a": a, "b": b}, within)
    for one in a:
        for two in b:
            gap = abs(one - two)
            nearest_to_one = all(abs(one - other) > gap for other in b if other != two)
            nearest_to_two = all(abs(two - other) > gap for other in a if other != one)
            if gap <= within and nearest_to_one and nearest_to_two:
                assert {"a": one, "b": two} in found


def test_the_slower_camera_goes_with_the_nearest_picture_of_the_faster() -> None:
    fast, slow = [0.0, 0.1, 0.2, 0.3, 0.4], [0.02, 0.22]
    together = [moment for moment in grouped({"slow": slow, "fast": fast}, 0.1) if len(moment) > 1]
    assert together == [{"slow": 0.02, "fast": 0.0}, {"slow": 0.22, "fast": 0.2}]
