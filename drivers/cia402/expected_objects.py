"""Objects that a drive must hold before it is configured; they are only read."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from drivers.cia402.error_codes import emergency_text, stored_error
from drivers.cia402.object_dictionary import HEARTBEAT_CONSUMERS, SOFTWARE_LIMITS, Setting
from drivers.cia402.pdo import NmtCommand
from drivers.cia402.profile import (
    HOW_UNLISTED,
    HOW_WITHOUT_CSP,
    SUPPORTED_MODES,
    profile_of,
)
from drivers.cia402.sdo import NOT_NOW, WRITE_ONLY, SetupNetwork, means_absent, silent
from drivers.cia402.sdo_jobs import CSP_MODE
from drivers.cia402.state_machine import FAULTED, DriveState
from drivers.plausibility import WrongScale, wrong_scales
from drivers.setup_refusals import (
    SETTING_UP,
    SdoAborted,
    in_fault,
    moved_by_another,
    wrong_setting,
)
from model.errors import HardwareMissing, Refused
from model.files.drive_profile_file import ProfileDocument, object_key, object_name
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


_CSP_LISTED = Expectation(
    *(SUPPORTED_MODES, 0, 0x80, 0x80, "supported drive modes"),
    f"bit 7 is cyclic synchronous position (CSP); {HOW_UNLISTED}",
)
_BEFORE = (
    Expectation(0x1000, 0, 0xFFFF, 402, "device type", "only CiA 402 drives are supported"),
    Expectation(
        *(0x607E, 0, 0xA0, 0, "polarity"),
        "bit 5 inverts torques alone, bit 7 positions; `direction` of the winch inverts both",
        optional=True,
    ),
    Expectation(
        *(0x607C, 0, 0xFFFFFFFF, 0, "home offset"),
        "drives subtract it from the position limits 607Dh; `home_counts` of the winch replaces it",
        optional=True,
    ),
)


def _identifiers(node: int) -> tuple[Expectation, ...]:
    """Identifiers on which a drive receives SYNC and sends emergencies; CiA 301, 7.5.2.

    Bit 30 of 1005h makes the drive send SYNC, bit 29 selects 29-bit identifiers.
    """
    sync, emergency = (
        "the program alone sends SYNC, as 80h without a counter",
        "emergencies are received as 80h + node",
    )
    return (
        Expectation(0x1005, 0, 0x600007FF, 0x80, "COB-ID SYNC", sync, optional=True),
        Expectation(0x1014, 0, 0xA00007FF, 0x80 + node, "COB-ID EMCY", emergency, optional=True),
        Expectation(0x1019, 0, 0xFF, 0, "synchronous counter overflow", sync, optional=True),
    )


def _identity(rig: Rig) -> tuple[Expectation, ...]:
    """Vendor and product that the rig file requires, if any (1018h)."""
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
    *(0x6061, 0, 0xFF, CSP_MODE, "mode of operation display"),
    "the mode must be active; for a drive that shows it only once enabled, set"
    " mode_display_when_enabled: true in its profile",
)
"""Required mode after the configuration, or once enabled (`ProfileDocument`)."""


SAVED_BY_COMMAND = Expectation(
    *(0x1010, 1, 0x2, 0, "store parameters"),
    "settings that were lost show a power cycle, with which incremental encoders lose their zero",
    optional=True,
)
"""Bit 1: the drive saves its settings without a command. Source: CiA 301, 7.5.2.13."""

HOW_SAVED = (
    "it saves its settings on its own (1010h:01, bit 1), so that no power cycle is noticed: run"
    " `cdpr home` after each, as its encoder is incremental"
)


def expectations(rig: Rig, profile: ProfileDocument, node: int) -> tuple[Expectation, ...]:
    """Requirements of a drive before anything is written to it."""
    listed = () if profile.csp_unlisted else (_CSP_LISTED,)
    return (*_BEFORE, *listed, *_identifiers(node), *_identity(rig), *_expected_by(profile))


def _expected_by(profile: ProfileDocument) -> tuple[Expectation, ...]:
    """Values that the profile requires and the program does not write, such as units."""
    return tuple(
        Expectation(*object_key(each.object), 0xFFFFFFFF, each.value, each.name, each.why)
        for each in profile.expect
    )


def how_to_set(expected: Expectation) -> str:
    """The next step for a wrong value."""
    if expected.index == SUPPORTED_MODES:
        return HOW_WITHOUT_CSP
    if expected is SAVED_BY_COMMAND:
        return HOW_SAVED
    if expected.index in (0x1000, 0x1018):
        return "check the node id, and vendor_id and product_code of the rig file"
    return BY_MAKERS_TOOL


BY_MAKERS_TOOL = "set it with the manufacturer's tool and store it"


# Checks of the drives before anything is written.


def require_answers(network: SetupNetwork, nodes: Sequence[int], *, revive: bool = False) -> None:
    """Contacts all drives at once, and reports all silent ones together.

    Args:
        revive: Takes drives that are in NMT *stopped* to *pre-operational*.

    Raises:
        HardwareMissing: Drives do not answer.
        Refused: Drives are in NMT *stopped*, or the single silent drive gives a wrong answer.
    """
    nothing = network.silent_nodes(nodes)
    stopped = [node for node in nothing if network.is_stopped(node)]
    if stopped and revive:
        for node in stopped:
            network.command(NmtCommand.PRE_OPERATIONAL, node)
        nothing = network.silent_nodes(nothing)
    elif stopped:
        names = ", ".join(str(node) for node in stopped)
        raise Refused(
            f"drive {names}: in the NMT state 'stopped', by its heartbeat",
            where=SETTING_UP,
            why="another program, or the drive's own reaction to a communication error (1029h),"
            " stopped its communication",
            next_step="end other programs, then run `cdpr reset RIG`",
            values={"nodes": names},
        )
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


def require_expected(network: SetupNetwork, node: int, expected: Expectation) -> None:
    """Requires that an object holds the expected value, or is optional and absent.

    Raises:
        Refused: It holds another value, or is missing.
    """
    try:
        data = network.client(node).read(expected.index, expected.sub, expected.name)
    except SdoAborted as error:
        if expected.optional and means_absent(error):
            return
        error.why = error.why or f"required because: {expected.why}"
        raise
    value = int.from_bytes(data, "little")
    if value & expected.mask != expected.expected:
        found, wanted = f"{value:X}h", f"{expected.expected:X}h"
        raise wrong_value(node, str(expected), found, wanted, expected.why)


POSITION_RANGE = 0x607B
"""Positions wrap around at its sub-indices 1 and 2, unless both are 0. Source: CiA 402-2."""
NO_WRAP = "0 and 0, or more than 607Dh"
"""The required position range."""


def position_range(
    read: Callable[[int, int, str], bytes | None],
) -> tuple[int, int] | None:
    """The position range limits of a drive, [counts]; None if there are none.

    Args:
        read: Reads an optional object by index, sub-index and name.
    """
    data = [read(POSITION_RANGE, sub, f"{name} position range limit") for sub, name in _ENDS]
    low, high = (int.from_bytes(each or b"", "little", signed=True) for each in data)
    return (low, high) if low or high else None


_ENDS = ((1, "min"), (2, "max"))


def position_scales(
    read: Callable[[int, int, str], bytes | None],
) -> dict[str, float]:
    """Position counts per motor turn that a drive states, by object, the one that counts first.

    A factor group scales positions; where it is not set (a feed of 1 per turn, whatever the gear
    ratio) the encoder does. Objects that are missing, zero or refused state nothing. Source: CiA
    402-2, factor group.

    Args:
        read: As for `position_range`.
    """
    feed, gear, encoder = (_quotient(read, index) for index in (0x6092, 0x6091, 0x608F))
    scales = {"6092h/6091h": feed / (gear or 1.0)} if feed and feed != 1.0 else {}
    return scales | ({"608Fh": encoder} if encoder else {})


def _quotient(read: Callable[[int, int, str], bytes | None], index: int) -> float | None:
    """Sub-index 1 divided by sub-index 2; None if the object is missing or zero."""
    try:
        data = [read(index, sub, "position scale") for sub in (1, 2)]
    except SdoAborted:
        return None
    above, below = (int.from_bytes(each or b"", "little") for each in data)
    return above / below if above and below else None


def saved_alone(read: Callable[[int, int, str], bytes | None]) -> list[str]:
    """A remark if a drive saves its settings on its own; none if it does not state it.

    Args:
        read: As for `position_range`.
    """
    try:
        data = read(SAVED_BY_COMMAND.index, SAVED_BY_COMMAND.sub, SAVED_BY_COMMAND.name)
    except SdoAborted:
        return []
    return [HOW_SAVED] if int.from_bytes(data or b"", "little") & SAVED_BY_COMMAND.mask else []


SCALE = "position counts per motor turn"
HOW_SCALED = (
    "compare 6064h over one motor turn, then correct the drive or winches[].counts_per_rev;"
    " if 6092h, 6091h and 608Fh do not describe 6064h, set states_scale: false in the profile"
)


def wrong_scales_of(
    rig: Rig, nodes: Sequence[int], scales_of: Callable[[int], Mapping[str, float]]
) -> list[WrongScale]:
    """Drives whose `position_scales`, by node, contradict the rig file, as indices of ``nodes``.

    They are not asked for where the profile says that they mean something else.
    """
    states_scale = profile_of(rig).states_scale
    if states_scale is False:
        return []
    counts = {w.node_id: w.counts_per_rev for w in rig.document.winches}
    scales = [scales_of(node) for node in nodes]
    return wrong_scales([counts[node] for node in nodes], scales, known=bool(states_scale))


def refuse_scale(node: int, wrong: WrongScale) -> None:
    """Raises `Refused` for a drive whose position scale is certainly another than the rig's."""
    if wrong.certain:
        found, wanted = f"{wrong.stated:.10g} by {wrong.source}", str(wrong.counts)
        raise wrong_setting(node, SCALE, found, wanted, "counts_per_rev of the winch", HOW_SCALED)


