"""Opening a bus, and its load."""

from __future__ import annotations

import errno
import gc
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import can
import pytest
from can.interfaces.udp_multicast import bus as udp_bus

from drivers import can_bus, can_interfaces
from drivers.can_bus import BusSettings, InProcessBus, SentFrame, open_bus
from drivers.can_errors import bus_text
from drivers.can_interfaces import KernelInterface
from drivers.can_load import bus_load, check_bus_load, cycle_bits, heartbeat_cycles
from model.errors import BadInput, HardwareMissing, Refused
from model.files.rig_file import RigDocument
from model.rig import Rig, rig_from_document


def with_bus(rig: Rig, **changes: object) -> Rig:
    document = rig.document.model_dump()
    document["bus"].update(changes)
    return rig_from_document(RigDocument.model_validate(document))


@pytest.mark.parametrize(
    ("interface", "channel", "why", "instead"),
    [
        ("gs_usb", "0", "its own frames", "interface: socketcan, channel: can0"),
        ("cantact", "0", "its own frames", "interface: socketcan, channel: can0"),
        ("socketcand", "can0", "TCP", "interface: socketcan, channel: can0"),
        ("socketcand", "10.0.0.5:29536/can0", "TCP", "interface: socketcan, channel: can0"),
    ],
)
def test_an_interface_that_cannot_command_drives_is_refused_with_what_to_use(
    monkeypatch: pytest.MonkeyPatch, interface: str, channel: str, why: str, instead: str
) -> None:
    """Own frames pass for another master's; socketcand failed for want of a host and a port."""
    monkeypatch.setattr(can, "Bus", lambda **_options: pytest.fail("it was opened"))
    with pytest.raises(BadInput, match=f"'{interface}' cannot be used") as caught:
        open_bus(BusSettings(interface, channel))
    assert why in caught.value.why
    assert instead in caught.value.next_step
    with pytest.raises(BadInput) as caught:
        open_bus(BusSettings("gs-usb", channel))
    assert f" {interface}," not in caught.value.next_step


@pytest.mark.parametrize(
    ("interface", "own_frames"),
    [("neovi", {"receive_own_messages": False}), ("kvaser", {}), ("pcan", {})],
)
def test_a_back_end_that_returns_sent_frames_by_default_is_kept_from_it(
    monkeypatch: pytest.MonkeyPatch, interface: str, own_frames: dict[str, bool]
) -> None:
    """Every run was refused: another program commands drive 1."""
    asked: dict[str, object] = {}

    def opened(**options: object) -> can.BusABC:
        asked.update(options)
        return InProcessBus("own-frames")

    monkeypatch.setattr(can, "Bus", opened)
    open_bus(BusSettings(interface, "1", 500_000)).shutdown()
    expected = {"interface": interface, "ignore_config": True, "channel": "1", "bitrate": 500_000}
    assert asked == expected | own_frames


def test_an_unknown_interface_lists_those_there_are() -> None:
    with pytest.raises(BadInput) as caught:
        open_bus(BusSettings("sockectan", "can0"))
    assert "'sockectan'" in caught.value.what
    assert "socketcan" in caught.value.next_step
    assert "udp_multicast" in caught.value.next_step


def test_a_missing_kernel_interface_says_how_to_bring_it_up() -> None:
    with pytest.raises(HardwareMissing) as caught:
        open_bus(BusSettings("socketcan", "can77", 500_000))
    assert "can77" in caught.value.what
    assert "ip link set can77 up" in caught.value.next_step
    assert "bitrate 500000" in caught.value.next_step


def set_up_can0(
    root: Path, monkeypatch: pytest.MonkeyPatch, flags: str = "0x40081", queue: int = 128
) -> None:
    """The kernel's files of an interface that is up, unless stated otherwise."""
    folder = root / "can0"
    folder.mkdir()
    (folder / "flags").write_text(f"{flags}\n")
    (folder / "tx_queue_len").write_text(f"{queue}\n")
    monkeypatch.setattr(can_interfaces, "INTERFACES", root)


