"""Files of a shared state folder: links are not followed, FIFOs and huge files do not block."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import shutil
import signal
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

import pytest

from drivers.can_bus import BusSettings
from executor.interlock import locks as state_folder
from executor.interlock.fault_latch import FaultLatch, LatchedFault
from executor.interlock.interlock import MotionInterlock
from executor.interlock.locks import (
    LARGEST_FILE,
    ControlLock,
    SetUpLock,
    read_state_file,
    state_file,
)
from executor.interlock.reference import ReferenceFile, as_in_the_file
from executor.state_machine import State
from model import jit as machine_code
from model.errors import HardwareMissing, Refused
from model.rig import load_rig
from tests.cli.plans import RIG
from tests.cli.program import call

CHANNEL = "239.74.163.61"
BUS = BusSettings("udp_multicast", CHANNEL)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(state_folder, "SHARED", tmp_path / "absent")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))  # the real-time process has it, too
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    made = tmp_path / "cdpr"
    made.mkdir()
    return made


@pytest.fixture(autouse=True)
def nothing_hangs() -> Iterator[None]:
    """A program that blocks on a FIFO fails its test."""

    def hung(_number: int, _frame: FrameType | None) -> None:
        pytest.fail("it waits for the file")

    before = signal.signal(signal.SIGALRM, hung)
    signal.alarm(30)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def link(path: Path) -> None:
    path.symlink_to(path.parent / "elsewhere")


def link_to_a_file(path: Path) -> None:
    (path.parent / "elsewhere").write_text("{}")
    link(path)


def bound(path: Path) -> None:
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(os.path.relpath(path))
    listener.close()


STRANGE: dict[str, Callable[[Path], object]] = {
    "a symbolic link": link,
    "a symbolic link,": link_to_a_file,
    "a FIFO": os.mkfifo,
    "a folder": Path.mkdir,
    "a socket": bound,
}


@pytest.fixture(params=STRANGE)
def strange(request: pytest.FixtureRequest, folder: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A kind of file that replaces every file of the bus."""
    monkeypatch.chdir(folder)
    for path in (_latched(), _latched().with_suffix(".lock"), _set_up(), _reference()):
        (path.parent / "elsewhere").unlink(missing_ok=True)
        STRANGE[request.param](path)
    return str(request.param).rstrip(",")


def _latched() -> Path:
    return state_file("latched", BUS)


def _set_up() -> Path:
    return state_file("set-up", BUS).with_suffix(".lock")


def _reference() -> Path:
    return state_file("reference", BUS)


def test_a_set_up_lock_of_another_kind_is_refused_by_name(strange: str) -> None:
    for use in (SetUpLock(BUS).held, SetUpLock(BUS).tried):
        with pytest.raises(Refused, match=strange) as caught, use():
            pytest.fail("it was locked")
        assert caught.value.where == str(_set_up())


def test_a_lock_of_the_latch_of_another_kind_is_refused_by_name(strange: str) -> None:
    _latched().rmdir() if strange == "a folder" else _latched().unlink()
    with pytest.raises(Refused, match=strange) as caught:
        FaultLatch(BUS).held_by_another()
    assert caught.value.where == str(_latched().with_suffix(".lock"))
    with pytest.raises(Refused, match=strange):
        FaultLatch(BUS).engage("rig", _latched().parent)
    assert not _latched().exists()


def test_a_latch_file_of_another_kind_counts_as_engaged(strange: str) -> None:
    latched = FaultLatch(BUS).read()
    assert latched is not None
    assert strange in latched.cause
    assert str(_latched()) in latched.cause


def test_a_reference_of_another_kind_cannot_be_read(strange: str) -> None:
    with pytest.raises(Refused, match=strange) as caught:
        ReferenceFile(BUS).read()
    assert caught.value.where == str(_reference())


def test_no_file_is_made_where_a_link_points(folder: Path) -> None:
    link(_set_up())
    link(_latched().with_suffix(".lock"))
    with pytest.raises(Refused), SetUpLock(BUS).held():
        pytest.fail("it was locked")
    with pytest.raises(Refused):
        FaultLatch(BUS).engage("rig", folder)
    assert not (folder / "elsewhere").exists()


