"""The drive profile file: objects and deviations from the standard of one make of drives.

It states facts; `drivers.cia402.object_dictionary` derives the values to write. Every fact in it
comes from the maker's manual or EDS file, named in ``sources``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from model.files.documents import Document, Finding, in_schema

OBJECTS: Mapping[str, str] = {
    "1006h:00": "communication cycle period",
    "1007h:00": "synchronous window length",
    "1016h:01": "consumer heartbeat time",
    "1017h:00": "producer heartbeat time",
    "1029h:01": "communication error behaviour",
    **{f"{0x1400 + pdo:04X}h:05": f"RPDO{pdo + 1} deadline" for pdo in range(4)},
    **{f"{0x1800 + pdo:04X}h:03": f"TPDO{pdo + 1} inhibit time" for pdo in range(4)},
    "6007h:00": "abort connection option code",
    "605Ah:00": "quick stop option code",
    "605Ch:00": "disable operation option code",
    "605Eh:00": "fault reaction option code",
    "6060h:00": "modes of operation",
    "6065h:00": "following error window",
    "6066h:00": "following error time out",
    "6072h:00": "max torque",
    "607Dh:01": "min position limit",
    "607Dh:02": "max position limit",
    "6085h:00": "quick stop deceleration",
    "60B0h:00": "position offset",
    "60B1h:00": "velocity offset",
    "60B2h:00": "torque offset",
    "60C2h:01": "interpolation time period value",
    "60C2h:02": "interpolation time index",
}
"""Objects that a profile may describe: those that are set up, except for PDO mapping."""

NEEDED = (
    "1017h:00",
    "6007h:00",
    "605Ah:00",
    "6060h:00",
    "6065h:00",
    "607Dh:01",
    "607Dh:02",
    "6085h:00",
)
"""Without these no run is safe, whatever a profile states."""

_RATED_SHARE = "6073h:00"
"""Max current, in per mille of the rated current. Source: CiA 402-2."""

FINEST_RATED = 10.0
"""Smallest value of a current limit at rated torque: it is rounded up, by less than 10 % of it."""

_PROCESS_DATA = "rpdo and tpdo"
_CYCLE = "bus.cycle_ms of the rig file"

_DETERMINED_BY: Mapping[int, str] = {
    0x1006: "monitoring and communication_cycle_period",
    0x1016: "heartbeat_entries and heartbeat_loss",
    0x1017: _CYCLE,
    0x6040: _PROCESS_DATA,
    0x6065: "motion.following_error_mm of the rig file",
    0x6066: _CYCLE,
    0x6072: "cables.max_tension_n of the rig file",
    0x607A: _PROCESS_DATA,
    0x607D: "workspace of the rig file",
    0x6085: "acceleration_unit and acceleration_step",
    0x60C2: _CYCLE,
}
"""Keys that determine the values of objects that the program writes; the others are constants."""

STOP_CODES = (0x8130, 0x8250, 0x8611, 0x8612, 0x8700)
"""EMCY codes of drives that stop as they are set up: by 1016h, 1400h:05, 6065h, 607Dh, 1006h."""

_OBJECT = re.compile(r"[0-9A-F]{4}h:[0-9A-F]{2}")
_CODE = re.compile(r"[0-9A-Fx]{4}h")


def _is_object(text: str) -> str:
    if not _OBJECT.fullmatch(text):
        raise ValueError(f"must be an object such as 6072h:00; it is {text!r}")
    return text


def _is_known(text: str) -> str:
    if text not in OBJECTS:
        there = ", ".join(OBJECTS)
        raise ValueError(f"object {text!r} is not one that this program sets; it sets: {there}")
    return text


def _is_fine(rated: float) -> float:
    if rated < FINEST_RATED:
        raise ValueError(
            f"must be {FINEST_RATED:g} or more, else the limit's unit is too coarse; it is"
            f" {rated:g}"
        )
    return rated


def _is_code(text: str) -> str:
    if not _CODE.fullmatch(text):
        raise ValueError(f"must be an error code such as 3180h or 33xxh; it is {text!r}")
    return text


ObjectName = Annotated[str, AfterValidator(_is_object), in_schema(pattern=f"^{_OBJECT.pattern}$")]
KnownObject = Annotated[str, AfterValidator(_is_known), in_schema(enum=[*OBJECTS])]
MissingObject = Annotated[
    str, AfterValidator(_is_known), in_schema(enum=[key for key in OBJECTS if key not in NEEDED])
]
CodePattern = Annotated[str, AfterValidator(_is_code), in_schema(pattern=f"^{_CODE.pattern}$")]
RatedValue = Annotated[
    float, Field(le=1e9), AfterValidator(_is_fine), in_schema(minimum=FINEST_RATED)
]
Text = Annotated[str, Field(min_length=1)]


class Range(Document):
    """Smallest and largest value that an object accepts."""

    low: int
    high: int

    @model_validator(mode="after")
    def _is_ordered(self) -> Self:
        if self.low > self.high:
            raise ValueError(f"low {self.low} is above high {self.high}")
        return self

    def holds(self, value: int) -> bool:
        """Whether a value is within."""
        return self.low <= value <= self.high


class Expected(Document):
    """An object that is read, and must hold a value that the program does not write."""

    object: ObjectName
    value: Annotated[int, Field(ge=0)]
    name: Text
    why: Text = Field(description="what it is needed for, and how to set it")


class TorqueLimit(Document):
    """The object that limits torque where there is no 6072h; it holds a current."""

    object: ObjectName = Field(description="the current limit, proportional to the current")
    rated: ObjectName | None = Field(
        default=None,
        description="the object with the current at rated torque, in the same unit; it and"
        f" rated_value left out, which only {_RATED_SHARE} allows, the limit is in per mille of it",
    )
    rated_value: RatedValue | None = Field(
        default=None,
        description="value of the limit at rated torque, where no object holds it",
    )
    bytes: Literal[2, 4] = Field(default=4, description="size of the current limit; 2 for 6073h")

    @model_validator(mode="after")
    def _has_unit(self) -> Self:
        stated = [each for each in (self.rated, self.rated_value) if each is not None]
        if len(stated) > 1:
            raise ValueError("rated and rated_value exclude each other")
        if not stated and self.object != _RATED_SHARE:
            raise ValueError(
                f"{self.object} needs rated or rated_value, the current at rated torque in its"
                f" unit; only {_RATED_SHARE} is in per mille of it"
            )
        return self


class ProfileDocument(Document):
    """Objects of one make of drives, and their deviations from the standard."""

    name: Text = Field(description="maker and type, as displayed")
    sources: Annotated[list[Text], Field(min_length=1)] = Field(
        description="source of every fact in this file"
    )
    absent: list[MissingObject] = Field(default=[], description="objects missing in the drive")
    ranges: dict[KnownObject, Range] = Field(
        default={}, description="values that objects accept, where narrower than the standard"
    )
    expect: list[Expected] = Field(
        default=[], description="objects that are read and must hold a value, such as units"
    )
    heartbeat_entries: Annotated[int, Field(ge=1, le=127)] | None = Field(
        default=None, description="entries of 1016h; left out, the number that the drive states"
    )
    rpdo: Annotated[int, Field(ge=1, le=4)] = Field(
        default=1,
        description="number of the RPDO for set-points: one whose mapping can be written; all"
        " others are disabled",
    )
    tpdo: Annotated[int, Field(ge=1, le=4)] = Field(
        default=1, description="number of the TPDO for replies, as rpdo"
    )
    monitoring: Literal["sync", "heartbeat"] = Field(
        default="sync",
        description="what stops a drive whose master is gone; heartbeat: it has no 1006h, does not"
        " detect missing SYNC by it, or removes torque without SYNC",
    )
    communication_cycle_period: Literal["cycle"] | None = Field(
        default=None,
        description="value of 1006h with monitoring heartbeat; cycle: the rig's cycle, to which the"
        " drive synchronises; left out: 0",
    )
    sync_timeout_periods: Annotated[float, Field(ge=1.1, le=10.0)] = Field(
        default=3.0,
        description="periods of 1006h without SYNC after which a drive stops on its own; with"
        " monitoring heartbeat, the age of SYNC from which no drive is enabled",
    )
    heartbeat_loss: Literal["quick stop", "fault"] = Field(
        default="quick stop",
        description="reaction of a drive to the loss of its heartbeat producer; fault: it removes"
        " torque whatever 6007h states, so it gets no heartbeat to monitor",
    )
    acceleration_unit: Literal["counts/s^2", "rpm/s", "rev/s^2"] = Field(
        default="counts/s^2", description="of 6085h; revolutions are of the motor shaft"
    )
    acceleration_step: Annotated[float, Field(gt=0.0, le=1e6)] = Field(
        default=1.0, description="acceleration, in this unit, of 6085h = 1"
    )
    torque_limit: TorqueLimit | None = Field(
        default=None, description="left out, 6072h limits the torque"
    )
    limits_need_restart: bool = Field(
        default=False,
        description="position limits (607Dh) are in force only once they are saved and the drive"
        " restarts; every set-up says so",
    )
    warnings: list[CodePattern] = Field(
        default=[],
        description="EMCY codes of warnings with which the drive stays enabled; x is any digit",
    )
    csp_unlisted: bool = Field(
        default=False,
        description="the drive has cyclic synchronous position, although 6502h is absent or its"
        " bit 7 is 0; 6061h = 8 shows it",
    )
    states_scale: bool | None = Field(
        default=None,
        description="6092h and 6091h, or 608Fh, are the counts of 6064h per motor turn; true: a"
        " drive where they contradict counts_per_rev is refused; false: they are not read; left"
        " out: it is refused where another drive agrees with counts_per_rev, else reported",
    )
    mode_display_when_enabled: bool = Field(
        default=False, description="6061h shows the mode only once the drive is enabled"
    )
    follows_bit: bool | None = Field(
        default=None,
        description="in CSP bit 12 of 6041h shows that an enabled drive follows its target; true:"
        " no set-point changes before all drives show it; false: it means something else; left"
        " out: it need not be shown, but a drive that no longer shows it stops all",
    )
    power_bits: bool = Field(
        default=True,
        description="in a drive without torque bit 4 of 6041h shows mains power, and bit 9 that it"
        " follows the control word; false: they mean something else, and are not read",
    )
    enable_timeout_ms: Annotated[int, Field(ge=100, le=30_000)] = Field(
        default=1000, description="longest time to enable or release, brake included"
    )
    sdo_timeout_ms: Annotated[int, Field(ge=50, le=30_000)] = Field(
        default=2000, description="longest time to one SDO reply"
    )

    def rules(self) -> Sequence[Callable[[], list[Finding]]]:
        """Checks across keys."""
        return (self._monitoring, self._torque, self._needed, self._only_read, self._warned)

    def _monitoring(self) -> list[Finding]:
        if self.monitoring == "heartbeat" and self.heartbeat_loss == "fault":
            what = "drives that remove torque when the master is lost cannot be run safely"
            return [(("heartbeat_loss",), what)]
        by_heartbeat = self.monitoring == "heartbeat"
        if {"1006h:00", "1016h:01"} <= {*self.absent}:
            what = "a drive without 1006h:00 and 1016h:01 cannot be run: nothing stops it when the"
            return [(("absent",), f"{what} master is lost")]
        if "1006h:00" in self.absent and self.communication_cycle_period:
            return [(("communication_cycle_period",), "needs 1006h:00, which is in absent")]
        if "1006h:00" in self.absent and not by_heartbeat:
            return [(("absent",), "monitoring must be heartbeat where 1006h:00 is absent")]
        if "1016h:01" in self.absent and by_heartbeat:
            return [(("absent",), "monitoring heartbeat needs 1016h:01")]
        return []

    def _torque(self) -> list[Finding]:
        absent, limit = "6072h:00" in self.absent, self.torque_limit
        if absent != (limit is not None):
            what = "torque_limit is needed where 6072h:00 is absent, and only there"
            return [(("absent",) if absent else ("torque_limit",), what)]
        if limit is None:
            return []
        named = (
            ("object", limit.object, "that limits the current"),
            ("rated", limit.rated, "that holds the current at rated torque"),
        )
        return [
            (("torque_limit", key), f"this program writes {name} itself: name the object {which}")
            for key, name, which in named
            if name and (self._keys_for(name) or (key == "rated" and name == limit.object))
        ]

    def _needed(self) -> list[Finding]:
        return [
            (("absent", index), f"required for a safe run: {name} {OBJECTS[name]}")
            for index, name in enumerate(self.absent)
            if name in NEEDED
        ]

    def _only_read(self) -> list[Finding]:
        return [
            (
                ("expect", number, "object"),
                f"{each.object} is in absent: a drive that has it needs the value of this program"
                if each.object in self.absent
                else f"this program writes {each.object} itself: use {keys} instead",
            )
            for number, each in enumerate(self.expect)
            if (keys := self._keys_with_limit(each.object))
        ]

    def _keys_with_limit(self, name: str) -> str:
        """As `_keys_for`, of the current limit too."""
        if self.torque_limit is not None and name == self.torque_limit.object:
            return f"torque_limit and {_DETERMINED_BY[0x6072]}"
        return self._keys_for(name)

    def _keys_for(self, name: str) -> str:
        """The keys that control an object that is written in all makes; empty if it is not."""
        index, sub = object_key(name)
        if 0x1400 <= index < 0x1C00:
            return _PROCESS_DATA if self._maps(index, sub) else ""
        if index == 0x1016:
            return _DETERMINED_BY[index] if sub else ""
        if index in (0x6040, 0x607A) or name in OBJECTS:
            return _DETERMINED_BY.get(index, "ranges" if name in NEEDED else "absent or ranges")
        return ""

    def _maps(self, index: int, sub: int) -> bool:
        """Whether parameters of a PDO are written: of the used ones, and all identifiers."""
        is_sent, is_mapping = bool(index & 0x800), bool(index & 0x200)
        if index & 0x1FF != (self.tpdo if is_sent else self.rpdo) - 1:
            return sub == 1 and not is_mapping
        objects = 3 if is_sent else 2
        return sub <= objects if is_mapping else sub in ((1, 2, 3) if is_sent else (1, 2, 5))

    def _warned(self) -> list[Finding]:
        return [
            (("warnings", index), f"includes {code:04X}h, with which drives stop: not a warning")
            for index, pattern in enumerate(self.warnings)
            for code in STOP_CODES
            if _matches(pattern, code)
        ]

    @property
    def watches_heartbeats(self) -> bool:
        """Whether drives get heartbeats to monitor."""
        return self.heartbeat_loss == "quick stop" and "1016h:01" not in self.absent

    def usable_heartbeats(self, entries: int) -> int:
        """Number of entries of 1016h to use in a drive that states this number of them."""
        if not self.watches_heartbeats:
            return 0
        return entries if self.heartbeat_entries is None else min(entries, self.heartbeat_entries)

    def has(self, index: int, sub: int) -> bool:
        """Whether the drive has an object, according to the profile."""
        return object_name(index, sub) not in self.absent

    def range_of(self, index: int, sub: int) -> Range | None:
        """Values that an object accepts; None where the profile does not state them."""
        return self.ranges.get(object_name(index, sub))

    def is_warning(self, code: int) -> bool:
        """Whether an EMCY code is a warning of a drive that stays enabled."""
        return any(_matches(pattern, code) for pattern in self.warnings)


def _matches(pattern: str, code: int) -> bool:
    """Whether an EMCY code is one of a pattern such as 33xxh."""
    digits = zip(pattern, f"{code:04X}h", strict=True)
    return all(want in ("x", digit) for want, digit in digits)


def object_name(index: int, sub: int) -> str:
    """Name of an object in profiles: ``6072h:00``."""
    return f"{index:04X}h:{sub:02X}"


def object_key(name: str) -> tuple[int, int]:
    """The inverse of `object_name`."""
    return int(name[:4], 16), int(name[6:], 16)
