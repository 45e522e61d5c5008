"""Reads every object that a configuration needs from every drive; writes nothing."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import can
import numpy as np

from drivers.cia402.configure import is_still_set_up, require_objects
from drivers.cia402.error_codes import abort_text, emergency_text, stored_error
from drivers.cia402.expected_objects import (
    BY_MAKERS_TOOL,
    HOW_SCALED,
    MODE_DISPLAY,
    NO_WRAP,
    POSITION_RANGE,
    SAVED_BY_COMMAND,
    Expectation,
    expectations,
    holds_limits,
    how_to_set,
    position_range,
    position_scales,
    require_answers,
    wrong_scales_of,
)
from drivers.cia402.object_dictionary import (
    CURRENT_LIMIT,
    HEARTBEAT_CONSUMERS,
    Setting,
    settings_for,
    stated_absent,
)
from drivers.cia402.profile import for_unused_pdos, how_without, power_bits, profile_of
from drivers.cia402.sdo import WRITE_ONLY, SetupNetwork
from drivers.cia402.sdo_jobs import OBJECT_DOES_NOT_EXIST
from drivers.cia402.state_machine import FAULTED, DriveState, state_of, without_power
from drivers.drive_group import DriveSnapshot, Pump
from drivers.plausibility import WrongScale, winding_signs
from drivers.setup_refusals import SdoAborted
from model.errors import CdprError, HardwareMissing, Refused
from model.files.drive_profile_file import ProfileDocument, object_name
from model.rig import Rig
from model.winches import WinchMap

Verdict = Literal["ok", "remark", "wrong"]

MOST_VALUES = 3
"""Largest number of distinct values listed per object."""

_WORST: tuple[Verdict, ...] = ("ok", "remark", "wrong")

_PROCESS_DATA = (
    (0x6040, "<H", "controlword", "commands of the master"),
    (0x607A, "<i", "target position", "set-points"),
    (0x6064, "<i", "position actual value", "replies"),
    (0x6077, "<h", "torque actual value", "tension of the cable"),
    (MODE_DISPLAY.index, "<b", MODE_DISPLAY.name, "the mode must be active"),
)


@dataclass(slots=True)
class ObjectRow:
    """One object in all drives.

    Attributes:
        object: Index, sub-index and name.
        needed: Required value or presence.
        meaning: Purpose.
        verdict: Worst verdict of all drives.
        change: Next step if it is not ok.
        found: Nodes by value found.
    """

    object: str
    needed: str
    meaning: str
    verdict: Verdict = "ok"
    change: str = ""
    found: dict[str, list[int]] = field(default_factory=dict)

    def note(self, node: int, text: str, verdict: Verdict = "ok", change: str = "") -> None:
        """Adds the value of one drive; ``change`` counts for a verdict that is not ok."""
        self.found.setdefault(text, []).append(node)
        if _WORST.index(verdict) > _WORST.index(self.verdict):
            self.verdict, self.change = verdict, change

    def found_text(self, nodes: Sequence[int]) -> str:
        """``all: 8``, or every value with its drives."""
        if len(self.found) > MOST_VALUES and self.verdict == "ok":
            return "present; differs between drives"
        if [sorted(nodes)] == [sorted(each) for each in self.found.values()]:
            return f"all: {next(iter(self.found))}"
        return "; ".join(
            f"drive {', '.join(map(str, each))}: {text}" for text, each in self.found.items()
        )


@dataclass(frozen=True, slots=True)
class Examined:
    """Result of an inspection.

    Attributes:
        nodes: The drives that answered.
        silent: The drives that did not answer.
        rows: One per object.
        stopped: The silent drives that are in NMT *stopped*, by their heartbeats.
        missing: Why none could be read, where the bus failed.
    """

    nodes: tuple[int, ...]
    silent: tuple[int, ...]
    rows: tuple[ObjectRow, ...]
    stopped: tuple[int, ...] = ()
    missing: CdprError | None = None

    @property
    def good(self) -> bool:
        """Whether every drive can be configured, as far as reading shows."""
        return not self.silent and all(row.verdict != "wrong" for row in self.rows)

    @property
    def watches_master(self) -> bool:
        """Whether the drives have what the profile says that they stop by without a master."""
        watched = (row for row in self.rows if row.object[:5] in ("1006h", "1016h"))
        return all(row.verdict != "wrong" for row in watched)

    @property
    def silent_facts(self) -> list[tuple[tuple[int, ...], str]]:
        """The silent drives in NMT *stopped*, then the others, each with the next step."""
        unexplained = tuple(node for node in self.silent if node not in self.stopped)
        stopped = "in NMT state 'stopped', by its heartbeat: run `cdpr reset RIG`"
        facts = [(self.stopped, stopped), (unexplained, "check power, wiring and node id")]
        return [(nodes, step) for nodes, step in facts if nodes]

    def as_dict(self) -> dict[str, Any]:
        """For `--json`."""
        return {
            "answered": list(self.nodes),
            "silent": list(self.silent),
            "stopped": list(self.stopped),
            "objects": [
                {
                    "object": row.object,
                    "verdict": row.verdict,
                    "needed": row.needed,
                    "found": [{"drives": each, "value": text} for text, each in row.found.items()],
                    "meaning": row.meaning,
                    "change": row.change,
                }
                for row in self.rows
            ],
        }


def examine_drives(rig: Rig, bus: can.BusABC, pump: Pump | None) -> Examined:
    """Reads all objects of all drives; sends only SDO upload requests.

    Args:
        rig: The robot, with its drive profile.
        pump: As for `drivers.factory.make_drive_group`.

    Raises:
        BadInput: The profile or a value of the rig is wrong.
        HardwareMissing: A drive stopped answering.
        Fault: The bus failed.
    """
    profile, winch_map = profile_of(rig), WinchMap(rig)
    all_nodes = [winch.node_id for winch in rig.winches]
    network = SetupNetwork(bus, pump, all_nodes, timeout=profile.sdo_timeout_ms / 1000.0)
    network.discard_waiting()
    silent = network.silent_nodes(all_nodes)
    answered = tuple(node for node in all_nodes if node not in silent)
    scales = {node: position_scales(network.client(node).read_if_there) for node in answered}
    scaled = {answered[w.drive]: w for w in wrong_scales_of(rig, answered, scales.__getitem__)}
    rows: dict[tuple[int, int], ObjectRow] = {}
    for drive, node in enumerate(all_nodes):
        if node in silent:
            continue
        reader = _Reader(network, node, rows, profile)
        for expected in expectations(rig, profile, node):
            reader.at_expected(expected)
        reader.at_state()
        for index, form, name, why in _PROCESS_DATA:
            reader.at_setting(Setting(index, 0, form, 0, name, why), "readable")
        reader.at_scale(rig.document.winches[drive].counts_per_rev, scales[node], scaled.get(node))
        if not rig.winches[drive].absolute:
            reader.at_expected(SAVED_BY_COMMAND, "remark")
        reader.at_heartbeats(rig.cable_count)
        settings = settings_for(rig, drive, winch_map, None)
        for setting in _last_of_each(settings):
            reader.at_setting(setting, _needed(setting))
        for setting in stated_absent(rig, drive, winch_map):
            reader.at_absent(setting)
        reader.at_position_range(settings)
        for_unused_pdos(profile, reader.at_unused)
    stopped = tuple(filter(network.is_stopped, silent))
    return Examined(answered, tuple(silent), tuple(rows.values()), stopped)


def _last_of_each(settings: Iterable[Setting]) -> list[Setting]:
    """The final setting of each object, without transient ones."""
    return list({(s.index, s.sub): s for s in settings if not s.transient}.values())


def _needed(setting: Setting) -> str:
    if setting.per_mille_of is None:
        return f"{setting.text(setting.value)}, written at configuration"
    rated = object_name(*setting.per_mille_of)
    return f"{setting.value} per mille of {rated}, written at configuration"


class _Reader:
    """Reads one drive's objects into the rows of all drives."""

    def __init__(
        self,
        network: SetupNetwork,
        node: int,
        rows: dict[tuple[int, int], ObjectRow],
        profile: ProfileDocument,
    ) -> None:
        self._client, self._node, self._rows = network.client(node), node, rows
        self._profile = profile

    def at_expected(self, expected: Expectation, otherwise: Verdict = "wrong") -> None:
        """An object that must hold a value and is not written."""
        row = self._row(expected.index, expected.sub, str(expected), f"{expected.expected:X}h")
        row.meaning = expected.why
        data = self._read(expected.index, expected.sub, row, expected.optional)
        if data is not None:
            value = int.from_bytes(data, "little")
            good = value & expected.mask == expected.expected
            row.note(self._node, f"{value:X}h", "ok" if good else otherwise, how_to_set(expected))

    def at_state(self) -> None:
        """State of the drive's state machine, with the error of one in fault."""
        row = self._row(0x6041, 0, "6041h:00 statusword", "not enabled, no fault")
        row.meaning = "only drives at rest are configured"
        data = self._read(0x6041, 0, row, optional=False)
        if data is None:
            return
        word = int.from_bytes(data, "little")
        state = state_of(word)
        if state in FAULTED:
            code = stored_error(self._client.read_if_there)
            text = f"{state.value}: {emergency_text(code)}" if code else state.value
            row.note(self._node, text, "wrong", "remove the cause, then run `cdpr reset RIG`")
        elif state is DriveState.OPERATION_ENABLED:
            row.note(self._node, state.value, "remark", "another program moves it; end it first")
        elif shown := without_power(word, power_bits(self._profile, operational=False)):
            row.note(self._node, state.value, "remark", f"before a motion: {'; '.join(shown)}")
        else:
            row.note(self._node, state.value)

    def at_heartbeats(self, drives: int) -> None:
        """Number of heartbeat producers that the drive can monitor."""
        needed, meaning = "any, not used", "a lost heartbeat would remove the torque"
        if used := self._profile.watches_heartbeats:
            needed = f"1; {drives} to monitor every peer as well"
            meaning = "stop when the master or a peer is lost"
        row = self._row(HEARTBEAT_CONSUMERS, 0, "1016h:00 consumer heartbeat entries", needed)
        row.meaning = meaning
        data = self._read(HEARTBEAT_CONSUMERS, 0, row, optional=not used, size=1)
        if data is None:
            return
        count = int.from_bytes(data, "little")
        if used and count < 1:
            lacks = how_without(self._profile, HEARTBEAT_CONSUMERS, 0, self._client.read_if_there)
            row.note(self._node, "0", "wrong", lacks)
        elif used and self._profile.usable_heartbeats(count) < drives:
            row.note(self._node, str(count), "remark", "none required: not every peer is monitored")
        else:
            row.note(self._node, str(count))

    def at_scale(
        self, counts_per_turn: int, scales: Mapping[str, float], wrong: WrongScale | None
    ) -> None:
        """Counts per motor turn that the drive reports, and whether they are wrong."""
        row = self._row(0x6092, 1, "feed constant, 6091h gear ratio, 608Fh encoder resolution", "")
        row.meaning = "position counts per motor turn: winches[].counts_per_rev"
        row.needed = row.needed or f"{counts_per_turn} per turn, if the drive has them"
        text = ", ".join(f"{value:.10g} from {name}" for name, value in scales.items()) or "absent"
        verdict: Verdict = "ok" if wrong is None else "wrong" if wrong.certain else "remark"
        row.note(self._node, text, verdict, HOW_SCALED)

    def at_position_range(self, settings: Sequence[Setting]) -> None:
        """Where positions wrap around, if anywhere."""
        row = self._row(POSITION_RANGE, 1, f"{POSITION_RANGE:04X}h position range limit", NO_WRAP)
        row.meaning = "positions must not wrap around"
        try:
            found = position_range(self._client.read_if_there)
        except SdoAborted as error:
            text = f"refused: {abort_text(error.abort_code)}"
            row.note(self._node, text, "wrong", "see the drive's manual")
            return
        good = holds_limits(found, settings)
        row.note(self._node, str(found or "none"), "ok" if good else "wrong", BY_MAKERS_TOOL)

    def at_setting(self, setting: Setting, needed: str) -> None:
        """An object written by the configuration, which must exist with the right length."""
        row = self._row(setting.index, setting.sub, str(setting), needed)
        row.meaning = setting.why
        if row.needed != needed:
            row.needed = "its own value, written at configuration"
        data = self._read(
            setting.index, setting.sub, row, setting.optional, setting.instead, setting.size
        )
        if data is None:
            return
        if len(data) != setting.size:
            text = f"{len(data)} bytes, not {setting.size}"
            is_limit = setting.name == CURRENT_LIMIT
            change = "profile: `bytes` of torque_limit" if is_limit else "see the drive's manual"
            row.note(self._node, text, "wrong", change)
        else:
            row.note(self._node, setting.text(struct.unpack(setting.form, data)[0]))
        if setting.per_mille_of is not None:
            rated = self._row(*setting.per_mille_of, "rated value of the limit", "more than 0")
            found = self._read(*setting.per_mille_of, rated, optional=False)
            if found is not None:
                value = int.from_bytes(found, "little")
                misfit = setting.misfit_of(value)
                rated.note(self._node, str(value), "wrong" if misfit else "ok", misfit)

    def at_absent(self, setting: Setting) -> None:
        """An object that the profile declares absent; if it exists, its value is checked."""
        needed = f"absent as in the profile, or {setting.text(setting.value)}"
        row = self._row(setting.index, setting.sub, str(setting), needed)
        row.meaning = setting.why
        data = self._read(setting.index, setting.sub, row, optional=True, size=setting.size)
        if data is not None:
            text = setting.text(int.from_bytes(data, "little"))
            change = "remove it from `absent` in the drive profile"
            row.note(self._node, text, "ok" if setting.is_kept(data) else "wrong", change)

    def at_unused(self, index: int) -> bool:
        """An unused PDO, which is switched off if it exists; returns whether it exists."""
        row = self._row(index, 1, "PDO identifier", "none required: switched off if present")
        row.meaning = "other process data would only load the bus"
        data = self._read(index, 1, row, optional=True)
        if data is not None:
            row.note(self._node, f"{int.from_bytes(data, 'little'):X}h")
        return data is not None

    def _row(self, index: int, sub: int, name: str, needed: str) -> ObjectRow:
        text = name if name.startswith(f"{index:04X}h") else f"{object_name(index, sub)} {name}"
        return self._rows.setdefault((index, sub), ObjectRow(text, needed, ""))

    def _read(
        self,
        index: int,
        sub: int,
        row: ObjectRow,
        optional: bool,
        instead: str = "",
        size: int = 4,
    ) -> bytes | None:
        """Reads an object; None if it cannot be read, which is noted in the row."""
        try:
            return self._client.read(index, sub, row.object, size)
        except SdoAborted as error:
            code = error.abort_code
        if code == WRITE_ONLY:
            row.note(self._node, "present, write-only")
            return None
        absent = code in OBJECT_DOES_NOT_EXIST
        text = "absent" if absent else f"refused: {abort_text(code)}"
        if optional:
            good = absent and not instead
            row.note(self._node, text, "ok" if good else "remark", instead or "none required")
        else:
            how = how_without(self._profile, index, sub, self._client.read_if_there)
            row.note(self._node, text, "wrong", how)
        return None


