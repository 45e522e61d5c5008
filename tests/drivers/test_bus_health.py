"""Problems of the bus or its frames end in a fault with a code."""

from __future__ import annotations

import errno
import os
import pickle
import socket
from collections.abc import Callable

import can
import pytest
from can.interfaces.pcan import PcanBus
from can.interfaces.socketcan import SocketcanBus
from can.interfaces.udp_multicast import UdpMulticastBus
from can.interfaces.virtual import VirtualBus
from hypothesis import given
from hypothesis import strategies as st

from drivers.can_bus import BusSettings, SentFrame, lost_frames, open_bus
from drivers.can_errors import (
    ERROR_CYCLES,
    WITH_CLASSES,
    BusDown,
    BusErrors,
    BusFault,
    BusGone,
    BusOff,
    BusPassive,
    EchoFilter,
    ErrorFrames,
    ForeignMaster,
    ReceiveOverflow,
    TransmitQueueFull,
    before_motion,
    bus_fault,
    error_frame_fault,
)
from drivers.cia402.pdo import commanding_ids, foreign_master_message, is_command
from drivers.cia402.state_machine import DriveState
from drivers.cyclic_group import CyclicBus
from drivers.drive_group import WHOLE_BUS, GroupCommand, GroupState
from drivers.factory import make_drive_group
from drivers.plausibility import ReplyCheck
from model.errors import Fault, HardwareMissing, Refused
from tests.drivers.drive_bench import Bench, free_udp_channel

HOLDING = DriveState.QUICK_STOP_ACTIVE
NODES = tuple(range(1, 9))


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (can.CanOperationError("Failed to transmit: down", errno.ENETDOWN), BusDown),
        (can.CanOperationError("Failed to receive: gone", errno.ENODEV), BusGone),
        (can.CanOperationError("Failed to transmit: full", errno.ENOBUFS), TransmitQueueFull),
        (can.CanOperationError("Transmit buffer full"), TransmitQueueFull),
        (can.CanOperationError("something of the maker's"), BusFault),
        (RuntimeError("a defect of the back end"), BusFault),
    ],
)
def test_what_a_back_end_raises_gets_a_name(error: Exception, kind: type[BusFault]) -> None:
    fault = bus_fault("the bus cannot be read", "bus can0", error)
    assert type(fault) is kind
    assert str(error) in fault.what
    assert "stop on their own" in fault.next_step


def test_an_error_number_may_be_in_the_cause() -> None:
    """The UDP back end gives it only there."""
    error = can.CanOperationError("failed to send via socket")
    error.__cause__ = OSError(errno.ENETDOWN, "Network is down")
    assert type(bus_fault("sending", "bus", error)) is BusDown


def test_every_bus_fault_has_a_code_of_its_own() -> None:
    kinds = [BusFault, *BusFault.__subclasses__()]
    assert len({kind.code for kind in kinds}) == len(kinds)
    assert Fault.code not in {kind.code for kind in kinds}


@pytest.mark.parametrize(
    ("identifier", "data", "kind"),
    [
        (0x040, bytes(8), BusOff),
        (0x004, b"\0\x01" + bytes(6), ReceiveOverflow),
        (0x004, b"\0\x10" + bytes(6), BusPassive),
        (0x004, b"\0\x20" + bytes(6), BusPassive),
        (0x004, b"\0\x08" + bytes(6), None),  # warning level
        (0x004, b"", None),
        (0x008, bytes(8), None),  # a protocol error: the frame is sent again
        (0x020, bytes(8), None),  # not acknowledged: as above, until error-passive
        (0x100, bytes(8), None),  # restarted
    ],
)
def test_which_error_frames_end_a_run(
    identifier: int, data: bytes, kind: type[BusFault] | None
) -> None:
    with open_bus(BusSettings("virtual", "classes")) as bus:
        fault = error_frame_fault(bus, error_frame(identifier, data))
    assert (type(fault) if fault else None) is kind


