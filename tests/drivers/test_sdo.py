"""SDO answers that are late, doubled, foreign or aborts: none counts for another request."""

from __future__ import annotations

import logging
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.cia402.sdo import CONTACT_REPEAT, SetupNetwork
from model.errors import HardwareMissing, Refused
from tests.drivers.sdo_server import STANDARD, ScriptedBus, ScriptedDrive, Times, at_once

NODE = 3
PATIENCE = 2.0


def network_of(times: Times = at_once, *nodes: int) -> tuple[SetupNetwork, ScriptedBus]:
    drives = [ScriptedDrive(node, STANDARD) for node in nodes or (NODE,)]
    bus = ScriptedBus(drives, times)
    all_nodes = [drive.node for drive in drives]
    return SetupNetwork(bus, None, all_nodes, timeout=PATIENCE, clock=bus.clock), bus


def reads(network: SetupNetwork, index: int, sub: int = 0) -> int:
    return int.from_bytes(network.client(NODE).read(index, sub, "object"), "little")


OBJECTS = [(0x1000, 0), (0x1016, 0), (0x1400, 1), (0x6502, 0), (0x6065, 0), (0x607D, 2)]


@given(
    asked=st.lists(st.sampled_from(OBJECTS), min_size=1, max_size=8),
    delays=st.lists(
        st.lists(st.floats(0.001, 5.0), min_size=1, max_size=3), min_size=8, max_size=24
    ),
)
def test_a_value_is_always_the_asked_objects(
    asked: list[tuple[int, int]], delays: list[list[float]]
) -> None:
    """However late and often the drive answers: the right value, or no answer at all."""
    script = iter(delays)
    network, bus = network_of(lambda _node, _key: next(script, [0.001]))
    drive = bus.drives[NODE]
    for index, sub in asked:
        try:
            found = network.client(NODE).read(index, sub, "object")
        except HardwareMissing:
            continue
        assert found == struct.pack(drive.form((index, sub)), drive.values[index, sub])


@given(frame=st.binary(min_size=0, max_size=8))
def test_a_foreign_frame_is_no_answer(frame: bytes) -> None:
    network, bus = network_of()
    command, index = (*frame[:1], 0)[0], int.from_bytes(frame[1:3], "little")
    if index == 0x6502 and (command in range(0x40, 0x60) or command == 0x80):
        return  # it is one
    bus.later(0.0, NODE, frame)
    assert reads(network, 0x6502) == 0x80


def test_an_abort_that_comes_late_is_not_blamed_on_the_next_object() -> None:
    """1400h:01 is asked after 1400h:05, which the drive refuses three seconds later."""
    slow = {(0x1400, 5): (6.0,)}
    network, bus = network_of(lambda _node, key: slow.get(key, (2.0 - 1e-3,)))
    bus.drives[NODE].aborts[0x1400, 5] = 0x06090011
    with pytest.raises(HardwareMissing):
        network.client(NODE).read_if_there(0x1400, 5, "RPDO1 deadline")
    assert reads(network, 0x1400, 1) == 0x200 + NODE


def test_answers_that_arrived_while_the_program_was_held_up_count() -> None:
    """It goes on ten seconds after it asked: the drives answered in time, it reads that late."""

    def held_up(_node: int, _key: tuple[int, int]) -> tuple[float]:
        bus.now += 10.0
        return (-9.9,)

    network, bus = network_of(held_up, 3, 5)
    assert network.silent_nodes([3, 5]) == []
    assert reads(network, 0x6502) == 0x80
    assert len(bus.sent) == 3  # and are asked once


def test_no_answer_never_means_that_an_object_is_absent() -> None:
    network, _ = network_of(lambda _node, _key: ())
    with pytest.raises(HardwareMissing, match="drive 3 does not answer"):
        network.client(NODE).read_if_there(0x1401, 1, "PDO identifier")


@given(code=st.integers(0, 0xFFFFFFFF))
def test_every_abort_code_is_reported_with_its_object(code: int) -> None:
    network, bus = network_of()
    bus.drives[NODE].aborts[0x6072, 0] = code or 1
    with pytest.raises(Refused) as caught:
        network.client(NODE).write(0x6072, 0, b"\x10\x00", "max torque")
    assert caught.value.values["abort_code"] == (code or 1)
    assert "drive 3, object 6072h:00 max torque" in caught.value.where


def test_a_lost_request_is_sent_again() -> None:
    first = iter([()])
    network, bus = network_of(lambda _node, _key: next(first, (0.001,)))
    assert reads(network, 0x6502) == 0x80
    assert len(bus.sent) == 2


def test_an_answer_in_segments_is_read() -> None:
    network, bus = network_of(lambda _node, _key: ())
    bus.later(0.001, NODE, struct.pack("<BHBI", 0x41, 0x6502, 0, 4))
    bus.later(0.002, NODE, b"\x07" + b"\x80\x00\x00\x00" + bytes(3))
    assert network.client(NODE).read(0x6502, 0, "modes") == b"\x80\x00\x00\x00"


def test_all_silent_drives_together_cost_one_time_out() -> None:
    network, bus = network_of(
        lambda node, _key: () if node in (2, 5, 7) else (0.001,), *range(1, 9)
    )
    assert network.silent_nodes(range(1, 9)) == [2, 5, 7]
    assert bus.now == pytest.approx(PATIENCE)


def test_a_drive_that_answers_late_is_not_silent() -> None:
    network, _ = network_of(lambda _node, _key: (PATIENCE - 0.01,))
    assert network.silent_nodes([NODE]) == []
    network, _ = network_of(lambda _node, _key: (PATIENCE - CONTACT_REPEAT + 0.4,))
    assert network.silent_nodes([NODE]) == []


@pytest.mark.parametrize("booted", [0.01, 0.6, 1.2, 1.49])
def test_a_drive_that_boots_while_it_is_waited_for_is_not_silent(booted: float) -> None:
    """What is asked before its boot-up message is lost."""
    network, bus = network_of(lambda _node, _key: (0.001,) if bus.now > booted else ())
    assert network.silent_nodes([NODE]) == []
    assert bus.now < booted + CONTACT_REPEAT + 0.01
    assert network.nodes_answering_twice() == []


def test_a_first_request_that_is_lost_is_sent_again_to_drives_of_this_process_too() -> None:
    lost = {1, 2}
    network, bus = network_of(
        lambda node, _key: lost.remove(node) or () if node in lost else (0.0,),
        1,
        2,  # type: ignore[func-returns-value]
    )
    network._pump = lambda: None
    assert network.silent_nodes([1, 2]) == []
    assert len(bus.sent) == 4


def test_two_devices_with_one_node_id_are_noticed() -> None:
    network, _ = network_of(lambda _node, _key: (0.001, 0.002))
    assert network.silent_nodes([NODE]) == []
    assert network.nodes_answering_twice() == [NODE]


def test_what_canopen_says_does_not_reach_the_terminal() -> None:
    """Without a handler of its own Python prints a library's warnings to standard error."""
    handlers = logging.getLogger("canopen").handlers
    assert any(isinstance(each, logging.NullHandler) for each in handlers)
