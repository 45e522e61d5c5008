"""Behaviour of drives within the standards: monitoring, named behaviours."""

from __future__ import annotations

import struct
from itertools import pairwise
from pathlib import Path
from unittest import mock

import can
import numpy as np
import pytest

from drivers.can_bus import BusSettings, open_bus
from drivers.cia402.profile import load_profile
from drivers.cia402.state_machine import DriveState
from model.errors import BadInput
from model.rig import Rig
from simulation import factory
from simulation.drives.behaviour import BEHAVIOURS, STRICT, behaviour_named, table
from simulation.drives.cia402_rig import SimulatedCia402Rig
from simulation.drives.eds_file import profile_path, read_eds
from tests.cli.program import call
from tests.simulation.drive_line import (
    DISABLED,
    ENABLED,
    FAULT,
    MASK,
    ON,
    READY,
    STOPPED,
    Line,
    ready,
)

STATES = {"switch on disabled": [], "switched on": [6, 7], "stopped": [6, 7, 0x0F, 2]}


def named(*names: str) -> Line:
    return ready(behaviour=behaviour_named(names))


@pytest.mark.parametrize("words", STATES.values(), ids=STATES)
def test_a_missed_sync_is_reported_in_every_state_and_its_end_too(words: list[int]) -> None:
    line = ready()
    for word in words:
        line.sync(word)
    line.sync(None)
    line.drive.advance(0.0299)
    assert line.emergencies() == []
    line.drive.advance(0.0002)
    assert line.take(0x085) == [bytes.fromhex("0087310000000000")]  # error register: 31h
    line.drive.advance(1.0)
    assert line.emergencies() == []  # once
    line.drive.on_sync()
    assert line.take(0x085) == [bytes(8)]


@pytest.mark.parametrize("words", STATES.values(), ids=STATES)
def test_missed_set_points_are_reported_in_every_state(words: list[int]) -> None:
    line = ready()
    line.write(0x1400, 5, "<H", 30)
    for word in words:
        line.sync(word)
    line.set_point(line.drive._control_word)
    for _ in range(4):
        line.sync(None)
    assert line.emergencies() == [0x8250]
    line.set_point(line.drive._control_word)
    assert line.emergencies() == [0x0000]


def test_sync_is_not_watched_before_the_first_nor_in_pre_operational() -> None:
    line = ready()
    line.drive.advance(1.0)
    line.drive.on_sync()
    line.drive.on_nmt(0x80, 5)
    line.drive.advance(1.0)
    line.drive.on_nmt(0x01, 5)
    line.drive.advance(1.0)
    assert line.emergencies() == []


def test_sync_periods_is_the_tolerance() -> None:
    line = named("sync-periods=1.5")
    line.enable()
    line.drive.advance(0.0149)
    assert line.drive.state is DriveState.OPERATION_ENABLED
    line.drive.advance(0.0002)
    assert line.drive.state is DriveState.QUICK_STOP_ACTIVE


@pytest.mark.parametrize(
    ("option", "before", "state"),
    [(0, ON, ON), (1, ON, FAULT), (2, ON, 0x40), (3, ON, 0x40), (1, STOPPED, FAULT)],
)
def test_6007_acts_in_other_states_too(option: int, before: int, state: int) -> None:
    line = Line()
    line.set_up(abort_option=option)
    for word in {ON: (6, 7), STOPPED: (6, 7, 0x0F, 2)}[before]:
        line.sync(word)
    line.sync(None)
    line.drive.advance(0.031)
    line.drive.advance(0.001)
    assert line.sync(None) == state


@pytest.mark.parametrize(("option", "heartbeat"), [(0, 0x7F), (1, 0x05), (2, 0x04)])
def test_1029_is_the_nmt_state_after_a_lost_heartbeat(option: int, heartbeat: int) -> None:
    line = ready()
    line.write(0x1029, 1, "<B", option)
    line.write(0x1016, 1, "<I", 127 << 16 | 100)
    line.drive.on_heartbeat(127, b"\x05")
    line.drive.advance(0.101)
    line.write(0x1017, 0, "<H", 30) if option < 2 else None
    assert line.drive.nmt == heartbeat
    assert line.emergencies() == [0x8130]


