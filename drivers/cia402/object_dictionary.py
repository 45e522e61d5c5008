"""Every object written to a drive before it is enabled, with value and reason."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, replace

from drivers.can_load import HEARTBEATS_WAITED, heartbeat_timeout
from drivers.cia402.pdo import MASTER_NODE, RPDO1_BASE, TPDO1_BASE
from drivers.cia402.profile import (
    interpolation_time,
    produced_ms,
    profile_of,
    quick_stop_ramp,
    quick_stop_time,
    used_pdos,
)
from drivers.cia402.sdo_jobs import CSP_MODE
from drivers.plausibility import position_limits
from model.errors import BadInput
from model.files.drive_profile_file import ProfileDocument, object_key
from model.rig import Rig
from model.winches import WinchMap

PDO_INVALID = 1 << 31
PDO_NO_RTR = 1 << 30

PDO_IDENTIFIER = 0xA0000000 | 0x7FF
"""Bits of a COB-ID that are compared: valid, frame format, identifier. Drives may change bit 30 (no
RTR); the others are reserved. Source: CiA 301, 7.5.2.35."""

SYNCHRONOUS = range(241)
"""Transmission types of an RPDO that takes effect at SYNC. Source: CiA 301, 7.5.2.36."""

TORQUE_RESERVE = 1.2
"""Torque limit relative to the largest tension: the following-error monitor must trip first."""

LOWEST, HIGHEST = 0.99, 1.1
"""Share of a ramp that a drive may keep where it rounds to its own steps: hardly less steep."""

_CHECK_RIG = "check the winches, the cycle and the drive profile of the rig file"
_CHECK_LIMIT = "check `bytes` and the value at rated torque in torque_limit of the drive profile"
_UNSIGNED_MAX = {"<B": 0xFF, "<H": 0xFFFF, "<I": 0xFFFFFFFF}


@dataclass(frozen=True, slots=True)
class Setting:
    """One object to write and read back.

    Attributes:
        index: Object index.
        sub: Sub-index.
        form: Format of `struct`.
        value: Value to write.
        name: Name in the standard.
        why: Reason for the value.
        transient: Overwritten later in the list, so that only a refusal counts.
        optional: The object may be absent.
        instead: Consequence of its absence; empty if there is none.
        mask: Bits compared when it is read back; 0 for all.
        equivalent: Values with the same effect, all accepted; the first one is written where the
            drive refuses ``value`` as out of its range.
        rounded: The drive may keep a nearby value, from `LOWEST` to `HIGHEST` times this one.
        per_mille_of: The value is in per mille of this object's value.
    """

    index: int
    sub: int
    form: str
    value: int
    name: str
    why: str
    transient: bool = False
    optional: bool = False
    instead: str = ""
    mask: int = 0
    equivalent: range = range(0)
    rounded: bool = False
    per_mille_of: tuple[int, int] | None = None

    def data(self) -> bytes:
        """The value as bytes.

        Raises:
            BadInput: It does not fit.
        """
        try:
            return struct.pack(self.form, self.value)
        except struct.error:
            raise BadInput(
                f"{self} cannot hold {self.value}",
                where="configuring the drives",
                why=self.why,
                next_step=_CHECK_LIMIT if self.name == CURRENT_LIMIT else _CHECK_RIG,
            ) from None

    @property
    def size(self) -> int:
        """Size of the value, [bytes]."""
        return struct.calcsize(self.form)

    def is_kept(self, data: bytes) -> bool:
        """Whether the drive holds the value, or one with the same effect."""
        if len(data) != self.size:
            return False
        found = int.from_bytes(data, "little")
        if self.mask:
            return not (found ^ self.value) & self.mask
        is_near = self.rounded and LOWEST * self.value <= found <= HIGHEST * self.value
        return found in self.equivalent or is_near or data == self.data()

    def of_rated(self, rated: float) -> Setting:
        """The setting in the unit of ``rated``, the value at rated torque, not in per mille."""
        return replace(self, value=math.ceil(self.value * rated / 1000.0), per_mille_of=None)

    def misfit_of(self, rated: float) -> str:
        """Why the limit cannot be a share of ``rated``, and what to do; empty if it can."""
        if not rated:
            return "no torque would be left: enter the motor data with the manufacturer's tool"
        value = self.of_rated(rated).value
        fits = value <= _UNSIGNED_MAX[self.form]
        return "" if fits else f"its {self.size} bytes cannot hold {value}: {_CHECK_LIMIT}"

    def text(self, value: int) -> str:
        """A value as text; identifiers, mappings and 1016h in hexadecimal, as in manuals."""
        is_code = self.size == 4 and (0x1400 <= self.index < 0x1C00 or self.index == 0x1016)
        return f"{value:08X}h" if is_code else str(value)

    def __str__(self) -> str:
        """Index, sub-index and name."""
        return f"{self.index:04X}h:{self.sub:02X} {self.name}"


HEARTBEAT_CONSUMERS = 0x1016
SOFTWARE_LIMITS = 0x607D
CURRENT_LIMIT = "current limit"


def settings_for(
    rig: Rig, drive: int, winch_map: WinchMap, max_tension: float | None = None
) -> tuple[Setting, ...]:
    """The settings of one drive, in the order of writing.

    Args:
        drive: Index of its winch in the rig file.
        winch_map: The rig's lengths and counts.
        max_tension: Tension that sets the torque limit, [N]; the rig's if None.

    Raises:
        BadInput: A value of the rig does not fit its object.
    """
    profile = profile_of(rig)
    settings = _all_settings(rig, drive, winch_map, max_tension, profile)
    present = [each for each in settings if profile.has(each.index, each.sub)]
    return tuple(_within(each, profile, rig.cycle) for each in present)


def stated_absent(
    rig: Rig, drive: int, winch_map: WinchMap, max_tension: float | None = None
) -> tuple[Setting, ...]:
    """Settings that are not written because the profile declares the object absent.

    If a drive has it nevertheless, a value of another program could be active.

    Args:
        drive: Index of its winch in the rig file.
        winch_map: The rig's lengths and counts.
        max_tension: As for `settings_for`.

    Raises:
        BadInput: A value of the rig does not fit its object.
    """
    profile = profile_of(rig)
    watched = Setting(
        HEARTBEAT_CONSUMERS, 1, "<I", 0, "consumer heartbeat time", "none is monitored"
    )
    settings = (*_all_settings(rig, drive, winch_map, max_tension, profile), watched)
    return tuple(each for each in settings if not profile.has(each.index, each.sub))


def _all_settings(
    rig: Rig, drive: int, winch_map: WinchMap, max_tension: float | None, profile: ProfileDocument
) -> tuple[Setting, ...]:
    cycle = rig.cycle
    tension = rig.max_tension if max_tension is None else max_tension
    return (
        *_process_data(rig.winches[drive].node_id, profile),
        *_supervision(cycle, profile),
        *_mode(cycle, profile),
        *_reactions(rig, drive, cycle, profile),
        *_limits(rig, drive, winch_map, tension, profile),
    )


def left_out(profile: ProfileDocument) -> tuple[str, ...]:
    """One remark for each optional object that drives of a profile lack."""
    all_optional = (*_process_data(1, profile), *_supervision(0.01, profile), *_options())
    return tuple(
        f"there is no {setting}: {setting.instead}"
        for setting in all_optional
        if setting.optional and setting.instead and not profile.has(setting.index, setting.sub)
    )


FOLLOWING_TIMEOUT, QUICK_STOP_RAMP = 0x6066, 0x6085
CLAMPED = (FOLLOWING_TIMEOUT, QUICK_STOP_RAMP)
"""Objects clamped to the drive's range: an earlier trip, and the steepest possible ramp."""