def holds_limits(wraps: tuple[int, int] | None, settings: Sequence[Setting]) -> bool:
    """Whether positions do not wrap around within the software limits 607Dh of the settings."""
    limits = [setting.value for setting in settings if setting.index == SOFTWARE_LIMITS]
    return wraps is None or (bool(limits) and wraps[0] <= min(limits) and max(limits) <= wraps[1])


def require_no_wrap(network: SetupNetwork, node: int, settings: Sequence[Setting]) -> None:
    """Requires a position range, if there is one, that holds the software limits.

    Raises:
        Refused: Positions would wrap around.
    """
    found = position_range(network.client(node).read_if_there)
    if not holds_limits(found, settings):
        raise wrong_value(
            *(node, f"{POSITION_RANGE:04X}h position range limit", str(found)),
            *(NO_WRAP, "positions would wrap around"),
        )


def require_there(network: SetupNetwork, node: int, setting: Setting) -> None:
    """Requires that an object exists, so that all missing ones are reported before any write.

    Raises:
        Refused: The drive lacks a required object, or its value is a share of nothing.
    """
    if setting.per_mille_of is not None:
        index, sub = setting.per_mille_of
        rated = int.from_bytes(network.client(node).read(index, sub, "rated value"), "little")
        if misfit := setting.misfit_of(rated):
            name, why = f"{object_name(index, sub)} rated value", f"{setting} is a share of it"
            raise wrong_value(node, name, str(rated), "the motor's", f"{why}; {misfit}")
    if setting.optional or setting.transient:
        return
    try:
        network.client(node).read(setting.index, setting.sub, setting.name, setting.size)
    except SdoAborted as error:
        # The others would be noticed only when limits have been changed.
        if error.abort_code not in (WRITE_ONLY, *NOT_NOW):
            raise