def test_a_node_is_watched_by_one_entry_only() -> None:
    line = Line()
    assert line.abort(0x1016, 1, "<I", 127 << 16 | 100) == 0
    assert line.abort(0x1016, 2, "<I", 127 << 16 | 200) == 0x06040043
    assert line.abort(0x1016, 1, "<I", 0) == 0
    assert line.abort(0x1016, 2, "<I", 127 << 16 | 200) == 0


@pytest.mark.parametrize(
    ("names", "state"),
    [((), DriveState.QUICK_STOP_ACTIVE), (("heartbeat-loss-is-fault",), DriveState.FAULT)],
)
@pytest.mark.parametrize("stopped", [False, True])
def test_heartbeat_loss_as_a_fault(
    names: tuple[str, ...], state: DriveState, stopped: bool
) -> None:
    line = named(*names)
    line.write(0x1006, 0, "<I", 0)
    line.write(0x1016, 1, "<I", 127 << 16 | 100)
    line.enable()
    if stopped:
        assert line.state_after(0x02) == STOPPED
    line.drive.on_heartbeat(127, b"\x05")
    line.drive.advance(0.101)
    line.drive.advance(0.001)
    assert line.drive.state is state
    assert line.drive.torque_on == (state is DriveState.QUICK_STOP_ACTIVE)


def answers(line: Line, seconds: float) -> list[float]:
    """Delays of the answers, [s]."""
    line.ask(0x40, 0x1000, 0)
    times = [0.0] * len(line.take(0x585))
    for step in range(1, round(seconds / 0.01) + 1):
        line.drive.advance(0.01)
        times += [step * 0.01] * len(line.take(0x585))
    return times


def test_sdo_delay_and_twice() -> None:
    assert answers(Line(), 0.1) == [0.0]
    slow = Line(behaviour=behaviour_named(["sdo-delay=1200"]))
    assert answers(slow, 2.0) == [pytest.approx(1.2)]
    twice = Line(behaviour=behaviour_named(["sdo-twice=30"]))
    assert answers(twice, 0.1) == [0.0, pytest.approx(0.03)]
    assert answers(Line(behaviour=behaviour_named(["sdo-twice"])), 0.1) == [0.0, 0.0]


def test_sdo_late_answers_overtake_each_other() -> None:
    line = Line(behaviour=behaviour_named(["sdo-late=50"]))
    for sub in range(1, 9):
        line.ask(0x40, 0x1A00, sub)
    assert [data[3] for data in line.take(0x585)] == [1, 2, 3, 4, 5, 6, 8]
    line.drive.advance(0.051)
    assert [data[3] for data in line.take(0x585)] == [7]


def test_sdo_lost() -> None:
    line = Line(behaviour=behaviour_named(["sdo-lost=3"]))
    assert [len(answers(line, 0.0)) for _ in range(6)] == [1, 1, 0, 1, 1, 0]


@pytest.mark.parametrize(
    ("name", "key", "abort"),
    [
        ("absent=1029", (0x1029, 1), 0x06020000),
        ("absent=1400:05/06010000", (0x1400, 5), 0x06010000),
        ("absent=605E/06010002", (0x605E, 0), 0x06010002),
        ("absent=605Eh:00/08000000h", (0x605E, 0), 0x08000000),
    ],
)
def test_absent_objects_are_answered_with_any_legal_abort(
    name: str, key: tuple[int, int], abort: int
) -> None:
    line = Line(behaviour=behaviour_named([name]))
    for command in (0x40, 0x2F):
        reply = line.sdo(command, *key, b"\0")
        assert (reply[0], *struct.unpack_from("<I", reply, 4)) == (0x80, abort)


def test_without_1006h_sync_is_not_watched() -> None:
    line = named("absent=1006")
    line.enable()
    line.drive.advance(1.0)
    assert line.drive.state is DriveState.OPERATION_ENABLED


