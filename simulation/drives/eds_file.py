"""EDS files: a drive's objects with access, ranges and defaults; a DCF's values are the defaults.

Source: CiA 306. Common deviations of manufacturers' files are accepted: hexadecimal limits of
signed types, `$NODEID` anywhere in a sum, suffixes of C, a decimal comma, limits that are none, an
empty access type, signed objects of CiA 402 typed as unsigned, blanks in headers, comments behind a
value and by ``#`` or ``//``, free text outside of objects, other encodings than ASCII, and the
end-of-file character of DOS.
"""

from __future__ import annotations

import codecs
import configparser
import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

from drivers.cia402.profile import profile_of
from model.errors import BadInput
from model.files.reading import MEGABYTE, read_bytes
from model.rig import Rig

Key = tuple[int, int]

EDS_FOLDER = Path(__file__).parent / "eds"
EDS_LIMIT = 4 * MEGABYTE
"""Largest size of a file, [bytes]; manufacturers' files have a tenth of it."""

_HEADER = re.compile(r"\[\s*([^]]*?)\s*\]")
_SECTION = re.compile(r"([0-9a-f]{4})(?:sub([0-9a-f]{1,2})|value|name)?$", re.IGNORECASE)
_NUMBER = re.compile(r"(-?(?:0X[0-9A-F]{1,32}|[0-9]{1,32}))U?L{0,2}$", re.ASCII)
_END = " \t\r\n\0\x1a"
_NO_LIMIT = ("", "-", "N/A", "NONE")
_RECORD, _ARRAY = 0x8, 0x9
_REALS = {0x08: "<f", 0x11: "<d"}
_SIGNED = {0x02: 1, 0x03: 2, 0x04: 4, 0x10: 3, 0x12: 5, 0x13: 6, 0x14: 7, 0x15: 8}
_UNSIGNED = {0x01: 1, 0x05: 1, 0x06: 2, 0x07: 4, 0x16: 3, 0x18: 5, 0x19: 6, 0x1A: 7, 0x1B: 8}
_UNSIGNED |= {0x08: 4, 0x11: 8}  # reals as their bits
_UNSIGNED_8 = 0x05
_SIGNED_KEYS = frozenset({(0x607D, 1), (0x607D, 2), (0x60C2, 2)}) | {
    (index, 0) for index in (0x6060, 0x6061, 0x6064, 0x6077, 0x607A, 0x607C, 0x60B0, 0x60B1, 0x60B2)
}
"""Objects that are signed in CiA 402-2, whatever type a file gives them."""


@dataclass(frozen=True, slots=True)
class ObjectDescription:
    """One object of a drive.

    Attributes:
        name: As in the file.
        length: In bytes; 0 for a text or a domain of any length.
        signed: The value is a signed integer.
        readable: By SDO.
        writable: By SDO.
        to_rpdo: It can be mapped to an RPDO.
        to_tpdo: It can be mapped to a TPDO.
        default: Value after power-on: an integer, or the bytes of a text.
        of_node: The node id is added to the default.
        low: Smallest value, if stated.
        high: Largest value, if stated.
    """

    name: str
    length: int
    signed: bool
    readable: bool
    writable: bool
    to_rpdo: bool
    to_tpdo: bool
    default: int | bytes
    of_node: bool
    low: int | None
    high: int | None

    def holds(self, value: int) -> bool:
        """Whether a value is within the limits."""
        above = self.low is None or value >= self.low
        return above and (self.high is None or value <= self.high)


@dataclass(frozen=True, slots=True, eq=False)
class Eds:
    """The objects of one EDS file.

    Attributes:
        path: Of the file.
        objects: By index and sub-index.
        dummies: Data types that may fill gaps in an RPDO (``DummyUsage``).
        unlisted_modes: Modes of operation that the drive has although 6502h does not list them:
            ``UnlistedModes`` of ``[6060]``, which is not in CiA 306.
    """

    path: Path
    objects: Mapping[Key, ObjectDescription]
    dummies: frozenset[int]
    unlisted_modes: frozenset[int] = frozenset()


def profile_path(profile: str) -> Path:
    """The EDS file of a drive profile.

    Raises:
        BadInput: There is none for this profile.
    """
    path = EDS_FOLDER / f"{profile}.eds"
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in EDS_FOLDER.glob("*.eds")))
        raise BadInput(
            f"the simulation has no EDS file for the drive profile {profile!r}",
            where="drives.profile",
            why=f"it has one for each of {known}",
            next_step="rehearse on a copy of the rig file without drives.profile; or on the drives"
            " of `cdpr sim RIG --eds FILE`, over udp_multicast, with the manufacturer's file",
        )
    return path