@pytest.mark.parametrize("kind", [SocketcanBus, VirtualBus, UdpMulticastBus])
def test_linux_classes_are_those_of_these_buses(kind: type[can.BusABC]) -> None:
    assert issubclass(kind, WITH_CLASSES)
    assert not issubclass(PcanBus, WITH_CLASSES)


def error_frame(identifier: int, data: bytes) -> can.Message:
    return can.Message(
        arbitration_id=identifier, data=data, is_extended_id=False, is_error_frame=True
    )


class Adapter(can.BusABC):
    """A back end of a maker, whose error frames have the maker's codes."""

    channel_info = "adapter"

    def __init__(self, bus: can.BusABC) -> None:
        self._inner = bus
        self.errors: list[can.Message] = []

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self._inner.send(msg, timeout)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        return self.errors.pop() if self.errors else self._inner.recv(timeout)

    def shutdown(self) -> None:
        """The wrapped bus stays open."""


#: ID 4 is a stuff error; DATA[1] the code of the segment. Source: PCAN-Basic, Error Frames.
STUFF_ERROR = error_frame(0x004, b"\0\x0a\0\0")


def test_error_frames_of_other_back_ends_are_only_counted(bench: Bench) -> None:
    """A stuff error was taken for a receive overflow, which ended the run."""
    adapter = Adapter(bench.group._bus)
    bench.group = make_drive_group(bench.rig, adapter, bench.rehearsal.pump)
    adapter.errors.append(STUFF_ERROR)
    bench.enable()
    for count in range(1, ERROR_CYCLES):
        adapter.errors.append(STUFF_ERROR)
        assert bench.cycle().error_frames == count
    assert bench.group.state is GroupState.ENABLED
    adapter.errors.append(STUFF_ERROR)
    with pytest.raises(BusErrors):
        bench.cycle()


def test_errors_that_do_not_cease_end_a_run_too() -> None:
    with open_bus(BusSettings("virtual", "errors")) as bus:
        errors, frame = ErrorFrames(bus), error_frame(0x008, bytes(8))
    for _ in range(ERROR_CYCLES - 1):
        assert errors.take(frame) is None
        assert errors.end_cycle() is None
    assert errors.end_cycle() is None  # a good cycle: counted from the beginning
    for _ in range(ERROR_CYCLES - 1):
        errors.take(frame)
        assert errors.end_cycle() is None
    errors.take(frame)
    fault = errors.end_cycle()
    assert isinstance(fault, BusErrors)
    assert errors.total == fault.values["error_frames"] == 2 * ERROR_CYCLES - 1


def test_lost_arbitration_is_no_error() -> None:
    """Drivers such as sja1000 report each; the frame is sent after the one that won."""
    with open_bus(BusSettings("virtual", "arbitration")) as bus:
        errors = ErrorFrames(bus)
        adapter = ErrorFrames(Adapter(bus))
    for _ in range(3 * ERROR_CYCLES):
        assert errors.take(error_frame(0x002, bytes(8))) is None
        assert errors.end_cycle() is None
    assert errors.total == 0
    errors.take(error_frame(0x00A, bytes(8)))  # with a protocol error
    adapter.take(error_frame(0x002, bytes(8)))  # a code of the maker
    assert errors.total == adapter.total == 1


def test_a_frame_that_the_kernel_threw_away_is_counted() -> None:
    with open_bus(BusSettings("udp_multicast", free_udp_channel())) as bus:
        with socket.socket(fileno=socket.dup(bus.fileno())) as its_socket:
            its_socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)
        assert lost_frames(bus) == 0
        for _ in range(50):
            bus.send(can.Message(arbitration_id=0x123, data=bytes(8), is_extended_id=False))
        taken = 0
        while bus.recv(0) is not None:
            taken += 1
        assert taken + lost_frames(bus) == 50
        assert lost_frames(bus) > 0