LONGEST_QUICK_STOP = 0.5  # from top speed, [s]


def _within(setting: Setting, profile: ProfileDocument, cycle: float) -> Setting:
    """The setting within the drive's range."""
    allowed = profile.range_of(setting.index, setting.sub)
    if allowed is None or allowed.holds(setting.value):
        return setting
    if setting.index in CLAMPED and setting.value > allowed.high:
        takes = quick_stop_time(setting.value, allowed, cycle)
        if setting.index == QUICK_STOP_RAMP and takes > LONGEST_QUICK_STOP:
            raise BadInput(
                f"the steepest {setting} of {profile.name}, {allowed.high}, stops a drive from top"
                f" speed in {takes:.3g} s, limit {LONGEST_QUICK_STOP:g} s",
                where="drives.profile",
                next_step="check range and unit in the profile, and max_speed of the winches",
            )
        return replace(setting, value=allowed.high)
    raise BadInput(
        f"{setting} must hold {setting.value}; {profile.name} accepts {allowed.low} to"
        f" {allowed.high}",
        where="drives.profile",
        why=f"required because: {setting.why}",
        next_step="change the cycle, the limits or the drives of the rig file",
    )


def heartbeat_consumers(rig: Rig, drive: int, entries: int) -> tuple[Setting, ...]:
    """Heartbeats that the drive monitors: the master's, then its peers', up to its entries.

    All entries are cleared first, since a drive refuses a node that another entry has, and stay so
    if a loss would remove the torque. The drive may lack those that its profile leaves out.

    Args:
        drive: Index of the winch in the rig file.
        entries: Number of entries that the drive states (1016h:00).
    """
    name, usable = "consumer heartbeat time", profile_of(rig).usable_heartbeats(entries)
    used = min(usable, rig.cable_count)
    why = "no other node is monitored" if used else "a lost heartbeat would remove the torque"
    cleared = tuple(
        Setting(HEARTBEAT_CONSUMERS, sub, "<I", 0, name, why, sub <= used, 0 < usable < sub)
        for sub in range(1, entries + 1)
    )
    time_ms, peers_ms = math.ceil(1000 * heartbeat_timeout(rig.cycle)), peer_timeout_ms(rig)
    master = MASTER_NODE, time_ms, "stop when the master is lost"
    others = (winch.node_id for i, winch in enumerate(rig.winches) if i != drive)
    monitored = [master, *((node, peers_ms, "stop when a peer is lost") for node in others)][:used]
    return cleared + tuple(
        Setting(HEARTBEAT_CONSUMERS, sub, "<I", node << 16 | after, name, reaction)
        for sub, (node, after, reaction) in enumerate(monitored, start=1)
    )


