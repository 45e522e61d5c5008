"""Drive profiles: real drives are configured with theirs, and refused with reasons without."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import can
import numpy as np
import pytest

from drivers.can_bus import BusSettings, open_bus
from drivers.cia402 import configure
from drivers.cia402 import inspection as examine
from drivers.cia402.configure import configure_drives
from drivers.cia402.inspection import Examined, examine_drives
from drivers.cia402.object_dictionary import heartbeat_consumers, settings_for
from drivers.cia402.profile import (
    FOLDER,
    load_profile,
    profile_names,
    profile_of,
)
from drivers.cia402.sdo import NOT_NOW, SetupNetwork
from drivers.cia402.sdo_jobs import monitoring_off
from drivers.factory import make_drive_group
from drivers.plausibility import position_limits
from drivers.stopping_distance import coasting_distance, lost_master, require_stopping_room
from model.errors import BadInput, CdprError, InvalidFile, Refused
from model.files.rig_file import RigDocument
from model.kinematics import cables_at
from model.pose import Pose
from model.rig import Rig, rig_from_document
from model.statics.gravity import STANDARD_GRAVITY, working_tensions
from model.winches import WinchMap
from tests.drivers.sdo_server import ScriptedBus, ScriptedDrive, downloads, eds_of

UNUSED_PDOS = [0x1401, 0x1402, 0x1403, 0x1801, 0x1802, 0x1803]
MAKERS = ("akd", "elmo-gold", "epos4", "nanotec-c5e")


def with_profile(rig: Rig, profile: str) -> Rig:
    document = rig.document.model_dump()
    document["drives"]["profile"] = profile
    return rig_from_document(RigDocument.model_validate(document))


def eight_of(profile: str) -> ScriptedBus:
    return ScriptedBus(ScriptedDrive(node, eds_of(profile)) for node in range(1, 9))


@pytest.fixture(autouse=True)
def _simulated_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """The configuration waits in the time of the scripted bus."""

    class Timed(SetupNetwork):
        def __init__(self, bus: can.BusABC, *arguments: object, timeout: float) -> None:
            super().__init__(bus, *arguments, timeout=timeout, clock=bus.clock)  # type: ignore[arg-type,attr-defined]

    monkeypatch.setattr(configure, "SetupNetwork", Timed)
    monkeypatch.setattr(examine, "SetupNetwork", Timed)


def set_up(
    rig: Rig,
    bus: ScriptedBus,
    *,
    to_reset: bool = False,
    on_restarted: Callable[[tuple[int, ...]], None] = lambda _nodes: None,
) -> tuple[str, ...]:
    return configure_drives(
        rig,
        bus,  # type: ignore[arg-type]
        None,
        max_tension=None,
        to_reset=to_reset,
        on_restarted=on_restarted,
    ).remarks


def examined(rig: Rig, bus: ScriptedBus) -> Examined:
    return examine_drives(rig, bus, None)  # type: ignore[arg-type]


def test_the_profiles_are_those_of_the_documentation() -> None:
    assert profile_names() == ("akd", "cia402", "elmo-gold", "epos4", "nanotec-c5e")


@pytest.mark.parametrize("name", ["cia402", *MAKERS])
def test_drives_of_a_profile_are_set_up_with_it(rig: Rig, name: str) -> None:
    theirs, bus = with_profile(rig, name), eight_of(name)
    remarks = set_up(theirs, bus)
    assert all("drive" in remark for remark in remarks)
    for drive, node in enumerate(range(1, 9)):
        values = bus.drives[node].values
        for setting in settings_for(theirs, drive, WinchMap(theirs)):
            place = (setting.index, setting.sub)
            if setting.transient or setting.per_mille_of:
                continue
            if setting.optional and not setting.instead and place not in values:
                continue
            held = values[place]
            assert not (held ^ setting.value) & (setting.mask or 0xFFFFFFFF), setting
        assert values.get((0x1800, 3), 0) == 0


@pytest.mark.parametrize("name", ["akd", "epos4", "nanotec-c5e"])
def test_with_another_profile_everything_wrong_is_reported_at_once(rig: Rig, name: str) -> None:
    bus = eight_of("cia402" if name == "akd" else name)
    if name == "akd":
        for drive in bus.drives.values():
            drive.aborts |= {(0x1006, 0): 0x06020000, (0x6072, 0): 0x06020000}
    elif name == "nanotec-c5e":
        for drive in bus.drives.values():
            drive.aborts[0x6072, 0] = 0x06090030
            drive.aborts[0x6007, 0] = 0x06010002
    with pytest.raises(Refused) as caught:
        set_up(rig, bus)
    message = caught.value.what
    wanted = {"akd": ("1006h", "6072h"), "epos4": ("1006h", "6072h")}
    for index in wanted.get(name, ("6072h", "6007h")):
        assert index in message
    assert "drive 1, 2, 3, 4, 5, 6, 7, 8" in message
    assert "cdpr doctor RIG --drives" in caught.value.next_step
    starts = [m for m in bus.sent if m.arbitration_id == 0 and m.data[0] == 0x01]
    assert not starts, "no drive is started"


def test_epos4_gets_its_limits_in_its_own_units(rig: Rig) -> None:
    """rpm/s of the motor shaft; milliamperes of the nominal current."""
    bus, winch = eight_of("epos4"), rig.winches[0]
    set_up(with_profile(rig, "epos4"), bus)
    values = bus.drives[1].values
    cycle = rig.document.bus.cycle_ms / 1000.0
    rpm = winch.max_speed * abs(winch.counts_per_metre) / winch.counts_per_turn * 60.0
    assert values[0x6085, 0] == math.ceil(rpm / cycle)
    assert values[0x3001, 2] == 6000  # 1200 per mille of 5 A
    assert values[0x6066, 0] == 0
    assert (values[0x60C2, 1], values[0x60C2, 2]) == (10, -3)
    assert values[0x1016, 1] == 127 << 16 | 100


def test_an_akd_limits_its_current_as_it_has_no_6072h(rig: Rig) -> None:
    """AKD CANopen Communication, edition H, page 102."""
    bus, theirs = eight_of("akd"), with_profile(rig, "akd")
    assert examined(theirs, bus).good
    set_up(theirs, bus)
    assert {drive.values[0x6073, 0] for drive in bus.drives.values()} == {1200}  # per mille
    assert all((0x6072, 0) not in drive.values for drive in bus.drives.values())


@pytest.mark.parametrize("name", ["akd", "epos4"])
@pytest.mark.parametrize("held", [0, 1199, 1200, 5000])
def test_a_torque_limit_that_the_profile_denies_must_not_hold_another_value(
    rig: Rig, name: str, held: int
) -> None:
    """A drive whose firmware has 6072h after all would get no limit there, or no torque."""
    bus, theirs = eight_of(name), with_profile(rig, name)
    bus.drives[5].objects[0x6072, 0] = bus.drives[5].objects[0x6040, 0]  # another UNSIGNED16
    bus.drives[5].values[0x6072, 0] = held
    (row,) = (row for row in examined(theirs, bus).rows if row.object.startswith("6072h"))
    assert row.verdict == ("ok" if held == 1200 else "wrong")
    if held == 1200:
        set_up(theirs, bus)
        return
    with pytest.raises(Refused, match=f"absent; the drive has it with {held}, 1200 is") as caught:
        set_up(theirs, bus)
    assert caught.value.where == "drive 5, object 6072h:00 max torque"
    assert not downloads(bus)


def test_a_torque_limit_that_is_a_share_of_nothing_is_refused_before_anything_is_written(
    rig: Rig,
) -> None:
    bus = eight_of("epos4")
    bus.drives[3].values[0x3001, 1] = 0  # no motor data were entered
    with pytest.raises(Refused, match="3001h:01") as caught:
        set_up(with_profile(rig, "epos4"), bus)
    assert "no torque" in str(caught.value)
    assert not downloads(bus)


@pytest.mark.parametrize("polarity", [0x20, 0x40, 0x80])
def test_positions_or_torques_that_are_inverted_alone_are_refused(rig: Rig, polarity: int) -> None:
    """Bit 5 inverts torques, as in a Mitsubishi MR-J5."""
    bus = eight_of("cia402")
    for drive in bus.drives.values():
        drive.objects[0x607E, 0] = drive.objects[0x1016, 0]  # another UNSIGNED8
        drive.values[0x607E, 0] = 0
    bus.drives[2].values[0x607E, 0] = polarity
    (row,) = (row for row in examined(rig, bus).rows if row.object.startswith("607Eh"))
    assert row.verdict == ("ok" if polarity == 0x40 else "wrong")
    if polarity == 0x40:  # of velocities, which are not used
        set_up(rig, bus)
        return
    with pytest.raises(Refused, match="607Eh"):
        set_up(rig, bus)
    assert not downloads(bus)


@pytest.mark.parametrize("encoder", ["incremental", "absolute"])
@pytest.mark.parametrize("stored", [None, 1, 2, 3])
def test_a_drive_that_saves_its_settings_on_its_own_is_remarked_on(
    rig: Rig, stored: int | None, encoder: str
) -> None:
    """It looks set up after a power cycle, in which an incremental encoder lost its zero."""
    document = rig.document.model_dump()
    for winch in document["winches"]:
        winch["encoder"] = encoder
    theirs, bus = rig_from_document(RigDocument.model_validate(document)), eight_of("cia402")
    if stored is not None:
        drive = bus.drives[3]
        drive.objects[0x1010, 1] = drive.objects[0x1006, 0]  # another UNSIGNED32
        drive.values[0x1010, 1] = stored
    saves = stored in (2, 3) and encoder == "incremental"
    rows = [row for row in examined(theirs, bus).rows if row.object.startswith("1010h:01")]
    assert [row.verdict for row in rows if row.verdict != "ok"] == ["remark"] * saves
    remarks = [remark for remark in set_up(theirs, bus) if "1010h" in remark]
    assert len(remarks) == saves
    if saves:
        assert remarks[0].startswith("drive 3: ")
        assert "`cdpr home`" in remarks[0]
        assert "`cdpr home`" in rows[0].change


def test_a_drive_that_refuses_to_state_how_it_saves_is_set_up(rig: Rig) -> None:
    document = rig.document.model_dump()
    document["winches"][1]["encoder"] = "incremental"
    bus = eight_of("cia402")
    bus.drives[2].aborts[0x1010, 1] = 0x08000022
    assert not set_up(rig_from_document(RigDocument.model_validate(document)), bus)


OFFSETS = {(0x60B0, 0): -1000, (0x60B1, 0): 20, (0x60B2, 0): 5}


def test_offsets_that_another_master_left_are_cleared(rig: Rig) -> None:
    """Drives add 60B0h to every set-point: all cables would jump when they are enabled."""
    bus = eight_of("cia402")
    bus.drives[4].values |= OFFSETS
    set_up(rig, bus)
    assert [bus.drives[4].values[key] for key in OFFSETS] == [0, 0, 0]


@pytest.mark.parametrize(("left", "allowed"), [(0, True), (7, False)])
def test_an_offset_that_cannot_be_cleared_must_be_zero(rig: Rig, left: int, allowed: bool) -> None:
    bus = eight_of("cia402")
    drive = bus.drives[4]
    drive.objects[0x60B0, 0] = drive.objects[0x1000, 0]  # read-only
    drive.values[0x60B0, 0] = left
    if allowed:
        assert set_up(rig, bus) == ()
        return
    with pytest.raises(Refused, match="drive 4, object 60B0h:00"):
        set_up(rig, bus)


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ((0x607C, 0), 2_000_000, "607Ch:00 home offset"),
        ((0x1005, 0), 0x40000080, "1005h:00 COB-ID SYNC"),  # the drive sends SYNC
        ((0x1005, 0), 0x20000080, "1005h:00 COB-ID SYNC"),  # 29 bits
        ((0x1014, 0), 0x20000084, "1014h:00 COB-ID EMCY"),
        ((0x607B, 2), 131_071, "607Bh position range limit"),  # of one turn
    ],
)
def test_what_would_move_positions_or_frames_is_refused_before_anything_is_written(
    rig: Rig, key: tuple[int, int], value: int, said: str
) -> None:
    bus = eight_of("cia402")
    assert examined(rig, bus).good
    bus.drives[4].values[key] = value
    wrong = [row.object for row in examined(rig, bus).rows if row.verdict == "wrong"]
    assert len(wrong) == 1, wrong
    assert wrong[0][:4] == said[:4]
    with pytest.raises(Refused, match=said):
        set_up(rig, bus)
    assert not downloads(bus)


def test_positions_may_wrap_around_beyond_the_software_limits(rig: Rig) -> None:
    bus = eight_of("cia402")
    for drive in bus.drives.values():
        drive.values |= {(0x607B, 1): -(2**31), (0x607B, 2): 2**31 - 1}
    assert set_up(rig, bus) == ()
    assert examined(rig, bus).good


def test_a_fixed_mapping_that_is_the_required_one_is_used(rig: Rig) -> None:
    bus = eight_of("cia402")
    fixed = {(0x1600, 0): 2, (0x1600, 1): 0x60400010, (0x1600, 2): 0x607A0020}
    for drive in bus.drives.values():
        drive.values |= fixed
        drive.objects |= {key: drive.objects[0x1000, 0] for key in fixed}  # read-only
        drive.objects[0x1600, 0] = drive.objects[0x607D, 0]
    assert set_up(rig, bus) == ()
    bus.drives[2].values[0x1600, 2] = 0x60FF0020
    with pytest.raises(Refused, match="drive 2, object 1600h:02"):
        set_up(rig, bus)


@pytest.mark.parametrize(
    ("high", "said"), [(1, "stops a drive from top speed in"), (-1, "low 0 is above high -1")]
)
def test_a_quick_stop_that_takes_too_long_is_refused(
    rig: Rig, tmp_path: Path, high: int, said: str
) -> None:
    profile = tmp_path / "slow.yaml"
    profile.write_text(
        f'name: slow\nsources: [a test]\nranges: {{"6085h:00": {{low: 0, high: {high}}}}}\n'
    )
    with pytest.raises(CdprError, match=said):
        settings_for(with_profile(rig, str(profile)), 0, WinchMap(rig))


def test_drives_in_nmt_stopped_are_named_and_reset_takes_them_back(rig: Rig) -> None:
    bus = eight_of("cia402")
    bus.stopped = {3, 5}
    with pytest.raises(Refused, match="drive 3, 5: in the NMT state 'stopped'"):
        set_up(rig, bus)
    set_up(rig, bus, to_reset=True)
    assert not bus.stopped


def test_a_cycle_that_the_drives_cannot_take_is_refused(rig: Rig) -> None:
    document = with_profile(rig, "nanotec-c5e").document.model_dump()
    document["bus"]["cycle_ms"] = 4.5
    with pytest.raises(BadInput, match="interpolate"):
        set_up(rig_from_document(RigDocument.model_validate(document)), eight_of("nanotec-c5e"))


@pytest.mark.parametrize("exponent", [None, 0, -3])
@pytest.mark.parametrize("cycle_ms", [10.0, 25.6])
def test_drives_without_an_interpolation_time_take_any_cycle(
    rig: Rig, tmp_path: Path, cycle_ms: float, exponent: int | None
) -> None:
    """60C2h holds 10 ms, not 25.6 ms; a drive that has it after all must hold the cycle."""
    document = rig.document.model_dump()
    document["drives"]["profile"] = lab_profile(tmp_path, 'absent: ["60C2h:01", "60C2h:02"]')
    document["bus"]["cycle_ms"] = cycle_ms
    theirs, bus = rig_from_document(RigDocument.model_validate(document)), eight_of("cia402")
    for node, drive in bus.drives.items():
        if exponent is None or node != 3:
            drive.aborts |= {(0x60C2, 1): 0x06020000, (0x60C2, 2): 0x06020000}
        else:
            drive.values |= {(0x60C2, 1): 10, (0x60C2, 2): exponent}
    if exponent is None or (cycle_ms, exponent) == (10.0, -3):
        assert set_up(theirs, bus) == ()
        return
    with pytest.raises(Refused, match=r"60C2h:0.*the profile declares it absent"):
        set_up(theirs, bus)
    assert not downloads(bus)


def test_another_unit_of_position_is_refused_before_anything_is_written(rig: Rig) -> None:
    bus = eight_of("nanotec-c5e")
    bus.drives[4].values[0x60A8, 0] = 0xFF410000  # as it leaves the maker: tenths of a degree
    with pytest.raises(Refused, match="FF410000h"):
        set_up(with_profile(rig, "nanotec-c5e"), bus)
    assert not downloads(bus)


def test_drives_without_csp_are_refused_with_the_reason(rig: Rig) -> None:
    bus = eight_of("cia402")
    for drive in bus.drives.values():
        drive.values[0x6502, 0] = 0x65  # all but the cyclic modes
    with pytest.raises(Refused, match="CSP"):
        set_up(rig, bus)
    assert not downloads(bus)


def modes_of_a_real_epos4(bus: ScriptedBus) -> None:
    """SDO trace in github.com/ros-industrial/ros2_canopen issue 236."""
    for drive in bus.drives.values():
        drive.values[0x6502, 0] = 0x225


def no_modes(bus: ScriptedBus) -> None:
    for drive in bus.drives.values():
        drive.aborts[0x6502, 0] = 0x06020000


@pytest.mark.parametrize("unlisted", [modes_of_a_real_epos4, no_modes])
def test_a_drive_that_runs_csp_without_listing_it_needs_a_key_of_its_profile(
    rig: Rig, unlisted: Callable[[ScriptedBus], None]
) -> None:
    bus = eight_of("cia402")
    unlisted(bus)
    (row,) = (row for row in examined(rig, bus).rows if row.verdict == "wrong")
    assert "csp_unlisted" in row.change
    with pytest.raises(Refused, match="csp_unlisted") as caught:
        set_up(rig, bus)
    assert "6502h" in str(caught.value)
    assert not downloads(bus)
    theirs = with_profile(rig, "epos4")
    bus = eight_of("epos4")
    unlisted(bus)
    assert examined(theirs, bus).good
    set_up(theirs, bus)


def test_a_drive_said_to_run_csp_must_show_it(rig: Rig) -> None:
    bus = eight_of("epos4")
    bus.drives[6].mode_late = 1000  # 6061h stays 0
    with pytest.raises(Refused, match="drive has 0h; 8h is required"):
        set_up(with_profile(rig, "epos4"), bus)
    starts = [m for m in bus.sent if m.arbitration_id == 0 and m.data[0] == 0x01]
    assert not starts, "no drive is started"


@pytest.mark.parametrize("late", [0, 1, 9])
def test_a_mode_that_shows_late_is_waited_for(rig: Rig, late: int) -> None:
    bus = eight_of("cia402")
    bus.drives[6].mode_late = late
    set_up(rig, bus)


def test_a_mode_that_never_shows_is_refused(rig: Rig) -> None:
    bus = eight_of("cia402")
    bus.drives[6].mode_late = 1000
    with pytest.raises(Refused) as caught:
        set_up(rig, bus)
    assert "drive 6, object 6061h" in caught.value.where


OPTIONAL = [(0x1007, 0), (0x1029, 1), (0x605C, 0), (0x605E, 0)]
NOT_THERE = (0x06020000, 0x06090011)
ABORTS = [*NOT_THERE, 0x06010000, 0x06010002, 0x06040041, 0x06040047, 0x06090030, 0x08000000]


@pytest.mark.parametrize("code", ABORTS, ids=hex)
def test_an_optional_object_that_is_refused_is_a_remark(rig: Rig, code: int) -> None:
    bus = eight_of("cia402")
    for node, key in enumerate(OPTIONAL, start=1):
        bus.drives[node].aborts[key] = code
    remarks = set_up(rig, bus)
    for node, (index, sub) in enumerate(OPTIONAL, start=1):
        (remark,) = (each for each in remarks if each.startswith(f"drive {node}: "))
        assert f"{index:04X}h:{sub:02X}" in remark
        assert (f"{code:08X}h" in remark) == (code not in NOT_THERE)
    assert len(remarks) == len(OPTIONAL)


@pytest.mark.parametrize("code", ABORTS, ids=hex)
def test_a_drive_without_a_position_range_has_none_whatever_code_says_so(
    rig: Rig, code: int
) -> None:
    bus = eight_of("cia402")
    bus.drives[3].aborts |= {(0x607B, 1): code, (0x607B, 2): code}
    assert examined(rig, bus).good
    assert set_up(rig, bus) == ()


@pytest.mark.parametrize("code", [0x05040000, *sorted(NOT_NOW)], ids=hex)
def test_a_position_range_that_cannot_be_read_now_is_not_taken_for_none(
    rig: Rig, code: int
) -> None:
    bus = eight_of("cia402")
    bus.drives[3].aborts[0x607B, 2] = code
    assert [row.object[:5] for row in examined(rig, bus).rows if row.verdict == "wrong"] == [
        "607Bh"
    ]
    with pytest.raises(Refused, match="607Bh"):
        set_up(rig, bus)
    assert not downloads(bus)


@pytest.mark.parametrize(
    ("low", "high"), [(-(10**9), -(10**8)), (0, 0), (-(2**31), 2**31 - 1), (10**8, 10**9)], ids=str
)
def test_the_software_limits_never_cross_while_they_are_written(
    rig: Rig, low: int, high: int
) -> None:
    """A drive may abort with 06090036h or go into fault; drive 1 gets -306354 and 385549."""
    bus = eight_of("cia402")
    for drive in bus.drives.values():
        drive.values |= {(0x607D, 1): low, (0x607D, 2): high}
    assert set_up(rig, bus) == ()
    limits = [position_limits(rig, drive, WinchMap(rig)) for drive in range(8)]
    held = [(d.values[0x607D, 1], d.values[0x607D, 2]) for d in bus.drives.values()]
    assert held == limits


@pytest.mark.parametrize("name", ["cia402", *MAKERS])
def test_limits_that_are_not_in_force_are_a_remark_of_every_set_up(rig: Rig, name: str) -> None:
    theirs, bus = with_profile(rig, name), eight_of(name)
    for _ in range(2):
        said = [remark for remark in set_up(theirs, bus) if "607Dh" in remark]
        assert len(said) == (name == "akd")
        assert all(remark.startswith("drive 1, 2, 3, 4, 5, 6, 7, 8: ") for remark in said)


@pytest.mark.parametrize("end", [0, 1])
@pytest.mark.parametrize("beyond", [0, 1])
@pytest.mark.parametrize("word", [0x0217, 0x0250])
def test_no_limits_are_written_to_a_drive_that_holds_its_cable_outside_them(
    rig: Rig, end: int, beyond: int, word: int
) -> None:
    """A drive that monitors its actual position trips with 8612h, and releases its cable."""
    bus = eight_of("cia402")
    limit = position_limits(rig, 4, WinchMap(rig))[end]
    bus.drives[5].values |= {(0x6041, 0): word, (0x6064, 0): limit + (beyond if end else -beyond)}
    if not beyond or word == 0x0250:  # without torque there is nothing to release
        assert set_up(rig, bus) == ()
        return
    with pytest.raises(Refused, match=r"cable 5.*outside its position limits") as caught:
        set_up(rig, bus)
    assert "cdpr home" in caught.value.next_step
    assert caught.value.next_step.endswith("the drives were not changed")
    assert not downloads(bus)


@pytest.mark.parametrize("key", [(0x6065, 0), (0x607D, 1)], ids=str)
@pytest.mark.parametrize("code", ABORTS, ids=hex)
def test_a_required_object_that_is_missing_is_refused_before_anything_is_written(
    rig: Rig, key: tuple[int, int], code: int
) -> None:
    bus = eight_of("cia402")
    bus.drives[3].aborts[key] = code
    assert not examined(rig, bus).good
    with pytest.raises(Refused, match=f"drive 3, object {key[0]:04X}h"):
        set_up(rig, bus)
    assert not downloads(bus)


@pytest.mark.parametrize("first", [0x6077, 0x1017], ids=hex)
@pytest.mark.parametrize("to_reset", [False, True])
def test_what_drives_lack_is_named_at_once_before_a_reset_and_by_the_status(
    rig: Rig, first: int, to_reset: bool
) -> None:
    """The state is read before the set-up, and the first missing object ended it."""
    bus = eight_of("cia402")
    for index in (first, 0x1006, 0x6066, 0x6072):
        bus.drives[3].aborts[index, 0] = 0x06020000
    bus.drives[5].aborts[0x1006, 0] = 0x06020000
    with pytest.raises(Refused) as caught:
        examine.read_states(rig, bus, None, to_reset=to_reset)  # type: ignore[arg-type]
    for missing in (f"drive 3, object {first:04X}h", "drive 3, object 6066h", "object 6072h"):
        assert missing in caught.value.what
    assert "drive 3, 5, object 1006h" in caught.value.what
    assert "the drives were not changed" in caught.value.next_step
    assert not downloads(bus)


@pytest.mark.parametrize("index", UNUSED_PDOS, ids=hex)
@pytest.mark.parametrize("code", ABORTS, ids=hex)
def test_a_pdo_that_is_not_used_may_be_refused_with_any_code(
    rig: Rig, index: int, code: int
) -> None:
    """Only its absence by the book needs no remark."""
    bus = eight_of("cia402")
    bus.drives[3].aborts[index, 1] = code
    remarks = set_up(rig, bus)
    assert len(remarks) == (code not in NOT_THERE)
    for remark in remarks:
        assert remark.startswith(f"drive 3: the drive refuses {index:04X}h:01")
        assert f"{code:08X}h" in remark


@pytest.mark.parametrize("index", UNUSED_PDOS, ids=hex)
@pytest.mark.parametrize("code", sorted(NOT_NOW), ids=hex)
def test_a_pdo_that_is_there_but_not_now_is_refused(rig: Rig, index: int, code: int) -> None:
    bus = eight_of("cia402")
    bus.drives[3].aborts[index, 1] = code
    with pytest.raises(Refused) as caught:
        set_up(rig, bus)
    assert f"drive 3, object {index:04X}h:01" in caught.value.where


def test_a_slow_drive_is_set_up_all_the_same(rig: Rig) -> None:
    """Answers after 0.7 s were attributed to other objects."""
    bus = eight_of("cia402")
    bus.times = lambda node, _key: (0.7,) if node == 3 else (0.001,)
    assert set_up(rig, bus) == ()


def test_doctor_reports_all_objects_of_all_drives_and_writes_nothing(rig: Rig) -> None:
    bus = eight_of("epos4")
    bus.drives[7].values[0x6502, 0] = 0x65
    found = examined(rig, bus)
    assert not found.good
    wrong = {row.object[:8]: row for row in found.rows if row.verdict == "wrong"}
    assert set(wrong) == {"1006h:00", "6072h:00", "6502h:00"}
    assert wrong["1006h:00"].found == {"absent": list(range(1, 9))}
    assert wrong["1006h:00"].change.endswith("epos4")
    assert (
        wrong["6502h:00"].found_text(found.nodes) == "drive 1, 2, 3, 4, 5, 6, 8: 225h; drive 7: 65h"
    )
    assert not downloads(bus)
    assert not [m for m in bus.sent if m.arbitration_id < 0x600], "no NMT, no SYNC, no heartbeat"


@pytest.mark.parametrize("name", ["cia402", *MAKERS])
def test_doctor_finds_nothing_wrong_with_the_right_profile(rig: Rig, name: str) -> None:
    found = examined(with_profile(rig, name), eight_of(name))
    assert found.good, [(row.object, row.found) for row in found.rows if row.verdict == "wrong"]


def with_scale(objects: dict[int, tuple[int, int]]) -> ScriptedBus:
    """Eight drives with these quotients of sub-index 1 and 2; see CiA 402-2, factor group."""
    bus = eight_of("cia402")
    for drive in bus.drives.values():
        for index, values in objects.items():
            for sub, value in enumerate(values, start=1):
                drive.objects[index, sub] = drive.objects[0x1006, 0]  # another UNSIGNED32
                drive.values[index, sub] = value
    return bus


TURN = 131072
"""Counts of a motor turn by the rig file."""


@pytest.mark.parametrize(
    ("objects", "verdict", "text"),
    [
        ({}, "ok", "absent"),
        ({0x608F: (TURN, 1)}, "ok", f"{TURN} from 608Fh"),
        ({0x6092: (10 * TURN, 1), 0x6091: (10, 1)}, "ok", f"{TURN} from 6092h/6091h"),
        ({0x6092: (3 * TURN, 3)}, "ok", f"{TURN} from 6092h/6091h"),
        (
            {0x6092: (TURN, 1), 0x608F: (1 << 22, 1)},
            "ok",
            f"{TURN} from 6092h/6091h, 4194304 from 608Fh",
        ),
        (
            {0x6092: (3600, 1), 0x608F: (2000, 1)},
            "remark",
            "3600 from 6092h/6091h, 2000 from 608Fh",
        ),
        ({0x608F: (TURN + 1, 1)}, "remark", f"{TURN + 1} from 608Fh"),
        ({0x608F: (TURN, 0)}, "ok", "absent"),
    ],
)
def test_doctor_holds_the_drives_scale_against_the_rig_s(
    rig: Rig, objects: dict[int, tuple[int, int]], verdict: str, text: str
) -> None:
    assert {winch.counts_per_rev for winch in rig.document.winches} == {TURN}
    found = examined(rig, with_scale(objects))
    (row,) = (row for row in found.rows if row.object.startswith("6092h"))
    assert (row.verdict, row.found) == (verdict, {text: list(range(1, 9))})
    assert found.good
    assert bool(row.change) == (verdict == "remark")


def keyed(rig: Rig, tmp_path: Path, key: str) -> Rig:
    return with_profile(rig, lab_profile(tmp_path, key))


@pytest.mark.parametrize(
    ("others", "of_five", "key", "named"),
    [
        ({}, {0x6092: (360_000, 1)}, "", None),  # no drive shows that its make means 6064h
        ({0x608F: (TURN, 1)}, {0x6092: (360_000, 1)}, "", "360000 by 6092h/6091h"),
        (
            {0x6092: (TURN, 1)},
            {0x608F: (4096, 1)},
            "",
            "4096 by 608Fh",
        ),  # replaced, at its defaults
        ({0x6092: (TURN, 1)}, {}, "", ""),
        ({}, {0x6092: (360_000, 1)}, "states_scale: true", "360000 by 6092h/6091h"),
        ({0x608F: (TURN, 1)}, {0x6092: (360_000, 1)}, "states_scale: false", ""),
        ({0x608F: (TURN, 1)}, {0x608F: (TURN, 1), 0x6092: (1, 1)}, "", ""),  # not set
        ({0x608F: (TURN, 1)}, {0x608F: (TURN, 1), 0x6092: (7, 7), 0x6091: (10, 1)}, "", ""),
        ({}, {0x6092: (1, 1), 0x6091: (10, 1)}, "states_scale: true", ""),
        (
            {0x6091: (10, 1)},
            {0x6092: (1, 1), 0x608F: (4096, 1)},
            "states_scale: true",
            "4096 by 608Fh",
        ),
        ({0x608F: (TURN, 1)}, {0x608F: (4096, 1), 0x6092: (TURN, 1)}, "", ""),  # another encoder
    ],
)
def test_a_drive_with_another_scale_than_the_rig_file_does_not_move_unannounced(
    rig: Rig,
    tmp_path: Path,
    others: dict[int, tuple[int, int]],
    of_five: dict[int, tuple[int, int]],
    key: str,
    named: str | None,
) -> None:
    """Refused where its make is known to state the scale, or another drive shows it."""
    bus = with_scale(others)
    five = with_scale(of_five).drives[5]
    bus.drives[5] = five
    theirs = keyed(rig, tmp_path, key)
    found = examined(theirs, bus)
    if named:
        assert not found.good
        with pytest.raises(Refused, match=f"the drive has {named}; {TURN} is required") as caught:
            set_up(theirs, bus)
        assert "drive 5, position counts per motor turn" in caught.value.where
        assert "states_scale: false" in caught.value.next_step
        assert "the drives were not changed" in caught.value.next_step
        return
    assert found.good
    said = [remark for remark in set_up(theirs, bus) if "counts per motor turn" in remark]
    if named == "":
        assert said == []
    else:
        (remark,) = said
        stated = "360000 position counts per motor turn by 6092h/6091h"
        assert remark.startswith(f"drive 5: {stated}, and {TURN} by the rig file: compare 6064h")


def test_doctor_reads_the_mode_that_a_set_up_waits_for(rig: Rig) -> None:
    bus = eight_of("cia402")
    bus.drives[5].aborts[0x6061, 0] = 0x06020000
    found = examined(rig, bus)
    assert [row.object[:8] for row in found.rows if row.verdict == "wrong"] == ["6061h:00"]
    assert not found.good
    with pytest.raises(Refused, match="6061h"):
        set_up(rig, bus)


@pytest.mark.parametrize("index", UNUSED_PDOS, ids=hex)
@pytest.mark.parametrize("code", ABORTS, ids=hex)
def test_doctor_reads_the_pdos_that_a_set_up_switches_off(rig: Rig, index: int, code: int) -> None:
    """It reports the same as the configuration: a remark, or nothing."""
    bus = eight_of("cia402")
    bus.drives[3].aborts[index, 1] = code
    found = examined(rig, bus)
    (row,) = (row for row in found.rows if row.object.startswith(f"{index:04X}h:01"))
    assert found.good
    assert row.verdict == ("ok" if code in NOT_THERE else "remark")
    (message,) = (text for text, nodes in row.found.items() if 3 in nodes)
    assert message.startswith("absent" if code in NOT_THERE else "refused: ")


def test_doctor_names_silent_drives_and_reads_the_others(rig: Rig) -> None:
    bus = eight_of("cia402")
    del bus.drives[2]
    found = examined(rig, bus)
    assert (found.silent, len(found.nodes), found.good) == ((2,), 7, False)
    assert found.stopped == ()
    assert found.silent_facts == [((2,), "check power, wiring and node id")]
    stopped, unpowered = replace(found, silent=(2, 5), stopped=(5,)).silent_facts
    assert (stopped[0], "cdpr reset" in stopped[1], unpowered[0]) == ((5,), True, (2,))


@pytest.mark.parametrize(
    ("name", "noticed_by", "millimetres"),
    [("cia402", "SYNC", 0.7), *((make, "heartbeat", 2.1) for make in MAKERS)],
)
def test_without_sync_monitoring_the_platform_goes_further(
    rig: Rig, name: str, noticed_by: str, millimetres: float
) -> None:
    """Heartbeat 100 ms, SYNC 30 ms, both with a ramp of one cycle, at 20 mm/s."""
    theirs = with_profile(rig, name)
    assert lost_master(theirs).noticed_by == noticed_by
    distance = lost_master(theirs).distance
    assert distance == pytest.approx(millimetres / 1000.0)
    for turns, room in ((False, distance), (True, lost_master(theirs).distance_turning)):
        require_stopping_room(theirs, room, 0.0, turns=turns)
        require_stopping_room(theirs, math.inf, math.inf, turns=turns)
        for clearance, coasting in ((0.99 * room, 0.0), (room, 0.01 * room), (math.nan, 0.0)):
            with pytest.raises(Refused, match="without its master"):
                require_stopping_room(theirs, clearance, coasting, turns=turns)


@pytest.mark.parametrize("name", ["rig", "pulley_rig"])
def test_no_point_of_the_platform_travels_farther_than_the_stopping_distance(
    name: str, request: pytest.FixtureRequest
) -> None:
    """Oracle: random twists at the speed along the path, of all corners and anchors."""
    rig: Rig = request.getfixturevalue(name)
    lost, rng = lost_master(rig), np.random.default_rng(5)
    time = lost.distance / rig.motion.speed
    weight = np.sqrt(np.mean(np.sum(rig.anchors**2, axis=1)))
    points = np.concatenate([rig.platform_corners, rig.anchors])
    travels = []
    for _ in range(2000):
        direction = rng.normal(size=6)
        direction *= rig.motion.speed / np.linalg.norm(direction)
        velocity, rotation = direction[:3], direction[3:] / weight
        speeds = np.linalg.norm(velocity + np.cross(rotation, points), axis=1)
        travels.append(time * speeds.max())
    assert lost.distance < max(travels) <= lost.distance_turning
    assert max(travels) > 0.9 * lost.distance_turning, "the bound is tight"


@pytest.mark.parametrize(("mass", "speed"), [(0.4, 0.02), (20.0, 0.5), (60.0, 2.0)])
@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.6, -0.64, 0.48)])
def test_inertia_carries_the_platform_no_farther_than_the_coasting_distance(
    rig: Rig, mass: float, speed: float, direction: tuple[float, float, float]
) -> None:
    """Oracle: a point mass on cables that stretch, and slip on their drums at the largest tension.

    The platform is kept level, as a rotation takes up energy too.
    """
    motion = replace(rig.motion, speed=speed)
    heavy = replace(rig, mass=mass, max_tension=800.0, motion=motion)
    tensions = working_tensions(heavy, heavy.home).tensions
    winches = WinchMap(heavy)
    unstrained = winches.unstrained(cables_at(heavy, heavy.home).lengths, tensions)
    travel, velocity, farthest = np.zeros(3), speed * np.array(direction), 0.0
    step = 5e-5 * math.sqrt(mass)
    while travel @ velocity >= 0.0:
        cables = cables_at(heavy, Pose(heavy.home.position + travel, heavy.home.rotation))
        pull = winches.tensions(unstrained, cables.lengths)
        slipping = pull > heavy.max_tension
        held = winches.unstrained(cables.lengths, np.full(len(pull), heavy.max_tension))
        unstrained = np.where(slipping, held, unstrained)
        force = cables.directions.T @ np.minimum(pull, heavy.max_tension)
        velocity = velocity + step * (force / mass - (0.0, 0.0, STANDARD_GRAVITY))
        travel = travel + step * velocity
        farthest = max(farthest, float(np.linalg.norm(travel)))
    positions, rotations = heavy.home.position[None], heavy.home.rotation[None]
    margin = heavy.at(heavy.home).capacity_margin
    bound = coasting_distance(heavy, (), positions, rotations, margin, turns=False)
    assert 0.0 < farthest <= bound < math.inf
    unheld = coasting_distance(heavy, (), positions, rotations, 0.0, turns=False)
    assert unheld == math.inf


def test_impatient_drives_are_said_to_stop_sooner(rig: Rig, tmp_path: Path) -> None:
    """What the loop and the clearance go by."""
    path = tmp_path / "impatient.yaml"
    path.write_text("name: Ours\nsources: [our bench]\nsync_timeout_periods: 1.5\n")
    theirs = with_profile(rig, str(path))
    settings = BusSettings("virtual", "impatient")
    with open_bus(settings) as bus:
        capabilities = [
            make_drive_group(each, bus).capabilities
            for each in (theirs, rig, with_profile(rig, "epos4"))
        ]
    assert [each.sync_timeout for each in capabilities] == [1.5, 3.0, 3.0]
    assert [each.master_timeout for each in capabilities] == [0.1] * 3
    assert lost_master(theirs).notice == pytest.approx(0.015)


@pytest.mark.parametrize("periods", ["1.0", "11"])
def test_a_sync_time_out_that_no_cycle_can_keep_is_refused(tmp_path: Path, periods: str) -> None:
    path = tmp_path / "lab.yaml"
    path.write_text(f"name: Ours\nsources: [our bench]\nsync_timeout_periods: {periods}\n")
    with pytest.raises(InvalidFile, match="sync_timeout_periods"):
        load_profile(str(path))


@pytest.mark.parametrize(
    ("index", "value"), [(0x1005, 0x81), (0x1014, 0x8000_0083), (0x1014, 0x84)]
)
def test_a_drive_that_hears_another_sync_or_warns_elsewhere_is_refused(
    rig: Rig, index: int, value: int
) -> None:
    """Its positions would never come, its emergencies be unseen."""
    bus = eight_of("cia402")
    bus.drives[3].values[index, 0] = value
    assert not examined(rig, bus).good
    with pytest.raises(Refused, match=f"{value:X}h"):
        set_up(rig, bus)


def test_monitoring_of_sync_is_off_where_its_loss_would_be_a_fault(
    tmp_path: Path, rig: Rig
) -> None:
    path = tmp_path / "lab.yaml"
    path.write_text("name: Ours\nsources: [our bench]\nmonitoring: heartbeat\n")
    bus = eight_of("cia402")
    set_up(with_profile(rig, str(path)), bus)
    assert {drive.values[0x1006, 0] for drive in bus.drives.values()} == {0}
    assert {drive.values[0x1016, 1] for drive in bus.drives.values()} == {0x7F0064}


def test_a_drive_without_heartbeat_consumer_is_stopped_by_sync_alone(
    tmp_path: Path, rig: Rig
) -> None:
    path = tmp_path / "lab.yaml"
    path.write_text('name: Ours\nsources: [our bench]\nabsent: ["1016h:01"]\n')
    rig, bus = with_profile(rig, str(path)), eight_of("cia402")
    for drive in bus.drives.values():
        drive.aborts[0x1016, 0] = 0x06020000
    assert examined(rig, bus).good
    (remark,) = set_up(rig, bus)
    assert "SYNC time-out alone" in remark
    assert not [d for d in downloads(bus) if d.data[1:3] == b"\x16\x10"]


@pytest.mark.parametrize("entries", [0, 1, 8])
def test_drives_that_let_go_without_a_heartbeat_are_given_none(
    tmp_path: Path, rig: Rig, entries: int
) -> None:
    path = tmp_path / "lab.yaml"
    path.write_text("name: Ours\nsources: [our bench]\nheartbeat_loss: fault\n")
    rig, bus = with_profile(rig, str(path)), eight_of("cia402")
    for drive in bus.drives.values():
        drive.values[0x1016, 0] = entries
        for sub in range(1, entries + 1):
            drive.values[0x1016, sub] = 0x7F0064
    assert examined(rig, bus).good
    (remark,) = set_up(rig, bus)
    assert "monitor none" in remark
    for drive in bus.drives.values():
        assert [drive.values[0x1016, sub] for sub in range(1, entries + 1)] == [0] * entries


ABSENT_SUB, FIXED = 0x06090011, 0x06010002


@pytest.mark.parametrize(
    ("code", "left", "kept"),
    [(None, 0x050032, 0), (ABSENT_SUB, 0, 0), (FIXED, 0, 0), (FIXED, 0x050032, None)],
)
def test_entries_of_another_program_that_are_not_used_are_cleared(
    tmp_path: Path, rig: Rig, code: int | None, left: int, kept: int | None
) -> None:
    """The loss of a node that no longer exists would stop the drive, in a run or after its end."""
    theirs = with_profile(rig, lab_profile(tmp_path, "heartbeat_entries: 2"))
    bus = eight_of("cia402")
    third = bus.drives[3]
    third.values[0x1016, 0] = 8
    third.values |= {(0x1016, sub): left for sub in range(1, 9)}
    if code == FIXED:
        third.objects[0x1016, 5] = third.objects[0x1000, 0]  # read-only
    elif code:
        third.aborts |= {(0x1016, sub): code for sub in range(3, 9)}
    if kept is None:
        with pytest.raises(Refused, match="drive 3, object 1016h:05"):
            set_up(theirs, bus)
        return
    assert all("1016h has 2 heartbeat entries" in remark for remark in set_up(theirs, bus))
    entries = [third.values[0x1016, sub] for sub in range(1, 9)]
    assert entries == [0x7F0064, 0x010064, *[kept] * 6]


def test_an_unknown_profile_lists_those_there_are(rig: Rig) -> None:
    with pytest.raises(BadInput) as caught:
        settings_for(with_profile(rig, "epos5"), 0, WinchMap(rig))
    assert "epos4" in caught.value.next_step


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ('absent: ["6073h:00"]', "6072h:00"),
        ("abscent: []", "absent"),
        ('absent: ["605Ah:00"]', "required for a safe run"),
        ('absent: ["1006h:00"]', "heartbeat"),
        ('heartbeat_loss: fault\nmonitoring: heartbeat\nabsent: ["1006h:00"]', "remove torque"),
        ('absent: ["6072h:00"]', "torque_limit"),
        ('absent: ["6085h:00"]', "required for a safe run"),
        ('absent: ["1016h:01"]\nmonitoring: heartbeat', "needs 1016h:01"),
        ('absent: ["1006h:00", "1016h:01"]', "nothing stops it when the master is lost"),
        ("communication_cycle_period: 10000", "cycle"),
        (
            'communication_cycle_period: cycle\nmonitoring: heartbeat\nabsent: ["1006h:00"]',
            "needs 1006h:00",
        ),
        ('torque_limit: {object: "207Fh:00", bytes: 2}', "207Fh:00 needs rated or rated_value"),
        (
            'torque_limit: {object: "6073h:00", rated: "6075h:00", rated_value: 819}',
            "exclude each other",
        ),
        ('torque_limit: {object: "207Fh:00", rated_value: 0}', "rated_value: must be 10 or more"),
        ('torque_limit: {object: "207Fh:00", rated_value: 5.4}', "too coarse; it is 5.4"),
        (
            'torque_limit: {object: "6072h:00", bytes: 2, rated_value: 819}\nabsent: ["6072h:00"]',
            "torque_limit.object: this program writes 6072h:00 itself",
        ),
        (
            'torque_limit: {object: "6065h:00", rated_value: 100}\nabsent: ["6072h:00"]',
            "torque_limit.object: this program writes 6065h:00 itself",
        ),
        (
            'torque_limit: {object: "6073h:00", rated: "6066h:00"}\nabsent: ["6072h:00"]',
            "torque_limit.rated: this program writes 6066h:00 itself",
        ),
        (
            'torque_limit: {object: "6073h:00", rated: "6073h:00"}\nabsent: ["6072h:00"]',
            "torque_limit.rated: this program writes 6073h:00 itself",
        ),
        (
            'expect: [{object: "1007h:00", value: 0, name: x, why: y}]\nabsent: ["1007h:00"]',
            "1007h:00 is in absent",
        ),
        ('warnings: ["31"]', "3180h"),
        ('warnings: ["3180h", "81xxh"]', "includes 8130h"),
        ('warnings: ["8612h"]', "includes 8612h"),
        ('ranges: {"60C3h:02": {low: 0, high: 1}}', "60C2h:02"),
    ],
)
def test_a_wrong_profile_file_says_what_where_and_what_there_is(
    tmp_path: Path, line: str, message: str
) -> None:
    path = tmp_path / "lab.yaml"
    path.write_text(f"name: Ours\nsources: [our bench]\n{line}\n")
    with pytest.raises(InvalidFile) as caught:
        load_profile(str(path))
    text = str(caught.value)
    assert message in text
    assert "lab.yaml:3" in text or ":3:" in text


def expecting(tmp_path: Path, name: str, lines: str) -> str:
    expected = f'expect: [{{object: "{name}", value: 1, name: x, why: y}}]'
    return lab_profile(tmp_path, f"{lines}\n{expected}")


MAKERS_LIMIT = 'absent: ["6072h:00"]\ntorque_limit: {object: "207Fh:00", rated_value: 819}'


@pytest.mark.parametrize("lines", ["", "rpdo: 4\ntpdo: 3", MAKERS_LIMIT])
def test_no_profile_expects_a_value_of_an_object_that_the_program_writes(
    rig: Rig, tmp_path: Path, lines: str
) -> None:
    """The value was required before the set-up, and then overwritten."""
    theirs = with_profile(rig, lab_profile(tmp_path, lines))
    settings = (*settings_for(theirs, 0, WinchMap(theirs)), *heartbeat_consumers(theirs, 0, 2))
    written = {(setting.index, setting.sub) for setting in settings}
    written |= {(index, 1) for index in UNUSED_PDOS}
    written |= {(job.index, job.sub) for job in monitoring_off(2)} - {(0x1400, 5)}
    written |= {(0x6040, 0), (0x607A, 0)}
    for index, sub in sorted(written):
        name = f"{index:04X}h:{sub:02X}"
        with pytest.raises(InvalidFile, match=f"this program writes {name} itself"):
            load_profile(expecting(tmp_path, name, lines))


@pytest.mark.parametrize(
    ("name", "keys"),
    [
        ("1006h:00", "monitoring and communication_cycle_period"),
        ("1016h:02", "heartbeat_entries and heartbeat_loss"),
        ("1A00h:02", "rpdo and tpdo"),
        ("6085h:00", "acceleration_unit and acceleration_step"),
        ("6007h:00", "ranges"),
        ("1007h:00", "absent or ranges"),
        ("207Fh:00", "torque_limit and cables.max_tension_n of the rig file"),
    ],
)
def test_the_refusal_of_an_expected_object_names_the_keys_that_control_it(
    tmp_path: Path, name: str, keys: str
) -> None:
    with pytest.raises(InvalidFile) as caught:
        load_profile(expecting(tmp_path, name, MAKERS_LIMIT))
    assert f"this program writes {name} itself: use {keys} instead\n" in str(caught.value)


@pytest.mark.parametrize(
    "name", ["60A8h:00", "607Eh:00", "1016h:00", "1401h:02", "1601h:01", "1800h:05", "1A00h:04"]
)
def test_a_profile_expects_values_of_objects_that_are_only_read(tmp_path: Path, name: str) -> None:
    (expected,) = load_profile(expecting(tmp_path, name, "")).expect
    assert expected.object == name


@pytest.mark.parametrize("monitoring", ["sync", "heartbeat"])
def test_a_drive_that_synchronises_by_1006h_keeps_the_cycle_there(
    rig: Rig, tmp_path: Path, monitoring: str
) -> None:
    """0 ends the synchronisation to SYNC in some makes; the heartbeat stops the drive all the same.

    Sources: Infranor XtraPulsGEM and CD1-k manuals, object 1006h; Bonfiglioli CM-CAN, page 57.
    """
    lines = f"monitoring: {monitoring}\ncommunication_cycle_period: cycle"
    theirs, bus = with_profile(rig, lab_profile(tmp_path, lines)), eight_of("cia402")
    for drive in bus.drives.values():
        drive.values[0x1006, 0] = 10_000
    (row,) = (row for row in examined(theirs, bus).rows if row.object.startswith("1006h"))
    assert (row.verdict, row.needed) == ("ok", "10000, written at configuration")
    set_up(theirs, bus)
    assert {drive.values[0x1006, 0] for drive in bus.drives.values()} == {10_000}
    written = [d.data[4:] for d in downloads(bus) if d.data[1:4] == b"\x06\x10\0"]
    assert {int.from_bytes(data, "little") for data in written} == {10_000}
    lost = lost_master(theirs)
    by_heartbeat = ("heartbeat", pytest.approx(0.1))
    assert (lost.noticed_by, lost.notice) == (
        by_heartbeat if monitoring == "heartbeat" else ("SYNC", pytest.approx(0.03))
    )


def test_a_profile_of_the_lab_is_used(tmp_path: Path, rig: Rig) -> None:
    path = tmp_path / "lab.yaml"
    path.write_text('name: Ours\nsources: [our bench]\nabsent: ["1400h:05"]\nwarnings: ["33xxh"]\n')
    assert load_profile(str(path)).is_warning(0x33F0)
    assert not load_profile(str(path)).is_warning(0x3210)
    written = {
        (s.index, s.sub) for s in settings_for(with_profile(rig, str(path)), 0, WinchMap(rig))
    }
    assert (0x1400, 5) not in written


def test_a_profile_of_the_lab_is_read_again_after_it_was_edited(tmp_path: Path, rig: Rig) -> None:
    """Between two runs of one notebook; the real-time process reads it as well."""
    path = tmp_path / "lab.yaml"
    text = (FOLDER / "cia402.yaml").read_text(encoding="utf-8")
    path.write_text(text, encoding="utf-8")
    before = profile_of(with_profile(rig, str(path)))
    assert profile_of(with_profile(rig, str(path))) is before
    path.write_text(f"{text}\nsdo_timeout_ms: {before.sdo_timeout_ms + 100}\n", encoding="utf-8")
    assert profile_of(with_profile(rig, str(path))).sdo_timeout_ms == before.sdo_timeout_ms + 100
    path.unlink()
    with pytest.raises(BadInput, match=r"cannot be read|no such file"):
        profile_of(with_profile(rig, str(path)))


def lab_profile(tmp_path: Path, lines: str) -> str:
    path = tmp_path / "lab.yaml"
    path.write_text(f"name: Ours\nsources: [our bench]\n{lines}\n")
    return str(path)


def test_process_data_can_be_others_than_the_first(rig: Rig, tmp_path: Path) -> None:
    """PDO mappings of some makes are fixed but for one; the first ones are switched off before."""
    bus = eight_of("cia402")
    for drive in bus.drives.values():
        for base in (0x1400, 0x1600, 0x1800, 0x1A00):
            of_first = {key: od for key, od in drive.objects.items() if key[0] == base}
            for (_, sub), od in of_first.items():
                for number in (1, 2, 3):
                    drive.objects[base + number, sub] = od
                    drive.values[base + number, sub] = 0
        drive.values[0x1400, 1] = 0x200 + drive.node
    set_up(with_profile(rig, lab_profile(tmp_path, "rpdo: 4\ntpdo: 3")), bus)
    for node, drive in bus.drives.items():
        values = drive.values
        assert values[0x1403, 1] == 0x200 + node
        assert values[0x1802, 1] & 0x3FFFFFFF == 0x180 + node
        assert [values[0x1603, sub] for sub in range(3)] == [2, 0x60400010, 0x607A0020]
        assert values[0x1A02, 0] == 3
        off = (0x1400, 0x1401, 0x1402, 0x1800, 0x1801, 0x1803)
        assert all(values[index, 1] & 1 << 31 for index in off)
    written = [struct.unpack_from("<HB", m.data, 1) for m in downloads(bus)]
    assert not [key for key in written if key[0] in (0x1600, 0x1A00)]
    of_one = [
        struct.unpack_from("<HB", m.data, 1) for m in downloads(bus) if m.arbitration_id == 0x601
    ]
    switched_on = len(of_one) - 1 - of_one[::-1].index((0x1403, 1))
    assert of_one.index((0x1400, 1)) < switched_on, "no identifier is there twice"


def test_the_deadline_of_the_pdo_in_use_is_the_one_that_ends() -> None:
    keys = [(job.index, job.sub) for job in monitoring_off(1, rpdo=4)]
    assert keys == [(0x1016, 1), (0x1403, 5), (0x1006, 0)]


def test_process_data_beyond_the_fourth_is_switched_off(rig: Rig) -> None:
    """A fifth RPDO on another drive's identifier would take that drive's set-points."""
    bus = eight_of("cia402")
    for index, identifier in ((0x1404, 0x205), (0x1405, 0x206), (0x1804, 0x1C3)):
        bus.drives[3].objects[index, 1] = bus.drives[3].objects[0x1400, 1]
        bus.drives[3].values[index, 1] = identifier
    assert {row.object[:8] for row in examined(rig, bus).rows} >= {"1405h:01", "1804h:01"}
    assert set_up(rig, bus) == ()
    for index in (0x1404, 0x1405, 0x1804):
        assert bus.drives[3].values[index, 1] & 1 << 31


@pytest.mark.parametrize("held", [0, 20_000])
def test_an_object_that_the_profile_denies_must_not_hold_another_value(
    rig: Rig, tmp_path: Path, held: int
) -> None:
    """A value written by an earlier program would be active unnoticed."""
    bus = eight_of("cia402")
    for drive in bus.drives.values():
        drive.values[0x1006, 0] = 0
    bus.drives[5].values[0x1006, 0] = held
    lines = 'absent: ["1006h:00"]\nmonitoring: heartbeat'
    theirs = with_profile(rig, lab_profile(tmp_path, lines))
    (row,) = (row for row in examined(theirs, bus).rows if row.object.startswith("1006h"))
    assert row.verdict == ("wrong" if held else "ok")
    if not held:
        set_up(theirs, bus)
        return
    with pytest.raises(Refused, match="the profile declares it absent") as caught:
        set_up(theirs, bus)
    assert caught.value.values["node"] == 5
    assert not downloads(bus)


@pytest.mark.parametrize(
    ("lines", "counts_per_s2"),
    [
        ("acceleration_unit: counts/s^2", 1.0),
        ("acceleration_unit: counts/s^2\nacceleration_step: 10", 10.0),
        ("acceleration_unit: rev/s^2", 131_072.0),
        ("acceleration_unit: rpm/s", 131_072.0 / 60.0),
        ("acceleration_unit: rpm/s\nacceleration_step: 0.1", 13_107.2 / 60.0),
    ],
)
def test_the_ramp_of_a_quick_stop_is_in_the_unit_of_the_make(
    rig: Rig, tmp_path: Path, lines: str, counts_per_s2: float
) -> None:
    theirs = with_profile(rig, lab_profile(tmp_path, lines))
    found = {s.index: s.value for s in settings_for(theirs, 0, WinchMap(theirs))}[0x6085]
    needed = rig.winches[0].max_speed / 0.01 * abs(rig.winches[0].counts_per_metre)
    assert found == math.ceil(needed / counts_per_s2)


def test_a_drive_with_a_slow_heartbeat_is_waited_for_by_its_peers_alone(
    rig: Rig, tmp_path: Path
) -> None:
    lines = 'ranges: {"1017h:00": {low: 100, high: 65535}}'
    theirs = with_profile(rig, lab_profile(tmp_path, lines))
    found = {s.index: s.value for s in settings_for(theirs, 0, WinchMap(theirs))}
    assert found[0x1017] == 100
    assert [s.value & 0xFFFF for s in heartbeat_consumers(theirs, 0, 3)][3:] == [100, 320, 320]


def test_doctor_names_what_a_profile_of_ones_own_says(rig: Rig) -> None:
    """Not another maker's profile, which would write objects of that maker."""
    bus = eight_of("cia402")
    for key in ((0x1006, 0), (0x6066, 0), (0x6007, 0)):
        bus.drives[2].aborts[key] = 0x06020000
    change = {row.object[:8]: row.change for row in examined(rig, bus).rows}
    assert change["6066h:00"] == "list it as absent in your own drive profile"
    assert change["1006h:00"].startswith("list it as absent in your own drive profile, with")
    assert "monitoring: heartbeat" in change["1006h:00"]
    assert "no profile" in change["6007h:00"]