@pytest.mark.parametrize("verb", [("status",), ("reset", "--yes")])
@pytest.mark.parametrize("file", [_set_up, lambda: _latched().with_suffix(".lock")])
def test_status_and_reset_name_a_fifo_and_end(
    verb: tuple[str, ...], file: Callable[[], Path]
) -> None:
    os.mkfifo(file())
    answer = call(verb[0], RIG, "--interface", "udp_multicast", "--channel", CHANNEL, *verb[1:])
    assert answer.code == Refused.exit_code, answer
    assert f"{file()}: it is a FIFO" in answer.err


@pytest.mark.parametrize(("size", "readable"), [(LARGEST_FILE, True), (LARGEST_FILE + 1, False)])
def test_a_file_too_large_is_not_read(size: int, readable: bool) -> None:
    _latched().write_bytes(b"[" * size)
    if readable:
        assert len(read_state_file(_latched())) == size
    else:
        with pytest.raises(Refused, match="larger than 65536 bytes"):
            read_state_file(_latched())
    latched = FaultLatch(BUS).read()
    assert latched is not None
    assert "cannot be read" in latched.cause


def test_files_left_open_do_not_pile_up(strange: str) -> None:
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(3):
        with pytest.raises(Refused):
            read_state_file(_latched())
    assert len(os.listdir("/proc/self/fd")) == before


