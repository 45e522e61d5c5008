"""Shared memory: rings that lose nothing silently, and requests that reach the loop."""

from __future__ import annotations

import math
import mmap
import os
import struct
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from executor.realtime import shared_memory as shared_board
from executor.realtime.shared_memory import (
    SILENCE,
    CycleRecordCodec,
    Ring,
    SharedMemory,
    SharedRequests,
    Supervised,
    pack_event,
    unpack_event,
)
from executor.state_machine import CycleRecord, LoopEvent, State
from executor.supervision import OperatorRequests, StopReason
from model.pose import Pose

SLOTS, CONTENT = 8, 40


@pytest.fixture
def memory() -> Iterator[SharedMemory]:
    made = SharedMemory.create(Ring.size(CONTENT, SLOTS))
    yield made
    made.close()


def test_sealed_memory_cannot_be_written_to_by_any_process():
    sealed = SharedMemory.sealed(b"proved" * 1000)
    try:
        assert sealed.view[:6] == b"proved"
        with pytest.raises(TypeError):
            sealed.view[0] = 1
        with pytest.raises(PermissionError):
            os.write(sealed.descriptor, b"x")
        with pytest.raises(PermissionError):
            mmap.mmap(sealed.descriptor, sealed.size)
        with pytest.raises(PermissionError):
            os.ftruncate(sealed.descriptor, 3)
    finally:
        sealed.close()


@given(batches=st.lists(st.lists(st.binary(max_size=CONTENT), max_size=SLOTS), max_size=20))
@settings(max_examples=60)
def test_what_is_read_in_time_comes_whole_and_in_order(batches):
    memory = SharedMemory.create(Ring.size(CONTENT, SLOTS))
    writer, reader = Ring(memory, SLOTS), Ring(memory, SLOTS)
    for batch in batches:
        for content in batch:
            writer.put(content)
        assert list(reader.take()) == batch
    assert reader.lost == 0
    memory.close()


@given(count=st.integers(0, 5 * SLOTS))
def test_what_was_written_over_is_counted(count):
    memory = SharedMemory.create(Ring.size(CONTENT, SLOTS))
    writer, reader = Ring(memory, SLOTS), Ring(memory, SLOTS)
    for number in range(count):
        writer.put(str(number).encode())
    got = [int(content) for content in reader.take()]
    assert got == sorted(got)
    assert reader.lost + len(got) == count
    assert (reader.lost == 0) == (count <= SLOTS)
    memory.close()


@given(spoilt=st.integers(0, 15 + CONTENT))
def test_half_a_slot_is_not_taken_for_a_whole_one(spoilt):
    """For any byte that is not yet written."""
    memory = SharedMemory.create(Ring.size(CONTENT, SLOTS))
    writer, reader = Ring(memory, SLOTS), Ring(memory, SLOTS)
    writer.put(b"first")
    assert list(reader.take()) == [b"first"]
    writer.put(bytes(range(1, CONTENT + 1)))
    at = memory.size // SLOTS + spoilt
    kept = memory.view[at]
    memory.view[at] = kept ^ 0x55
    assert list(reader.take()) == []
    memory.view[at] = kept
    assert list(reader.take()) == [bytes(range(1, CONTENT + 1))]
    assert reader.lost == 0
    memory.close()


def test_what_does_not_fit_is_refused(memory):
    with pytest.raises(ValueError, match="do not fit"):
        Ring(memory, SLOTS).put(b"x" * (CONTENT + 1))


@given(
    state=st.sampled_from(State),
    counts=st.lists(st.integers(-(2**31), 2**31 - 1), min_size=8, max_size=8),
    numbers=st.tuples(*[st.floats(allow_nan=False)] * 4),
    error=st.floats(),
    rotated=st.booleans(),
)
def test_a_record_comes_back_as_it_was(state, counts, numbers, error, rotated):
    pair = tuple(counts[:2])
    record = CycleRecord(
        cycle=2**40,
        at=numbers[0],
        state=state,
        index=numbers[1],
        rate=numbers[2],
        targets=pair,
        actual=tuple(counts[2:4]),
        torques=tuple(counts[4:6]),
        words=tuple(counts[6:]),
        missing=2,
        rejected=5,
        error_frames=7,
        following_error=error,
        lateness=numbers[3],
        tension_known=(rotated, True),
        press=2**50,
    )
    wire = CycleRecordCodec(2)
    pose = Pose(np.array([0.1, -0.2, 0.3]), np.diag([1.0, -1.0, -1.0])) if rotated else None
    content = wire.pack(record, pose)
    assert len(content) == wire.size
    back, pose_back = wire.unpack(content)
    if math.isnan(error):
        assert math.isnan(back.following_error)
    else:
        assert back == record
    assert (pose_back is None) is (pose is None)
    if pose is not None and pose_back is not None:
        assert pose_back.position == pytest.approx(pose.position)
        assert pose_back.rotation == pytest.approx(pose.rotation)