def test_a_bus_without_a_socket_loses_nothing_that_could_be_counted() -> None:
    with open_bus(BusSettings("virtual", "no-socket")) as bus:
        assert lost_frames(bus) == 0


@pytest.mark.parametrize("kind", [BusFault, *BusFault.__subclasses__()])
def test_a_fault_of_the_bus_before_a_motion_is_no_fault_of_the_motion(kind: type[BusFault]) -> None:
    """Also in the process of the command line, which gets it from the real-time process."""
    with pytest.raises(kind) as caught, before_motion():
        raise kind("it fails", "bus can0")
    received = pickle.loads(pickle.dumps(caught.value))
    code = Refused.exit_code if kind is ForeignMaster else HardwareMissing.exit_code
    assert (received.exit_code, received.as_dict()["exit_code"]) == (code, code)
    assert received.code == kind.code
    assert "no drive was enabled" in received.next_step
    assert kind("it fails", "bus can0").exit_code == Fault.exit_code


def say(bench: Bench, can_id: int, data: bytes = b"", *, error: bool = False) -> None:
    """Another device on the bus sends a frame."""
    bench._ear.send(
        can.Message(arbitration_id=can_id, data=data, is_extended_id=False, is_error_frame=error)
    )


@pytest.mark.parametrize(
    ("happens", "kind"),
    [
        (lambda b: say(b, 0x040, bytes(8), error=True), BusOff),
        (lambda b: say(b, 0x004, b"\0\x30" + bytes(6), error=True), BusPassive),
        (lambda b: say(b, 0x004, b"\0\x01" + bytes(6), error=True), ReceiveOverflow),
        (lambda b: say(b, 0x080), ForeignMaster),
        (lambda b: say(b, 0x000, b"\x02\x00"), ForeignMaster),
        (lambda b: say(b, 0x77F, b"\x05"), ForeignMaster),
        (lambda b: say(b, 0x203, bytes(8)), ForeignMaster),
        # 1006h = 0, so that a lost SYNC would not stop the drive; the same in segments.
        (lambda b: say(b, 0x603, bytes.fromhex("2306100000000000")), ForeignMaster),
        (lambda b: say(b, 0x603, bytes.fromhex("2106100004000000")), ForeignMaster),
    ],
)
def test_it_stops_the_drives_and_is_latched(
    bench: Bench, happens: Callable[[Bench], None], kind: type[BusFault]
) -> None:
    bench.enable()
    happens(bench)
    with pytest.raises(kind) as caught:
        bench.cycle()
    assert bench.group.state is GroupState.FAULT
    status = bench.cycle()  # raised once; replies of the drives are still processed
    assert (WHOLE_BUS, caught.value.what) in status.faults
    bench.cycle()
    assert [d.state for d in bench.drives] == [HOLDING] * 8
    with pytest.raises(Refused, match="latched"):
        bench.group.command(GroupCommand.ENABLE)
    bench.group.command(GroupCommand.RESET_FAULT)
    happens(bench)
    with pytest.raises(kind):  # a persisting fault is raised again
        bench.cycle()


def test_frames_of_others_that_command_nothing_are_let_be(bench: Bench) -> None:
    """Another device's data, a tool that reads an object, an extended and a remote frame."""
    bench.enable()
    say(bench, 0x1B0, bytes(8))
    for first in (0x40, 0x60, 0x70, 0x80, 0xA0):
        say(bench, 0x603, bytes((first, 0x41, 0x60, 0, 0, 0, 0, 0)))
    bench._ear.send(can.Message(arbitration_id=0x080, is_extended_id=True))
    bench._ear.send(can.Message(arbitration_id=0x080, is_extended_id=False, is_remote_frame=True))
    status = bench.cycle()
    assert not status.faults
    assert not status.missing.any()


def test_single_error_frames_are_counted_and_do_not_stop(bench: Bench) -> None:
    bench.enable()
    say(bench, 0x008, bytes(8), error=True)
    status = bench.cycle()
    assert status.error_frames == 1
    assert bench.group.state is GroupState.ENABLED