UNMONITORED = "use another drive: nothing stops this one when the master is lost"


@pytest.mark.parametrize(
    ("lines", "absent"),
    [
        ("", ["1006h:00", "1016h:00"]),
        ("monitoring: heartbeat", ["1006h:00", "1016h:00"]),
        ('absent: ["1006h:00"]\nmonitoring: heartbeat', ["1016h:00"]),
        ('absent: ["1016h:01"]', ["1006h:00"]),
        ("heartbeat_loss: fault", ["1006h:00"]),
    ],
)
def test_doctor_sees_that_nothing_would_stop_a_drive_without_its_master(
    rig: Rig, tmp_path: Path, lines: str, absent: list[str]
) -> None:
    """Each line named the other object as the solution; both absent were refused."""
    bus = eight_of("cia402")
    for drive in bus.drives.values():
        drive.aborts |= dict.fromkeys([(0x1006, 0), (0x1016, 0), (0x1016, 1)], 0x06020000)
    rows = examined(with_profile(rig, lab_profile(tmp_path, lines)), bus).rows
    wrong = {row.object[:8]: row.change for row in rows if row.verdict == "wrong"}
    assert wrong == dict.fromkeys(absent, UNMONITORED)


@pytest.mark.parametrize(
    ("missing", "step"),
    [
        (0x1006, "list it as absent in your own drive profile, with monitoring: heartbeat"),
        (0x1016, "list it as absent in your own drive profile, with monitoring: sync"),
    ],
    ids=["1006h", "1016h"],
)
@pytest.mark.parametrize("other", [None, 0x08000022], ids=["present", "not now"])
def test_doctor_names_the_other_object_that_stops_a_drive(
    rig: Rig, missing: int, step: str, other: int | None
) -> None:
    bus = eight_of("cia402")
    for drive in bus.drives.values():
        drive.aborts[missing, 0] = 0x06020000
        if other is not None:
            drive.aborts[0x1006 if missing == 0x1016 else 0x1016, 0] = other
    change = {row.object[:8]: row.change for row in examined(rig, bus).rows}
    assert change[f"{missing:04X}h:00"].startswith(step)