def peer_timeout_ms(rig: Rig) -> int:
    """Time without a heartbeat of a drive after which others that monitor it stop, [ms]."""
    produced = HEARTBEATS_WAITED * produced_ms(rig.cycle, profile_of(rig))
    return math.ceil(max(1000 * heartbeat_timeout(rig.cycle), produced))


def _process_data(node: int, profile: ProfileDocument) -> tuple[Setting, ...]:
    """The two PDOs in use, on the identifiers of RPDO1 and TPDO1."""
    received = (0x60400010, 0x607A0020)
    sent = (0x60410010, 0x60640020, 0x60770010)
    rpdo, tpdo = used_pdos(profile)
    taken, replies = f"RPDO{profile.rpdo}", f"TPDO{profile.tpdo}"
    return (
        *_mapped(rpdo, RPDO1_BASE + node, received),
        # Off: a drive that stopped because its frames were lost would be re-enabled by the next
        # one (transition 16 is level-sensitive) before its reply shows that.
        Setting(
            *(rpdo, 5, "<H", 0, f"{taken} deadline"),
            "the program detects lost set-points and stops",
            optional=True,
        ),
        _switched_on(rpdo, RPDO1_BASE + node, f"{taken} identifier"),
        *_mapped(tpdo, PDO_NO_RTR | TPDO1_BASE + node, sent),
        Setting(
            *(tpdo, 3, "<H", 0, f"{replies} inhibit time", "no reply is delayed"), optional=True
        ),
        _switched_on(tpdo, PDO_NO_RTR | TPDO1_BASE + node, f"{replies} identifier"),
    )


def _switched_on(parameters: int, identifier: int, name: str) -> Setting:
    return Setting(parameters, 1, "<I", identifier, name, "switched on", mask=PDO_IDENTIFIER)


def _mapped(parameters: int, identifier: int, objects: tuple[int, ...]) -> tuple[Setting, ...]:
    """Mapping procedure: off, clear, objects, count, SYNC. Source: CiA 301, 7.5.2.36."""
    off, mapping = PDO_INVALID | identifier, parameters + 0x200
    return (
        Setting(parameters, 1, "<I", off, "PDO identifier", "off while mapping", True),
        Setting(mapping, 0, "<B", 0, "PDO mapping", "off while mapping", True),
        *(
            Setting(
                mapping, sub, "<I", entry, "PDO mapping", "word and position, torque in replies"
            )
            for sub, entry in enumerate(objects, start=1)
        ),
        Setting(mapping, 0, "<B", len(objects), "PDO mapping", "all objects"),
        Setting(
            *(parameters, 2, "<B", 1, "PDO transmission type", "one SYNC for all drives"),
            equivalent=SYNCHRONOUS if parameters < 0x1800 else range(0),
        ),
    )


def _supervision(cycle: float, profile: ProfileDocument) -> tuple[Setting, ...]:
    period_us, why = round(1e6 * cycle), "the cycle of the rig"
    if profile.monitoring == "heartbeat" and profile.communication_cycle_period:
        why = "the drive synchronises to it; the heartbeat stops the drive"
    elif profile.monitoring == "heartbeat":
        key = " (communication_cycle_period)" if profile.has(0x1006, 0) else ""
        period_us, why = 0, f"unused{key}: the heartbeat stops the drive"
    return (
        Setting(0x1006, 0, "<I", period_us, "communication cycle period", why),
        Setting(
            *(0x1007, 0, "<I", 0, "synchronous window length", "no window: set-points may be late"),
            optional=True,
            instead="a drive without it has no window",
        ),
        Setting(
            *(0x1017, 0, "<H", produced_ms(cycle, profile)),
            *("producer heartbeat time", "peers monitor each other"),
        ),
        Setting(
            *(0x1029, 1, "<B", 1, "communication error behaviour", "keep reporting"),
            optional=True,
            instead="a drive may leave NMT operational, which is a fault",
        ),
    )


