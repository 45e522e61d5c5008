"""Sets all drives of a rig up and reads every object back; nothing is enabled here."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import can

from drivers.can_errors import (
    SETTING_UP,
    all_of_them,
    answers_twice,
)
from drivers.cia402.error_codes import abort_text
from drivers.cia402.expected_objects import (
    BEFORE,
    MODE_DISPLAY,
    count_heartbeats,
    expected_by,
    identifiers,
    identity,
    number_text,
    require_absent,
    require_expected,
    require_idle,
    require_there,
    wrong_value,
)
from drivers.cia402.object_dictionary import (
    PDO_IDENTIFIER,
    PDO_INVALID,
    Setting,
    heartbeat_consumers,
    left_out,
    settings_for,
    stated_absent,
)
from drivers.cia402.pdo import NmtCommand
from drivers.cia402.profile import for_unused_pdos, profile_of, used_pdos
from drivers.cia402.sdo import NOT_NOW, SetupNetwork, silent
from drivers.cia402.sdo_jobs import OBJECT_DOES_NOT_EXIST
from drivers.drive_group import OnRestarted, Pump
from model.errors import HardwareMissing, Refused
from model.files.drive_profile_file import ProfileDocument
from model.rig import Rig
from model.winches import WinchMap

#: What a drive that was just switched on holds another value of, and keeps after an ordered end:
#: its heartbeat is 0, and a lost connection means nothing. Source: CiA 301, 7.5.2; CiA 402-2.
FORGOTTEN = (0x1017, 0x6007)

MODE_WAIT = 0.5
"""So long a drive may take to show a mode that was written, [s]."""

MODE_ASKED = 10
"""Times that it is asked meanwhile."""

READ_ONLY = frozenset({0x06010000, 0x06010002})
"""Not writable: an object of a fixed value, which counts when it is the wanted one."""

PDO_OBJECTS = 0xF9FF
"""Makes one of a PDO's communication parameters (1400h, 1800h) and its mapping (1600h, 1A00h)."""


