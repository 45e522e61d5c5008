"""ODrives as one group: read, enabled and stopped together, never one alone."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import numpy as np
import pytest

from drivers import cyclic_group
from drivers.can_bus import InProcessBus
from drivers.drive_group import GroupCommand, GroupState
from drivers.factory import drive_flags, drive_states, read_drives
from drivers.odrive import configure
from drivers.odrive.configure import check_resolution
from drivers.odrive.endpoints import read_endpoints, wanted_settings
from drivers.odrive.messages import (
    OWN_DBC,
    RXSDO,
    AxisError,
    AxisState,
    can_id,
    node_and_command,
    read_layouts,
    status_word,
)
from drivers.odrive.monitor import OdriveMonitor, too_rare
from executor.doctor import rig_drives
from model.errors import BadInput, Fault, HardwareMissing, Refused
from model.files.rig_file import OdriveDocument
from model.rig import Rig, rig_from_document
from simulation.drives.odrive import SimulatedOdrive
from tests.drivers.odrive_bench import OdriveBench, odrive_bench, odrive_rig, write_endpoints

SET_AXIS_STATE, SET_INPUT_POS, GET_IQ = 0x07, 0x0C, 0x14
HEARTBEAT, ENCODER_ESTIMATES, TORQUES, TXSDO = 0x01, 0x09, 0x1C, 0x05
WATCHDOG_S = 0.1


@pytest.fixture
def bench() -> Iterator[OdriveBench]:
    with odrive_bench() as made:
        yield made


def odrive_of(rig: Rig) -> OdriveDocument:
    """The `drives` of a rig."""
    document = rig.document.drives
    assert isinstance(document, OdriveDocument)
    return document


def states(bench: OdriveBench) -> set[AxisState]:
    return {drive.state for drive in bench.drives}


def test_all_drives_are_enabled_at_their_positions_and_follow(bench: OdriveBench) -> None:
    status = bench.enable()
    assert status.state is GroupState.ENABLED
    assert status.holding
    assert states(bench) == {AxisState.CLOSED_LOOP_CONTROL}
    stood = status.positions
    per_metre = np.array([w.counts_per_metre for w in bench.rig.winches])
    for step in range(1, 11):
        targets = stood + np.rint(per_metre * 2e-4 * step).astype(int)
        status = bench.cycle(targets.tolist())
        assert np.array_equal(bench.group.targets, targets)
        error = (status.positions - status.demands) / per_metre
        assert np.abs(error).max() < 1e-5
        assert not status.missing.any()
    assert np.abs(status.positions - targets).max() <= 1
    words = status.status_words.tolist()
    assert drive_states(bench.rig, words) == ("closed loop control",) * 8
    in_error = status_word(AxisState.CLOSED_LOOP_CONTROL, 1)
    flags = drive_flags(bench.rig, [in_error, AxisState.IDLE, *words[2:]])
    assert [one.torque for one in flags] == ["enabled", "none", *["enabled"] * 6]


def test_torques_are_tensions_in_per_mille_of_rated_torque(bench: OdriveBench) -> None:
    bench.enable()
    status = bench.cycles(3)
    rated = np.array([w.torque_constant for w in bench.rig.winches])
    reported = status.torques / 1000.0 * rated
    assert reported == pytest.approx(bench.rehearsal.tensions, abs=0.51e-3 * rated.max())
    assert (status.torques > 0).all()


def test_set_points_go_back_to_back_with_their_speed(bench: OdriveBench) -> None:
    bench.enable()
    bench.frames()
    targets = bench.group.targets + 100
    bench.group.send_cycle(targets.tolist())
    sent = [m for m in bench.frames() if m.data]
    assert [node_and_command(m.arbitration_id) for m in sent] == [
        (winch.node_id, SET_INPUT_POS) for winch in bench.rig.winches
    ]
    turns, speed, torque = bench.group._layouts.set_input_pos.unpack(sent[0].data) or ()
    assert turns == pytest.approx(targets[0] / 16384, abs=1e-6)
    assert speed == pytest.approx(100 / 16384 / 0.01, abs=1e-3)
    assert torque == 0.0


def test_a_stop_holds_under_torque_then_hands_all_drives_to_their_brakes(
    bench: OdriveBench,
) -> None:
    status = bench.enable()
    stood = bench.cycle((status.positions + 40).tolist())
    bench.group.quick_stop_now()
    held = 0
    while AxisState.CLOSED_LOOP_CONTROL in states(bench):
        assert states(bench) == {AxisState.CLOSED_LOOP_CONTROL}, "all or none"
        assert bench.group.stopping
        status = bench.cycle((stood.positions + 10_000).tolist())
        assert not status.stopped
        held += 1
    assert 10 <= held <= 12
    for _ in range(12):
        status = bench.cycle()
    assert not bench.group.stopping
    assert status.state is GroupState.QUICK_STOP
    assert status.stopped
    assert status.holding
    assert np.abs(status.positions - stood.positions).max() <= 40
    assert status.faults == ()


def test_a_stop_before_anything_was_enabled_is_over_at_once(bench: OdriveBench) -> None:
    bench.group.configure()
    bench.group.read_positions()
    bench.group.command(GroupCommand.QUICK_STOP)
    assert not bench.group.stopping
    status = bench.cycle()
    assert status.stopped
    assert states(bench) == {AxisState.IDLE}


def test_drives_can_be_enabled_again_after_a_stop(bench: OdriveBench) -> None:
    bench.enable()
    bench.group.command(GroupCommand.QUICK_STOP)
    with pytest.raises(Refused, match="being stopped"):
        bench.group.command(GroupCommand.ENABLE)
    bench.cycles(30)
    bench.group.command(GroupCommand.ENABLE)
    assert bench.cycles(30).state is GroupState.ENABLED


def test_without_a_master_all_are_disarmed_together_by_their_watchdogs(bench: OdriveBench) -> None:
    bench.enable()
    began = [drive.motor.position for drive in bench.drives]
    bench.rehearsal.advance(WATCHDOG_S - 0.011)  # a cycle has passed since they were fed
    assert states(bench) == {AxisState.CLOSED_LOOP_CONTROL}
    bench.rehearsal.advance(0.002)
    assert states(bench) == {AxisState.IDLE}
    assert {drive.errors for drive in bench.drives} == {AxisError.WATCHDOG_TIMER_EXPIRED}
    assert [drive.motor.position for drive in bench.drives] == began


def test_frames_of_the_drives_that_the_bus_echoes_feed_no_watchdog() -> None:
    """As over UDP multicast, which returns a sender its own frames."""
    with odrive_bench() as bench:
        bench.rehearsal._bus.receive_own_messages = True
        bench.enable()
        for _ in range(round(WATCHDOG_S / bench.rig.cycle) + 2):
            bench.rehearsal.pump()
        assert states(bench) == {AxisState.IDLE}
        assert {drive.errors for drive in bench.drives} == {AxisError.WATCHDOG_TIMER_EXPIRED}


@pytest.mark.parametrize("fed_by_reads", [True, False])
def test_without_a_master_those_that_another_program_reads_may_stay_enabled(
    bench: OdriveBench, fed_by_reads: bool
) -> None:
    """Of which kind firmware 0.6 is, is not documented; so the page on ODrives forbids reads."""
    for drive in bench.drives:
        drive.settings.fed_by_reads = fed_by_reads
    bench.enable()
    for _ in range(10):
        other_program(bench, 3, GET_IQ, b"", is_remote_frame=True)
        for _ in range(5):
            bench.rehearsal.pump()
    still = [drive.node for drive in bench.drives if drive.state is not AxisState.IDLE]
    assert still == ([3] if fed_by_reads else [])


def test_after_that_a_new_master_finds_them_idle_and_starts_from_where_they_are(
    bench: OdriveBench,
) -> None:
    bench.enable()
    bench.rehearsal.advance(1.0)
    bench.group.close()
    status = bench.enable()
    assert status.state is GroupState.ENABLED
    assert {drive.errors for drive in bench.drives} == {0}


FAULTS: dict[str, tuple[Callable[[OdriveBench], object], str, int]] = {
    "axis error": (lambda b: b.drives[2].fail(0x2000), "(drive 3): motor over-temperature", 6),
    "watchdog of one": (
        lambda b: b.drives[2].fail(AxisError.WATCHDOG_TIMER_EXPIRED),
        "(drive 3): watchdog",
        6,
    ),
    "disarmed by another tool": (
        lambda b: b.drives[2]._disarm(0),
        "(drive 3) disarmed itself; its brake holds",
        6,
    ),
    "no heartbeat": (
        lambda b: b.drives[2].silent.add("heartbeat"),
        "(drive 3): heartbeat missing",
        18,
    ),
    "no torque": (
        lambda b: b.drives[2].silent.add("torques"),
        "(drive 3) does not report its torque",
        7,
    ),
    "not a number": (
        lambda b: setattr(b.drives[2].motor, "position", float("nan")),
        "(drive 3): its position is not a number",
        3,
    ),
    "a jump": (
        lambda b: setattr(b.drives[2].motor, "position", b.drives[2].motor.position + 20_000),
        "(drive 3): its position jumped",
        3,
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_of_one_is_a_hold_of_all_then_brakes(bench: OdriveBench, name: str) -> None:
    happens, words, within = FAULTS[name]
    bench.enable()
    bench.cycles(8)
    bench.rehearsal._begin_torque_update = lambda: None  # type: ignore[method-assign]  # a NaN has no equilibrium
    targets = bench.group.targets
    happens(bench)
    others = [drive for i, drive in enumerate(bench.drives) if i != 2]
    for _ in range(within):
        status = bench.cycle()
        if status.state is GroupState.FAULT:
            break
    assert any(words in text for _, text in status.faults), status.faults
    held = 0
    while any(drive.torque_on for drive in others):
        assert all(drive.torque_on for drive in others), "the others hold together"
        bench.cycle((targets + 5_000).tolist())
        assert np.array_equal(bench.group.targets, targets), "nothing moves on"
        held += 1
    assert 8 <= held <= 12
    with pytest.raises(Refused, match="a fault is latched"):
        bench.group.command(GroupCommand.ENABLE)


def test_a_silent_drive_is_missing_in_a_few_cycles(bench: OdriveBench) -> None:
    bench.enable()
    bench.drives[4].deaf = True
    missing = [bench.cycle().missing.tolist() for _ in range(4)]
    assert [row[4] for row in missing] == [False, True, True, True]
    assert not any(any(row[:4]) or any(row[5:]) for row in missing)


def test_messages_at_other_periods_than_the_cycle_are_not_missing() -> None:
    with odrive_bench(odrive_rig(estimates_ms=25, torques_ms=40, heartbeat_ms=70)) as bench:
        bench.enable()
        for _ in range(60):
            status = bench.cycle()
            assert not status.missing.any()
            assert status.state is GroupState.ENABLED, status.faults


@pytest.mark.parametrize("torques_ms", [5, 10, 30, 50])
@pytest.mark.parametrize("heartbeat_ms", [20, 50])
def test_the_first_tensions_of_enabled_drives_were_sent_under_torque(
    torques_ms: int, heartbeat_ms: int
) -> None:
    """The last torque of an idle drive, 0, was a slack cable, and a good run failed."""
    with odrive_bench(odrive_rig(torques_ms=torques_ms, heartbeat_ms=heartbeat_ms)) as bench:
        status = bench.enable()
        assert status.state is GroupState.ENABLED, status.faults
        tensions = bench.rig.tensions_by(status.torques)
        assert tensions == pytest.approx(bench.rehearsal.tensions, abs=0.1)


@pytest.mark.parametrize("torques_ms", [5, 10, 50])
@pytest.mark.parametrize("heartbeat_ms", [20, 50])
@pytest.mark.parametrize("opens_ms", [30, 50, 100, 150, 400])
def test_drives_count_as_enabled_once_their_brakes_have_opened(
    torques_ms: int, heartbeat_ms: int, opens_ms: float
) -> None:
    """An armed motor carries nothing before: its 0 N were a slack cable, and a jog failed."""
    rig = odrive_rig(torques_ms=torques_ms, heartbeat_ms=heartbeat_ms, brake_opens_ms=opens_ms)
    with odrive_bench(rig) as bench:
        bench.group.configure()
        at_rest = bench.group.read_positions().positions
        bench.group.command(GroupCommand.ENABLE)
        closed = 0
        while (status := bench.cycle((at_rest + 500).tolist())).state is GroupState.ENABLING:
            closed += not any(drive.torque_on for drive in bench.drives)
            assert np.array_equal(bench.group.targets, at_rest)
            assert np.array_equal(status.positions, at_rest)
        assert status.state is GroupState.ENABLED, status.faults
        assert closed >= opens_ms / 10 - 1
        tensions = bench.rig.tensions_by(status.torques)
        assert tensions == pytest.approx(bench.rehearsal.tensions, abs=0.1)


def test_an_armed_motor_neither_pulls_nor_moves_before_its_brake_is_open() -> None:
    with odrive_bench(odrive_rig(watchdog_ms=200)) as bench:
        bench.group.configure()
        bench.rehearsal.pump()
        drive, layouts = bench.drives[2], read_layouts()
        arm = layouts.set_axis_state.pack(AxisState.CLOSED_LOOP_CONTROL)
        ahead = layouts.set_input_pos.pack(0.01, 0.0, 0.0)
        drive.receive(SET_AXIS_STATE, arm)
        drive.receive(SET_INPUT_POS, ahead)
        began = drive.motor.position
        bench.rehearsal.advance(0.149)
        assert drive.state is AxisState.CLOSED_LOOP_CONTROL
        assert (drive.motor.position, drive.torque, drive.torque_on) == (began, 0.0, False)
        bench.rehearsal.advance(0.021)
        assert drive.torque_on
        assert drive.motor.position == pytest.approx(0.01 * bench.rig.winches[2].counts_per_turn)
        bench.rehearsal.advance(0.2)
        assert drive.errors == AxisError.WATCHDOG_TIMER_EXPIRED


def test_drives_without_brakes_are_enabled_at_once() -> None:
    took = {}
    for brakes in (True, False):
        with odrive_bench(odrive_rig(brakes)) as bench:
            bench.group.configure()
            bench.group.read_positions()
            bench.group.command(GroupCommand.ENABLE)
            took[brakes] = 1
            while bench.cycle().state is GroupState.ENABLING:
                took[brakes] += 1
            tensions = bench.rig.tensions_by(bench.cycle().torques)
            assert tensions == pytest.approx(bench.rehearsal.tensions, abs=0.1)
    assert took[True] == took[False] + 15


def test_a_drive_that_sends_no_torque_once_enabled_is_a_fault(bench: OdriveBench) -> None:
    bench.group.configure()
    bench.group.read_positions()
    bench.group.command(GroupCommand.ENABLE)
    bench.cycle()
    bench.drives[4].silent.add("torques")
    for _ in range(8):
        status = bench.cycle()
        assert status.state is not GroupState.ENABLED
    assert status.faults == ((5, "cable 5 (drive 5) does not report its torque"),)


@pytest.mark.parametrize("key", ["estimates_ms", "torques_ms"])
def test_reports_too_rare_to_see_a_fault_in_time_are_refused(key: str) -> None:
    """Positions are compared with all set-points of a period: a jammed drive may be any of them."""
    with odrive_bench(odrive_rig(**{key: 50})) as bench:
        bench.group.configure()
    with odrive_bench(odrive_rig(**{key: 51})) as bench:
        with pytest.raises(BadInput, match=rf"drives\.{key} is 51 ms.*limit.*50 ms") as caught:
            bench.group.configure()
        assert not bench.frames()
    assert "msg_rate_ms" in caught.value.next_step


class PassingTime(InProcessBus):
    """A bus that is not simulated in the master's cycles: its drives send while it waits."""

    pump: Callable[[], None]
    now, idle = 0.0, 0.0

    def recv(self, timeout: float | None = None) -> can.Message | None:
        while (message := super().recv(0.0)) is None and self.idle < (timeout or 0.0):
            self.pump()
            self.idle += 0.01
            self.now += 0.01
        self.idle = 0.0
        return message

    def configure(self, bench: OdriveBench) -> None:
        self.pump = bench.rehearsal.pump
        document, most = odrive_of(bench.rig), bench.rig.max_tension
        configure.configure_drives(
            bench.rig, document, read_layouts(), self, None, max_tension=most, to_reset=False
        )


