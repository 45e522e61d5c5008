"""Images that waited in a queue get no time; those of a healthy camera do."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from math import nan
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.cameras.frame_reader import (
    AGE_TIME,
    EVEN_INTERVALS,
    START,
    TOLERANCE,
    ArrivalSchedule,
    DriverTimes,
)

RATES = (1.0, 2.0, 5.0, 10.0, 15.0, 20.0, 30.0, 60.0, 100.0, 200.0)


@dataclass(frozen=True)
class Judged:
    """An image: when it was taken and read, and whether it counts as on time."""

    taken: float
    read: float
    is_on_time: bool

    @property
    def lateness(self) -> float:
        return self.read - self.taken


def judged(
    exposures: list[float],
    *,
    pause: tuple[float, float] = (0.0, 0.0),
    decoding: float = 1e-3,
    jitter: float = 0.0,
    places: int = 10**6,
    seed: int = 1,
) -> list[Judged]:
    """Images through a queue, in order, and none read during the pause; a full queue takes none."""
    random, schedule = Random(seed), ArrivalSchedule()
    queue: deque[float] = deque()
    coming = deque((taken + random.uniform(0.0, jitter), taken) for taken in exposures)
    now, images = 0.0, []
    while coming or queue:
        if not queue:
            now = max(now, coming[0][0])
        if pause[0] <= now < pause[1]:
            now = pause[1]
        while coming and coming[0][0] <= now:
            _, taken = coming.popleft()
            if len(queue) < places:
                queue.append(taken)
        taken = queue.popleft()
        now += decoding
        images.append(Judged(taken, now, schedule.is_on_time(now)))
    return images


def at_rate(rate: float, seconds: float, begin: float = 0.0) -> list[float]:
    return [begin + k / rate for k in range(int(seconds * rate))]


@given(
    rate=st.sampled_from(RATES),
    length=st.floats(0.0, 5.0),
    share=st.floats(0.01, 0.5),
    jitter=st.floats(0.0, 0.02),
    places=st.sampled_from([4, 10, 10**6]),
    seed=st.integers(0, 9),
)
def test_no_image_that_waited_gets_the_present_time(
    rate: float, length: float, share: float, jitter: float, places: int, seed: int
) -> None:
    begin = START + (EVEN_INTERVALS + 5) / rate
    recovered = begin + length + 2.0 * (EVEN_INTERVALS + 2) / rate + length + 1.0
    decoding, jitter = min(0.02, share / rate), min(jitter, 0.2 / rate)
    images = judged(
        at_rate(rate, recovered + 3.0 + 5.0 / rate),
        pause=(begin, begin + length),
        decoding=decoding,
        jitter=jitter,
        places=places,
        seed=seed,
    )
    used = [image for image in images if image.is_on_time]
    assert max(image.lateness for image in used) <= 2.0 * TOLERANCE + decoding + jitter
    after = [image.is_on_time for image in images if image.taken > recovered]
    assert sum(after) >= 0.9 * len(after)


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("new", [0.34, 0.5, 0.7, 1.5, 3.0])
@pytest.mark.parametrize("gap", [0.0, 0.3, 2.0])
def test_a_camera_may_change_its_rate(rate: float, new: float, gap: float) -> None:
    """Its exposure follows the light; it may pause meanwhile."""
    change = START + 10.0 / rate
    exposures = at_rate(rate, change) + at_rate(new * rate, 30.0 + 20.0 / rate, change + gap)
    images = judged(exposures)
    settled = change + gap + 6.0 + 8.0 / (new * rate)
    assert all(image.is_on_time for image in images if image.taken > settled)


def test_images_stored_while_the_camera_opened_are_skipped() -> None:
    """FFmpeg reads some seconds of a stream to find its format."""
    images = judged(at_rate(20.0, 20.0), pause=(0.0, 5.0), decoding=0.01)
    assert not any(image.is_on_time for image in images if image.lateness > 0.02)
    assert all(image.is_on_time for image in images if image.taken > 5.0 + START + 0.3)


@pytest.mark.parametrize("rate", [5.0, 10.0, 30.0, 100.0])
def test_a_camera_that_loses_images_stays_in_use(rate: float) -> None:
    """Every tenth image is lost, also while the camera opens."""
    exposures = [taken for k, taken in enumerate(at_rate(rate, 60.0)) if k % 10]
    used = [image.is_on_time for image in judged(exposures) if image.taken > START + 2.0]
    assert sum(used) > 0.5 * len(used)


@pytest.mark.parametrize(
    "exposures",
    [
        [k // 2 * 0.2 + k % 2 / 15.0 for k in range(600)],
        [k / 15.0 for k in range(900) if k % 3],
    ],
    ids=["intervals of 67 and 133 ms", "every third image lost at 15 Hz"],
)
def test_a_camera_of_two_intervals_is_used(exposures: list[float]) -> None:
    used = [image.is_on_time for image in judged(exposures, jitter=3e-3) if image.taken > 3.0]
    assert all(used)


@pytest.mark.parametrize("together", [2, 3])
def test_a_camera_whose_images_come_together_is_used(together: int) -> None:
    """A USB hub delivers them so; at 30 Hz none waits for more than 67 ms."""
    schedule, used = ArrivalSchedule(), []
    for k in range(900):
        arrival = (k - k % together + together - 1) / 30.0 + 1e-3 * (k % together)
        used.append(schedule.is_on_time(arrival))
    assert sum(used[100:]) > 0.9 * len(used[100:])


def test_a_camera_of_uneven_images_stays_in_use() -> None:
    """As one on a busy wireless network: what came in time counts."""
    images = judged(at_rate(10.0, 60.0), jitter=0.1)
    used = [image for image in images if image.is_on_time]
    assert len(used) > 0.2 * len(images)
    assert max(image.lateness for image in used) < 0.1 + TOLERANCE


def test_the_images_of_a_stalled_reader_are_skipped_until_none_waits() -> None:
    """The case of a whole second at 20 images/s, image by image."""
    images = judged(at_rate(20.0, 8.0), pause=(5.0, 6.0), decoding=0.01)
    skipped = [image for image in images if not image.is_on_time and image.taken > START + 1.0]
    assert (round(skipped[0].taken, 2), len(skipped)) == (5.0, 30)  # 20 waited


@dataclass(frozen=True)
class Loads:
    """Times between which reading an image takes longer, as the computer is busy, [s]."""

    begin: float
    end: float
    decoding: float


def dated(
    rate: float, seconds: float, loads: list[Loads], *, places: int, offset: float, drift: float
) -> list[tuple[float, float, float | None]]:
    """Images of a driver that states their times: exposure, arrival and time as used, [s].

    Its clock has an offset and a drift. A full queue takes no image.
    """
    times, queue = DriverTimes(), deque[float]()
    coming = deque(at_rate(rate, seconds))
    now, images = 0.0, []
    while coming or queue:
        if not queue:
            now = max(now, coming[0])
        now += max([0.002] + [one.decoding for one in loads if one.begin <= now < one.end])
        while coming and coming[0] <= now:
            taken = coming.popleft()
            if len(queue) < places:
                queue.append(taken)
        taken = queue.popleft()
        images.append((taken, now, times.time(now, offset + (1.0 + drift) * taken)))
    return images


@given(
    rate=st.sampled_from(RATES),
    load=st.builds(Loads, st.floats(2.1, 8.0), st.floats(8.0, 15.0), st.floats(0.0, 3.0)),
    places=st.sampled_from([4, 10]),
    offset=st.sampled_from([1.0, 1e5, 1.7e9]),
    drift=st.floats(-1e-4, 1e-4),
)
def test_an_image_that_waited_has_its_time_if_the_driver_states_it(
    rate: float, load: Loads, places: int, offset: float, drift: float
) -> None:
    """A pause, or a computer that is too slow for seconds; none is skipped."""
    images = dated(rate, 30.0, [load], places=places, offset=offset, drift=drift)
    used = [(taken, now, time) for taken, now, time in images if time is not None]
    assert len(used) == sum(now - images[0][1] >= START for _, now, _ in images)
    assert all(abs(time - taken) < 0.1 for taken, _, time in used)
    assert all(time <= now for _, now, time in used)
    assert all(after[2] > before[2] for before, after in pairwise(used))


def test_stated_times_are_used_though_images_waited_while_the_camera_opened() -> None:
    opening = Loads(0.0, 0.01, 3.0)
    images = dated(20.0, 20.0, [opening], places=10**6, offset=0.5, drift=0.0)
    assert max(now - taken for taken, now, _ in images) > 2.5
    assert all(abs(time - taken) < 0.1 for taken, _, time in images if time is not None)
    assert sum(time is not None for _, _, time in images) > 250


def test_the_times_follow_the_clocks() -> None:
    """After an hour, clocks of 100 ppm differ by 0.4 s."""
    images = dated(2.0, 3600.0, [], places=4, offset=10.0, drift=-1e-4)
    assert all(abs(time - now) < 2e-4 * AGE_TIME for _, now, time in images if time is not None)


@pytest.mark.parametrize(
    "stated",
    [lambda k: 0.0, lambda k: 7.0, lambda k: (k if k < 90 else k - 50) / 30.0 + 1.0, lambda k: nan],
    ids=["none", "constant", "jumps back", "not a number"],
)
def test_times_that_do_not_rise_are_not_used(stated: Callable[[int], float]) -> None:
    times = DriverTimes()
    dates = [times.time(k / 30.0, stated(k)) for k in range(300)]
    assert dates[90:] == [None] * 210