# Reads the state of CiA 402 drives by SDO without changing anything.

_STATE = (
    (0x6041, "status word", 2),
    (0x6064, "position actual value", 4),
    (0x6077, "torque actual value", 2),
)


def read_states(
    rig: Rig,
    bus: can.BusABC,
    pump: Pump | None,
    *,
    to_reset: bool = False,
    partial: bool = False,
) -> DriveSnapshot:
    """Status word, position and torque of every drive; see `drivers.factory.read_drives`."""
    all_nodes, profile = [winch.node_id for winch in rig.winches], profile_of(rig)
    network = SetupNetwork(bus, pump, all_nodes, timeout=profile.sdo_timeout_ms / 1000.0)
    network.discard_waiting()
    silence: CdprError | None = None
    try:
        require_answers(network, all_nodes, revive=to_reset)
    except (HardwareMissing, Refused) as error:
        if not (partial and network.silent):
            raise
        silence = error
    drives = [drive for drive, node in enumerate(all_nodes) if node not in network.silent]
    nodes = [all_nodes[drive] for drive in drives]
    winch_map = WinchMap(rig)

    def read(index: int, name: str, size: int) -> list[int]:
        data = [network.client(node).read(index, 0, name, size) for node in nodes]
        return [int.from_bytes(value, "little", signed=True) for value in data]

    try:
        words, positions, torques = (read(*each) for each in _STATE)
        restarted = tuple(
            node
            for drive, node in zip(drives, nodes, strict=True)
            if not is_still_set_up(network, node, settings_for(rig, drive, winch_map, None))
        )
    except Refused:
        if silence is not None:
            raise
        require_objects(rig, network, _STATE)  # names all missing ones, not only the first
        raise
    is_faulted = [state_of(word & 0xFFFF) in FAULTED for word in words]
    codes = [
        stored_error(network.client(node).read_if_there) if faulted else 0
        for node, faulted in zip(nodes, is_faulted, strict=True)
    ]
    bits = power_bits(profile, operational=False)
    return DriveSnapshot(
        positions=np.array(positions, dtype=np.int64),
        torques=np.array(torques, dtype=np.int64) * winding_signs(rig)[drives],
        status_words=np.array(words, dtype=np.int64) & 0xFFFF,
        restarted=restarted,
        errors=tuple(
            emergency_text(code) if code else "; ".join(without_power(word, bits))
            for code, word in zip(codes, words, strict=True)
        ),
        silent=tuple(network.silent),
        silence=silence,
    )