def eds_of(rig: Rig, path: Path | None = None) -> Eds:
    """The objects of a rig's simulated drives, from a file or for its drive profile.

    Raises:
        BadInput: There is no such file or profile, or it cannot be used.
    """
    if path is None:
        profile_of(rig)  # a profile that is missing or invalid is reported as such
        path = profile_path(getattr(rig.document.drives, "profile", "cia402"))
    return read_eds(path)


@cache
def read_eds(path: Path) -> Eds:
    """Reads an EDS file.

    Raises:
        BadInput: The file cannot be read, has no objects, or contains an invalid line.
    """
    parser = configparser.ConfigParser(
        interpolation=None,
        strict=False,
        delimiters=("=",),
        comment_prefixes=(";",),
        inline_comment_prefixes=(";",),
    )
    try:
        parser.read_string(_cleaned(_text(path)))
    except (OSError, configparser.Error) as error:
        raise BadInput(
            f"cannot be read as an EDS file: {_fault_of(error)}",
            where=str(path),
            next_step="pass an electronic data sheet (.eds) of CiA 306",
        ) from error
    sections: dict[str, Mapping[str, str]] = {
        name.lower(): parser[name] for name in parser.sections()
    }
    objects: dict[Key, ObjectDescription] = {}
    for name, section in sections.items():
        matched = _SECTION.match(name)
        if matched and not name.endswith(("value", "name")):
            where = f"{path}: [{name}]"
            index, sub = int(matched[1], 16), int(matched[2] or "0", 16)
            own = {
                "parametervalue": sections.get(f"{name}value", {}),
                "parametername": sections.get(f"{name}name", {}),
            }
            objects |= _described(index, sub, section, own, where)
    if not any(index >= 0x6000 for index, _ in objects):
        raise BadInput(
            "has no object of a drive profile (6000h and above)",
            where=str(path),
            next_step="pass the EDS file of a CiA 402 drive",
        )
    objects |= {key: _signed(objects[key]) for key in _SIGNED_KEYS & objects.keys()}
    used = sections.get("dummyusage", {})
    dummies = {
        int(name[5:], 16)
        for name, value in used.items()
        if value.strip() == "1" and re.fullmatch(r"dummy[0-9a-f]{4}", name, re.IGNORECASE)
    }
    modes = parser.get("6060", "unlistedmodes", fallback="")
    unlisted = frozenset(_number(mode, f"{path}: [6060]")[0] or 0 for mode in modes.split())
    return Eds(path, objects, frozenset(dummies), unlisted)


def _text(path: Path) -> str:
    data = read_bytes(path, EDS_LIMIT)
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", "replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def _cleaned(text: str) -> str:
    """The text without what only people read; every line keeps its number."""
    lines, kept = [], True
    for raw in text.rstrip(_END).replace("\r\n", "\n").replace("\r", "\n").split("\n"):
        line = raw.strip()
        header = _HEADER.match(line)
        if header:
            kept, line = bool(_SECTION.match(header[1])), f"[{header[1]}]"
        elif line.startswith(("#", "//")) or not (kept or "=" in line or line.startswith("[")):
            line = ""
        lines.append(line)
    return "\n".join(lines)


def _fault_of(error: OSError | configparser.Error) -> str:
    """First line and line number of an error, without what the parser adds for programmers."""
    first = str(error).splitlines()[0].removesuffix(": '<string>'").rstrip(".")
    listed = getattr(error, "errors", None) or [(getattr(error, "lineno", None), "")]
    number = listed[0][0]
    return first if number is None else f"{first}, line {number}"


def _described(
    index: int,
    sub: int,
    section: Mapping[str, str],
    own: Mapping[str, Mapping[str, str]],
    where: str,
) -> dict[Key, ObjectDescription]:
    """Objects of one section: a variable, or a compact array.

    Args:
        section: Its keys and values.
        own: Of a compact array: keys that differ between sub-objects, by key and sub-index.
        where: The section, for messages.
    """
    kind = _number(section.get("objecttype", ""), where)[0] or 0x7
    compact = _number(section.get("compactsubobj", ""), where)[0] or 0
    if not 0 <= compact <= 254:
        raise _unfit(f"CompactSubObj {compact}: an object has 254 sub-objects", where)
    if kind in (_RECORD, _ARRAY) and not compact:
        return {}
    one = _variable(section, where)
    if not compact:
        return {(index, sub): one}
    count = ObjectDescription(
        "Highest sub-index supported", 1, False, True, False, False, False, compact, False, None,
        None,
    )  # fmt: skip
    found = {(index, 0): count} | {(index, number): one for number in range(1, compact + 1)}
    for number in {entry for entries in own.values() for entry in entries if entry.isdecimal()}:
        if not 1 <= int(number[:9]) <= compact:
            raise _unfit(f"CompactSubObj {compact}: there is no sub-object {number[:40]}", where)
        changes = {key: entries[number] for key, entries in own.items() if number in entries}
        found[index, int(number)] = _variable({**section, **changes}, where)
    return found