def test_a_flood_of_frames_does_not_hold_the_stop_up(bench: Bench) -> None:
    bench.enable()
    bench.drives[2].silent = True  # a whole cycle never comes
    for _ in range(5000):
        say(bench, 0x123)
    with pytest.raises(ReceiveOverflow):
        bench.cycle()
    bench.group.quick_stop_now()
    bench.rehearsal.pump()
    assert [d.state for d in bench.drives if d.node != 3] == [HOLDING] * 7


class TestAnotherProgramWhileDrivesAreSetUp:
    """Nothing is enabled, and the drives of the other program are left alone."""

    @pytest.mark.parametrize(
        ("can_id", "words"),
        [
            (0x080, "SYNC"),
            (0x000, "NMT"),
            (0x77F, "heartbeat"),
            (0x205, "set-points to drive 5"),
            (0x605, "objects of drive 5"),
        ],
    )
    def test_is_reported(self, bench: Bench, can_id: int, words: str) -> None:
        reply = bench.drives[0]._bus_send
        read = bytes((0x40, 0x41, 0x60, 0, 0, 0, 0, 0))
        bench.drives[0]._bus_send = lambda i, d: (say(bench, can_id, read), reply(i, d))
        with pytest.raises(Refused, match=words) as caught:
            bench.group.configure()
        assert "end the other program" in caught.value.next_step
        assert bench.group.state is GroupState.OFFLINE


def test_two_devices_with_one_node_id_are_reported_before_anything_is_written(bench: Bench) -> None:
    send = bench.drives[4]._bus_send
    bench.drives[4]._bus_send = lambda i, d: (send(i, d), send(i, d))
    with pytest.raises(Refused, match="drive 5 answered twice"):
        bench.group.configure()
    assert bench.drives[4].objects[0x6007, 0] == 1


def test_a_second_device_that_comes_later_is_a_fault(bench: Bench) -> None:
    bench.enable()
    send = bench.drives[4]._bus_send
    bench.drives[4]._bus_send = lambda i, d: (send(i, d), send(i, d))
    for _ in range(4):
        bench.cycle()
    assert bench.group.state is GroupState.FAULT
    assert any(node == 5 and "answered twice" in text for node, text in bench.status.faults)


def test_an_answer_to_another_question_is_no_silence(bench: Bench) -> None:
    send = bench.drives[1]._bus_send

    def another(can_id: int, data: bytes) -> None:
        wrong = bytes((data[0], data[1] ^ 1, *data[2:])) if can_id == 0x582 else data
        send(can_id, wrong)

    bench.drives[1]._bus_send = another
    with pytest.raises(Refused, match="drive 2 answered a different request"):
        bench.group.configure()


def spoil(bench: Bench, drive: int, times: int, change: Callable[[bytes], bytes]) -> None:
    """Changes the next replies of a drive in transit."""
    send, left = bench.drives[drive]._bus_send, [times]

    def on_its_way(can_id: int, data: bytes) -> None:
        if can_id == 0x181 + drive and left[0]:
            left[0] -= 1
            data = change(bytes(data))
        send(can_id, data)

    bench.drives[drive]._bus_send = on_its_way


def spiked(data: bytes) -> bytes:
    """A high bit of the position flipped."""
    return data[:4] + bytes((data[4] ^ 0x40,)) + data[5:]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda data: data[:2], "2 bytes instead of 8"),
        (spiked, "position jumped"),
    ],
)
def test_one_reply_that_cannot_be_true_is_not_used_and_two_in_a_row_are_a_fault(
    bench: Bench, change: Callable[[bytes], bytes], words: str
) -> None:
    bench.enable()
    before = bench.status
    spoil(bench, 5, 1, change)
    status = bench.cycle()
    assert status.missing.tolist() == [False] * 5 + [True] + [False] * 2
    assert status.positions.tolist() == before.positions.tolist()
    assert status.rejected == before.rejected + 1
    assert not bench.cycle().missing.any()
    assert bench.group.state is GroupState.ENABLED
    spoil(bench, 5, 2, change)
    bench.cycle()
    status = bench.cycle()
    assert bench.group.state is GroupState.FAULT
    assert any(node == 6 and words in text for node, text in status.faults)
    bench.cycle()
    bench.cycle()
    assert [d.state for d in bench.drives] == [HOLDING] * 8