@pytest.fixture
def passing(bench: OdriveBench, monkeypatch: pytest.MonkeyPatch) -> Iterator[PassingTime]:
    master = bench.group._bus
    assert isinstance(master, InProcessBus)
    with PassingTime(master.channel_id) as bus:
        monkeypatch.setattr(configure, "time", SimpleNamespace(monotonic=lambda: bus.now))
        yield bus


@pytest.mark.parametrize("period", [0.02, 0.1])
@pytest.mark.parametrize(
    ("kind", "text", "setting"),
    [
        (
            "torques",
            r"drive 4: torque less often than every 10 ms \(drives\.torques_ms\)",
            "torques",
        ),
        ("estimates", r"drive 4: position .* every 10 ms \(drives\.estimates_ms\)", "encoder"),
    ],
)
def test_a_message_period_longer_than_in_the_rig_file_is_refused_before_anything_is_enabled(
    bench: OdriveBench, passing: PassingTime, period: float, kind: str, text: str, setting: str
) -> None:
    """All were enabled, and 0.1 s later one "did not report its torque"."""
    passing.configure(bench)
    setattr(bench.drives[3].settings, kind, period)
    bench.frames()
    with pytest.raises(HardwareMissing, match=text) as caught:
        passing.configure(bench)
    assert f"set {setting}_msg_rate_ms of every drive to drives." in caught.value.next_step
    assert caught.value.values == {"nodes": "4"}
    commands = {node_and_command(m.arbitration_id)[1] for m in bench.frames() if m.data}
    assert SET_AXIS_STATE not in commands