def require_absent(network: SetupNetwork, node: int, setting: Setting) -> None:
    """Requires that an object declared absent is absent, or holds the required value.

    Raises:
        Refused: It exists, with another value.
    """
    try:
        data = network.client(node).read(setting.index, setting.sub, setting.name, setting.size)
    except SdoAborted as error:
        if not means_absent(error):
            raise
        return
    if not setting.is_kept(data):
        found = found_text(data, setting)
        raise Refused(
            f"the profile declares it absent; the drive has it with {found},"
            f" {setting.text(setting.value)} is required",
            where=f"drive {node}, object {setting}",
            next_step="remove the object from `absent` in the drive profile",
            values={"node": node, "object": str(setting), "found": found},
        )


_STATUS_WORD = "object 6041h:00 status word"


def require_idle(network: SetupNetwork, node: int, to_reset: bool, errors: dict[int, int]) -> None:
    """Refuses an enabled drive, which another master controls; quick stop is accepted.

    Args:
        to_reset: Accepts a drive in fault.
        errors: Gets the error code of one in fault, by node.

    Raises:
        Refused: It is enabled, or in fault without ``to_reset``.
    """
    state = network.client(node).read_state()
    if state in FAULTED:
        errors[node] = code = stored_error(network.client(node).read_if_there)
        if not to_reset:
            why = "it stopped itself; its display or the manufacturer's tool shows the cause"
            known = f": {emergency_text(code)}" if code else ""
            raise in_fault(node, known, _STATUS_WORD, why)
    if state is DriveState.OPERATION_ENABLED:
        raise moved_by_another(node, "enabled already", _STATUS_WORD)