@pytest.mark.parametrize(
    ("lines", "lacks", "wrong"),
    [
        ("", True, {"1006h:00": UNMONITORED, "1016h:00": UNMONITORED}),
        ('absent: ["1006h:00"]\nmonitoring: heartbeat', True, {"1016h:00": UNMONITORED}),
        (
            "",
            False,
            {
                "1016h:00": "list it as absent in your own drive profile, with monitoring: sync;"
                " the SYNC time-out alone then stops the drive"
            },
        ),
    ],
)
def test_a_drive_without_heartbeat_entries_is_as_one_without_their_object(
    rig: Rig, tmp_path: Path, lines: str, lacks: bool, wrong: dict[str, str]
) -> None:
    """It was sent to a profile that is refused, or was "not safe to run" although it is."""
    bus = eight_of("cia402")
    for drive in bus.drives.values():
        drive.values[0x1016, 0] = 0
        drive.aborts |= {(0x1006, 0): 0x06020000} if lacks else {}
    rows = examined(with_profile(rig, lab_profile(tmp_path, lines)), bus).rows
    assert {row.object[:8]: row.change for row in rows if row.verdict == "wrong"} == wrong
    if not lacks:
        assert examined(with_profile(rig, lab_profile(tmp_path, 'absent: ["1016h:01"]')), bus).good