@dataclass(frozen=True, slots=True)
class SetUp:
    """What `configure_drives` did.

    Attributes:
        remarks: What drives cannot do although a run would use it.
        heartbeats: How many entries of 1016h were written, one number a drive: the master's, then
            its peers'.
    """

    remarks: tuple[str, ...]
    heartbeats: tuple[int, ...]


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
        bus: An open bus.
        pump: As for `drivers.factory.make_drive_group`.
        max_tension: From which the torque limit comes, [N]; the rig's own if None.
        to_reset: Also takes drives in fault, which are going to be reset.
        on_restarted: Called, before anything is written, with the nodes that do not hold our set-up
            any more, or never did.

    Returns:
        What was set up, and what could not be.

    Raises:
        HardwareMissing: Drives do not answer; with all their nodes.
        Refused: A drive is no CiA 402 drive, is enabled already, refuses an object or does not
            keep it; two devices have one node id; or another master is at work on this bus.
        BadInput: A value of the rig does not fit its object.
        Fault: The bus does not take frames.
    """
    winch_map, profile = WinchMap(rig), profile_of(rig)
    settings = [settings_for(rig, i, winch_map, max_tension) for i in range(rig.cable_count)]
    nodes = [winch.node_id for winch in rig.winches]
    network = SetupNetwork(bus, pump, nodes, timeout=profile.sdo_timeout_ms / 1000.0)
    network.discard_waiting()
    require_answers(network, nodes)
    _refuse_duplicates(network)
    wrong = WrongObjects()
    entries: list[int] = []
    for drive, node in enumerate(nodes):
        for expected in (*BEFORE, *identifiers(node), *identity(rig), *expected_by(profile)):
            wrong.note(require_expected, network, node, expected)
        wrong.note(require_idle, network, node, to_reset)
        for setting in settings[drive]:
            wrong.note(require_there, network, node, setting)
        for setting in stated_absent(rig, drive, winch_map, max_tension):
            wrong.note(require_absent, network, node, setting)
        wrong.note(count_heartbeats, network, node, profile, entries)
    wrong.refuse()
    _refuse_duplicates(network)
    on_restarted(
        tuple(n for n, s in zip(nodes, settings, strict=True) if not is_still_set_up(network, n, s))
    )
    absent: dict[str, list[int]] = {}
    for drive, node in enumerate(nodes):
        network.command(NmtCommand.PRE_OPERATIONAL, node)
        wrong.note(_switch_off_used, network, node, profile)
        refused: list[str] = []  # before another PDO gets the identifier that this one has
        wrong.note(_switch_off_unused, network, node, profile, refused)
        refused += _write_all(network, node, settings[drive], wrong)
        _write_all(network, node, heartbeat_consumers(rig, drive, entries[drive]), wrong)
        for remark in refused:
            absent.setdefault(remark, []).append(node)
    wrong.refuse()  # a mode that was not taken is not waited for
    if not profile.mode_display_when_enabled:
        for node in nodes:
            wrong.note(_await_mode, network, node)
    wrong.refuse()
    for node in nodes:
        network.command(NmtCommand.START, node)
    network.take_waiting()
    for remark in left_out(profile):
        absent.setdefault(remark, []).extend(nodes)
    remarks = (*_absent(absent), *_unwatched_peers(nodes, entries, profile))
    watched = (
        min(count, rig.cable_count) if profile.watches_heartbeats else 0 for count in entries
    )
    return SetUp(remarks, tuple(watched))


class WrongObjects:
    """Collects what drives refuse, so that one message reports everything."""

    def __init__(self) -> None:
        """Begins with nothing."""
        self._found: list[Refused] = []

    def note(self, action: Callable[..., None], *arguments: Any) -> bool:
        """Does something with a drive; false when the drive refused, which is kept."""
        try:
            action(*arguments)
        except Refused as error:
            if "node" not in error.values:  # the bus is another's: nothing more can be said
                raise
            self._found.append(error)
            return False
        return True

    def refuse(self) -> None:
        """Does nothing unless something was found.

        Raises:
            Refused: With everything that was found.
        """
        if self._found:
            raise all_of_them(self._found)


def is_still_set_up(network: SetupNetwork, node: int, settings: Sequence[Setting]) -> bool:
    """Whether it holds what only a set-up gives it: a drive that starts again forgets it."""
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


def _unwatched_peers(
    nodes: Sequence[int], entries: Sequence[int], profile: ProfileDocument
) -> Iterator[str]:
    """One remark for all drives that have the same number of heartbeat entries too few."""
    if not profile.watches_heartbeats:
        reason = (
            "take a lost heartbeat as a fault"
            if profile.heartbeat_loss == "fault"
            else "have no heartbeat consumer"
        )
        yield (
            f"{profile.name} drives {reason}, so they monitor none; the SYNC time-out alone stops"
            " them when the master is lost"
        )
        return
    instead = (
        "the master's heartbeat stops the drive"
        if profile.monitoring == "heartbeat"
        else "the SYNC time-out stops the drive"
    )
    for count in sorted(set(entries)):
        if count >= len(nodes):
            continue
        drives = ", ".join(str(n) for n, own in zip(nodes, entries, strict=True) if own == count)
        yield (
            f"drive {drives}: 1016h has {count} heartbeat {'entry' if count == 1 else 'entries'},"
            f" so the master and {count - 1} of {len(nodes) - 1} other drives are monitored; if"
            f" another one is lost together with the master, {instead} instead"
        )


def require_answers(network: SetupNetwork, nodes: Sequence[int]) -> None:
    """First contact with all drives at once; the silent ones are named together.

    Raises:
        HardwareMissing: Drives do not answer.
        Refused: The one that does not answers something else.
    """
    nothing = network.silent_nodes(nodes)
    if len(nothing) == 1:
        where = f"drive {nothing[0]}, object 1000h:00 device type"
        raise network.client(nothing[0]).no_answer(where)
    if nothing:
        names = ", ".join(str(node) for node in nothing)
        first = silent(nothing[0], SETTING_UP)
        raise HardwareMissing(
            f"drives {names} do not answer",
            where=SETTING_UP,
            why=first.why,
            next_step=first.next_step,
            values={"nodes": names},
        )


def _await_mode(network: SetupNetwork, node: int) -> None:
    """The mode that was written shows within `MODE_WAIT`; drives need not follow at once."""
    deadline = network.clock() + MODE_WAIT
    for _ in range(MODE_ASKED):
        data = network.client(node).read(MODE_DISPLAY.index, 0, MODE_DISPLAY.name, 1)
        if int.from_bytes(data, "little") == MODE_DISPLAY.expected or network.clock() >= deadline:
            break
        network.wait(MODE_WAIT / MODE_ASKED)
    require_expected(network, node, MODE_DISPLAY)


def _write_all(
    network: SetupNetwork, node: int, settings: Sequence[Setting], wrong: WrongObjects
) -> list[str]:
    """Writes and reads back; remarks on what the drive does not have and need not have."""
    remarks: list[str] = []
    refused: set[int] = set()
    for setting in settings:
        # Of a PDO that refuses one object the others fail for the same reason.
        if setting.index & PDO_OBJECTS in refused:
            continue
        if not wrong.note(_write, network, node, setting, remarks) and _is_pdo(setting.index):
            refused.add(setting.index & PDO_OBJECTS)
    return remarks


def _is_pdo(index: int) -> bool:
    return 0x1400 <= index < 0x1C00


def _write(network: SetupNetwork, node: int, setting: Setting, remarks: list[str]) -> None:
    """Writes one object and reads it back; what an optional one lacks becomes a remark."""
    client = network.client(node)
    if setting.per_mille_of is not None:
        index, sub = setting.per_mille_of
        rated = int.from_bytes(client.read(index, sub, "rated value of the limit"), "little")
        setting = setting.of_rated(rated)
    try:
        client.write(setting.index, setting.sub, setting.data(), setting.name)
    except Refused as error:
        code = error.values.get("abort_code")
        if code in NOT_NOW or not (setting.optional or code in READ_ONLY):
            raise
        if _holds(network, node, setting):
            return
        if not setting.optional:
            raise
        if setting.instead:
            lost = "there is no" if code in OBJECT_DOES_NOT_EXIST else "the drive refuses"
            reason = "" if code in OBJECT_DOES_NOT_EXIST else f" ({abort_text(int(code or 0))})"
            remarks.append(f"{lost} {setting}{reason}: {setting.instead}")
        return
    if setting.transient:
        return
    kept = client.read(setting.index, setting.sub, setting.name, setting.size)
    if not setting.is_kept(kept):
        found = number_text(kept, setting.form)
        raise wrong_value(node, str(setting), found, str(setting.value), setting.why)


def _holds(network: SetupNetwork, node: int, setting: Setting) -> bool:
    """Whether an object that cannot be written holds what it must anyway."""
    try:
        kept = network.client(node).read(setting.index, setting.sub, setting.name, setting.size)
    except Refused:
        return False
    return setting.is_kept(kept)


def _switch_off_used(network: SetupNetwork, node: int, profile: ProfileDocument) -> None:
    """The identifier of a PDO may change only while it is off. Source: CiA 301, 7.5.2.35."""
    for index in used_pdos(profile):
        data = network.client(node).read(index, 1, "PDO identifier")
        value = int.from_bytes(data, "little")
        if not value & PDO_INVALID:
            _switch_off(network, node, index, value)


def _switch_off_unused(
    network: SetupNetwork, node: int, profile: ProfileDocument, remarks: list[str]
) -> None:
    """Process data that is not used fills the bus, or takes frames for others; it may be absent."""

    def is_there(index: int) -> bool:
        value = _identifier_if_there(network, node, index, remarks)
        if value is not None and not value & PDO_INVALID:
            _switch_off(network, node, index, value)
        return value is not None

    for_unused_pdos(profile, is_there)


def _identifier_if_there(
    network: SetupNetwork, node: int, index: int, remarks: list[str]
) -> int | None:
    """Identifier of a PDO (sub-index 1); None where it cannot be read, which may be a remark."""
    try:
        return int.from_bytes(network.client(node).read(index, 1, "PDO identifier"), "little")
    except Refused as error:
        code = error.values.get("abort_code")
        if code is None or code in NOT_NOW:
            raise
        if code not in OBJECT_DOES_NOT_EXIST:
            remarks.append(
                f"the drive refuses {index:04X}h:01 PDO identifier ({abort_text(int(code))}):"
                " if it has this PDO, it stays as it is"
            )
        return None


def _switch_off(network: SetupNetwork, node: int, index: int, value: int) -> None:
    off = Setting(
        *(index, 1, "<I", value | PDO_INVALID, "PDO identifier", "switched off"),
        mask=PDO_IDENTIFIER,
    )
    _write(network, node, off, [])
