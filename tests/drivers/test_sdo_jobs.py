"""SDO requests during cyclic operation: golden bytes, one at a time, only matching answers."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.can_load import MAX_LOAD, bus_load, frame_bits, requests_per_cycle
from drivers.cia402.sdo_jobs import (
    ModeCheck,
    MonitoringEnd,
    SdoJobs,
    SdoRequest,
    StatePoll,
    StateReading,
    answer_cycles,
    cycles_to_end,
    monitoring_off,
)

NODE = 5
NEVER = 1_000_000
"""Turns after which a request is sent again."""
READ, WRITE = SdoRequest(0x6041, 0), SdoRequest(0x1006, 0, bytes(4))


def test_requests_are_those_of_cia_301() -> None:
    jobs = SdoJobs({NODE: (*monitoring_off(2), READ)}, NEVER)
    sent = []
    for answer in ("60 16 10 01", "60 16 10 02", "60 00 14 05", "60 06 10 00", "4b 41 60 00 37 02"):
        sent += jobs.next_requests(9)
        jobs.take(NODE, bytes.fromhex(answer).ljust(8, b"\0"))
    assert sent == [
        (0x605, bytes.fromhex("23 16 10 01 00 00 00 00")),
        (0x605, bytes.fromhex("23 16 10 02 00 00 00 00")),
        (0x605, bytes.fromhex("2b 00 14 05 00 00 00 00")),
        (0x605, bytes.fromhex("23 06 10 00 00 00 00 00")),
        (0x605, bytes.fromhex("40 41 60 00 00 00 00 00")),
    ]
    assert jobs.unfinished() == set()
    assert jobs.values == {(NODE, READ): 0x237}


def test_every_drive_gets_its_first_request_before_any_gets_its_second() -> None:
    """The master's heartbeat is the first to be watched no longer, by all drives."""
    jobs = SdoJobs({node: (WRITE, READ) for node in (1, 2, 3)}, NEVER)
    asked = []
    for _ in range(6):
        ((can_id, data),) = jobs.next_requests(1)
        asked.append((can_id - 0x600, data[0]))
        jobs.take(
            can_id - 0x600,
            bytes.fromhex(
                "60 06 10 00 00 00 00 00" if data[0] == 0x23 else "4b 41 60 00 37 02 00 00"
            ),
        )
    assert asked == [(1, 0x23), (2, 0x23), (3, 0x23), (1, 0x40), (2, 0x40), (3, 0x40)]
    assert jobs.unfinished() == set()


def turns_of(jobs: StateReading | MonitoringEnd, most: int, delay: int, word: bytes) -> int:
    """Turns until all are answered, each in the last turn that the delay allows."""
    due: list[tuple[int, int, bytes]] = []
    for turn in itertools.count():
        for at, node, data in [each for each in due if each[0] <= turn]:
            jobs.take(node, data)
            due.remove((at, node, data))
        if not jobs.unfinished():
            return turn
        for can_id, data in jobs.next_requests(most):
            answer = bytes((0x43, *data[1:4])) + word if data[0] == 0x40 else b"\x60" + data[1:]
            due.append((turn + delay, can_id - 0x600, answer))
    raise AssertionError


@given(
    heartbeats=st.lists(st.integers(0, 12), min_size=1, max_size=12),
    most=st.integers(1, 12),
    timeout=st.floats(0.001, 0.3),
    cycle=st.sampled_from([0.004, 0.01, 0.03, 0.1]),
    stopped=st.sets(st.integers(1, 12)),
)
def test_the_time_to_end_monitoring_suffices_for_the_slowest_answers(
    heartbeats: list[int], most: int, timeout: float, cycle: float, stopped: set[int]
) -> None:
    """A time-out below the cycle counted as less than one, though one answer is taken a cycle."""
    answer = answer_cycles(timeout, cycle)
    assert answer * cycle >= max(timeout, cycle) - 1e-9
    ending = MonitoringEnd(dict(enumerate(heartbeats, 1)), 1, NEVER, stopped=stopped)
    turns = turns_of(ending, most, answer, b"\x07\x06\0\0")
    assert turns <= cycles_to_end(heartbeats, most, answer)
    assert ending.refused() == set()