@pytest.mark.parametrize(
    ("absent", "said"), [("[]", "unused (communication_cycle_period)"), ('["1006h:00"]', "unused")]
)
def test_doctor_names_a_key_of_1006h_only_where_the_profile_may_have_it(
    rig: Rig, tmp_path: Path, absent: str, said: str
) -> None:
    lines = f"absent: {absent}\nmonitoring: heartbeat"
    rows = examined(with_profile(rig, lab_profile(tmp_path, lines)), eight_of("cia402")).rows
    (row,) = (row for row in rows if row.object.startswith("1006h"))
    assert row.meaning == f"{said}: the heartbeat stops the drive"


def test_the_texts_on_supported_modes_name_no_make(rig: Rig) -> None:
    """Technosoft iPOS has CSP since 2017: manual P091.063.iPOS.STO.UM.0117, section 10."""
    bus = eight_of("cia402")
    for drive in bus.drives.values():
        drive.values[0x6502, 0] = 0x65
    (row,) = (row for row in examined(rig, bus).rows if row.object.startswith("6502h"))
    for text in (row.meaning, row.change):
        assert "Technosoft" not in text
        assert "Pilz" not in text
        assert "csp_unlisted: true" in text


def test_doctor_names_the_keys_for_process_data_that_cannot_be_mapped(rig: Rig) -> None:
    """A PDO1 with the fixed mapping of CiA 402; "no profile can replace it" was said of it."""
    bus = eight_of("cia402")
    for drive in bus.drives.values():
        drive.aborts |= dict.fromkeys([(0x1600, 2), (0x1A00, 2), (0x1A00, 3)], 0x06020000)
    change = {row.object[:8]: row.change for row in examined(rig, bus).rows}
    assert "as `rpdo` in your own drive profile" in change["1600h:02"]
    assert "as `tpdo` in your own drive profile" in change["1A00h:02"]
    assert "as `tpdo` in your own drive profile" in change["1A00h:03"]