@pytest.mark.parametrize(("late", "accepted"), [(4, True), (5, False)])
def test_message_periods_are_measured_again_where_the_computer_was_late(
    bench: OdriveBench,
    passing: PassingTime,
    monkeypatch: pytest.MonkeyPatch,
    late: int,
    accepted: bool,
) -> None:
    measured: list[Mapping[int, int]] = []

    def too_rare_at_first(nodes: Any, heard: Mapping[int, int], *period: Any) -> Any:
        measured.append(heard)
        return too_rare(nodes, {} if len(measured) <= late else heard, *period)

    monkeypatch.setattr(configure, "too_rare", too_rare_at_first)
    with (
        nullcontext()
        if accepted
        else pytest.raises(HardwareMissing, match="1, 2, 3, 4, 5, 6, 7, 8")
    ):
        passing.configure(bench)
    assert len(measured) == (late + 2 if accepted else late)


def test_messages_may_be_late_while_their_period_is_measured() -> None:
    period = "torques_ms", "torques_msg_rate_ms", 20
    assert too_rare((1, 2), {1: 12, 2: 21}, *period) is None
    refusal = too_rare((1, 2, 3), {1: 11, 2: 21}, *period)
    assert refusal is not None
    assert refusal.what == (
        "drives 1, 3: torque less often than every 20 ms (drives.torques_ms), 0 instead of 20 in"
        " 400 ms"
    )