def _variable(section: Mapping[str, str], where: str) -> ObjectDescription:
    kind = _number(section.get("datatype", ""), where)[0] or _UNSIGNED_8
    access = section.get("accesstype", "").strip().lower() or "rw"
    if access not in ("ro", "wo", "rw", "rwr", "rww", "const"):
        raise _unfit(f"the access type {access[:40]!r} does not exist", where)
    length, signed = _SIGNED.get(kind) or _UNSIGNED.get(kind, 0), kind in _SIGNED
    value = section.get("parametervalue", "") or section.get("defaultvalue", "")
    default, of_node = _default(value, kind, length, where)
    mappable = bool(_number(section.get("pdomapping", ""), where)[0])
    readable, writable = access != "wo", access not in ("ro", "const")
    low, high = (
        _limit(section.get(name, ""), kind, length, where) for name in ("lowlimit", "highlimit")
    )
    return ObjectDescription(
        section.get("parametername", ""),
        length,
        signed,
        readable,
        writable,
        mappable and writable and access != "rwr",
        mappable and readable and access != "rww",
        default,
        of_node,
        *_uncrossed(low, high, signed),
    )


def _signed(described: ObjectDescription) -> ObjectDescription:
    """The object with a signed value, and without limits that exclude every such value."""
    if isinstance(described.default, bytes):
        return described  # a text, which `ProcessData` does not map
    limits = described.low, described.high
    low, high = (
        each if each is None else _wrapped(each, described.length, True) for each in limits
    )
    low, high = _uncrossed(low, high, True)
    default = _wrapped(described.default, described.length, True)
    return replace(described, signed=True, default=default, low=low, high=high)


def _uncrossed(low: int | None, high: int | None, signed: bool) -> tuple[int | None, int | None]:
    """Limits; none where those of a signed type, as 0 and FFFFh of 16 bits, exclude every value."""
    crossed = signed and low is not None and high is not None and low > high
    return (None, None) if crossed else (low, high)


def _default(text: str, kind: int, length: int, where: str) -> tuple[int | bytes, bool]:
    """The default, and whether the node id is added."""
    if not length:
        return text.strip().encode("latin-1", "replace"), False
    if kind in _REALS and text.strip() and not text.strip().lower().startswith("0x"):
        try:
            data = struct.pack(_REALS[kind], float(text.replace(",", ".", 1)))
        except (ValueError, OverflowError):
            raise _unfit(f"{text.strip()[:40]!r} is not a real number", where) from None
        return int.from_bytes(data, "little"), False
    value, of_node = _number(text, where)
    value, size = value or 0, 1 << 8 * length
    if not -(size >> 1) <= value < size:
        raise _unfit(f"the default {text.strip()[:40]} needs more than {length} bytes", where)
    return _wrapped(value % size, length, kind in _SIGNED), of_node


def _limit(text: str, kind: int, length: int, where: str) -> int | None:
    if not length or kind in _REALS or text.strip().upper() in _NO_LIMIT:
        return None
    try:
        value, of_node = _number(text, where)
    except BadInput:
        if "." in text:  # a real number
            return None
        raise
    return None if value is None or of_node else _wrapped(value, length, kind in _SIGNED)


def _number(text: str, where: str) -> tuple[int | None, bool]:
    """The value of a sum, None if empty; and whether the node id is added."""
    terms = [term for term in re.sub(r"[\s()]", "", text.upper()).split("+") if term]
    numbers = [_NUMBER.match(term) for term in terms if term != "$NODEID"]
    value = 0
    for matched in numbers:
        if matched is None:
            raise _unfit(f"{text.strip()[:40]!r} is not a number", where)
        value += int(matched[1], 16 if "X" in matched[1] else 10)
    return value if terms else None, len(numbers) < len(terms)


def _wrapped(value: int, length: int, signed: bool) -> int:
    """Value as a signed integer; 0xFF of a signed byte is −1."""
    bits = 8 * length
    return value - (1 << bits) if signed and value >= 1 << (bits - 1) else value


def _unfit(what: str, where: str) -> BadInput:
    return BadInput(what, where=where, next_step="correct it in a copy, and pass that with --eds")