@pytest.mark.parametrize(
    ("flags", "queue", "what"),
    [("0x40080", 128, "down"), ("0x40081", 10, "transmit queue")],
)
def test_a_kernel_interface_that_is_down_or_short_of_queue_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flags: str, queue: int, what: str
) -> None:
    set_up_can0(tmp_path, monkeypatch, flags, queue)
    with pytest.raises(HardwareMissing) as caught:
        open_bus(BusSettings("socketcan", "can0"))
    assert what in caught.value.what
    assert "txqueuelen" in caught.value.next_step


@pytest.mark.parametrize(("rate", "refused"), [(500_000, True), (1_000_000, False), (None, False)])
def test_a_kernel_interface_at_another_bit_rate_is_not_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rate: int | None, refused: bool
) -> None:
    """The load of its bus would be twice the one that was checked; a serial adapter states none."""
    set_up_can0(tmp_path, monkeypatch)
    found = (
        KernelInterface("can1", "can", True, 128, 125_000, ""),
        KernelInterface("can0", "can", True, 128, rate, ""),
    )
    monkeypatch.setattr(can, "Bus", lambda **_options: InProcessBus("same-rate"))
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(can_interfaces, "SYSTEM_FOLDERS", ())
    open_bus(BusSettings("socketcan", "can0", 1_000_000)).shutdown()  # no `ip` shows the rate
    monkeypatch.setattr(can_interfaces, "can_interfaces", lambda: found)
    settings = BusSettings("socketcan", "can0", 1_000_000)
    if not refused:
        open_bus(settings).shutdown()
        return
    with pytest.raises(
        HardwareMissing, match="500000 bit/s; the rig file states 1000000"
    ) as caught:
        open_bus(settings)
    assert "bus.bitrate" in caught.value.next_step
    assert "ip link set can0 down" in caught.value.next_step


@pytest.mark.parametrize(
    ("state", "modes", "what"),
    [
        ("BUS-OFF", (), "state BUS-OFF"),
        ("STOPPED", (), "state STOPPED"),
        ("ERROR-ACTIVE", ("FD", "LISTEN-ONLY"), "mode LISTEN-ONLY"),
        ("ERROR-ACTIVE", ("ONE-SHOT",), "mode ONE-SHOT"),
        ("ERROR-ACTIVE", ("LOOPBACK",), "mode LOOPBACK"),
        ("ERROR-PASSIVE", ("BERR-REPORTING", "FD", "TRIPLE-SAMPLING"), ""),
        ("", (), ""),
    ],
)
def test_a_controller_that_cannot_command_drives_is_not_opened(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    state: str,
    modes: tuple[str, ...],
    what: str,
) -> None:
    """It is up, and every frame is lost: the drives were said to have no power."""
    set_up_can0(tmp_path, monkeypatch)
    monkeypatch.setattr(can, "Bus", lambda **_options: InProcessBus("ready"))
    found = KernelInterface("can0", "can", True, 128, 1_000_000, state, modes)
    monkeypatch.setattr(can_interfaces, "can_interfaces", lambda: (found,))
    if not what:
        open_bus(BusSettings("socketcan", "can0")).shutdown()
        return
    with pytest.raises(HardwareMissing, match=what) as caught:
        open_bus(BusSettings("socketcan", "can0"))
    assert "sudo ip link set can0 down && sudo ip link set can0 up" in caught.value.next_step
    for mode in modes:
        assert (f" {mode.lower()} off" in caught.value.next_step) == (mode in what)


def test_importing_the_bus_prints_nothing() -> None:
    """python-can warns where its module for adapters by PEAK is imported."""
    done = subprocess.run(
        [sys.executable, "-c", "import drivers.can_bus"], capture_output=True, text=True, check=True
    )
    assert done.stdout == done.stderr == ""


def test_a_bit_rate_that_an_adapter_by_peak_does_not_have_is_refused() -> None:
    """python-can opened it at 500 kbit/s without a word."""
    with pytest.raises(BadInput, match="no bit rate of 400000") as caught:
        open_bus(BusSettings("pcan", "PCAN_USBBUS1", 400_000))
    assert "500000, 800000, 1000000" in caught.value.next_step