@given(drives=st.integers(1, 12), answer=st.integers(1, 30))
def test_every_state_is_read_from_the_slowest_answers(drives: int, answer: int) -> None:
    nodes = range(1, drives + 1)
    reading = StateReading(nodes, NEVER, answer, silent=set(nodes))
    assert turns_of(reading, drives, answer, bytes(4)) <= 3 * answer
    assert len(reading.values) == 3 * drives


@given(
    drives=st.integers(1, 12),
    cycle_ms=st.integers(1, 100),
    bitrate=st.sampled_from([50_000, 125_000, 250_000, 500_000, 1_000_000]),
)
def test_several_requests_a_cycle_leave_the_bus_below_its_limit(
    drives: int, cycle_ms: int, bitrate: int
) -> None:
    cycle = cycle_ms / 1000.0
    most = requests_per_cycle(drives, cycle, bitrate)
    added = most * 2 * frame_bits(8) / (cycle * bitrate)
    assert most == 1 or bus_load(drives, cycle, bitrate) + added <= MAX_LOAD + 1e-9
    assert 1 <= most <= max(1, cycle_ms // 10)


def test_the_end_of_monitoring_is_short_in_long_cycles_too() -> None:
    """One request a cycle took 7 s at 100 ms; ten a cycle overloaded a bus of 50 kbit/s."""
    assert requests_per_cycle(8, 0.1, 1_000_000) == 10
    assert requests_per_cycle(10, 0.1, 50_000) == 1
    assert requests_per_cycle(8, 0.01, 1_000_000) == 1


@pytest.mark.parametrize(
    ("answers", "size", "value"),
    [
        (("42 41 60 00 37 02 99 99",), 2, 0x237),
        (("42 41 60 00 37 02 99 99",), 4, 0x99990237),
        (("41 41 60 00 02 00 00 00", "0b 37 02 00 00 00 00 00"), 2, 0x237),
        (("40 41 60 00 00 00 00 00", "07 37 02 00 00 00 00 00"), 2, 0x237),
    ],
)
def test_the_other_legal_answers_are_understood(
    answers: tuple[str, ...], size: int, value: int
) -> None:
    """Expedited without a size, and in segments. Source: CiA 301, 7.2.4.3.6."""
    request = SdoRequest(0x6041, 0, size=size)
    jobs = SdoJobs({NODE: (request,)}, NEVER)
    sent = []
    for answer in answers:
        sent += [data.hex() for _, data in jobs.next_requests(1)]
        jobs.take(NODE, bytes.fromhex(answer))
    assert sent == ["4041600000000000", "6000000000000000"][: len(answers)]
    assert jobs.values == {(NODE, request): value}
    assert jobs.unfinished() == set()


def test_a_drive_is_asked_one_thing_at_a_time_and_all_at_once() -> None:
    jobs = SdoJobs({1: (READ, WRITE), 2: (READ,)}, NEVER)
    assert [can_id for can_id, _ in jobs.next_requests(1)] == [0x601]
    assert [can_id for can_id, _ in jobs.next_requests(5)] == [0x602]
    assert jobs.next_requests(5) == []
    assert jobs.is_asking


def test_a_refusal_is_kept_with_its_code_and_the_next_follows() -> None:
    jobs = SdoJobs({NODE: (WRITE, READ)}, NEVER)
    jobs.next_requests(1)
    jobs.take(NODE, bytes.fromhex("80 06 10 00 00 00 02 06"))
    assert jobs.failed == {(NODE, WRITE): 0x06020000}
    assert [data[0] for _, data in jobs.next_requests(1)] == [0x40]


@pytest.mark.parametrize(
    "answer",
    [
        "60 06 10 01 00 00 00 00",  # another sub-index
        "60 07 10 00 00 00 00 00",  # another object
        "4b 06 10 00 00 00 00 00",  # an upload's answer to a download
        "60 06 10 00",  # too short
        "",
    ],
)
def test_an_answer_to_another_question_counts_for_nothing(answer: str) -> None:
    jobs = SdoJobs({NODE: (WRITE,)}, NEVER)
    jobs.next_requests(1)
    jobs.take(NODE, bytes.fromhex(answer))
    assert jobs.is_asking
    assert jobs.failed == {}
    assert jobs.values == {}


@given(st.binary(max_size=8), st.integers(0, 127))
def test_whatever_comes_nothing_breaks_and_nothing_is_taken_that_was_not_asked(
    data: bytes, node: int
) -> None:
    jobs = SdoJobs({NODE: (READ,)}, NEVER)
    jobs.take(node, data)
    assert jobs.unfinished() == {NODE}
    jobs.next_requests(1)
    jobs.take(node, data)
    if jobs.unfinished() == set():
        assert node == NODE
        assert data[1:4] == b"\x41\x60\x00"


def test_a_request_without_an_answer_is_sent_again_and_only_then() -> None:
    jobs = SdoJobs({NODE: (READ,), 6: (READ,)}, 3)
    asked = [[can_id - 0x600 for can_id, _ in jobs.next_requests(9)] for _ in range(2)]
    jobs.take(6, bytes.fromhex("4b 41 60 00 37 02 00 00"))
    asked += [[can_id - 0x600 for can_id, _ in jobs.next_requests(9)] for _ in range(5)]
    assert asked == [[5, 6], [], [], [5], [], [], [5]]


def mode(value: int) -> bytes:
    return bytes((0x4F, 0x61, 0x60, 0, value, 0, 0, 0))


def test_enabled_drives_are_asked_until_all_show_the_mode() -> None:
    check = ModeCheck((1, 2), 20, NEVER)
    assert [can_id for can_id, _ in check.next_requests(9)] == [0x601, 0x602]
    check.take(1, mode(8))
    check.take(2, mode(0))
    assert check.wrong() == {2: 0}
    assert [can_id for can_id, _ in check.next_requests(9)] == [0x602]
    check.take(2, mode(8))
    assert check.wrong() == {}
    assert not check.is_overdue


def test_a_drive_that_never_says_its_mode_is_named_when_time_is_over() -> None:
    check = ModeCheck((1, 2), 3, NEVER)
    for _ in range(3):
        assert not check.is_overdue
        check.next_requests(1)
        check.take(1, mode(8))
    assert check.is_overdue
    assert check.wrong() == {2: None}


def test_status_words_are_read_in_turn_for_as_long_as_drives_answer() -> None:
    """A silent drive does not keep the others from being read; first answers are not judged."""
    poll = StatePoll((1, 2, 3), 5)
    asked = []
    for _ in range(12):
        for can_id, data in poll.next_requests(1):
            asked.append(can_id - 0x600)
            assert data == bytes.fromhex("40 41 60 00 00 00 00 00")
            if asked[-1] != 2:
                poll.take(asked[-1], bytes.fromhex("4b 41 60 00 17 02 00 00"))
        assert set(poll.new_words().values()) <= {0x217}
    assert asked[:5] == [1, 2, 3, 1, 3]
    assert (asked.count(1), asked.count(3)) == (5, 4)
    assert asked.count(2) == 3, "the first request, and its repetitions"


def test_a_first_answer_may_be_from_before_and_the_next_one_counts() -> None:
    poll = StatePoll((1,), NEVER)
    for words in ({}, {1: 0x217}, {1: 0x217}):
        poll.next_requests(1)
        poll.take(1, bytes.fromhex("4b 41 60 00 17 02 00 00"))
        assert poll.new_words() == words
        assert poll.new_words() == {}
