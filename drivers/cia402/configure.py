"""Sets all drives of a rig up and reads every object back; nothing is enabled here."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Sequence

import can

from cdpr.errors import HardwareMissing, Refused
from cdpr.rig import Rig
from cdpr.winches import WinchMap
from drivers.cia402.frames import NmtCommand
from drivers.cia402.objects import (
    AFTER,
    BEFORE,
    HEARTBEAT_CONSUMERS,
    PDO_INVALID,
    UNUSED_PDOS,
    Expectation,
    Setting,
    heartbeat_consumers,
    identity,
    settings_for,
)
from drivers.cia402.sdo import OBJECT_DOES_NOT_EXIST, SetupNetwork
from drivers.cia402.states import FAULTED, DriveState, state_of
from drivers.drive_group import OnRestarted, Pump
from drivers.set_up_refusals import (
    SETTING_UP,
    answers_twice,
    in_fault,
    keeps_another,
    moved_by_another,
)

#: Communication parameters that are 0 in a drive that was just switched on. Source: CiA 301, 7.5.2.
FORGOTTEN = (0x1006, 0x1017)


def configure_drives(
    rig: Rig,
    bus: can.BusABC,
    pump: Pump | None,
    *,
    max_tension: float | None,
    to_reset: bool,
    on_restarted: OnRestarted,
) -> tuple[str, ...]:
    """Writes and reads back every object of every drive, then starts their process data.

    Args:
        rig: The robot; its winches name the nodes.
        bus: An open bus.
        pump: As for `drivers.drive_group.make_drive_group`.
        max_tension: From which the torque limit comes, [N]; the rig's own if None.
        to_reset: Also takes drives in fault, which are going to be reset.
        on_restarted: Called, before anything is written, with the nodes that do not hold our set-up
            any more, or never did.

    Returns:
        Remarks: what drives cannot do although a run would use it.

    Raises:
        HardwareMissing: Drives do not answer; with all their nodes.
        Refused: A drive is no CiA 402 drive, is enabled already, refuses an object or does not
            keep it; two devices have one node id; or another master is at work on this bus.
        BadInput: A value of the rig does not fit its object.
        Fault: The bus does not take frames.
    """
    winch_map = WinchMap(rig)
    settings = [settings_for(rig, i, winch_map, max_tension) for i in range(rig.cable_count)]
    nodes = [winch.node_id for winch in rig.winches]
    network = SetupNetwork(bus, pump, nodes)
    network.discard_waiting()
    _find_all(network, nodes, (*BEFORE, *identity(rig)))
    _refuse_duplicates(network)
    for node in nodes:
        _check_idle(network, node, to_reset)
    on_restarted(
        tuple(n for n, s in zip(nodes, settings, strict=True) if not is_still_set_up(network, n, s))
    )
    entries = []
    absent: dict[Setting, list[int]] = {}
    for drive, node in enumerate(nodes):
        network.command(NmtCommand.PRE_OPERATIONAL, node)
        for setting in _write_all(network, node, settings[drive]):
            absent.setdefault(setting, []).append(node)
        entries.append(_watch_heartbeats(network, node, rig, drive))
        _switch_off_unused(network, node)
        _expect(network, node, AFTER)
    for node in nodes:
        network.command(NmtCommand.START, node)
    network.take_waiting()
    return (*_absent(absent), *_unwatched_peers(nodes, entries))


def is_still_set_up(network: SetupNetwork, node: int, settings: Sequence[Setting]) -> bool:
    """Whether it holds what only a set-up gives it: a drive that starts again forgets it."""
    client = network.client(node)
    return all(
        client.read(setting.index, setting.sub, setting.name) == setting.data()
        for setting in settings
        if setting.index in FORGOTTEN
    )


def _refuse_duplicates(network: SetupNetwork) -> None:
    for node in network.nodes_answering_twice():
        raise answers_twice(node)


def _absent(absent: dict[Setting, list[int]]) -> Iterator[str]:
    for setting, nodes in absent.items():
        yield f"drive {', '.join(map(str, nodes))}: there is no {setting}: {setting.instead}"


def _unwatched_peers(nodes: Sequence[int], entries: Sequence[int]) -> Iterator[str]:
    """One remark for all drives that have the same number of heartbeat entries too few."""
    for count in sorted(set(entries)):
        if count >= len(nodes):
            continue
        drives = ", ".join(str(n) for n, own in zip(nodes, entries, strict=True) if own == count)
        yield (
            f"drive {drives}: 1016h has {count} heartbeat {'entry' if count == 1 else 'entries'},"
            f" so the master and {count - 1} of {len(nodes) - 1} other drives are watched; when"
            " another one falls silent together with the master, SYNC and set-point time-outs stop"
            " the drive instead"
        )


def _find_all(
    network: SetupNetwork, nodes: Iterable[int], expectations: Sequence[Expectation]
) -> None:
    """Every drive answers and is what it must be; the silent ones are named together."""
    silent: list[HardwareMissing] = []
    for node in nodes:
        try:
            _expect(network, node, expectations)
        except HardwareMissing as error:
            silent.append(error)
    if len(silent) > 1:
        names = ", ".join(str(error.values["node"]) for error in silent)
        first = silent[0]
        raise HardwareMissing(
            f"drives {names} do not answer",
            where=SETTING_UP,
            why=first.why,
            next_step=first.next_step,
            values={"nodes": names},
        )
    if silent:
        raise silent[0]


def _expect(network: SetupNetwork, node: int, expectations: Sequence[Expectation]) -> None:
    for expected in expectations:
        data = network.client(node).read(expected.index, expected.sub, expected.name)
        value = int.from_bytes(data, "little")
        if value & expected.mask != expected.expected:
            raise _wrong(
                node, str(expected), f"{value:X}h", f"{expected.expected:X}h", expected.why
            )


_STATUS_WORD = "object 6041h:00 status word"


def _check_idle(network: SetupNetwork, node: int, to_reset: bool) -> None:
    """A drive that is enabled belongs to somebody; one that holds in quick stop may be taken."""
    data = network.client(node).read(0x6041, 0, "status word")
    state = state_of(int.from_bytes(data, "little"))
    if state in FAULTED and not to_reset:
        why = "it stopped itself; its own display or tool tells the cause"
        raise in_fault(node, "", _STATUS_WORD, why)
    if state is DriveState.OPERATION_ENABLED:
        raise moved_by_another(node, "enabled already", _STATUS_WORD)


def _write_all(
    network: SetupNetwork, node: int, settings: Sequence[Setting]
) -> tuple[Setting, ...]:
    """Writes and reads back; those that the drive does not have and need not have."""
    client = network.client(node)
    absent = []
    for setting in settings:
        try:
            client.write(setting.index, setting.sub, setting.data(), setting.name)
        except Refused as error:
            if setting.instead and error.values.get("abort_code") in OBJECT_DOES_NOT_EXIST:
                absent.append(setting)
                continue
            raise
        if setting.transient:
            continue
        kept = client.read(setting.index, setting.sub, setting.name)
        if kept != setting.data():
            found = _number(kept, setting.form)
            raise _wrong(node, str(setting), found, str(setting.value), setting.why)
    return tuple(absent)


def _watch_heartbeats(network: SetupNetwork, node: int, rig: Rig, drive: int) -> int:
    """Sets the heartbeat consumer up; returns how many producers it can watch."""
    data = network.client(node).read(HEARTBEAT_CONSUMERS, 0, "consumer heartbeat entries")
    entries = int.from_bytes(data, "little")
    if entries < 1:
        raise _wrong(
            node, "1016h:00 consumer heartbeat entries", "0", "1 or more", "watch the master"
        )
    _write_all(network, node, heartbeat_consumers(rig, drive, entries))
    return entries


def _switch_off_unused(network: SetupNetwork, node: int) -> None:
    """Process data that nobody asked for would only fill the bus."""
    client = network.client(node)
    for index in UNUSED_PDOS:
        data = client.read_if_there(index, 1, "PDO identifier")
        if data is None or int.from_bytes(data, "little") & PDO_INVALID:
            continue
        value = int.from_bytes(data, "little") | PDO_INVALID
        off = Setting(index, 1, "<I", value, "PDO identifier", "not used, switched off")
        _write_all(network, node, [off])


def _number(data: bytes, form: str) -> str:
    if len(data) != struct.calcsize(form):
        return f"{len(data)} bytes ({data.hex()})"
    return str(struct.unpack(form, data)[0])


def _wrong(node: int, place: str, found: str, wanted: str, why: str) -> Refused:
    return keeps_another(node, f"object {place}", found, wanted, why, "the drive's manual")
