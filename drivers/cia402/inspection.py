"""Reads every object that a set-up needs from every drive, all problems at once; writes nothing."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import can
import numpy as np

from drivers.cia402.configure import is_still_set_up, require_answers
from drivers.cia402.error_codes import abort_text
from drivers.cia402.expected_objects import (
    BEFORE,
    MODE_DISPLAY,
    Expectation,
    expected_by,
    how_to_set,
    identifiers,
    identity,
)
from drivers.cia402.object_dictionary import (
    HEARTBEAT_CONSUMERS,
    Setting,
    settings_for,
    stated_absent,
)
from drivers.cia402.profile import (
    for_unused_pdos,
    load_profile,
    profile_names,
    profile_of,
)
from drivers.cia402.sdo import SetupNetwork
from drivers.cia402.sdo_jobs import OBJECT_DOES_NOT_EXIST
from drivers.cia402.state_machine import FAULTED, DriveState, state_of, without_power
from drivers.drive_group import DriveSnapshot, Pump
from drivers.plausibility import winding_signs
from model.errors import CdprError, Refused
from model.files.drive_profile_file import NEEDED, OBJECTS, ProfileDocument, object_name
from model.rig import Rig
from model.winches import WinchMap

Verdict = Literal["ok", "remark", "wrong"]

WRITE_ONLY = 0x06010001
MOST_VALUES = 3
"""Of an object that are listed; more are reported as different ones."""

_WORST: tuple[Verdict, ...] = ("ok", "remark", "wrong")

_PROCESS_DATA = (
    (0x6040, "<H", "controlword", "commands of the master"),
    (0x607A, "<i", "target position", "set-points"),
    (0x6064, "<i", "position actual value", "replies"),
    (0x6077, "<h", "torque actual value", "tension of the cable"),
    (MODE_DISPLAY.index, "<b", MODE_DISPLAY.name, MODE_DISPLAY.why),
)


@dataclass(slots=True)
class ObjectRow:
    """One object of all drives.

    Attributes:
        object: Index, sub-index and name.
        needed: What it must hold, or that it must be there.
        meaning: What it is needed for.
        verdict: The worst of all drives.
        change: The next step where it is not good.
        found: What was found, and in which nodes.
    """

    object: str
    needed: str
    meaning: str
    verdict: Verdict = "ok"
    change: str = ""
    found: dict[str, list[int]] = field(default_factory=dict)

    def note(self, node: int, text: str, verdict: Verdict = "ok", change: str = "") -> None:
        """Adds what one drive reported."""
        self.found.setdefault(text, []).append(node)
        if _WORST.index(verdict) > _WORST.index(self.verdict):
            self.verdict, self.change = verdict, change

    def found_text(self, nodes: Sequence[int]) -> str:
        """``all: 8``, or each value with its drives."""
        if len(self.found) > MOST_VALUES and self.verdict == "ok":
            return "present; differs between drives"
        if [sorted(nodes)] == [sorted(each) for each in self.found.values()]:
            return f"all: {next(iter(self.found))}"
        return "; ".join(
            f"drive {', '.join(map(str, each))}: {text}" for text, each in self.found.items()
        )


@dataclass(frozen=True, slots=True)
class Examined:
    """What was found.

    Attributes:
        nodes: The drives that answered.
        silent: Those that did not.
        rows: One for each object.
    """

    nodes: tuple[int, ...]
    silent: tuple[int, ...]
    rows: tuple[ObjectRow, ...]

    @property
    def good(self) -> bool:
        """Every drive can be set up, as far as reading shows."""
        return not self.silent and all(row.verdict != "wrong" for row in self.rows)

    def as_dict(self) -> dict[str, Any]:
        """For `--json`."""
        return {
            "answered": list(self.nodes),
            "silent": list(self.silent),
            "objects": [
                {
                    "object": row.object,
                    "verdict": row.verdict,
                    "needed": row.needed,
                    "found": [
                        {"drives": nodes, "value": text} for text, nodes in row.found.items()
                    ],
                    "meaning": row.meaning,
                    "change": row.change,
                }
                for row in self.rows
            ],
        }


def examine_drives(rig: Rig, bus: can.BusABC, pump: Pump | None) -> Examined:
    """Reads all objects of all drives; sends SDO uploads and nothing else.

    Args:
        rig: The robot; its profile says what the drives have.
        bus: An open bus.
        pump: As for `drivers.factory.make_drive_group`.

    Raises:
        BadInput: The profile or a value of the rig is wrong.
        HardwareMissing: A drive fell silent meanwhile.
        Fault: The bus failed.
    """
    profile, winch_map = profile_of(rig), WinchMap(rig)
    all_nodes = [winch.node_id for winch in rig.winches]
    network = SetupNetwork(bus, pump, all_nodes, timeout=profile.sdo_timeout_ms / 1000.0)
    network.discard_waiting()
    silent = network.silent_nodes(all_nodes)
    rows: dict[tuple[int, int], ObjectRow] = {}
    for drive, node in enumerate(all_nodes):
        if node in silent:
            continue
        look = _Look(network, node, rows)
        for expected in (*BEFORE, *identifiers(node), *identity(rig), *expected_by(profile)):
            look.at_expected(expected)
        look.at_state()
        for index, form, name, why in _PROCESS_DATA:
            look.at_setting(Setting(index, 0, form, 0, name, why), "readable")
        look.at_scale(rig.document.winches[drive].counts_per_rev)
        look.at_heartbeats(profile, rig.cable_count)
        for setting in _last_of_each(settings_for(rig, drive, winch_map, None)):
            look.at_setting(setting, _needed(setting))
        for setting in stated_absent(rig, drive, winch_map):
            look.at_absent(setting)
        for_unused_pdos(profile, look.at_unused)
    answered = tuple(node for node in all_nodes if node not in silent)
    return Examined(answered, tuple(silent), tuple(rows.values()))


def _last_of_each(settings: Iterable[Setting]) -> list[Setting]:
    """What an object holds in the end, without the steps towards it."""
    return list({(s.index, s.sub): s for s in settings if not s.transient}.values())


def _number(setting: Setting, value: int) -> str:
    """Objects and identifiers of process data in hexadecimal digits, as manuals print them."""
    is_entry = 0x1400 <= setting.index < 0x1C00 and setting.size == 4
    return f"{value:08X}h" if is_entry else str(value)


def _needed(setting: Setting) -> str:
    if setting.per_mille_of is None:
        return f"{_number(setting, setting.value)}, written at set-up"
    return f"{setting.value} per mille of {object_name(*setting.per_mille_of)}, written at set-up"


class _Look:
    """What one drive holds, into the rows of all."""

    def __init__(
        self, network: SetupNetwork, node: int, rows: dict[tuple[int, int], ObjectRow]
    ) -> None:
        self._client, self._node, self._rows = network.client(node), node, rows

    def at_expected(self, expected: Expectation) -> None:
        """An object that must hold a value which is not written."""
        row = self._row(expected.index, expected.sub, str(expected), f"{expected.expected:X}h")
        row.meaning = expected.why
        data = self._read(expected.index, expected.sub, row, expected.optional)
        if data is None:
            return
        value = int.from_bytes(data, "little")
        good = value & expected.mask == expected.expected
        change = "" if good else how_to_set(expected)
        row.note(self._node, f"{value:X}h", "ok" if good else "wrong", change)

    def at_state(self) -> None:
        """Where the drive is in the state machine."""
        row = self._row(0x6041, 0, "6041h:00 statusword", "not enabled, no fault")
        row.meaning = "only drives at rest are configured"
        data = self._read(0x6041, 0, row, optional=False)
        if data is None:
            return
        word = int.from_bytes(data, "little")
        state = state_of(word)
        if state in FAULTED:
            row.note(
                self._node, state.value, "wrong", "remove the cause, then run `cdpr reset RIG`"
            )
        elif state is DriveState.OPERATION_ENABLED:
            row.note(self._node, state.value, "remark", "another program moves it; end it first")
        elif shown := without_power(word):
            row.note(self._node, state.value, "remark", f"before a motion: {' and '.join(shown)}")
        else:
            row.note(self._node, state.value)

    def at_heartbeats(self, profile: ProfileDocument, drives: int) -> None:
        """How many producers the drive can watch."""
        name, needed = "consumer heartbeat entries", f"1; {drives} to monitor every peer as well"
        used = profile.watches_heartbeats
        row = self._row(
            HEARTBEAT_CONSUMERS, 0, f"1016h:00 {name}", needed if used else "any, not used"
        )
        row.meaning = (
            "stop when the master or a peer is lost"
            if used
            else "a lost heartbeat would take the torque off"
        )
        data = self._read(HEARTBEAT_CONSUMERS, 0, row, optional=not used, size=1)
        if data is None:
            return
        count = int.from_bytes(data, "little")
        if not used:
            row.note(self._node, str(count))
        elif count < 1:
            row.note(
                self._node,
                "0",
                "wrong",
                "a drive that cannot monitor its master is not safe to run",
            )
        elif min(count, profile.heartbeat_entries or count) < drives:
            row.note(self._node, str(count), "remark", "none required: not every peer is monitored")
        else:
            row.note(self._node, str(count))

    def at_scale(self, counts_per_turn: int) -> None:
        """Position counts of a motor turn, as far as the drive says; CiA 402-2, factor group."""
        row = self._row(0x6092, 1, "feed constant, 6091h gear ratio, 608Fh encoder resolution", "")
        row.meaning = "position counts of a motor turn: winches[].counts_per_rev"
        row.needed = row.needed or f"{counts_per_turn} a turn, where the drive has them"
        feed, gear, encoder = (self._quotient(index) for index in (0x6092, 0x6091, 0x608F))
        said = {"6092h/6091h": feed / (gear or 1.0)} if feed else {}
        if encoder:
            said["608Fh"] = encoder
        text = ", ".join(f"{value:.10g} by {name}" for name, value in said.items()) or "absent"
        if not said or counts_per_turn in said.values():
            row.note(self._node, text)
        else:
            row.note(self._node, text, "remark", "compare with 6064h over a motor turn by hand")

    def at_setting(self, setting: Setting, needed: str) -> None:
        """An object that is written at set-up: it must be there, and of that length."""
        row = self._row(setting.index, setting.sub, str(setting), needed)
        row.meaning = setting.why
        if row.needed != needed:
            row.needed = "its own value, written at set-up"
        data = self._read(
            setting.index, setting.sub, row, setting.optional, setting.instead, setting.size
        )
        if data is None:
            return
        if len(data) != setting.size:
            text = f"{len(data)} bytes, not {setting.size}"
            row.note(self._node, text, "wrong", "compare with the drive's manual")
        else:
            row.note(self._node, _number(setting, struct.unpack(setting.form, data)[0]))
        if setting.per_mille_of is not None:
            rated = self._row(*setting.per_mille_of, "rated value of the limit", "more than 0")
            found = self._read(*setting.per_mille_of, rated, optional=False)
            if found is not None:
                value = int.from_bytes(found, "little")
                change = "" if value else "enter the motor data with the maker's tool"
                rated.note(self._node, str(value), "ok" if value else "wrong", change)

    def at_absent(self, setting: Setting) -> None:
        """An object that the profile calls absent; where it is there, its value counts."""
        needed = f"absent by the profile, or {_number(setting, setting.value)}"
        row = self._row(setting.index, setting.sub, str(setting), needed)
        row.meaning = setting.why
        data = self._read(setting.index, setting.sub, row, optional=True, size=setting.size)
        if data is not None:
            text = _number(setting, int.from_bytes(data, "little"))
            good = setting.is_kept(data)
            change = "" if good else "take it out of `absent` in the drive profile"
            row.note(self._node, text, "ok" if good else "wrong", change)

    def at_unused(self, index: int) -> bool:
        """A PDO that is switched off at set-up where it is there, which is returned."""
        row = self._row(index, 1, "PDO identifier", "none required: switched off where it is there")
        row.meaning = "other process data would only fill the bus"
        data = self._read(index, 1, row, optional=True)
        if data is not None:
            row.note(self._node, f"{int.from_bytes(data, 'little'):X}h")
        return data is not None

    def _quotient(self, index: int) -> float | None:
        """Sub-index 1 by sub-index 2; None where there is no such object, or no number."""
        try:
            data = [self._client.read_if_there(index, sub, "position scale") for sub in (1, 2)]
        except Refused as error:
            if "abort_code" not in error.values:
                raise
            return None
        above, below = (int.from_bytes(each or b"", "little") for each in data)
        return above / below if above and below else None

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
        """The object; None where it cannot be read, which is noted."""
        try:
            return self._client.read(index, sub, row.object, size)
        except Refused as error:
            code = error.values.get("abort_code")
            if code is None:
                raise
        if code == WRITE_ONLY:
            row.note(self._node, "present, write-only")
            return None
        absent = code in OBJECT_DOES_NOT_EXIST
        text = "absent" if absent else f"refused: {abort_text(int(code))}"
        if optional:
            good = absent and not instead
            row.note(self._node, text, "ok" if good else "remark", instead or "none required")
        else:
            row.note(self._node, text, "wrong", _how_without(index, sub))
        return None


_BESIDE = {
    "1006h:00": ", with monitoring: heartbeat",
    "1016h:01": "; the SYNC time-out alone then stops the drive",
    "6072h:00": ", with torque_limit",
    "60C2h:01": ", where the drive needs no interpolation time",
    "60C2h:02": ", where the drive needs no interpolation time",
}
"""What else a profile says in which an object is absent."""


def _how_without(index: int, sub: int) -> str:
    """Of an object that is needed and not there."""
    name = "1016h:01" if index == HEARTBEAT_CONSUMERS else object_name(index, sub)
    if name not in OBJECTS or name in NEEDED:
        return "use another drive or firmware: no profile makes up for it"
    own = f"name it as absent in a drive profile of your own{_BESIDE.get(name, '')}"
    there = [each for each in profile_names() if name in load_profile(each).absent]
    of_ours = "".join(f"; {load_profile(each).name} have drives.profile: {each}" for each in there)
    return own + of_ours


# Looks at CiA 402 drives without changing anything: questions by SDO, and nothing else.


def read_states(rig: Rig, bus: can.BusABC, pump: Pump | None) -> DriveSnapshot:
    """Status word, position and torque of every drive; see `drivers.factory.read_drives`."""
    nodes = [winch.node_id for winch in rig.winches]
    timeout = profile_of(rig).sdo_timeout_ms / 1000.0
    network = SetupNetwork(bus, pump, nodes, timeout=timeout)
    network.discard_waiting()
    require_answers(network, nodes)
    winch_map = WinchMap(rig)

    def read(index: int, name: str, size: int) -> list[int]:
        data = [network.client(node).read(index, 0, name, size) for node in nodes]
        return [int.from_bytes(value, "little", signed=True) for value in data]

    words = [word & 0xFFFF for word in read(0x6041, "status word", 2)]
    return DriveSnapshot(
        positions=np.array(read(0x6064, "position actual value", 4), dtype=np.int64),
        torques=np.array(read(0x6077, "torque actual value", 2), dtype=np.int64)
        * winding_signs(rig),
        status_words=np.array(words, dtype=np.int64),
        restarted=tuple(
            node
            for drive, node in enumerate(nodes)
            if not is_still_set_up(network, node, settings_for(rig, drive, winch_map, None))
        ),
    )


# Whether drives say by themselves that they are simulated.


#: What simulated drives have as 1008h, the manufacturer device name. Source: CiA 301, 7.5.2.8.
SIMULATED = b"cdpr simulated drive"


def say_simulated(bus: can.BusABC, pump: Pump | None, nodes: Sequence[int]) -> bool:
    """Whether every drive has the name of a simulated one; real ones need not have a name.

    Asks the drives one after another, up to the first that is none. One that does not answer counts
    as real here: the set-up that follows says what is wrong with it.

    Args:
        bus: An open bus.
        pump: As for `drivers.factory.make_drive_group`.
        nodes: All drives.
    """
    network = SetupNetwork(bus, pump, nodes)
    network.discard_waiting()
    try:
        return all(
            network.client(node).read_if_there(0x1008, 0, "manufacturer device name") == SIMULATED
            for node in nodes
        )
    except CdprError:
        return False