def test_a_first_position_that_is_wrong_becomes_no_target(bench: Bench) -> None:
    """With drives that hold already, the next cycle could enable them."""
    bench.group.configure()
    true = [round(d.motor.position) for d in bench.drives]
    spoil(bench, 3, 1, spiked)
    assert bench.group.read_positions().positions.tolist() == true


def test_drives_rotated_by_hand_between_two_readings_are_accepted(bench: Bench) -> None:
    bench.group.configure()
    bench.group.read_positions()
    for drive, position in zip(bench.drives, bench.lifted(0.05), strict=True):
        drive.motor.position = position
    true = [round(d.motor.position) for d in bench.drives]
    assert bench.group.read_positions().positions.tolist() == true


def test_a_position_with_its_sign_flipped_is_not_accepted() -> None:
    check = ReplyCheck({1: "drive 1"}, (500.0,))
    check.begin_cycle()
    assert check.accept(0, 40_000)
    assert not check.accept(0, -40_000)
    assert check.rejected == 1


@given(
    step=st.integers(-3000, 3000),
    gap=st.integers(0, 5),
    start=st.integers(-(2**30), 2**30),
)
def test_a_position_is_accepted_exactly_when_the_drum_can_have_rotated_that_far(
    step: int, gap: int, start: int
) -> None:
    check = ReplyCheck({1: "drive 1"}, (500.0,))
    check.begin_cycle()
    assert check.accept(0, start)
    check.end_cycle()
    for _ in range(gap):
        check.begin_cycle()
        check.end_cycle()
    check.begin_cycle()
    believed = check.accept(0, start + step)
    assert believed == (abs(step) <= 500 * (gap + 1))


@given(
    cycles=st.lists(
        st.tuples(st.integers(-250, 250), st.lists(st.floats(0.0, 1.0), max_size=4)), max_size=20
    ),
    start=st.integers(-(2**30), 2**30),
)
def test_drives_may_report_at_any_times_of_a_cycle(
    cycles: list[tuple[int, list[float]]], start: int
) -> None:
    """ODrives report on their own clocks; between two cycles that is up to two cycles' motion."""
    check, position = ReplyCheck({1: "drive 1"}, (500.0,)), start
    for step, times in cycles:
        check.begin_cycle()
        for time in sorted(times):
            assert check.accept(0, position + round(time * step))
        check.end_cycle()
        position += step
    assert check.faults() == []


@given(st.lists(st.lists(st.integers(-600, 600), max_size=6), max_size=10))
def test_replies_of_one_cycle_do_not_add_up_to_a_jump(cycles: list[list[int]]) -> None:
    """A drive that runs away in steps each of which is plausible."""
    check = ReplyCheck({1: "drive 1"}, (500.0,))
    check.begin_cycle()
    believed = before = 0
    assert check.accept(0, believed)
    age = 1
    check.end_cycle()
    for steps in cycles:
        check.begin_cycle()
        position, heard = believed, False
        for step in steps:
            position += step
            if check.accept(0, position):
                believed, heard = position, True
        check.end_cycle()
        assert abs(believed - before) <= 500 * age
        before, age = (believed, 1) if heard else (before, age + 1)


def test_the_first_position_is_one_alone() -> None:
    check = ReplyCheck({1: "drive 1"}, (500.0,))
    for _ in range(2):
        check.begin_cycle()
        assert check.accept(0, 7000)
        assert not check.accept(0, 7501)
        check.forget_positions()