def count_heartbeats(
    network: SetupNetwork, node: int, profile: ProfileDocument, entries: list[int]
) -> None:
    """Appends the number of entries of 1016h that the drive states.

    Raises:
        Refused: It has none, and the profile requires one.
    """
    name, needed = "consumer heartbeat entries", profile.watches_heartbeats
    client = network.client(node)
    read = client.read if needed else client.read_if_there
    data = read(HEARTBEAT_CONSUMERS, 0, name, 1) if profile.has(HEARTBEAT_CONSUMERS, 1) else None
    count = int.from_bytes(data or b"", "little")
    if count < 1 and needed:
        raise wrong_value(node, f"1016h:00 {name}", "0", "1 or more", "watch the master")
    entries.append(count)


def found_text(data: bytes, setting: Setting) -> str:
    """A value read as text, or the bytes if the length is wrong."""
    if len(data) != setting.size:
        return f"{len(data)} bytes ({data.hex()})"
    return setting.text(struct.unpack(setting.form, data)[0])


def wrong_value(node: int, name: str, found: str, wanted: str, why: str) -> Refused:
    """An object of a drive holds a wrong value."""
    return wrong_setting(node, f"object {name}", found, wanted, why, "see the drive's manual")


# Whether drives identify themselves as simulated.
#: Manufacturer device name (1008h) of simulated drives. Source: CiA 301, 7.5.2.8.
SIMULATED = b"cdpr simulated drive"


def are_simulated(network: SetupNetwork, nodes: Sequence[int]) -> bool:
    """Whether every drive has the device name of a simulated one.

    Reads the drives in turn up to the first real one. A drive that does not answer counts as real.

    Raises:
        Refused: Another master is active, or a drive restarted.
        Fault: The bus failed.
    """
    try:
        return all(
            network.client(node).read_if_there(0x1008, 0, "manufacturer device name") == SIMULATED
            for node in nodes
        )
    except HardwareMissing:
        return False
    except Refused as error:
        if "node" not in error.values:
            raise
        return False