def test_doctor_names_what_asks_for_a_missing_object(rig: Rig) -> None:
    """A profile of a sibling drive, and the identity in the rig file."""
    document = with_profile(rig, "epos4").document.model_dump()
    document["drives"] |= {"vendor_id": 1, "product_code": 2}
    theirs = rig_from_document(RigDocument.model_validate(document))
    bus = eight_of("epos4")
    asked = {(0x60A8, 0): "`expect`", (0x3001, 1): "`torque_limit`"}
    asked |= {(0x1018, 1): "remove vendor_id", (0x1018, 2): "remove product_code"}
    for drive in bus.drives.values():
        drive.aborts |= dict.fromkeys(asked, 0x06020000)
    change = {row.object[:8]: row.change for row in examined(theirs, bus).rows}
    for (index, sub), said in asked.items():
        assert said in change[f"{index:04X}h:{sub:02X}"]


@pytest.mark.parametrize(
    ("key", "kept", "said"),
    [
        ((0x1400, 1), 0x208, "the drive has 00000208h; 80000201h is required"),
        ((0x1600, 1), 0x60410010, "the drive has 60410010h; 60400010h is required"),
        ((0x1016, 1), 0x7F0065, "the drive has 007F0065h; 007F0064h is required"),
        ((0x1017, 0), 31, "the drive has 31; 30 is required"),
    ],
)
def test_refusals_print_identifiers_as_manuals_do(
    rig: Rig, key: tuple[int, int], kept: int, said: str
) -> None:
    bus = eight_of("cia402")
    bus.drives[1].keeps[key] = kept
    with pytest.raises(Refused, match=said):
        set_up(rig, bus)