@pytest.mark.parametrize(
    ("monitoring", "state"),
    [("sync", DriveState.QUICK_STOP_ACTIVE), ("heartbeat", DriveState.OPERATION_ENABLED)],
)
def test_a_make_that_does_not_detect_missing_sync_keeps_1006h_without_a_reaction(
    monitoring: str, state: DriveState
) -> None:
    """Drives that synchronise to SYNC by 1006h; the heartbeat alone stops them."""
    profile = load_profile("cia402").model_copy(update={"monitoring": monitoring})
    line = ready(profile=profile)
    line.enable()
    line.drive.advance(1.0)
    assert line.read(0x1006, 0) == 10_000
    assert line.drive.state is state


def test_a_wider_range_than_that_of_the_eds_file_accepts_no_more() -> None:
    eds = read_eds(profile_path("epos4"))
    line = Line(eds=eds, behaviour=behaviour_named(["range=6066/0..65535", "range=60C2:01/0..50"]))
    assert line.abort(0x6066, 0, "<H", 1) == 0x06090030  # the file's: 0 to 0
    assert line.abort(0x6066, 0, "<H", 0) == line.abort(0x60C2, 1, "<B", 50) == 0
    assert line.abort(0x60C2, 1, "<B", 51) == 0x06090030


def test_range() -> None:
    line = Line(behaviour=behaviour_named(["range=6066/0..0", "range=60C2:02/-3..-3"]))
    assert line.abort(0x6066, 0, "<H", 20) == 0x06090030
    assert line.abort(0x6066, 0, "<H", 0) == 0
    assert line.abort(0x60C2, 2, "<b", -4) == 0x06090030
    assert line.abort(0x60C2, 2, "<b", -3) == 0


def test_mode_late() -> None:
    line = Line(behaviour=behaviour_named(["mode-late=50"]))
    line.write(0x6060, 0, "<b", 8)
    line.drive.advance(0.049)
    assert line.read(0x6061, 0) == 0
    line.drive.advance(0.002)
    assert line.read(0x6061, 0) == 8


def test_mode_when_enabled() -> None:
    line = named("mode-when-enabled")
    line.sync(0x06)
    assert line.read(0x6061, 0) == 0
    line.enable()
    assert line.read(0x6061, 0) == 8
    line.sync(0x0F, 1100)
    line.sync(0x0F)
    assert line.drive.motor.position == 1100


def test_enable_late() -> None:
    """It is switched on meanwhile, without torque; another command cancels it."""
    line = named("enable-late=45")
    for _ in range(3):
        line.sync(0x06)
        states = [line.sync(0x0F) for _ in range(3)]
        assert ENABLED not in states
        assert line.drive.torque == 0.0
    line.sync(0x06)
    assert [line.sync(0x0F) for _ in range(9)][-1] == ENABLED


@pytest.mark.parametrize(("word", "state"), [(0x07, ON), (0x06, READY), (0x02, DISABLED)])
def test_a_command_to_enable_that_is_withdrawn_in_time_enables_nothing(
    word: int, state: int
) -> None:
    line = named("enable-late=45")
    for each in (0x06, 0x07, 0x0F):
        line.sync(each)
    assert {line.sync(word) for _ in range(9)} == {ON, state}  # ON once, before it is taken
    assert line.drive.torque == 0.0


def test_a_warning_comes_and_goes_and_the_drive_goes_on() -> None:
    line = named("warning=4310")
    line.enable()
    bits = []
    for _ in range(180):
        assert line.sync(0x0F) == ENABLED
        bits.append(line.word >> 7 & 1)
    assert line.emergencies() == [0x4310, 0x0000, 0x4310]
    assert {0, 1} == set(bits)


def test_status_flicker_leaves_the_state_alone() -> None:
    line = named("status-flicker")
    line.enable()
    words = []
    for _ in range(60):
        assert line.sync(0x0F) == ENABLED
        words.append(line.word)
    changed = 0
    for before, after in pairwise(words):
        changed |= before ^ after
    assert changed == 0xEF90, "bit 12 shows that it follows"