def test_drives_that_report_several_times_a_cycle_follow_without_a_fault() -> None:
    with odrive_bench(odrive_rig(estimates_ms=3)) as bench:
        stood = bench.enable().positions
        per_metre = np.array([w.counts_per_metre for w in bench.rig.winches])
        for step in range(1, 31):
            targets = stood + np.rint(per_metre * 2e-4 * step).astype(int)
            status = bench.cycle(targets.tolist())
            assert status.state is GroupState.ENABLED, status.faults
            assert status.rejected == 0
        assert np.abs(status.positions - targets).max() <= 1


READ, WRITE = b"\0", b"\1"
COMMANDED: dict[str, tuple[int, bytes]] = {
    # ODrive, "CAN Protocol": every message from host to drive, by number
    "Estop": (0x02, b""),
    "RxSdo": (0x04, WRITE + bytes(7)),
    "Address": (0x06, b"\x09" + bytes(6)),
    "Set_Axis_State": (0x07, struct.pack("<I", 1)),
    "Set_Controller_Mode": (0x0B, struct.pack("<II", 2, 1)),
    "Set_Input_Pos": (0x0C, bytes(8)),
    "Set_Input_Vel": (0x0D, struct.pack("<ff", 0.2, 0.0)),
    "Set_Input_Torque": (0x0E, bytes(4)),
    "Set_Limits": (0x0F, struct.pack("<ff", 1000.0, 100.0)),
    "Set_Traj_Vel_Limit": (0x11, bytes(4)),
    "Set_Traj_Accel_Limits": (0x12, bytes(8)),
    "Set_Traj_Inertia": (0x13, bytes(4)),
    "Reboot": (0x16, b""),
    "Clear_Errors": (0x18, b"\0"),
    "Set_Absolute_Position": (0x19, bytes(4)),
    "Set_Pos_Gain": (0x1A, bytes(4)),
    "Set_Vel_Gains": (0x1B, bytes(8)),
    "Enter_DFU_Mode": (0x1F, b""),
}
HARMLESS: dict[str, tuple[int, bytes, bool]] = {
    "asking by remote frame": (0x09, b"", True),
    "asking by an empty frame": (0x1C, b"", False),
    "reading a setting": (0x04, READ + bytes(3), False),
    "asking who is there": (0x06, b"", True),
    "asking who is there without a remote frame": (0x06, b"", False),
}


def other_program(bench: OdriveBench, node: int, command: int, data: bytes, **more: bool) -> None:
    bench.ear.send(
        can.Message(arbitration_id=can_id(node, command), data=data, is_extended_id=False, **more)
    )


@pytest.mark.parametrize("node", [3, 0x3F], ids=["one", "all"])
@pytest.mark.parametrize("name", COMMANDED)
def test_another_program_that_commands_drives_is_a_fault_of_the_bus_at_once(
    bench: OdriveBench, name: str, node: int
) -> None:
    bench.enable()
    command, data = COMMANDED[name]
    bench.ear.send(can.Message(arbitration_id=can_id(node, command), data=data))  # another 29 bits
    bench.cycle()
    other_program(bench, node, command, data)
    drives = "all drives" if node == 0x3F else "drive 3"
    with pytest.raises(Fault) as caught:
        bench.cycle()
    assert caught.value.code == "foreign_master"
    assert caught.value.what == f"another program commands {drives} ({name})"
    assert bench.group.state is GroupState.FAULT


@pytest.mark.parametrize("node", [3, 0x3F], ids=["one", "all"])
@pytest.mark.parametrize("name", HARMLESS)
def test_another_program_that_only_reads_is_no_fault(
    bench: OdriveBench, name: str, node: int
) -> None:
    bench.enable()
    command, data, remote = HARMLESS[name]
    other_program(bench, node, command, data, is_remote_frame=remote)
    other_program(bench, node, 0x06, bytes([node]) + bytes(6))  # a drive tells its own node id
    assert bench.cycles(20).state is GroupState.ENABLED


@pytest.mark.parametrize("name", COMMANDED)
def test_another_program_that_commands_during_configuration_is_a_fault(
    bench: OdriveBench, name: str
) -> None:
    """Before anything is sent: in some firmware every frame to a drive feeds its watchdog."""
    other_program(bench, 0x3F, *COMMANDED[name])
    with pytest.raises(Fault, match=rf"another program commands all drives \({name}\)"):
        bench.group.configure()
    assert not any(frame.is_remote_frame for frame in bench.frames())