def test_doctor_prints_mappings_as_manuals_do(rig: Rig) -> None:
    (row,) = (row for row in examined(rig, eight_of("cia402")).rows if row.object[:8] == "1600h:02")
    assert row.needed == "607A0020h, written at configuration"


@pytest.mark.parametrize("word", [0x0240, 0x0040])
def test_doctor_says_what_may_keep_a_drive_from_being_enabled(rig: Rig, word: int) -> None:
    bus = eight_of("cia402")
    for drive in bus.drives.values():
        drive.values[0x6041, 0] = 0x0250
    bus.drives[4].values[0x6041, 0] = word
    (row,) = (row for row in examined(rig, bus).rows if row.object.startswith("6041h"))
    assert row.verdict == "remark"
    assert "voltage enabled" in row.change
    assert "or the drive does not use this bit" in row.change
    assert "remote" not in row.change


def test_bit_9_is_not_judged_before_nmt_start(rig: Rig) -> None:
    """Many drives set it in NMT operational; doctor and status named a panel for a healthy one."""
    bus = eight_of("cia402")
    for drive in bus.drives.values():
        drive.values[0x6041, 0] = 0x0050
    (row,) = (row for row in examined(rig, bus).rows if row.object.startswith("6041h"))
    assert row.verdict == "ok"
    assert set(examine.read_states(rig, bus, None).errors) == {""}  # type: ignore[arg-type]


