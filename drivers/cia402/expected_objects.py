"""Objects that a drive must hold before anything is written to it; none of them is written."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from drivers.can_errors import in_fault, keeps_another, moved_by_another
from drivers.cia402.object_dictionary import HEARTBEAT_CONSUMERS, Setting
from drivers.cia402.sdo import NOT_NOW, SetupNetwork
from drivers.cia402.sdo_jobs import CSP_MODE, OBJECT_DOES_NOT_EXIST
from drivers.cia402.state_machine import FAULTED, DriveState, state_of
from model.errors import Refused
from model.files.drive_profile_file import ProfileDocument, object_key
from model.files.rig_file import Cia402Document
from model.rig import Rig


@dataclass(frozen=True, slots=True)
class Expectation:
    """One object to read: ``value & mask`` must be ``expected``; optional ones may be absent."""

    index: int
    sub: int
    mask: int
    expected: int
    name: str
    why: str
    optional: bool = False

    def __str__(self) -> str:
        """Index, sub-index and name."""
        return f"{self.index:04X}h:{self.sub:02X} {self.name}"


#: What a drive must be before anything is written to it.
BEFORE = (
    Expectation(0x1000, 0, 0xFFFF, 402, "device type", "only CiA 402 drives are supported"),
    Expectation(
        *(0x6502, 0, 0x80, 0x80, "supported drive modes"),
        "cyclic synchronous position (CSP), bit 7; Technosoft iPOS and Pilz PRBT do not have it",
    ),
)


def identifiers(node: int) -> tuple[Expectation, ...]:
    """On what identifiers a drive hears SYNC and sends its emergencies; CiA 301, 7.5.2."""
    sync, emergency = (
        "SYNC goes out as 80h, without a counter",
        "emergencies are heard as 80h + node",
    )
    return (
        Expectation(0x1005, 0, 0x7FF, 0x80, "COB-ID SYNC", sync, optional=True),
        Expectation(0x1014, 0, 0x800007FF, 0x80 + node, "COB-ID EMCY", emergency, optional=True),
        Expectation(0x1019, 0, 0xFF, 0, "synchronous counter overflow", sync, optional=True),
    )


def identity(rig: Rig) -> tuple[Expectation, ...]:
    """Whose drives they must be, where the rig file says so (1018h)."""
    drives = rig.document.drives
    if not isinstance(drives, Cia402Document):
        return ()
    named = ((1, drives.vendor_id, "vendor id"), (2, drives.product_code, "product code"))
    why = "the rig file requires this drive"
    return tuple(
        Expectation(0x1018, sub, 0xFFFFFFFF, value, name, why)
        for sub, value, name in named
        if value is not None
    )


MODE_DISPLAY = Expectation(
    0x6061, 0, 0xFF, CSP_MODE, "mode of operation display", "the mode must be active"
)
"""What it must show after the set-up, or once enabled (`ProfileDocument`)."""


def expected_by(profile: ProfileDocument) -> tuple[Expectation, ...]:
    """What drives of a profile must hold that the program does not write, such as units."""
    return tuple(
        Expectation(*object_key(each.object), 0xFFFFFFFF, each.value, each.name, each.why)
        for each in profile.expect
    )


def how_to_set(expected: Expectation) -> str:
    """The next step where a drive holds another value."""
    if expected.index == 0x6502:
        return (
            "none: a drive without cyclic synchronous position (CSP) cannot be used; Technosoft"
            " iPOS and Pilz PRBT do not have it"
        )
    if expected.index in (0x1000, 0x1018):
        return "check the node id, and vendor_id and product_code of the rig file"
    return "set it with the maker's tool and store it"


# Questions to one drive, each of which refuses it; asked before anything is written.


def require_expected(network: SetupNetwork, node: int, expected: Expectation) -> None:
    """An object holds what is expected, or is absent where it may be.

    Raises:
        Refused: It does not.
    """
    try:
        data = network.client(node).read(expected.index, expected.sub, expected.name)
    except Refused as error:
        if expected.optional and error.values.get("abort_code") not in (None, *NOT_NOW):
            return
        raise
    value = int.from_bytes(data, "little")
    if value & expected.mask != expected.expected:
        found, wanted = f"{value:X}h", f"{expected.expected:X}h"
        raise wrong_value(node, str(expected), found, wanted, expected.why)


def require_there(network: SetupNetwork, node: int, setting: Setting) -> None:
    """Missing objects are all reported before any is written; other errors show then.

    Raises:
        Refused: A drive does not have an object that it needs.
    """
    if setting.optional or setting.transient:
        return
    try:
        network.client(node).read(setting.index, setting.sub, setting.name, setting.size)
    except Refused as error:
        if error.values.get("abort_code") in OBJECT_DOES_NOT_EXIST:
            raise


def require_absent(network: SetupNetwork, node: int, setting: Setting) -> None:
    """Of an object that its profile calls absent: it is, or holds what it must anyway.

    Raises:
        Refused: It is there, with another value.
    """
    try:
        data = network.client(node).read(setting.index, setting.sub, setting.name, setting.size)
    except Refused as error:
        if error.values.get("abort_code") in (None, *NOT_NOW):
            raise
        return
    if not setting.is_kept(data):
        found = number_text(data, setting.form)
        raise Refused(
            f"its profile says that it is absent; the drive has it with {found},"
            f" {setting.value} is required",
            where=f"drive {node}, object {setting}",
            next_step="take the object out of `absent` in the drive profile",
            values={"node": node, "object": str(setting), "found": found},
        )


_STATUS_WORD = "object 6041h:00 status word"


def require_idle(network: SetupNetwork, node: int, to_reset: bool) -> None:
    """A drive that is enabled belongs to somebody; one that holds in quick stop may be taken.

    Raises:
        Refused: It is enabled, or in fault and not about to be reset.
    """
    data = network.client(node).read(0x6041, 0, "status word", 2)
    state = state_of(int.from_bytes(data, "little"))
    if state in FAULTED and not to_reset:
        why = "it stopped itself; see its display or maker's tool for the cause"
        raise in_fault(node, "", _STATUS_WORD, why)
    if state is DriveState.OPERATION_ENABLED:
        raise moved_by_another(node, "enabled already", _STATUS_WORD)


def count_heartbeats(
    network: SetupNetwork, node: int, profile: ProfileDocument, entries: list[int]
) -> None:
    """Appends how many entries of 1016h the drive has, as far as the profile uses them.

    Raises:
        Refused: It has none, and the profile needs one.
    """
    name, needed = "consumer heartbeat entries", profile.watches_heartbeats
    client = network.client(node)
    read = client.read if needed else client.read_if_there
    data = read(HEARTBEAT_CONSUMERS, 0, name, 1) if profile.has(HEARTBEAT_CONSUMERS, 1) else None
    count, most = int.from_bytes(data or b"", "little"), profile.heartbeat_entries
    if count < 1 and needed:
        raise wrong_value(node, f"1016h:00 {name}", "0", "1 or more", "watch the master")
    entries.append(count if most is None else min(count, most))


def number_text(data: bytes, form: str) -> str:
    """A value of the type that `struct` names, or what came in its place."""
    if len(data) != struct.calcsize(form):
        return f"{len(data)} bytes ({data.hex()})"
    return str(struct.unpack(form, data)[0])


def wrong_value(node: int, place: str, found: str, wanted: str, why: str) -> Refused:
    """A drive holds another value than the one that is needed."""
    return keeps_another(node, f"object {place}", found, wanted, why, "the drive's manual")
