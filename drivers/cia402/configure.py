"""Configures all drives of a rig and reads every object back; enables nothing."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace

import can

from drivers.cia402.error_codes import abort_text
from drivers.cia402.expected_objects import (
    HOW_SCALED,
    MODE_DISPLAY,
    are_simulated,
    count_heartbeats,
    expectations,
    found_text,
    position_scales,
    refuse_scale,
    require_absent,
    require_answers,
    require_expected,
    require_idle,
    require_no_wrap,
    require_there,
    saved_alone,
    wrong_scales_of,
    wrong_value,
)
from drivers.cia402.object_dictionary import (
    PDO_IDENTIFIER,
    PDO_INVALID,
    SOFTWARE_LIMITS,
    Setting,
    heartbeat_consumers,
    left_out,
    settings_for,
    stated_absent,
)
from drivers.cia402.pdo import NmtCommand
from drivers.cia402.profile import (
    for_unused_pdos,
    limits_out_of_force,
    profile_of,
    unwatched_peers,
    used_pdos,
)
from drivers.cia402.sdo import NOT_NOW, SetupNetwork, means_absent
from drivers.cia402.sdo_jobs import OBJECT_DOES_NOT_EXIST
from drivers.cia402.state_machine import HOLDS
from drivers.drive_group import OnRestarted, Pump
from drivers.plausibility import require_within_limits
from drivers.setup_refusals import (
    DriveRestarted,
    Refusals,
    SdoAborted,
    TorqueLost,
    answers_twice,
)
from model.files.drive_profile_file import ProfileDocument
from model.rig import Rig
from model.winches import WinchMap

#: Objects whose values show a power cycle: volatile, with other defaults (no heartbeat, no reaction
#: to a lost connection), and kept at the end of a run. Source: CiA 301, 7.5.2; CiA 402-2.
FORGOTTEN = (0x1017, 0x6007)

MODE_WAIT = 0.5
"""Time-out for a drive to show the mode that was written, [s]."""

MODE_ASKED = 10
"""Number of reads within `MODE_WAIT`."""

READ_ONLY = frozenset({0x06010000, 0x06010002})
"""Abort codes of a read-only object, whose fixed value may be the required one."""

OUT_OF_RANGE = frozenset({0x06090030, 0x06090031, 0x06090032})
"""Abort codes of a value outside an object's range, too high, too low."""

UNCHANGED = "the drives were not changed"
UNFINISHED = (
    "the set-up was not finished: the drives are in NMT pre-operational with part of their"
    " settings, and none is enabled"
)

_POSITION = 0x6064, 0, "position actual value"

PDO_OBJECTS = 0xF9FF
"""Mask that maps a PDO's parameters (1400h, 1800h) and mapping (1600h, 1A00h) to one index."""


@dataclass(frozen=True, slots=True)
class SetUp:
    """Result of `configure_drives`.

    Attributes:
        remarks: Functions that drives lack although a run would use them.
        heartbeats: Number of entries of 1016h written in each drive: the master's, then peers'.
        simulated: Whether all drives identify themselves as simulated.
        emergencies: Data of the last EMCY of each drive, by identifier.
        errors: Stored error codes of the drives in fault, by node.
    """

    remarks: tuple[str, ...]
    heartbeats: tuple[int, ...]
    simulated: bool
    emergencies: Mapping[int, bytes]
    errors: Mapping[int, int]