@given(st.lists(st.sampled_from(["send", "own", "foreign"]), max_size=30))
def test_where_a_sender_hears_itself_only_what_was_not_sent_is_foreign(script: list[str]) -> None:
    own = EchoFilter(commanding_ids(NODES), echoes_own_frames=True)
    waiting = 0
    for what in script:
        if what == "send" and waiting < EchoFilter.MOST_CREDIT:
            own.sent(0x080)
            waiting += 1
        elif what == "own" and waiting:
            waiting -= 1
            assert not own.is_foreign(0x080)
        elif what == "foreign" and not waiting:
            assert own.is_foreign(0x080)


class Nobody:
    """Listens to frames until the time is over."""

    complete = False

    def take(self, can_id: int, data: bytes, *, stale: bool = False) -> None:
        """Nothing is of interest."""


@pytest.mark.parametrize("kind", ["virtual", "udp_multicast"])
def test_only_another_programs_write_is_foreign_where_echoes_return(kind: str) -> None:
    """Own reads and writes come back over multicast; own reads excuse no write of another."""
    read, write = bytes.fromhex("4061600000000000"), bytes.fromhex("2306100000000000")
    channel = free_udp_channel() if kind == "udp_multicast" else "echoes"
    own, other = (open_bus(BusSettings(kind, channel)) for _ in range(2))
    cyclic = CyclicBus(own, commanding_ids(NODES), foreign_master_message, is_command)
    try:
        cyclic.send(SentFrame(0x600 + node, data) for node in NODES for data in (read, write))
        cyclic.take_replies(Nobody(), 0.0)
        cyclic.end_cycle()
        other.send(SentFrame(0x603, read))
        cyclic.take_replies(Nobody(), 0.0)
        cyclic.end_cycle()
        other.send(SentFrame(0x603, write))
        cyclic.take_replies(Nobody(), 0.0)
        with pytest.raises(ForeignMaster, match="another program writes objects of drive 3"):
            cyclic.end_cycle()
    finally:
        own.shutdown()
        other.shutdown()


@pytest.mark.parametrize("count", [4, 12, 40])
def test_a_batch_to_many_drives_may_be_sent_before_its_echoes_are_read(count: int) -> None:
    own = EchoFilter(frozenset({0}), echoes_own_frames=True, batch=count)
    for _ in range(count):
        own.sent(0)
    assert not any(own.is_foreign(0) for _ in range(count))
    assert own.is_foreign(0)


class Serial(can.BusABC):
    """A serial adapter: its descriptor is no socket."""

    channel_info = "serial"

    def __init__(self, **_options: object) -> None:
        self._inner, self.outer = os.openpty()

    def fileno(self) -> int:
        return self.outer

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise NotImplementedError

    def shutdown(self) -> None:
        os.close(self._inner)
        os.close(self.outer)


def test_a_serial_adapter_is_opened_and_reports_no_loss(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(can, "Bus", Serial)
    bus = open_bus(BusSettings("slcan", "/dev/ttyACM0"))
    assert lost_frames(bus) == 0
    bus.shutdown()


def test_a_missing_package_of_an_adapter_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(**_options: object) -> None:
        raise can.CanInterfaceNotImplementedError("The serial module is not installed")

    monkeypatch.setattr(can, "Bus", missing)
    with pytest.raises(HardwareMissing) as caught:
        open_bus(BusSettings("slcan", "/dev/ttyACM0"))
    assert "pip install 'python-can[serial]'" in caught.value.next_step


def test_drives_with_few_heartbeat_entries_are_reported(bench: Bench) -> None:
    assert bench.group.configure() == ()
    bench.group.close()
    for drive in (2, 6):
        bench.drives[drive].power_on()
        bench.drives[drive].objects[0x1016, 0] = 2
    (remark,) = bench.group.configure()
    assert "drive 3, 7" in remark
    assert "1 of 7 other drives" in remark
    assert bench.drives[2].objects[0x1016, 2] == 1 << 16 | 100
    assert bench.drives[2].objects[0x1016, 3] == 0