@pytest.mark.parametrize("behaviour", ["strict", "limits-monitored"])
def test_limits_that_exclude_the_actual_position_stop_a_drive_that_monitors_it(
    behaviour: str,
) -> None:
    line = named(behaviour)
    line.enable()
    line.sync(0x02)
    line.write(0x607D, 2, "<i", 1000)
    line.drive.advance(0.001)
    assert line.emergencies() == []
    line.write(0x607D, 2, "<i", 999)
    line.drive.advance(0.001)
    line.drive.advance(0.001)
    trips = behaviour == "limits-monitored"
    assert line.emergencies() == [0x8612] * trips
    assert line.drive.torque_on is not trips


def test_a_limit_switch_stops_the_drive_after_every_reply_that_shows_it_enabled() -> None:
    """605Ah = 6 and 0Fh every cycle: transitions 11 and 16 by turns, without an emergency."""
    line = named("limit-switch=100")
    line.enable()
    for target in range(1000, 1250, 50):
        assert line.sync(0x0F, target) == ENABLED
        assert line.position is not None
        assert (line.drive.state is DriveState.OPERATION_ENABLED) == (line.position <= 1100)
    reached = []
    for target in range(1250, 2250, 50):
        assert line.sync(0x0F, target) == ENABLED
        reached.append(line.position)
        assert line.read(0x6041, 0) & MASK == STOPPED
    assert min(np.diff(reached)) > 0, "it moves on"
    assert line.emergencies() == []
    assert line.sync(None) == STOPPED, "no set-point, no transition 16"


def test_boot_late() -> None:
    line = Line(behaviour=behaviour_named(["boot-late=2000"]))
    line.ask(0x40, 0x1000, 0)
    line.drive.on_nmt(1, 5)
    line.drive.advance(1.99)
    assert line.sent == []
    line.drive.advance(0.02)
    assert line.sent == [(0x705, b"\0")]
    assert line.read(0x1000, 0) == 0x20192


@pytest.mark.parametrize(("name", "at"), [("position-noise=3", 0), ("torque-noise=3", 1)])
def test_noise_is_in_what_is_reported_only(name: str, at: int) -> None:
    line = named(name)
    seen = []
    for _ in range(200):
        line.sync(0x06)
        seen.append((line.position, line.torque))
    for column, still in enumerate((1000, 0)):
        values = [row[column] for row in seen]
        deviation = (sum((value - still) ** 2 for value in values) / len(values)) ** 0.5
        assert (2.0 < deviation < 4.0) if column == at else deviation == 0.0
    assert line.drive.motor.position == 1000.0


def test_stick_slip_rests_and_then_jumps() -> None:
    line = named("stick-slip=40")
    line.enable()
    positions = []
    for step in range(1, 21):
        line.sync(0x0F, 1000 + 10 * step)
        positions.append(line.drive.motor.position)
    steps = {after - before for before, after in pairwise(positions)}
    assert steps == {0.0, 40.0}


def torques_out_and_back(rig: Rig, friction: float) -> list[float]:
    """Of the first drive, with the platform where it was, after paying out and after winding in."""
    behaviour = behaviour_named([f"friction={friction}"])
    with open_bus(BusSettings("virtual", f"friction-{friction}")) as bus:
        rehearsal = SimulatedCia402Rig(rig, bus, rig.home, behaviour=behaviour)
        torques = []
        for drive in rehearsal.drives:
            drive.state = DriveState.OPERATION_ENABLED
        for rotation in (2.0, -2.0, 0.0):
            for drive in rehearsal.drives:
                drive.motor.position += rotation
            rehearsal._begin_torque_update()
            rehearsal._finish_torque_update()
            torques.append(rehearsal.drives[0].torque)
    return torques


def test_friction_is_torque_that_no_cable_feels(rig: Rig) -> None:
    free, rubbing = torques_out_and_back(rig, 0.0), torques_out_and_back(rig, 60.0)
    more = [b - a for a, b in zip(free, rubbing, strict=True)]
    assert more == pytest.approx([60.0, -60.0, -60.0])  # at rest it stays as it was