def configure_drives(
    rig: Rig,
    bus: can.BusABC,
    pump: Pump | None,
    *,
    max_tension: float | None,
    to_reset: bool,
    on_restarted: OnRestarted,
) -> SetUp:
    """Writes and reads back every object of every drive, then starts their process data.

    Args:
        rig: The robot; its winches name the nodes.
        pump: As for `drivers.factory.make_drive_group`.
        max_tension: Tension that sets the torque limit, [N]; the rig's if None.
        to_reset: Accepts drives in fault too, which will be reset.
        on_restarted: Called, before anything is written, with the nodes that lost the
            configuration or never had it; again if a drive restarts during the set-up.

    Returns:
        What was configured, with remarks.

    Raises:
        HardwareMissing: Drives do not answer; with all their nodes.
        DriveRestarted: A drive restarted meanwhile.
        TorqueLost: A drive that held its cable released it meanwhile.
        Refused: A drive is not a CiA 402 drive, is already enabled, holds its cable outside its
            position limits, or refuses or changes an object; two devices have one node id; or
            another master is active on this bus.
        BadInput: A value of the rig does not fit its object.
        Fault: The bus does not accept frames.
    """
    winch_map, profile = WinchMap(rig), profile_of(rig)
    settings = [settings_for(rig, i, winch_map, max_tension) for i in range(rig.cable_count)]
    nodes = [winch.node_id for winch in rig.winches]
    network = SetupNetwork(bus, pump, nodes, timeout=profile.sdo_timeout_ms / 1000.0)
    network.discard_waiting()
    require_answers(network, nodes, revive=to_reset)
    network.refuse_restarts()
    _refuse_duplicates(network)
    refusals = Refusals()
    entries: list[int] = []
    errors: dict[int, int] = {}
    for drive, node in enumerate(nodes):
        refusals.note(require_idle, network, node, to_reset, errors)
        _note_objects(rig, network, winch_map, drive, settings[drive], max_tension, refusals)
        refusals.note(count_heartbeats, network, node, profile, entries)
    scales = wrong_scales_of(
        rig, nodes, lambda node: position_scales(network.client(node).read_if_there)
    )
    for wrong in scales:
        refusals.note(refuse_scale, nodes[wrong.drive], wrong)
    refusals.raise_any(UNCHANGED)
    _refuse_duplicates(network)
    holding = {node for node in nodes if network.client(node).read_state() in HOLDS}
    held = {
        drive: int.from_bytes(network.client(node).read(*_POSITION), "little", signed=True)
        for drive, node in enumerate(nodes)
        if node in holding
    }
    require_within_limits(rig, held, UNCHANGED)
    restarted = _restarted(network, nodes, settings)
    on_restarted(restarted)
    try:
        absent = _write_settings(rig, network, settings, entries, holding)
        simulated = are_simulated(network, nodes)
        _start(network, nodes, settings)
        _require_held(network, holding)
    except DriveRestarted as error:
        on_restarted(tuple(sorted({*restarted, error.node})))
        raise
    for wrong in scales:
        absent.setdefault(f"{wrong}: {HOW_SCALED}", []).append(nodes[wrong.drive])
    for remark in (*left_out(profile), *limits_out_of_force(profile)):
        absent.setdefault(remark, []).extend(nodes)
    usable = [profile.usable_heartbeats(count) for count in entries]
    remarks = (*_absent(absent), *unwatched_peers(profile, nodes, usable))
    watched = tuple(min(count, rig.cable_count) for count in usable)
    return SetUp(remarks, watched, simulated, network.emergencies, errors)


def _write_settings(
    rig: Rig,
    network: SetupNetwork,
    settings: Sequence[Sequence[Setting]],
    entries: Sequence[int],
    holding: Set[int],
) -> dict[str, list[int]]:
    """Writes all settings of all drives; returns nodes by remark on a missing object."""
    profile, nodes, refusals = profile_of(rig), [w.node_id for w in rig.winches], Refusals()
    absent: dict[str, list[int]] = {}
    for drive, node in enumerate(nodes):
        network.command(NmtCommand.PRE_OPERATIONAL, node)
        refusals.note(_switch_off_used, network, node, profile)
        refused: list[str] = []  # switched off before another PDO takes its identifier
        refusals.note(_switch_off_unused, network, node, profile, refused)
        own = list(settings[drive])
        refusals.note(_uncross_limits, network, node, own)
        refused += _write_all(network, node, own, refusals)
        if not rig.winches[drive].absolute:
            refused += saved_alone(network.client(node).read_if_there)
        _require_held(network, holding & {node})  # not sooner: a drive may react late
        for remark in refused:
            absent.setdefault(remark, []).append(node)
    for drive, node in enumerate(nodes):  # last: by now all peers send at their new period
        _write_all(network, node, heartbeat_consumers(rig, drive, entries[drive]), refusals)
    refusals.raise_any(UNFINISHED)  # before waiting for a mode that was refused
    if not profile.mode_display_when_enabled:
        for node in nodes:
            refusals.note(_await_mode, network, node)
    refusals.raise_any(UNFINISHED)
    return absent


def _require_held(network: SetupNetwork, nodes: Iterable[int]) -> None:
    """Raises `TorqueLost` for the first drive that no longer holds its cable."""
    for node in nodes:
        state = network.client(node).read_state()
        if state not in HOLDS:
            raise TorqueLost(node, state.value)