def test_a_latch_outlives_the_change_to_a_folder_for_all_users(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As `docs/commissioning.md` advises it, maybe between a fault and its reset."""
    FaultLatch(BUS).engage("rig", tmp_path, "cable 4 is slack")
    shared = tmp_path / "shared"
    shared.mkdir()
    monkeypatch.setattr(state_folder, "SHARED", shared)
    later = FaultLatch(BUS)
    with pytest.raises(Refused, match="cable 4 is slack"):
        later.engage("rig", tmp_path)
    with later.held_for_reset("rig", later.read()):
        pass
    later.engage("rig", tmp_path)
    later.disengage()
    monkeypatch.setattr(state_folder, "SHARED", tmp_path / "absent")
    assert FaultLatch(BUS).read() is None


def test_a_fault_is_not_reset_with_the_file_of_another_rig(tmp_path: Path) -> None:
    """Of fewer drives, say: the one in fault would not be checked."""
    latch = FaultLatch(BUS)
    latch.engage("eight cables", tmp_path, "drive 8 is in fault")
    with (
        pytest.raises(Refused, match="to rig 'eight cables', not to 'four cables'"),
        latch.held_for_reset("four cables", latch.read()),
    ):
        pytest.fail("it would be reset")
    assert latch.read() is not None


def engaged_by(nodes: tuple[int, ...], folder: Path) -> LatchedFault:
    """A fault of a rig with drives of these node ids."""
    latch = FaultLatch(BUS, nodes)
    latch.engage("rig", folder)
    latch.settle("rig", State.LATCHED, "drive 8 is in fault", folder)
    latched = latch.read()
    assert latched is not None
    return latched


@pytest.mark.parametrize("others", [(), (1, 2, 3, 4), (1, 2, 3, 4, 5, 6, 7, 9)])
def test_a_fault_is_not_reset_with_a_file_of_its_name_that_lacks_drives(
    tmp_path: Path, others: tuple[int, ...]
) -> None:
    """A copy for four of eight cables, say: drive 8, in fault, would not be checked."""
    shown, other = engaged_by(tuple(range(1, 9)), tmp_path), FaultLatch(BUS, others)
    assert not other.is_of(shown, "rig")
    with (
        pytest.raises(Refused, match=r"(?m)not in the rig file: node .*\b8$") as caught,
        other.held_for_reset("rig", shown),
    ):
        pytest.fail("it would be reset")
    assert "rig file it happened with" in caught.value.next_step
    assert not FaultLatch(BUS).held_by_another()
    assert other.read() == shown


@pytest.mark.parametrize("nodes", [(1, 2), (2, 1), (1, 2, 3)])
def test_a_fault_is_reset_with_a_file_of_its_name_and_drives(
    tmp_path: Path, nodes: tuple[int, ...]
) -> None:
    """Their order may be what was wrong."""
    shown, latch = engaged_by((1, 2), tmp_path), FaultLatch(BUS, nodes)
    assert latch.is_of(shown, "rig")
    with latch.held_for_reset("rig", shown):
        pass
    latch.require_disengaged()


def test_a_fault_without_its_drives_counts_as_engaged_and_is_reset(tmp_path: Path) -> None:
    engaged_by((1, 2), tmp_path)
    latch = FaultLatch(BUS, (1, 2))
    content = json.loads(latch.path.read_text())
    del content["nodes"]
    latch.path.write_text(json.dumps(content))
    shown = latch.read()
    assert shown is not None
    assert "cannot be read" in shown.cause
    assert "nodes" in shown.cause
    with latch.held_for_reset("rig", shown):
        pass
    latch.require_disengaged()


@pytest.mark.parametrize("nodes", ["twelve", 3, [[]], None])
def test_a_fault_with_unreadable_drives_counts_as_engaged(tmp_path: Path, nodes: object) -> None:
    engaged_by((1, 2), tmp_path)
    latch = FaultLatch(BUS)
    latch.path.write_text(json.dumps({**json.loads(latch.path.read_text()), "nodes": nodes}))
    with pytest.raises(Refused, match="cannot be read"):
        latch.require_disengaged()


def test_a_motion_latches_the_drives_of_its_rig(tmp_path: Path) -> None:
    rig = load_rig(RIG).with_bus("udp_multicast", CHANNEL)
    MotionInterlock(rig).begin(tmp_path, None)
    latched = FaultLatch(BUS).read()
    assert latched is not None
    assert latched.nodes == tuple(winch.node_id for winch in rig.winches)


def test_locks_may_be_used_by_every_operator_whatever_the_umask(tmp_path: Path) -> None:
    before = os.umask(0o077)
    try:
        FaultLatch(BUS).engage("rig", tmp_path)
        with SetUpLock(BUS).held():
            pass
    finally:
        os.umask(before)
    for lock in (_latched().with_suffix(".lock"), _set_up()):
        assert lock.stat().st_mode & 0o777 == 0o664


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EBADF])
def test_a_file_system_without_locks_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    def no_lock(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", no_lock)
    with pytest.raises(Refused, match="cannot be locked"):
        FaultLatch(BUS).engage("rig", tmp_path)
    with pytest.raises(Refused, match="cannot be locked"), SetUpLock(BUS).held():
        pytest.fail("it was not locked")
    assert FaultLatch(BUS).read() is None


def test_a_serial_adapter_is_the_same_bus_by_each_of_its_names(tmp_path: Path) -> None:
    device, by_id = tmp_path / "ttyACM0", tmp_path / "usb-adapter"
    device.touch()
    by_id.symlink_to(device)
    for speed in ("", "@115200"):
        names = {BusSettings("slcan", f"{name}{speed}").canonical for name in (device, by_id)}
        assert names == {f"slcan {device}"}


class UsbAdapters:
    """Serial adapters in folders like /dev and /sys of Linux."""

    def __init__(self, root: Path) -> None:
        self.dev, self.by_id, self.sys = root / "dev", root / "by-id", root / "sys"
        for folder in (self.dev, self.by_id, self.sys / "class"):
            folder.mkdir(parents=True)

    def plug_in(self, device: str, port: str, serial: str | None, bus: int = 1) -> Path:
        """Returns the name of the adapter, which is the same each time."""
        name = f"{bus}-{port}"
        usb = self.sys / "devices" / "pci0000:00" / "0000:00:14.0" / f"usb{bus}" / name
        (usb / f"{name}:1.0").mkdir(parents=True)
        (usb.parent / "serial").write_text("0000:00:14.0\n")  # of the hub in the computer
        (usb.parent / "idVendor").write_text("1d6b\n")
        (usb / "idVendor").write_text("1d50\n")
        (usb / "idProduct").write_text("606f\n")
        if serial is not None:
            (usb / "serial").write_text(f"{serial}\n")
        (self.dev / device).touch()
        (self.sys / "class" / device).mkdir()
        (self.sys / "class" / device / "device").symlink_to(usb / f"{name}:1.0")
        link = self.by_id / f"usb-{serial or port}"
        link.unlink(missing_ok=True)
        link.symlink_to(self.dev / device)
        return link

    def unplug_all(self) -> None:
        shutil.rmtree(self.sys)
        for path in (*self.dev.iterdir(), *self.by_id.iterdir()):
            path.unlink()
        (self.sys / "class").mkdir(parents=True)


@pytest.fixture
def adapters(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> UsbAdapters:
    adapters = UsbAdapters(tmp_path)
    monkeypatch.setattr(state_folder, "DEVICES", adapters.sys / "class")
    return adapters


@pytest.mark.parametrize("serial", ["207C3", None])
@pytest.mark.parametrize("spelled", ["device", "link"])
def test_a_serial_adapter_keeps_latch_and_reference_when_it_gets_another_number(
    adapters: UsbAdapters, serial: str | None, spelled: str, tmp_path: Path
) -> None:
    """Absolute encoders would move by the rig file without their reference."""
    link = adapters.plug_in("ttyACM0", "4.2", serial)
    before = BusSettings("slcan", f"{adapters.dev / 'ttyACM0'}@115200")
    FaultLatch(before).engage("rig", tmp_path, "a cable broke")
    lost = as_in_the_file(load_rig(RIG)).model_copy(update={"lost": "a cable broke"})
    ReferenceFile(before).write(lost)
    adapters.unplug_all()
    for name in (adapters.dev / "ttyACM0", link):
        with pytest.raises(HardwareMissing, match="no serial adapter"):
            FaultLatch(BusSettings("slcan", str(name)))
    adapters.plug_in("ttyACM0", "4.1", serial and "another")
    adapters.plug_in("ttyACM1", "4.2", serial, bus=3)
    now = BusSettings("slcan", str(link if spelled == "link" else adapters.dev / "ttyACM1"))
    latched, reference = FaultLatch(now).read(), ReferenceFile(now).read()
    assert latched is not None
    assert latched.cause == "a cable broke"
    assert reference is not None
    assert reference.lost == "a cable broke"
    other = BusSettings("slcan", str(adapters.dev / "ttyACM0"))
    assert (FaultLatch(other).read(), ReferenceFile(other).read()) == (None, None)


@pytest.mark.parametrize("speed", ["", "@115200"])
@pytest.mark.parametrize("shares", [False, True])
def test_a_serial_adapter_keeps_latch_and_reference_filed_under_its_device(
    adapters: UsbAdapters,
    speed: str,
    shares: bool,
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As they were before adapters were known by serial number; then the folder may change, too."""
    channel = f"{adapters.dev / 'ttyACM0'}{speed}"
    former, bus = BusSettings("slcan", f"-{channel}"), BusSettings("slcan", channel)
    FaultLatch(former).engage("rig", tmp_path, "a cable broke")
    lost = as_in_the_file(load_rig(RIG)).model_copy(update={"lost": "a cable broke"})
    ReferenceFile(former).write(lost)
    before = [FaultLatch(former).path, ReferenceFile(former).path]
    link = adapters.plug_in("ttyACM0", "4.2", "207C3")
    if shares:
        (tmp_path / "shared").mkdir()
        monkeypatch.setattr(state_folder, "SHARED", tmp_path / "shared")
    for name in (channel, f"{link}{speed}"):
        latch = FaultLatch(BusSettings("slcan", name))
        with pytest.raises(Refused, match="a cable broke"):
            latch.engage("rig", tmp_path)
        reference = ReferenceFile(BusSettings("slcan", name)).read()
        assert reference is not None
        assert reference.lost == "a cable broke"
    with latch.held_for_reset("rig", latch.read()):
        pass
    ReferenceFile(bus).write(as_in_the_file(load_rig(RIG)))
    assert not any(path.exists() for path in before)
    FaultLatch(bus).require_disengaged()


def test_a_reset_keeps_the_fault_of_another_rig_under_a_former_device(
    adapters: UsbAdapters, tmp_path: Path
) -> None:
    """Its adapter had this device before: nobody has looked at its drives."""
    channel = str(adapters.dev / "ttyACM0")
    former, bus = BusSettings("slcan", f"-{channel}"), BusSettings("slcan", channel)
    adapters.plug_in("ttyACM0", "4.2", "207C3")
    FaultLatch(bus).engage("this", tmp_path, "a cable broke")
    FaultLatch(former).engage("other", tmp_path, "a drive is silent")
    latch = FaultLatch(bus)
    with latch.held_for_reset("this", latch.read()):
        pass
    left = FaultLatch(bus).read()
    assert left is not None
    assert (left.rig, left.cause) == ("other", "a drive is silent")


def test_state_of_a_serial_device_without_usb_is_written_and_kept(tmp_path: Path) -> None:
    """Its name is the same as before: what is written must not be removed as the former one."""
    device = tmp_path / "ttyS0"
    device.touch()
    file = ReferenceFile(BusSettings("slcan", f"{device}@115200"))
    file.write(as_in_the_file(load_rig(RIG)))
    assert file.read() == as_in_the_file(load_rig(RIG))


def test_two_adapters_with_the_short_serial_number_of_their_maker_are_two_buses(
    adapters: UsbAdapters, tmp_path: Path
) -> None:
    """All CP2102 have 0001: a reference of one rig would count for an equal one beside it."""
    here, there = (BusSettings("slcan", str(adapters.dev / f"ttyUSB{n}")) for n in range(2))
    adapters.plug_in("ttyUSB0", "4.1", "0001")
    FaultLatch(here).engage("rig", tmp_path, "a cable broke")
    adapters.plug_in("ttyUSB1", "4.2", "0001")
    FaultLatch(there).require_disengaged()
    with pytest.raises(Refused, match="a cable broke"):
        FaultLatch(here).require_disengaged()


@pytest.mark.parametrize("product", ["606f", "0000"])
def test_two_adapters_with_the_same_serial_number_are_refused_while_both_are_there(
    adapters: UsbAdapters, product: str
) -> None:
    channels = [str(adapters.dev / f"ttyUSB{number}") for number in range(2)]
    for number, channel in enumerate(channels):
        adapters.plug_in(Path(channel).name, f"4.{number}", "0123456789")
    usb = (adapters.sys / "class" / "ttyUSB1" / "device").resolve().parent
    (usb / "idProduct").write_text(f"{product}\n")
    for channel in channels:
        if product == "0000":
            FaultLatch(BusSettings("slcan", channel))
            continue
        with pytest.raises(HardwareMissing, match="two serial adapters have the serial number"):
            FaultLatch(BusSettings("slcan", channel))
    shutil.rmtree(adapters.sys / "class" / "ttyUSB1")
    FaultLatch(BusSettings("slcan", channels[0]))


def test_two_channels_of_one_serial_adapter_are_two_buses(adapters: UsbAdapters) -> None:
    adapters.plug_in("ttyUSB0", "1", "207C3")
    unit = (adapters.sys / "class" / "ttyUSB0" / "device").resolve()
    names = set()
    for number in (0, 1):
        (adapters.dev / f"ttyUSB{number}").touch()
        (unit / f"ttyUSB{number}").mkdir()
        (unit / f"ttyUSB{number}" / "port_number").write_text(f"{number}\n")
        folder = adapters.sys / "class" / f"ttyUSB{number}"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        (folder / "device").symlink_to(unit / f"ttyUSB{number}")
        names.add(FaultLatch(BusSettings("slcan", str(adapters.dev / f"ttyUSB{number}"))).path)
    assert len(names) == 2


@pytest.mark.parametrize("relative", ["state", "./state", "~/state", ""])
def test_a_relative_state_folder_is_ignored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, relative: str
) -> None:
    """XDG Base Directory Specification: paths must be absolute; a latch would depend on `cd`."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(state_folder, "SHARED", tmp_path / "absent")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_STATE_HOME", relative)
    FaultLatch(BUS).engage("rig", tmp_path)
    other = tmp_path / "elsewhere"
    other.mkdir()
    monkeypatch.chdir(other)
    with pytest.raises(Refused, match="did not finish"):
        FaultLatch(BUS).require_disengaged()
    assert FaultLatch(BUS).path.is_relative_to(tmp_path / ".local/state/cdpr")


def test_a_user_without_a_home_is_told_what_to_set(monkeypatch: pytest.MonkeyPatch) -> None:
    """As one without a name, in a container: its latched faults would have no place."""
    for name in ("HOME", "XDG_STATE_HOME", "XDG_CACHE_HOME", "NUMBA_CACHE_DIR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("os.getuid", lambda: 54321)
    with pytest.raises(Refused) as refusal:
        state_file("latched", BUS)
    assert "XDG_STATE_HOME" in refusal.value.next_step
    with pytest.raises(Refused, match="no folder for latched faults"):
        ControlLock(BUS)  # at once, as a console would show nothing
    assert machine_code.use_folder("0123456789abcdef") is None
