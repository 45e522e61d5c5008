"""The bus with faults: rules work in both directions, and frames take their time on the wire."""

from __future__ import annotations

import itertools
import random
from collections.abc import Iterator
from dataclasses import dataclass

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.can_bus import BusSettings, open_bus
from drivers.can_load import frame_bits
from tests.scenarios.faults.fault_bus import FaultBus, delay, lose, lose_next, repeat, spoil

_CHANNELS = itertools.count()


@dataclass
class Line:
    """One end with faults, the other without."""

    faulty: FaultBus
    plain: can.BusABC
    now: float = 0.0

    def in_order(self, numbers: list[int]) -> list[int]:
        """What comes in of frames with these identifiers."""
        for number in numbers:
            self.plain.send(frame(number))
        return self.came()

    def came(self) -> list[int]:
        found = []
        while (message := self.faulty.recv(0.0)) is not None:
            found.append(message.arbitration_id)
        return found

    def went(self) -> list[int]:
        self.faulty.recv(0.0)
        found = []
        while (message := self.plain.recv(0.0)) is not None:
            found.append(message.arbitration_id)
        return found


def frame(number: int, data: bytes = b"") -> can.Message:
    return can.Message(arbitration_id=number, data=data, is_extended_id=False)


@pytest.fixture
def line() -> Iterator[Line]:
    settings = BusSettings("virtual", f"faults-{next(_CHANNELS)}")
    with (
        open_bus(settings) as plain,
        open_bus(settings) as under,
        FaultBus(under, lambda: made.now) as faulty,
    ):
        made = Line(faulty, plain)
        yield made


def test_without_rules_frames_pass_in_both_directions_in_order(line: Line) -> None:
    assert line.in_order([3, 1, 2]) == [3, 1, 2]
    for number in (5, 4):
        line.faulty.send(frame(number))
    assert line.went() == [5, 4]


def test_what_is_lost_is_lost_in_that_direction_only(line: Line) -> None:
    line.faulty.incoming.append(lose({1}))
    assert line.in_order([1, 2, 1, 3]) == [2, 3]
    line.faulty.send(frame(1))
    assert line.went() == [1]


def test_so_many_are_lost_and_no_more(line: Line) -> None:
    line.faulty.incoming.append(lose_next({1}, 2))
    assert line.in_order([1, 2, 1, 1, 1]) == [2, 1, 1]


def test_a_share_is_lost_by_the_dice_and_the_same_for_the_same_seed(line: Line) -> None:
    line.faulty.incoming.append(lose({1}, 0.3, random.Random(4)))
    left = len(line.in_order([1] * 1000))
    dice = random.Random(4)
    assert left == sum(dice.random() >= 0.3 for _ in range(1000))
    assert 650 < left < 750


def test_a_delayed_frame_comes_later(line: Line) -> None:
    line.faulty.incoming.append(delay({1}, 0.02))
    assert line.in_order([1, 2]) == [2]
    line.now = 0.019
    assert line.came() == []
    line.now = 0.02
    assert line.came() == [1]


def test_a_repeated_frame_comes_twice(line: Line) -> None:
    line.faulty.outgoing.append(repeat({1}, 0.01))
    line.faulty.send(frame(1))
    assert line.went() == [1]
    line.now = 0.01
    assert line.went() == [1]
    assert line.went() == []


def test_data_are_spoilt_as_often_as_wanted(line: Line) -> None:
    line.faulty.incoming.append(spoil({1}, lambda data: data[:2], 1))
    for _ in range(2):
        line.plain.send(frame(1, bytes(8)))
    found = [line.faulty.recv(0.0) for _ in range(2)]
    assert [message.dlc for message in found if message] == [2, 8]


def test_rules_follow_each_other(line: Line) -> None:
    line.faulty.incoming += [repeat({1}), lose_next({1}, 1)]
    assert line.in_order([1]) == [1], "of the two, one is lost"


def test_what_another_device_says_no_rule_touches(line: Line) -> None:
    line.faulty.outgoing.append(lose(range(0x800)))
    line.faulty.inject(frame(7))
    assert line.went() == [7]


@given(numbers=st.lists(st.integers(0, 0x7FF), min_size=1, max_size=20))
def test_on_the_wire_the_lowest_identifier_is_next_and_none_is_lost(numbers: list[int]) -> None:
    settings = BusSettings("virtual", f"faults-{next(_CHANNELS)}")
    now, bitrate = 0.0, 1e6
    with (
        open_bus(settings) as plain,
        open_bus(settings) as under,
        FaultBus(under, lambda: now, bitrate=bitrate) as faulty,
    ):
        for number in numbers:
            plain.send(frame(number, bytes(8)))
        assert faulty.recv(0.0) is None, "the first is still on the wire"
        found = []
        for k in range(1, len(numbers) + 1):
            now = k * frame_bits(8) / bitrate + 1e-9
            message = faulty.recv(0.0)
            assert message is not None
            found.append(message.arbitration_id)
            assert faulty.recv(0.0) is None, "one frame at a time"
        assert sorted(found) == sorted(numbers)
        first = found[0]
        assert first == numbers[0], "it found the wire free"
        assert found[1:] == sorted(found[1:])