def _start(
    network: SetupNetwork, nodes: Sequence[int], settings: Sequence[Sequence[Setting]]
) -> None:
    """Starts the process data; a drive that has lost its settings by then is refused.

    Raises:
        DriveRestarted: A boot-up came, or volatile settings are at their defaults.
    """
    for node in nodes:
        network.command(NmtCommand.START, node)
    network.process_waiting()
    for node in _restarted(network, nodes, settings):  # its boot-up was lost
        raise DriveRestarted(node)


def _note_objects(
    rig: Rig,
    network: SetupNetwork,
    winch_map: WinchMap,
    drive: int,
    settings: Sequence[Setting],
    max_tension: float | None,
    refusals: Refusals,
) -> None:
    """Records every object that a drive lacks, or has with an unsuitable value; only reads."""
    profile, node = profile_of(rig), rig.winches[drive].node_id
    for expected in expectations(rig, profile, node):
        refusals.note(require_expected, network, node, expected)
    for setting in settings:
        refusals.note(require_there, network, node, setting)
    for setting in stated_absent(rig, drive, winch_map, max_tension):
        refusals.note(require_absent, network, node, setting)
    refusals.note(require_no_wrap, network, node, settings)


def require_objects(
    rig: Rig, network: SetupNetwork, others: Sequence[tuple[int, str, int]]
) -> None:
    """Requires the objects of a configuration, and others, of all drives; writes nothing.

    Args:
        rig: The robot; its winches name the nodes.
        others: Index, name and size [bytes] of further objects.

    Raises:
        HardwareMissing: A drive does not answer.
        Refused: Drives lack objects, or have unsuitable values; with all drives and objects.
    """
    winch_map, refusals = WinchMap(rig), Refusals()
    for drive, winch in enumerate(rig.winches):
        client = network.client(winch.node_id)
        for index, name, size in others:
            refusals.note(client.read, index, 0, name, size)
        settings = settings_for(rig, drive, winch_map, None)
        _note_objects(rig, network, winch_map, drive, settings, None, refusals)
    refusals.raise_any(UNCHANGED)


def _restarted(
    network: SetupNetwork, nodes: Sequence[int], settings: Sequence[Sequence[Setting]]
) -> tuple[int, ...]:
    each = zip(nodes, settings, strict=True)
    return tuple(node for node, own in each if not is_still_set_up(network, node, own))


def is_still_set_up(network: SetupNetwork, node: int, settings: Sequence[Setting]) -> bool:
    """Whether the drive still holds the volatile settings, which a restart clears."""
    client = network.client(node)
    return all(
        client.read(setting.index, setting.sub, setting.name, setting.size) == setting.data()
        for setting in settings
        if setting.index in FORGOTTEN
    )


def _refuse_duplicates(network: SetupNetwork) -> None:
    for node in network.nodes_answering_twice():
        raise answers_twice(node)


def _absent(absent: dict[str, list[int]]) -> Iterator[str]:
    for remark, nodes in absent.items():
        yield f"drive {', '.join(map(str, nodes))}: {remark}"


def _await_mode(network: SetupNetwork, node: int) -> None:
    """Waits up to `MODE_WAIT` until the drive shows the mode that was written."""
    deadline = network.clock() + MODE_WAIT
    for _ in range(MODE_ASKED):
        data = network.client(node).read(MODE_DISPLAY.index, 0, MODE_DISPLAY.name, 1)
        if int.from_bytes(data, "little") == MODE_DISPLAY.expected or network.clock() >= deadline:
            break
        network.wait(MODE_WAIT / MODE_ASKED)
    require_expected(network, node, MODE_DISPLAY)


def _write_all(
    network: SetupNetwork, node: int, settings: Sequence[Setting], refusals: Refusals
) -> list[str]:
    """Writes settings and reads them back; returns remarks on missing optional objects."""
    remarks: list[str] = []
    refused: set[int] = set()
    for setting in settings:
        # If a PDO refuses one object, the others fail for the same reason.
        if setting.index & PDO_OBJECTS in refused:
            continue
        is_set = refusals.note(_write, network, node, setting, remarks)
        if not is_set and 0x1400 <= setting.index < 0x1C00:
            refused.add(setting.index & PDO_OBJECTS)
    return remarks