def test_doctor_and_status_read_the_bits_of_power_as_the_profile_says(
    rig: Rig, tmp_path: Path
) -> None:
    bus, theirs = eight_of("cia402"), with_profile(rig, lab_profile(tmp_path, "power_bits: false"))
    for drive in bus.drives.values():
        drive.values[0x6041, 0] = 0x0740
    (row,) = (row for row in examined(theirs, bus).rows if row.object.startswith("6041h"))
    assert row.verdict == "ok"
    assert set(examine.read_states(theirs, bus, None).errors) == {""}  # type: ignore[arg-type]


def errors_of(bus: ScriptedBus, code: int | None, history: int | None) -> None:
    """Drive 5 is in fault, with 603Fh and 1003h:01, or without either; the others have power."""
    for drive in bus.drives.values():
        drive.values[0x6041, 0] = 0x0250
    drive = bus.drives[5]
    drive.values[0x6041, 0] = 0x0218
    drive.objects[0x1003, 1] = drive.objects[0x1006, 0]
    for key, value in (((0x603F, 0), code), ((0x1003, 1), history)):
        drive.values[key] = value or 0
        if value is None:
            drive.aborts[key] = 0x06020000


def test_a_drive_at_rest_says_what_keeps_it_from_being_enabled(rig: Rig) -> None:
    """With its safe torque off active it was in "switch on disabled", without a reason."""
    bus = eight_of("cia402")
    for drive in bus.drives.values():
        drive.values[0x6041, 0] = 0x0250
    bus.drives[5].values[0x6041, 0] = 0x0240
    errors = examine.read_states(rig, bus, None).errors  # type: ignore[arg-type]
    assert [number for number, error in enumerate(errors, 1) if error] == [5]
    assert "safe torque off (STO)" in errors[4]