def test_a_slow_drive_of_this_process_is_waited_for(rig: Rig) -> None:
    """In simulated time an SDO answer takes as long as the behaviour says, for everyone."""
    behaviour = behaviour_named(["sdo-delay=300"])
    settings = BusSettings("virtual", "slow-sdo")
    with open_bus(settings) as near, open_bus(settings) as far:
        rehearsal = SimulatedCia402Rig(rig, far, rig.home, behaviour=behaviour)
        rehearsal.pump()
        request = bytes.fromhex("4000100000000000")
        near.send(can.Message(arbitration_id=0x601, data=request, is_extended_id=False))
        rehearsal.pump()
        heard = []
        while (message := near.recv(0.0)) is not None:
            heard.append(message.arbitration_id)
        assert 0x581 in heard
        assert rehearsal.drives[7]._now == pytest.approx(0.3, abs=1e-6)


def test_all_names_can_be_given_and_are_in_the_list() -> None:
    assert len(table()) == len({b.name for b in BEHAVIOURS}) == len(BEHAVIOURS)
    for one in BEHAVIOURS:
        if one.example or not one.value:
            assert (behaviour_named([one.name]) == STRICT) == (one.name == "strict")


@pytest.mark.parametrize(
    "text",
    [
        *("kind", "sdo-lost=0", "sdo-lost=x", "warning=", "status-flicker=1", "absent"),
        *("absent=12", "absent=1006/1", "range=6066", "range=6066/2..1", "friction=-1"),
        *("sync-periods=0.5", "sync-periods=3.1", "friction=nan"),
    ],
)
def test_a_wrong_name_or_value_is_explained(text: str) -> None:
    with pytest.raises(BadInput) as caught:
        behaviour_named([text])
    assert "--drive-behaviour" in str(caught.value)


def test_the_documentation_has_every_behaviour() -> None:
    page = (Path(__file__).parents[2] / "docs" / "drives.md").read_text()
    rows = []
    for name, _ in table():
        usage, _, default = name.partition(" ")
        rows.append(f"| `{usage}` {default}".rstrip() + " |")
    assert [row for row in rows if row not in page] == []


def test_the_list_names_the_value_that_is_used_without_one() -> None:
    for one, (usage, _) in zip(BEHAVIOURS, table(), strict=True):
        if one.example:
            assert usage == f"{one.name}[={one.value}] ({one.example})"
            assert behaviour_named([one.name]) == behaviour_named([f"{one.name}={one.example}"])
        else:
            assert "(" not in usage


def test_the_command_line_lists_them_and_explains_a_wrong_one() -> None:
    file = Path(__file__).parents[2] / "configs" / "gachon_8_6.yaml"
    listed = call("sim", file, "--drive-behaviour", "list")
    assert listed.code == 0
    assert all(name in listed.out for name, _ in table())
    wrong = call("sim", file, "--drive-behaviour", "kind")
    assert wrong.code == 2
    assert "strict" in wrong.err


def test_the_command_line_takes_no_eds_for_odrives() -> None:
    odrives = Path(__file__).parents[2] / "configs" / "gachon_8_6_odrive.yaml"
    wrong = call("sim", odrives, "--interface", "udp_multicast", "--drive-behaviour", "sdo-twice")
    assert wrong.code == 2
    assert "ODrive" in wrong.err


def test_drives_that_answer_already_are_not_simulated_too(monkeypatch: pytest.MonkeyPatch) -> None:
    file = Path(__file__).parents[2] / "configs" / "gachon_8_6.yaml"
    bus = open_bus(BusSettings("virtual", "occupied"))
    monkeypatch.setattr(factory, "open_bus", lambda _settings: bus)
    monkeypatch.setattr(factory, "nodes_present", lambda _rig, _bus: {4, 2})
    with mock.patch.object(bus, "shutdown", wraps=bus.shutdown) as closed:
        answer = call("sim", file, "--interface", "udp_multicast")
    assert answer.code == 3
    assert "drives with node ids 2, 4 already answer" in answer.said
    assert "disconnect the real drives, or pass another --channel" in answer.said
    closed.assert_called_once()


def test_a_wrong_eds_file_is_found_before_the_bus_is_opened(tmp_path: Path) -> None:
    file = Path(__file__).parents[2] / "configs" / "gachon_8_6.yaml"
    wrong = call("sim", file, "--interface", "udp_multicast", "--eds", tmp_path / "none.eds")
    assert wrong.code == 2
    assert "none.eds" in wrong.err