def test_what_a_back_end_raises_becomes_hardware_missing() -> None:
    with pytest.raises(HardwareMissing) as caught:
        open_bus(BusSettings("slcan", "/nowhere/ttyACM7"))
    assert caught.value.why
    assert caught.value.next_step


@pytest.mark.parametrize("port", ["port", "0", "65536"])
def test_a_udp_port_that_is_none_is_refused(port: str) -> None:
    with pytest.raises(BadInput, match="port"):
        open_bus(BusSettings("udp_multicast", f"239.74.163.2:{port}"))


@pytest.mark.parametrize("channel", ["foo", "foo.bar:43113", "localhost", "10.0.0.1", "can0"])
def test_a_udp_channel_that_is_no_multicast_address_is_refused(channel: str) -> None:
    with pytest.raises(BadInput, match="is not a multicast address") as caught:
        open_bus(BusSettings("udp_multicast", channel))
    assert "239.74.163.77:43114" in caught.value.next_step


def test_a_udp_bus_may_have_an_ipv6_group() -> None:
    assert BusSettings("udp_multicast", "ff15::17").canonical == "udp_multicast ff15::17:43113"


def test_messages_name_a_udp_bus_as_the_rig_file_does(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(udp_bus, "GeneralPurposeUdpMulticastBus", Mock())
    monkeypatch.setattr(can_bus, "_prepare_socket", lambda _bus: None)
    with open_bus(BusSettings("udp_multicast", "239.74.163.11:43811")) as bus:
        assert bus_text(bus) == "bus udp_multicast 239.74.163.11:43811"


def test_a_bus_that_did_not_open_is_not_said_to_be_left_open(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def unreachable(*_arguments: object) -> None:
        raise OSError(errno.ENODEV, "No such device")

    monkeypatch.setattr(udp_bus, "GeneralPurposeUdpMulticastBus", unreachable)
    with pytest.raises(HardwareMissing, match="cannot be opened") as caught:
        open_bus(BusSettings("udp_multicast", "239.74.163.77"))
    assert "route multicast" in caught.value.next_step
    del caught
    gc.collect()
    assert caplog.messages == []


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (("udp_multicast", ""), ("udp_multicast", "239.74.163.2:43113")),
        (("udp_multicast", "239.74.163.2"), ("udp_multicast", "239.74.163.2:43113")),
        (("socketcan", "can0"), ("socketcan", " can0")),
    ],
)
def test_a_bus_is_known_however_its_name_is_spelled(
    one: tuple[str, str], other: tuple[str, str]
) -> None:
    assert BusSettings(*one).canonical == BusSettings(*other).canonical
    assert BusSettings(*one).canonical != BusSettings(one[0], "239.74.163.9:43113").canonical


def test_buses_of_one_virtual_channel_hear_each_other() -> None:
    settings = BusSettings("virtual", "hear-each-other")
    with open_bus(settings) as one, open_bus(settings) as other:
        one.send(can.Message(arbitration_id=0x123, data=b"ab", is_extended_id=False))
        heard = other.recv(0)
        assert heard is not None
        assert (heard.arbitration_id, bytes(heard.data)) == (0x123, b"ab")


def test_the_bus_in_one_process_behaves_as_that_of_python_can() -> None:
    """Order, every other end, no echo, waits, filters, a closed bus; for both kinds of frame."""
    settings = BusSettings("virtual", "as-python-can")
    frames = [SentFrame(0x181, b"a"), can.Message(arbitration_id=0x80), SentFrame(0x182, b"b")]
    with open_bus(settings) as bus, can.Bus("as-python-can", "virtual") as theirs:
        with open_bus(settings) as other:
            for frame in frames:
                bus.send(frame)
            for end in (theirs, other):
                came = [end.recv(0.0), end.recv(0.01), end.recv(0.0), end.recv(0.0)]
                received = [(m.arbitration_id, bytes(m.data), m.is_rx) for m in came if m]
                assert received == [(0x181, b"a", True), (0x80, b"", True), (0x182, b"b", True)]
                assert all(m.timestamp > 0.0 and m.channel == "as-python-can" for m in came if m)
            assert bus.recv(0.0) is None
            other.set_filters([{"can_id": 0x182, "can_mask": 0x7FF}])
            theirs.send(frames[0])
            theirs.send(frames[2])
            assert other.recv(0.0) is None
            kept = other.recv(0.0)
            assert kept is not None
            assert kept.arbitration_id == 0x182
        bus.send(frames[0])
    with pytest.raises(can.CanError):
        bus.send(frames[0])
    with pytest.raises(can.CanError):
        bus.recv(0.0)