STORED = [
    (0x3210, 0x12344310, "DC link over-voltage (error 3210h)"),
    (0, 0x12344310, "drive temperature too high (error 4310h)"),
    (None, 0x12344310, "drive temperature too high (error 4310h)"),
    (0x3210, None, "DC link over-voltage (error 3210h)"),
    (None, None, ""),
]


@pytest.mark.parametrize(("code", "history", "said"), STORED)
def test_a_fault_is_explained_by_what_the_drive_stores(
    rig: Rig, code: int | None, history: int | None, said: str
) -> None:
    bus = eight_of("cia402")
    errors_of(bus, code, history)
    (row,) = (row for row in examined(rig, bus).rows if row.object.startswith("6041h"))
    assert row.found[f"fault: {said}" if said else "fault"] == [5]
    assert examine.read_states(rig, bus, None).errors == ("",) * 4 + (said,) + ("",) * 3  # type: ignore[arg-type]
    with pytest.raises(Refused) as caught:
        set_up(rig, bus)
    assert caught.value.what == "drive 5 is in fault" + (f": {said}" if said else "")
    set_up(rig, bus, to_reset=True)


def test_every_profile_names_its_sources() -> None:
    for name in profile_names():
        assert load_profile(name).sources, name
    assert issubclass(InvalidFile, CdprError)


class Interrupted(ScriptedBus):
    """Another frame comes before the answer to one of drive 1's writes; a boot-up is drive 8's."""

    def __init__(self, before: ScriptedBus, profile: str, number: int, frame: can.Message) -> None:
        super().__init__(ScriptedDrive(node, eds_of(profile)) for node in before.drives)
        self.profile, self.left, self.frame = profile, number, frame
        for node, drive in self.drives.items():
            drive.values = dict(before.drives[node].values)

    def send(self, message: can.Message) -> None:
        if message.arbitration_id == 0x601 and message.data[0] & 0xE0 == 0x20:
            self.left -= 1
            if self.left == 0:
                self._receive(0.0005, self.frame.arbitration_id, bytes(self.frame.data))
                if self.frame.arbitration_id == 0x708:
                    self.drives[8] = ScriptedDrive(8, eds_of(self.profile))
        super().send(message)


@pytest.mark.parametrize(
    ("profile", "frame", "words"),
    [
        ("elmo-gold", "708#00", "drive 8 restarted during set-up"),
        ("epos4", "202#0F0000000000", "another program sends set-points to drive 2"),
    ],
)
def test_a_restart_or_another_master_is_refused_at_every_write(
    rig: Rig, profile: str, frame: str, words: str
) -> None:
    """During the write of an optional object it passed for one that cannot be written."""
    identifier, data = frame.split("#")
    sent = can.Message(arbitration_id=int(identifier, 16), data=bytes.fromhex(data))
    theirs, bus = with_profile(rig, profile), eight_of(profile)
    for _ in range(2):
        bus.sent.clear()
        set_up(theirs, bus)
    writes = [m for m in downloads(bus) if m.arbitration_id == 0x601]
    for number, write in enumerate(writes, 1):
        reported: list[tuple[int, ...]] = []
        with pytest.raises(Refused) as caught:
            set_up(theirs, Interrupted(bus, profile, number, sent), on_restarted=reported.append)
        assert caught.value.what == words, write
        assert reported == ([(), (8,)] if identifier == "708" else [()]), write


class HoldingDrive(ScriptedDrive):
    """Refuses 6060h while it holds; some makes change the mode only without torque."""

    def _write(self, key: tuple[int, int], data: bytes) -> int:
        if key == (0x6060, 0) and self.values[0x6041, 0] == 0x0217:
            return 0x08000022
        return super()._write(key, data)


@pytest.mark.parametrize("to_reset", [True, False])
def test_a_mode_that_cannot_be_written_under_torque_must_be_the_required_one(
    rig: Rig, to_reset: bool
) -> None:
    bus = ScriptedBus(HoldingDrive(node, eds_of("cia402")) for node in range(1, 9))
    set_up(rig, bus)
    for drive in bus.drives.values():
        drive.values[0x6041, 0] = 0x0217
    assert set_up(rig, bus, to_reset=to_reset) == (), "after a motion the drives hold in this mode"
    bus.drives[4].mode_late = 100
    with pytest.raises(Refused, match="6061h"):
        set_up(rig, bus, to_reset=to_reset)
    bus.drives[4].values[0x6060, 0], bus.drives[4].mode_late = 1, 0
    with pytest.raises(Refused, match="present device state") as caught:
        set_up(rig, bus, to_reset=to_reset)
    assert "drive 4, object 6060h:00" in caught.value.where


@pytest.mark.parametrize(
    ("share", "allowed"),
    [
        (0.98, False),
        (0.9899, False),
        (0.9902, True),
        (1.0001, True),
        (1.0999, True),
        (1.101, False),
    ],
)
def test_a_drive_may_round_the_ramp_of_its_quick_stop(
    rig: Rig, share: float, allowed: bool
) -> None:
    """An amplifier in steps of 128 counts/s^2 keeps 1272000 for 1272174."""
    bus = eight_of("cia402")
    (ramp,) = [s.value for s in settings_for(rig, 3, WinchMap(rig)) if s.index == 0x6085]
    bus.drives[4].keeps[0x6085, 0] = round(share * ramp)
    if allowed:
        assert set_up(rig, bus) == ()
        return
    with pytest.raises(Refused, match=f"{ramp} is required"):
        set_up(rig, bus)


def with_max_current(rig: Rig, tmp_path: Path, keys: str) -> tuple[Rig, ScriptedBus]:
    """6073h as in the standard instead of 6072h: 16 bits, per mille of rated current (6075h).

    The profile of the rig states it with these keys.
    """
    line = f'torque_limit: {{object: "6073h:00", {keys}}}\nabsent: ["6072h:00"]'
    theirs, bus = with_profile(rig, lab_profile(tmp_path, line)), eight_of("cia402")
    for drive in bus.drives.values():
        drive.objects[0x6073, 0] = drive.objects.pop((0x6072, 0))
        drive.values[0x6073, 0] = 1000
        drive.objects[0x6075, 0], drive.values[0x6075, 0] = drive.objects[0x6085, 0], 4200
    return theirs, bus


@pytest.mark.parametrize(
    ("keys", "limit"), [("", 1200), (', rated: "6075h:00"', 5040)], ids=["per mille", "as rated"]
)
def test_a_current_limit_of_16_bits_is_set(rig: Rig, tmp_path: Path, keys: str, limit: int) -> None:
    """1200 per mille: 100 N at rated torque, 100 N allowed, a fifth in reserve."""
    theirs, bus = with_max_current(rig, tmp_path, f"bytes: 2{keys}")
    assert examined(theirs, bus).good
    set_up(theirs, bus)
    assert {drive.values[0x6073, 0] for drive in bus.drives.values()} == {limit}


@pytest.mark.parametrize(("rated", "limit"), [("819", 983), ("10.1", 13), ("54000", 64800)])
def test_a_current_limit_in_a_unit_that_no_object_states_is_set(
    rig: Rig, tmp_path: Path, rated: str, limit: int
) -> None:
    """Per mille were written to it unnoticed, as of the drive's peak current of 40 A."""
    theirs, bus = with_max_current(rig, tmp_path, f"bytes: 2, rated_value: {rated}")
    (row,) = (row for row in examined(theirs, bus).rows if row.object.startswith("6073h"))
    assert row.needed == f"{limit}, written at configuration"
    set_up(theirs, bus)
    assert {drive.values[0x6073, 0] for drive in bus.drives.values()} == {limit}


def test_a_current_limit_beyond_its_size_is_refused_before_anything_is_written(
    rig: Rig, tmp_path: Path
) -> None:
    """Doctor said ok; the set-up ended after 38 objects of the first drive, without its state."""
    theirs, bus = with_max_current(rig, tmp_path, "bytes: 2, rated_value: 60000")
    for does in (examined, set_up):
        with pytest.raises(BadInput, match="6073h:00 current limit cannot hold 72000") as caught:
            does(theirs, bus)
        assert "`bytes`" in caught.value.next_step
    assert not downloads(bus)


def test_a_rated_current_too_large_for_the_limit_is_refused_before_anything_is_written(
    rig: Rig, tmp_path: Path
) -> None:
    theirs, bus = with_max_current(rig, tmp_path, 'bytes: 2, rated: "6075h:00"')
    bus.drives[3].values[0x6075, 0] = 60_000
    (row,) = [row for row in examined(theirs, bus).rows if row.verdict == "wrong"]
    assert (row.object[:8], row.found["60000"]) == ("6075h:00", [3])
    assert row.change.startswith("its 2 bytes cannot hold 72000: check `bytes`")
    with pytest.raises(Refused, match="its 2 bytes cannot hold 72000") as caught:
        set_up(theirs, bus)
    assert "the drives were not changed" in caught.value.next_step
    assert not downloads(bus)


def test_a_current_limit_of_another_size_names_the_key_for_it(rig: Rig, tmp_path: Path) -> None:
    theirs, bus = with_max_current(rig, tmp_path, 'rated: "6075h:00"')
    (row,) = [row for row in examined(theirs, bus).rows if row.verdict == "wrong"]
    assert row.object.startswith("6073h:00")
    assert row.change == "profile: `bytes` of torque_limit"