def _uncross_limits(network: SetupNetwork, node: int, settings: list[Setting]) -> None:
    """Writes the upper software limit before the lower one, where the drive's is below that.

    A drive may refuse a minimum above its maximum (06090036h), or treat it as a fault.
    """
    low, high = (each for each in settings if each.index == SOFTWARE_LIMITS)
    held = network.client(node).read(high.index, high.sub, high.name, high.size)
    if int.from_bytes(held, "little", signed=True) < low.value:
        settings.remove(high)
        settings.insert(settings.index(low), high)


def _write(network: SetupNetwork, node: int, setting: Setting, remarks: list[str]) -> None:
    """Writes one object and reads it back; a missing optional one becomes a remark.

    A write that the drive aborts may be accepted, else its error is raised:

    abort code  required object           optional object                      transient value
    read-only   if it holds the value     if it holds the value, or as absent  yes
    not now     if it holds the value     if it holds the value                no
    another     no                        if it holds the value, or as absent  no

    An object counts as absent if it cannot be read or ``instead`` states the consequence.
    """
    client = network.client(node)
    if setting.per_mille_of is not None:
        index, sub = setting.per_mille_of
        rated = int.from_bytes(client.read(index, sub, "rated value of the limit"), "little")
        setting = setting.of_rated(rated)
    try:
        client.write(setting.index, setting.sub, setting.data(), setting.name)
    except SdoAborted as error:
        code = error.abort_code
        if code in OUT_OF_RANGE and setting.equivalent and setting.value != setting.equivalent[0]:
            return _write(network, node, replace(setting, value=setting.equivalent[0]), remarks)
        if setting.transient and code in READ_ONLY:
            return  # a fixed object, whose final value is checked later
        may_lack = setting.optional and code not in NOT_NOW
        if setting.transient or not (may_lack or code in READ_ONLY | NOT_NOW):
            raise
        fixed = _fixed_value(network, node, setting)
        if fixed is not None and setting.is_kept(fixed):
            return
        if not may_lack or (fixed is not None and not setting.instead):
            raise
        if setting.instead:
            lost = "there is no" if code in OBJECT_DOES_NOT_EXIST else "the drive refuses"
            reason = "" if code in OBJECT_DOES_NOT_EXIST else f" ({abort_text(code)})"
            remarks.append(f"{lost} {setting}{reason}: {setting.instead}")
        return
    if setting.transient:
        return
    kept = client.read(setting.index, setting.sub, setting.name, setting.size)
    if not setting.is_kept(kept):
        found, wanted = found_text(kept, setting), setting.text(setting.value)
        raise wrong_value(node, str(setting), found, wanted, setting.why)


def _fixed_value(network: SetupNetwork, node: int, setting: Setting) -> bytes | None:
    """Value of an object that cannot be written; None if it cannot be read either."""
    try:
        return network.client(node).read(setting.index, setting.sub, setting.name, setting.size)
    except SdoAborted:
        return None


def _switch_off_used(network: SetupNetwork, node: int, profile: ProfileDocument) -> None:
    """Switches the used PDOs off, as identifiers may change only then. CiA 301, 7.5.2.35."""
    for index in used_pdos(profile):
        data = network.client(node).read(index, 1, "PDO identifier")
        _switch_off(network, node, index, int.from_bytes(data, "little"))


def _switch_off_unused(
    network: SetupNetwork, node: int, profile: ProfileDocument, remarks: list[str]
) -> None:
    """Switches unused PDOs off, which load the bus or react to other frames; may be absent."""

    def is_there(index: int) -> bool:
        try:
            data = network.client(node).read(index, 1, "PDO identifier")
        except SdoAborted as error:
            if not means_absent(error):
                raise
            code = error.abort_code
            if code not in OBJECT_DOES_NOT_EXIST:
                remarks.append(
                    f"the drive refuses {index:04X}h:01 PDO identifier ({abort_text(code)}):"
                    " if it has this PDO, it stays unchanged"
                )
            return False
        _switch_off(network, node, index, int.from_bytes(data, "little"))
        return True

    for_unused_pdos(profile, is_there)


def _switch_off(network: SetupNetwork, node: int, index: int, value: int) -> None:
    """Sets bit 31 of a PDO's identifier, unless it is set."""
    if not value & PDO_INVALID:
        off = Setting(
            *(index, 1, "<I", value | PDO_INVALID, "PDO identifier", "switched off"),
            mask=PDO_IDENTIFIER,
        )
        _write(network, node, off, [])