def test_bits_of_a_cycle_at_worst_stuffing() -> None:
    """Eight set-points, eight replies, one SYNC: 2055 bits; 70 % at 341 Hz and 1 Mbit/s."""
    assert cycle_bits(8) == 2055
    assert cycle_bits(8) * 341 == pytest.approx(0.7e6, rel=2e-3)


@pytest.mark.parametrize(
    ("rate", "bitrate", "load"),
    [(100, 1_000_000, 0.23), (250, 1_000_000, 0.56), (500, 1_000_000, 1.04), (100, 500_000, 0.46)],
)
def test_the_load_is_that_of_the_cyclic_frames_and_some_heartbeats(
    rate: int, bitrate: int, load: float
) -> None:
    assert bus_load(8, 1.0 / rate, bitrate) == pytest.approx(load, abs=0.03)
    assert bus_load(8, 1.0 / rate, bitrate) > cycle_bits(8) * rate / bitrate


def test_a_bus_that_is_too_slow_is_refused_with_the_cycle_it_can_do(rig: Rig) -> None:
    assert check_bus_load(rig) < 0.25
    with pytest.raises(Refused) as caught:
        check_bus_load(with_bus(rig, cycle_ms=2.0))
    assert caught.value.values["load"] > 1.0
    enough = float(caught.value.next_step.split("bus.cycle_ms to ")[1].split()[0])
    assert check_bus_load(with_bus(rig, cycle_ms=enough)) <= 0.7


@pytest.mark.parametrize(("cycle_ms", "bitrate"), [(1, 1_000_000), (2, 1_000_000), (3, 500_000)])
def test_no_cycle_is_advised_that_arming_would_refuse(
    rig: Rig, cycle_ms: float, bitrate: int
) -> None:
    """250 Hz is the fastest that was tested, whatever the bus could carry."""
    with pytest.raises(Refused) as caught:
        check_bus_load(with_bus(rig, cycle_ms=cycle_ms, bitrate=bitrate))
    advised = float(caught.value.next_step.split("bus.cycle_ms to ")[1].split()[0])
    assert advised >= 4.0
    assert check_bus_load(with_bus(rig, cycle_ms=advised, bitrate=bitrate)) <= 0.7


def test_a_bus_that_no_cycle_helps_needs_more_bits(rig: Rig) -> None:
    with pytest.raises(Refused) as caught:
        check_bus_load(with_bus(rig, bitrate=20_000))
    assert caught.value.next_step.startswith("raise the bitrate")


@pytest.mark.parametrize("cycle_ms", [1, 3, 4, 10, 30, 100])
def test_heartbeats_come_several_times_within_their_time_out(cycle_ms: int) -> None:
    assert heartbeat_cycles(cycle_ms / 1000.0) * cycle_ms <= max(30, cycle_ms)


def test_a_sent_frame_arrives_whole_at_every_listener_and_stays_as_it_was() -> None:
    frame = SentFrame(0x201, bytes(range(8)))
    with (
        open_bus(BusSettings("virtual", "sent-frame")) as sender,
        open_bus(BusSettings("virtual", "sent-frame")) as one,
        open_bus(BusSettings("virtual", "sent-frame")) as other,
    ):
        sender.send(frame)
        heard = [bus.recv(1.0) for bus in (one, other)]
    for message in heard:
        assert message is not None
        assert (message.arbitration_id, bytes(message.data)) == (0x201, bytes(range(8)))
        assert (message.dlc, message.is_extended_id, message.is_rx) == (8, False, True)
        assert message is not frame
    assert (frame.timestamp, frame.channel) == (0.0, None)