@given(text=st.text(max_size=3000), most=st.integers(300, 5000))
def test_an_event_fits_and_keeps_its_head_and_end(text, most):
    event = LoopEvent(7, 1.5, "broken", text)
    content = pack_event(event, most)
    assert len(content) <= most
    back = unpack_event(content)
    assert (back.cycle, back.at, back.code) == (7, 1.5, "broken")
    if back.text != text:
        assert " … " in back.text
        assert back.text[:10] == text[:10]


class _Clock:
    now = 100.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> _Clock:
    moved_by_hand = _Clock()
    monkeypatch.setattr(shared_board, "time", moved_by_hand)
    return moved_by_hand


@pytest.fixture
def board() -> Iterator[SharedRequests]:
    made = SharedRequests()
    yield made
    made.memory.close()


def test_requests_reach_the_other_side_and_stay(board, clock):
    other = Supervised(board.memory, os.getppid())
    assert other.read() == board.read() == OperatorRequests()
    board.ask_speed(30)
    board.ask_hold(True)
    assert other.read() == board.read() == OperatorRequests(hold=True, speed=0.3)
    board.ask_hold(False)
    board.ask_stop()
    assert other.read() == board.read() == OperatorRequests(stop=True, speed=0.3)


@pytest.mark.parametrize("text", ["platform to post: 6.0 ± 1.0 mm", "ü" * 1000])
def test_what_a_stop_is_for_reaches_the_other_side(board, clock, text):
    other = Supervised(board.memory, os.getppid())
    board.ask_stop(StopReason("clearance_low", text))
    board.ask_stop()
    reason = other.read().for_what
    assert reason == board.read().for_what
    assert reason is not None
    assert reason.code == "clearance_low"
    assert reason.text
    assert text.startswith(reason.text.rstrip("�"))


def test_a_stop_that_was_requested_before_was_for_nothing_else(board, clock):
    board.ask_stop()
    board.ask_stop(StopReason("camera", "all cameras failed"))
    assert board.read() == OperatorRequests(stop=True)


def test_a_process_that_is_requested_to_end_stops(board, clock):
    other = Supervised(board.memory, os.getppid())
    other.ask_stop()
    assert other.read().stop
    assert not board.read().stop


def test_a_supervisor_that_says_nothing_for_too_long_is_lost_until_it_is_alive_again(board, clock):
    other = Supervised(board.memory, os.getppid())
    for _ in range(5):
        clock.now += SILENCE
        board.beat()
        assert other.read().lost == ""
    clock.now += SILENCE
    assert other.read().lost == ""
    clock.now += 0.001
    assert "silent for 2 s" in other.read().lost
    board.beat()
    assert other.read().lost == ""


def test_a_supervisor_that_is_gone_is_noticed_at_once(board, clock):
    other = Supervised(board.memory, os.getpid())  # not this process's parent
    board.beat()
    assert "has ended" in other.read().lost


@pytest.mark.parametrize("text", ["the disk is full", "ü" * 1000])
def test_the_first_trouble_is_reported(board, clock, text):
    other = Supervised(board.memory, os.getppid())
    board.complain(text)
    board.complain("something else")
    lost = other.read().lost
    assert lost
    assert text.startswith(lost.rstrip("�"))


def test_the_layout_leaves_room_for_every_request(board):
    """Separate bytes: writing one request does not affect reading another."""
    before = bytes(board.memory.view)
    board.ask_stop()
    board.ask_hold(True)
    board.ask_speed(7)
    changed = [
        i for i, (a, b) in enumerate(zip(before, board.memory.view[:], strict=True)) if a != b
    ]
    assert len(changed) == 3
    board.beat()
    assert struct.unpack_from("<Q", board.memory.view, 8) == (1,)