def test_where_the_master_hears_itself_its_own_frames_are_not_anothers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As over UDP multicast; each echo excuses one frame and no more."""
    for module in (cyclic_group, configure):
        monkeypatch.setattr(module, "echoes_own_frames", lambda _bus: True)
    file = write_endpoints(tmp_path / "flat_endpoints.json", odrive_rig())
    with odrive_bench(odrive_rig(endpoints=str(file)), echo=True) as bench:
        bench.drives[2].errors = AxisError.WATCHDOG_TIMER_EXPIRED
        assert bench.enable().state is GroupState.ENABLED
        other_program(bench, 3, 0x04, READ + bytes(3))
        assert bench.cycles(5).state is GroupState.ENABLED
        other_program(bench, 3, *COMMANDED["Set_Input_Pos"])
        with pytest.raises(Fault, match="another program commands drive 3"):
            bench.cycle()


def test_requests_are_remote_frames(bench: OdriveBench) -> None:
    """A data frame of the identifier that a drive sends could collide with its own."""
    bench.group.configure()
    asked = [m for m in bench.frames() if m.is_remote_frame or not m.data]
    assert all(m.is_remote_frame and not m.is_extended_id for m in asked)
    assert {node_and_command(m.arbitration_id) for m in asked} == {
        (winch.node_id, command) for winch in bench.rig.winches for command in (0x00, 0x17)
    }


@pytest.mark.parametrize("waits", [0, 3, 30, 200])
def test_a_watchdog_that_runs_at_rest_is_cleared_before_arming(
    bench: OdriveBench, waits: int
) -> None:
    """As in firmware 0.5; the brakes hold all cables."""
    for drive in bench.drives:
        drive.settings.watchdog_at_rest = True
    bench.rehearsal.advance(1.0)
    bench.group.configure()
    bench.group.read_positions()
    bench.rehearsal.advance(waits * 0.001)  # the operator thinks
    bench.group.command(GroupCommand.ENABLE)
    for _ in range(30):
        status = bench.cycle()
    assert status.state is GroupState.ENABLED
    assert status.faults == ()
    bench.group.command(GroupCommand.QUICK_STOP)
    status = bench.cycles(60)
    assert status.stopped
    assert status.faults == ()
    assert bench.enable().state is GroupState.ENABLED, "and again"
    bench.rehearsal.advance(0.2)  # the master is late
    status = bench.cycles(2)
    assert status.state is GroupState.FAULT
    assert "watchdog" in status.faults[0][1]


def test_a_watchdog_that_stays_expired_is_a_drive_that_is_not_enabled(
    bench: OdriveBench,
) -> None:
    bench.drives[5].settings.watchdog_at_rest = True
    bench.group.configure()
    bench.group.read_positions()
    bench.group.command(GroupCommand.ENABLE)
    bench.drives[5].fail(AxisError.WATCHDOG_TIMER_EXPIRED)
    del bench.drives[5]._commands[0x18]  # Clear_Errors
    status = bench.cycles(140)
    assert status.state is GroupState.FAULT
    assert status.faults[0][1].startswith("cable 6 (drive 6) stays idle instead of closed loop")


def test_another_error_is_neither_cleared_nor_excused_before_arming(bench: OdriveBench) -> None:
    bench.group.configure()
    bench.group.read_positions()
    bench.drives[5].fail(AxisError.WATCHDOG_TIMER_EXPIRED | 0x2000)
    bench.group.command(GroupCommand.ENABLE)
    status = bench.cycles(8)
    assert status.state is GroupState.FAULT
    assert bench.drives[5].errors == AxisError.WATCHDOG_TIMER_EXPIRED | 0x2000


def test_a_drive_that_is_not_calibrated_is_named_and_no_other_stays_enabled(
    bench: OdriveBench,
) -> None:
    bench.drives[5].calibrated = False
    bench.group.configure()
    bench.group.read_positions()
    bench.group.command(GroupCommand.ENABLE)
    status = bench.cycles(140)
    assert status.state is GroupState.FAULT
    reported = status.faults[0][1]
    assert reported.startswith("cable 6 (drive 6) stays idle instead of closed loop control")
    assert "not calibrated" in reported
    bench.cycles(15)
    assert states(bench) == {AxisState.IDLE}


def _twin(bench: OdriveBench) -> None:
    twin = OdriveRehearsalTwin(bench)
    bench.rehearsal._by_node[4].receive = twin.receive  # type: ignore[method-assign]


class OdriveRehearsalTwin:
    """Two devices with one node id: each request is answered twice."""

    def __init__(self, bench: OdriveBench) -> None:
        self._receive = bench.rehearsal._by_node[4].receive

    def receive(self, command: int, data: bytes) -> None:
        self._receive(command, data)
        self._receive(command, data)


@pytest.mark.parametrize("drive", [0, 7])
def test_a_drive_that_also_reports_its_supply_on_its_own_is_no_second_device(
    bench: OdriveBench, drive: int
) -> None:
    """Its bus_voltage_msg_rate_ms may be set; the first drive to answer is the likelier one."""
    pump = bench.rehearsal.pump

    def with_reports() -> None:
        pump()
        bench.drives[drive].receive(0x17, b"")

    bench.group._pump = with_reports
    assert bench.group.configure()
    assert bench.group.state is GroupState.CONFIGURED


def test_a_drive_that_reports_its_version_on_its_own_is_refused_by_that_setting(
    bench: OdriveBench,
) -> None:
    _twin(bench)
    with pytest.raises(Refused) as caught:
        bench.group.configure()
    assert "version_msg_rate_ms is not 0" in caught.value.why
    assert "set version_msg_rate_ms to 0" in caught.value.next_step


def left_enabled(drive: SimulatedOdrive) -> None:
    """By a master that is gone; its watchdog is off."""
    drive.settings = replace(drive.settings, watchdog=None)
    drive.state = AxisState.CLOSED_LOOP_CONTROL


REFUSED: dict[str, tuple[Callable[[OdriveBench], object], type[Exception], str]] = {
    "silent": (lambda b: setattr(b.drives[1], "deaf", True), HardwareMissing, "drive 2: no"),
    "firmware 0.5": (
        lambda b: setattr(b.drives[1], "_answer", lambda _command: None),
        HardwareMissing,
        r"drive 2: heartbeats, but no Get_Version(.|\n)*firmware 0\.5, which every ODrive 3\.x has",
    ),
    "neither version nor heartbeat": (
        lambda b: (
            setattr(b.drives[1], "_answer", lambda _command: None),
            b.drives[1].silent.add("heartbeat"),
        ),
        HardwareMissing,
        "drive 2: no Get_Version",
    ),
    "no heartbeat": (
        lambda b: b.drives[1].silent.add("heartbeat"),
        HardwareMissing,
        "drive 2: no Heartbeat",
    ),
    "old firmware": (
        lambda b: setattr(b.drives[1].settings, "firmware", (0, 5, 6)),
        Refused,
        "firmware 0.5.6 is too old",
    ),
    "already enabled": (
        lambda b: left_enabled(b.drives[1]),
        Refused,
        "drive 2 is already enabled",
    ),
    "calibrating": (
        lambda b: setattr(b.drives[1], "state", 7),
        Refused,
        r"drive 2 is in axis state 7(.|\n)*axis0\.config\.startup_\*(.|\n)*wait until it is idle",
    ),
    "in fault": (
        lambda b: b.drives[1].fail(0x100),
        Refused,
        r"supply over-voltage(.|\n)*disarmed itself",
    ),
    "supply off": (
        lambda b: b.drives[1].fail(0x200),
        Refused,
        r"supply under-voltage(.|\n)*why: its motor supply is off or too low",
    ),
    "restarting": (
        lambda b: b.drives[1].fail(0x1),
        Refused,
        r"still starting(.|\n)*why: it was switched on or restarted just now",
    ),
    "no motor supply": (
        lambda b: setattr(b.drives[1], "supply", 0.0),
        Refused,
        "drive 2 has no motor supply",
    ),
    "a twin": (_twin, Refused, "drive 4 answered twice"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_drives_that_are_not_fit_are_refused_before_anything_is_enabled(
    bench: OdriveBench, name: str
) -> None:
    happens, kind, words = REFUSED[name]
    happens(bench)
    bench.rehearsal.pump()
    with pytest.raises(kind, match=words):
        bench.group.configure()
    commands = {node_and_command(m.arbitration_id)[1] for m in bench.frames()}
    assert SET_AXIS_STATE not in commands
    assert bench.group.state is GroupState.OFFLINE


def test_without_endpoints_settings_not_read_back_are_reported(bench: OdriveBench) -> None:
    (remark,) = bench.group.configure()
    assert "scales of feed-forward" in remark
    assert "not read back" in remark


def test_settings_are_written_and_read_back_with_the_endpoints_of_the_firmware(
    tmp_path: Path,
) -> None:
    file = write_endpoints(tmp_path / "flat_endpoints.json", odrive_rig())
    rig = odrive_rig(endpoints=str(file))
    with odrive_bench(rig) as bench:
        assert bench.group.configure() == ()
        document: Any = rig.document.drives
        known = read_endpoints(file, document, read_layouts())
        for drive in bench.drives:
            for wanted in wanted_settings(document, read_layouts()):
                endpoint = known.by_name[wanted.name]
                raw = drive.settings.values[endpoint.number].to_bytes(4, "little")
                value = endpoint.from_bytes(endpoint.value_in(raw, drive.node))
                assert value == pytest.approx(float(wanted.value))


def dbc_with_steps(path: Path, speed: str, torque: str) -> Path:
    """A DBC file whose feed-forward comes in other steps."""
    text = OWN_DBC.read_text().replace("48|16@1- (0.001,0)", f"48|16@1- ({torque},0)")
    path.write_text(text.replace("32|16@1- (0.001,0)", f"32|16@1- ({speed},0)"))
    return path


@pytest.mark.parametrize(
    ("speed", "torque", "scales"),
    [("0.001", "0.001", (1000, 1000)), ("0.0001", "0.01", (10_000, 100)), ("1", "0.1", (1, 10))],
)
def test_drives_scale_feed_forward_as_the_dbc_file_does(
    tmp_path: Path, speed: str, torque: str, scales: tuple[int, int]
) -> None:
    dbc = dbc_with_steps(tmp_path / "steps.dbc", speed, torque)
    file = write_endpoints(tmp_path / "flat_endpoints.json", odrive_rig())
    rig = odrive_rig(endpoints=str(file), dbc=str(dbc))
    known = read_endpoints(file, odrive_of(rig), read_layouts(dbc)).by_name
    with odrive_bench(rig) as bench:
        bench.group.configure()
        written = tuple(
            bench.drives[0].settings.values[known[f"axis0.config.can.input_{kind}_scale"].number]
            for kind in ("vel", "torque")
        )
    assert written == scales
    packed = read_layouts(dbc).set_input_pos.pack(0.0, 3.0, -2.0)
    steps = struct.unpack("<hh", packed[4:])
    assert [step / scale for step, scale in zip(steps, written, strict=True)] == [3.0, -2.0]


@pytest.mark.parametrize("step", ["0.0003", "2", "-0.001"])
def test_steps_that_no_scale_of_a_drive_gives_are_refused(tmp_path: Path, step: str) -> None:
    dbc = dbc_with_steps(tmp_path / "steps.dbc", step, "0.001")
    file = write_endpoints(tmp_path / "flat_endpoints.json", odrive_rig())
    with pytest.raises(BadInput, match="Vel_FF"):
        read_endpoints(file, odrive_of(odrive_rig(dbc=str(dbc))), read_layouts(dbc))


def test_a_setting_that_is_not_kept_is_refused_with_drive_and_endpoint(tmp_path: Path) -> None:
    file = write_endpoints(tmp_path / "flat_endpoints.json", odrive_rig())
    with odrive_bench(odrive_rig(endpoints=str(file))) as bench:
        bench.drives[6].settings.stuck.add(200)
        with pytest.raises(Refused, match=r"has 0; 0\.1 is required") as caught:
            bench.group.configure()
    assert caught.value.where == "drive 7, endpoint axis0.config.watchdog_timeout"
    assert "drives.watchdog_ms" in caught.value.why


def answer_endpoints(bench: OdriveBench, changed: Callable[[bytes], bytes]) -> None:
    """Changes every answer to the reading or writing of an endpoint."""
    for drive in bench.drives:

        def send(identifier: int, data: bytes, send: Any = drive._send_frame) -> None:
            is_answer = node_and_command(identifier)[1] == TXSDO
            send(identifier, changed(bytes(data)) if is_answer else data)

        drive._send_frame = send


def test_what_follows_a_value_in_an_answer_does_not_count(tmp_path: Path) -> None:
    """The size of each value is known; firmware may leave the rest of the frame undefined."""
    file = write_endpoints(tmp_path / "flat_endpoints.json", odrive_rig())
    rig = odrive_rig(endpoints=str(file))
    known = read_endpoints(file, odrive_of(rig), read_layouts()).by_name.values()
    sizes = {endpoint.number: endpoint.size for endpoint in known}

    def undefined_rest(data: bytes) -> bytes:
        end = 4 + sizes[int.from_bytes(data[1:3], "little")]
        return data[:end].ljust(8, b"\xa5")

    with odrive_bench(rig) as bench:
        answer_endpoints(bench, undefined_rest)
        assert bench.group.configure() == ()


def test_an_answer_shorter_than_its_value_is_refused_as_such(tmp_path: Path) -> None:
    file = write_endpoints(tmp_path / "flat_endpoints.json", odrive_rig())
    with odrive_bench(odrive_rig(endpoints=str(file))) as bench:
        answer_endpoints(bench, lambda data: data[:5])
        with pytest.raises(Refused, match="its answer has 1 byte, a float has 4") as caught:
            bench.group.configure()
    assert caught.value.where == "drive 1, endpoint axis0.config.watchdog_timeout"
    assert "drives.endpoints" in caught.value.why


def test_endpoints_of_another_firmware_are_refused(tmp_path: Path) -> None:
    file = write_endpoints(tmp_path / "flat_endpoints.json", odrive_rig(), "0.6.10-1")
    with odrive_bench(odrive_rig(endpoints=str(file))) as bench:
        bench.drives[3].settings.firmware = (0, 6, 11)
        with pytest.raises(Refused, match=r"is 0\.6\.11, drives\.endpoints is for 0\.6\.10"):
            bench.group.configure()


def test_endpoints_of_another_board_are_refused_before_any_is_written(tmp_path: Path) -> None:
    """Their numbers are other settings, which would read back as written."""
    file = write_endpoints(tmp_path / "flat_endpoints.json", odrive_rig())
    with odrive_bench(odrive_rig(endpoints=str(file))) as bench:
        bench.drives[7].settings.board = (5, 2, 0)
        with pytest.raises(Refused, match=r"is 5\.2\.0, drives\.endpoints is for 4\.4\.58") as got:
            bench.group.configure()
        commands = {node_and_command(m.arbitration_id)[1] for m in bench.frames()}
    assert got.value.where == "drive 8"
    assert "board, or leave out drives.endpoints" in got.value.next_step
    assert RXSDO not in commands


def test_doctor_reports_what_only_the_rig_file_makes_wrong() -> None:
    (good,) = rig_drives(odrive_rig(estimates_ms=50))
    (rare,) = rig_drives(odrive_rig(estimates_ms=51))
    assert good.good
    assert not rare.good
    assert "encoder_msg_rate_ms" in rare.fix


def test_endpoints_of_no_stated_board_are_refused_in_one_sentence(tmp_path: Path) -> None:
    file = write_endpoints(tmp_path / "flat_endpoints.json", odrive_rig())
    content = json.loads(file.read_text())
    del content["hw_version"]
    file.write_text(json.dumps(content))
    with pytest.raises(BadInput) as caught:
        read_endpoints(file, odrive_of(odrive_rig()), read_layouts())
    assert caught.value.what == "the file does not state its board: it has no hw_version"
    assert "flat_endpoints.json" in caught.value.next_step


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        '{"fw_version": "0.6.11", "hw_version": "4.4.58", "endpoints": {}}',
        '{"fw_version": "9e99.6.11", "hw_version": "4.4.58", "endpoints": {}}',
        '{"fw_version": "0.6.11", "hw_version": "4.4", "endpoints": {}}',
        '{"fw_version": "0.6.11", "hw_version": "4.4.300", "endpoints": {}}',
        '{"fw_version": "0.6", "hw_version": "4.4.58", "endpoints": {}}',
        '{"fw_version": "0.6.11", "hw_version": "4.4.58", "endpoints":'
        ' {"axis0.config.watchdog_timeout": 3}}',
        *(
            '{"fw_version": "0.6.11", "hw_version": "4.4.58", "endpoints":'
            f' {{"axis0.config.watchdog_timeout": {{"id": {number}, "type": "float"}}}}}}'
            for number in ("1e400", "-1", "1.5", "9" * 30, '"x"', "70000")
        ),
    ],
)
def test_a_file_that_holds_no_endpoints_is_refused(tmp_path: Path, text: str) -> None:
    document: Any = odrive_rig().document.drives
    path = tmp_path / "endpoints.json"
    path.write_text(text)
    with pytest.raises(BadInput, match=r"lacks required endpoints|not valid JSON|finite") as caught:
        read_endpoints(path, document, read_layouts())
    assert "Error(" not in str(caught.value), "no error of a library"


@pytest.mark.parametrize("lacking", range(9))
def test_a_firmware_without_a_required_setting_is_refused_by_both_names(
    tmp_path: Path, lacking: int
) -> None:
    document: Any = odrive_rig().document.drives
    path = write_endpoints(tmp_path / "flat_endpoints.json", odrive_rig(), "0.6.3-1")
    content = json.loads(path.read_text())
    name = wanted_settings(document, read_layouts())[lacking].name
    del content["endpoints"][name]
    path.write_text(json.dumps(content))
    with pytest.raises(BadInput) as caught:
        read_endpoints(path, document, read_layouts())
    assert caught.value.what == f"the file lacks required endpoints: {name}"
    assert "firmware 0.6.3-1" in caught.value.why
    assert "leave out drives.endpoints" in caught.value.next_step


def test_an_endpoint_of_an_unknown_type_is_named(tmp_path: Path) -> None:
    document: Any = odrive_rig().document.drives
    path = write_endpoints(tmp_path / "flat_endpoints.json", odrive_rig())
    path.write_text(path.read_text().replace('"bool"', '"endpoint_ref"'))
    words = "axis0.config.enable_watchdog has the type 'endpoint_ref'"
    with pytest.raises(BadInput, match=words):
        read_endpoints(path, document, read_layouts())


def test_errors_are_reset_on_all_drives_and_only_while_none_holds_by_torque(
    bench: OdriveBench,
) -> None:
    bench.enable()
    bench.drives[1].fail(0x2000)
    bench.cycles(8)
    with pytest.raises(Refused, match="while some hold the platform under torque"):
        bench.group.command(GroupCommand.RESET_FAULT)
    assert bench.drives[1].errors
    bench.cycles(30)
    bench.group.command(GroupCommand.RESET_FAULT)
    status = bench.cycles(10)
    assert status.state is GroupState.CONFIGURED
    assert status.faults == ()
    assert {drive.errors for drive in bench.drives} == {0}


def test_drives_in_fault_are_taken_to_be_reset(bench: OdriveBench) -> None:
    bench.drives[1].fail(0x2000)
    bench.group.configure(to_reset=True)
    assert bench.group.read_positions().state is GroupState.FAULT
    bench.group.command(GroupCommand.RESET_FAULT)
    assert bench.cycles(10).state is GroupState.CONFIGURED


def test_errors_are_reset_with_the_dbc_file_of_an_older_firmware(tmp_path: Path) -> None:
    """Its Clear_Errors has no data."""
    head, body = OWN_DBC.read_text().split("Axis0_Clear_Errors: 1")
    path = tmp_path / "old.dbc"
    path.write_text(head + "Axis0_Clear_Errors: 0" + re.sub(r" SG_ Identify .*\n", "", body))
    with odrive_bench(odrive_rig(dbc=str(path))) as bench:
        test_drives_in_fault_are_taken_to_be_reset(bench)
        assert {drive.errors for drive in bench.drives} == {0}


def test_capabilities_of_the_drives_are_the_rig_files(bench: OdriveBench) -> None:
    reported = bench.group.capabilities
    assert (reported.sync, reported.has_brake, reported.watchdog_ms) == (False, True, 100.0)
    with odrive_bench(odrive_rig(brakes=False, watchdog_ms=None)) as other:
        assert not other.group.capabilities.has_brake
        assert other.group.capabilities.watchdog_ms is None


def with_winches(rig: Rig, **changes: float) -> Rig:
    winches = [w.model_copy(update=changes) for w in rig.document.winches]
    return rig_from_document(rig.document.model_copy(update={"winches": winches}))


def test_counts_that_a_float_cannot_resolve_are_refused() -> None:
    check_resolution(with_winches(odrive_rig(), counts_per_rev=100_000))
    with pytest.raises(BadInput, match="an ODrive's set-point does not resolve") as caught:
        check_resolution(with_winches(odrive_rig(), counts_per_rev=2_000_000))
    assert "counts_per_rev" in caught.value.next_step


@pytest.mark.parametrize(
    ("step", "turns_per_s", "refused"),
    [
        ("0.001", 32.76, False),
        ("0.001", 32.78, True),
        ("0.01", 327.6, False),
        ("0.01", 327.8, True),
    ],
)
def test_a_speed_beyond_the_feed_forward_is_refused(
    tmp_path: Path, step: str, turns_per_s: float, refused: bool
) -> None:
    dbc = dbc_with_steps(tmp_path / "steps.dbc", step, "0.001")
    speed = turns_per_s * 206.06 / 50
    rig = with_winches(odrive_rig(dbc=str(dbc)), gear_ratio=50, max_speed_mm_s=speed)
    with odrive_bench(rig) as bench:
        if not refused:
            bench.group.configure()
            return
        with pytest.raises(BadInput, match=rf"{turns_per_s:g} turns/s") as caught:
            bench.group.configure()
        assert not bench.frames()
    assert "max_speed_mm_s" in caught.value.next_step


def test_reading_alone_sends_nothing(bench: OdriveBench) -> None:
    seen = read_drives(bench.rig, bench.group._bus, bench.rehearsal.pump)
    assert seen.positions.tolist() == [round(drive.motor.position) for drive in bench.drives]
    assert not seen.torques.any(), "their brakes hold"
    assert seen.restarted == ()
    assert all("idle" in state for state in drive_states(bench.rig, seen.status_words.tolist()))
    reported = {node_and_command(message.arbitration_id)[1] for message in bench.frames()}
    assert reported == {HEARTBEAT, ENCODER_ESTIMATES, TORQUES}


def test_a_position_that_is_not_a_number_is_not_a_drive_without_power(bench: OdriveBench) -> None:
    bench.rehearsal._begin_torque_update = lambda: None  # type: ignore[method-assign]  # a NaN has no equilibrium
    bench.group.configure()
    bench.drives[2].motor.position = float("nan")
    for read in (
        bench.group.read_positions,
        lambda: read_drives(bench.rig, bench.group._bus, bench.rehearsal.pump),
    ):
        with pytest.raises(HardwareMissing) as caught:
            read()
        assert caught.value.what == "no position from drives 3: it is not a number"
        assert "absolute_setpoints" in caught.value.why
        assert caught.value.next_step == "check the encoder with odrivetool"
    bench.drives[4].deaf = True
    with pytest.raises(HardwareMissing, match="no position from drives 5") as caught:
        bench.group.read_positions()
    assert "no power" in caught.value.why


def test_drives_that_report_no_torque_are_not_enabled(bench: OdriveBench) -> None:
    """All brakes opened, and the first cycle was a fault. State and position can still be read."""
    for drive in bench.drives[:2]:
        drive.silent.add("torques")
    bench.group.configure()
    with pytest.raises(HardwareMissing, match="no torque from drives 1, 2") as caught:
        bench.group.read_positions()
    assert "torques_msg_rate_ms" in caught.value.next_step
    assert SET_AXIS_STATE not in {node_and_command(m.arbitration_id)[1] for m in bench.frames()}
    assert bench.group.read_state(lambda: 0.0).state is GroupState.CONFIGURED
    assert read_drives(bench.rig, bench.group._bus, bench.rehearsal.pump).silent == ()


@pytest.mark.parametrize(
    ("kinds", "missing"), [({"heartbeat"}, "heartbeat"), ({"heartbeat", "estimates"}, "position")]
)
def test_those_that_answer_are_read_beside_a_silent_one(
    bench: OdriveBench, kinds: set[str], missing: str
) -> None:
    bench.drives[4].silent |= kinds
    with pytest.raises(HardwareMissing, match=f"no {missing} from drives 5"):
        read_drives(bench.rig, bench.group._bus, bench.rehearsal.pump)
    seen = read_drives(bench.rig, bench.group._bus, bench.rehearsal.pump, partial=True)
    there = [drive for k, drive in enumerate(bench.drives) if k != 4]
    assert seen.positions.tolist() == [round(drive.motor.position) for drive in there]
    assert seen.silent == (5,)
    assert len(seen.torques) == len(seen.status_words) == len(seen.errors) == 7
    assert f"no {missing} from drives 5" in str(seen.silence)


def test_released_drives_are_disarmed_and_their_brakes_hold(bench: OdriveBench) -> None:
    bench.enable()
    bench.group.command(GroupCommand.RELEASE)
    status = bench.cycles(40)
    assert status.state is GroupState.RELEASED
    assert status.holding
    assert states(bench) == {AxisState.IDLE}


def test_a_loss_of_power_leaves_no_trace(bench: OdriveBench) -> None:
    """So the rig file requires absolute encoders."""
    seen = read_drives(bench.rig, bench.group._bus, bench.rehearsal.pump)
    assert seen.restarted == bench.group.restarted == ()


@pytest.mark.parametrize("heartbeat_ms", [250, 1000])
def test_slow_heartbeats_are_waited_for(heartbeat_ms: int) -> None:
    """All that the rig file allows; the drives were named as silent, and then as not enabled."""
    rig = odrive_rig(heartbeat_ms=heartbeat_ms)
    with odrive_bench(rig) as bench:
        seen = read_drives(rig, bench.group._bus, bench.rehearsal.pump)
        assert seen.silent == ()
        bench.group.configure()
        bench.group.read_positions()
        bench.group.command(GroupCommand.ENABLE)
        while bench.cycle().state is GroupState.ENABLING:
            pass
        assert bench.group.state is GroupState.ENABLED
        bench.group.command(GroupCommand.RELEASE)
        within = bench.group.capabilities.released_within
        for _ in range(round(within / rig.cycle)):
            status = bench.cycle()
        assert (status.state, status.faults) == (GroupState.RELEASED, ())
        assert within >= 4.0 * heartbeat_ms / 1000.0


def test_the_first_reading_goes_on_until_every_state_and_torque_is_known() -> None:
    """At 1 ms the positions were complete 20 times before the first heartbeat."""
    rig, layouts = odrive_rig(), read_layouts()
    watch = OdriveMonitor(rig, rig.document.drives, layouts, [1e9] * 8)  # type: ignore[arg-type]
    sent = [
        (layouts.heartbeat, (0, 1, 0)),
        (layouts.get_encoder_estimates, (0.0, 0.0)),
        (layouts.get_torques, (0.0, 0.0)),
    ]
    messages = [(can_id(n, each.command), each.pack(*v)) for each, v in sent for n in watch.nodes]
    for number, message in enumerate(messages[1:]):
        assert not watch.complete, f"after {number} messages"
        watch.take(*message)
    assert not watch.complete
    watch.take(*messages[0])
    assert watch.complete
