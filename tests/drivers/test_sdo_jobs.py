"""SDO requests during cyclic operation: golden bytes, one at a time, only matching answers."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.cia402.sdo_jobs import (
    REQUEST_PERIOD,
    ModeCheck,
    SdoJobs,
    SdoRequest,
    StatePoll,
    monitoring_off,
    requests_per_cycle,
    time_to_end,
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


@given(cycle_ms=st.integers(1, 250), drives=st.integers(1, 12), heartbeats=st.integers(1, 12))
def test_a_long_cycle_ends_the_monitoring_no_later_than_a_short_one(
    cycle_ms: int, drives: int, heartbeats: int
) -> None:
    """At 100 ms, one request a cycle took 7 s from the end of a motion to the prompt."""
    cycle = cycle_ms / 1000.0
    jobs = {node: monitoring_off(heartbeats) for node in range(1, drives + 1)}
    queue, turns = SdoJobs(jobs, NEVER), 0
    while queue.unfinished():
        requests = queue.next_requests(requests_per_cycle(cycle))
        assert requests, "drives answer within the cycle here"
        assert len(requests) == 1 or len(requests) * REQUEST_PERIOD <= cycle * (1.0 + 1e-9)
        for can_id, data in requests:
            queue.take(can_id - 0x600, bytes((0x60, *data[1:])))
        turns += 1
    of_each, of_all = len(jobs[1]), sum(map(len, jobs.values()))
    assert turns * cycle <= of_each * cycle + 2 * of_all * REQUEST_PERIOD
    assert turns * cycle <= time_to_end([heartbeats] * drives, cycle, answer=cycle) + 1e-9


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