def _mode(cycle: float, profile: ProfileDocument) -> tuple[Setting, ...]:
    ranges = profile.range_of(0x60C2, 1), profile.range_of(0x60C2, 2)
    try:
        value, exponent = interpolation_time(cycle, *ranges)
    except BadInput:
        if profile.has(0x60C2, 1) or profile.has(0x60C2, 2):
            raise
        value, exponent = 0, 0  # none: a drive that has 60C2h after all is refused
    why = "one set-point per cycle"
    return (
        Setting(0x6060, 0, "<b", CSP_MODE, "modes of operation", "cyclic synchronous position"),
        Setting(0x60C2, 1, "<B", value, "interpolation time period value", why),
        Setting(0x60C2, 2, "<b", exponent, "interpolation time index", why),
    )


def _reactions(rig: Rig, drive: int, cycle: float, profile: ProfileDocument) -> tuple[Setting, ...]:
    winch = rig.winches[drive]
    # A drive at top speed stops within one cycle, so that all drives stop within a cycle of each
    # other and the tensions change little.
    ramp = quick_stop_ramp(rig, drive, cycle, profile)
    window = rig.motion.following_error * abs(winch.counts_per_metre)
    timeout = math.ceil(1000 * cycle)
    stop = _capped(QUICK_STOP_RAMP, "quick stop deceleration", ramp, "at rest within one cycle")
    return (
        Setting(0x6007, 0, "<h", 3, "abort connection option code", "stop when the bus is lost"),
        Setting(0x605A, 0, "<h", 6, "quick stop option code", "ramp down, then hold under torque"),
        *_options(),
        *_offsets(),
        replace(stop, rounded=True),
        _capped(0x6065, "following error window", window, "motion.following_error_mm"),
        Setting(FOLLOWING_TIMEOUT, 0, "<H", timeout, "following error time out", "one cycle"),
    )


def _options() -> tuple[Setting, ...]:
    return (
        Setting(
            *(0x605C, 0, "<h", 1, "disable operation option code", "ramp down before torque off"),
            optional=True,
            instead="the reaction to disabling operation is manufacturer-specific: read the"
            " manual before `cdpr release`",
        ),
        Setting(
            *(0x605E, 0, "<h", 2, "fault reaction option code", "ramp down before torque off"),
            optional=True,
            instead="the reaction to a fault is manufacturer-specific: read the manual",
        ),
    )


def _offsets() -> tuple[Setting, ...]:
    """Offsets that drives add to set-points, which a former master may have left."""
    why = "set-points are used as sent"
    return (
        Setting(0x60B0, 0, "<i", 0, "position offset", why, optional=True),
        Setting(0x60B1, 0, "<i", 0, "velocity offset", why, optional=True),
        Setting(0x60B2, 0, "<h", 0, "torque offset", why, optional=True),
    )


def _limits(
    rig: Rig, drive: int, winch_map: WinchMap, max_tension: float, profile: ProfileDocument
) -> tuple[Setting, ...]:
    winch = rig.winches[drive]
    torque = math.ceil(1000.0 * TORQUE_RESERVE * max_tension / winch.torque_constant)
    if torque > _UNSIGNED_MAX["<H"]:
        raise BadInput(
            f"max_tension_n is {max_tension / winch.torque_constant:.0f} times the tension at"
            " rated torque",
            where=f"rig {rig.name}: winches[{drive}].torque_constant_n",
            next_step="enter the cable tension at rated motor torque",
        )
    low, high = position_limits(rig, drive, winch_map)
    why = "longest and shortest cable in the workspace"
    return (
        *_torque_limits(torque, profile),
        Setting(SOFTWARE_LIMITS, 1, "<i", low, "min position limit", why),
        Setting(SOFTWARE_LIMITS, 2, "<i", high, "max position limit", why),
    )


def _torque_limits(per_mille: int, profile: ProfileDocument) -> tuple[Setting, ...]:
    """Setting of 6072h, and of a manufacturer's current limit; [per mille of rated torque]."""
    why = "largest allowed tension plus a reserve"
    standard = Setting(0x6072, 0, "<H", per_mille, "max torque", why)
    if (limit := profile.torque_limit) is None:
        return (standard,)
    rated = None if limit.rated is None else object_key(limit.rated)
    where, form = object_key(limit.object), "<H" if limit.bytes == 2 else "<I"
    setting = Setting(*where, form, per_mille, CURRENT_LIMIT, why, per_mille_of=rated)
    if limit.rated_value is not None:
        setting = setting.of_rated(limit.rated_value)
        setting.data()  # refused before anything is written
    return standard, setting


def _capped(index: int, name: str, value: float, why: str) -> Setting:
    """A setting capped at the object's largest value, which has the same effect."""
    return Setting(index, 0, "<I", min(math.ceil(value), _UNSIGNED_MAX["<I"]), name, why)
