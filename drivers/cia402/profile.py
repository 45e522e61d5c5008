"""Drive profiles: those shipped with cdpr, your own, and the one of a rig file.

A profile is a YAML file (`model.files.drive_profile_file`) in ``drivers/cia402/profiles`` or
elsewhere; ``drives.profile`` of the rig file names it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cache, lru_cache
from pathlib import Path

from drivers.can_load import heartbeat_cycles
from drivers.cia402.state_machine import POWER_BITS, REMOTE
from drivers.setup_refusals import SdoAborted
from model.errors import BadInput
from model.files.documents import load_yaml
from model.files.drive_profile_file import (
    NEEDED,
    OBJECTS,
    ProfileDocument,
    Range,
    object_key,
    object_name,
)
from model.files.reading import unreadable
from model.files.rig_file import Cia402Document
from model.rig import Rig

FOLDER = Path(__file__).parent / "profiles"

MOST_PDOS = 512
"""Largest number of RPDOs, and of TPDOs. Source: CiA 301, 7.5.2.35 to 7.5.2.38."""

STANDARD_PDOS = 4
"""RPDOs and TPDOs of which a drive may have any subset."""


@cache
def profile_names() -> tuple[str, ...]:
    """The profiles shipped with cdpr."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.yaml")))


def load_profile(name: str) -> ProfileDocument:
    """A shipped profile by name, or a profile file by path, as it is now.

    Raises:
        BadInput: There is no such profile, or the file cannot be read.
        InvalidFile: With all errors of the file.
    """
    if name in profile_names():
        return _loaded(FOLDER / f"{name}.yaml", ())
    path = Path(name)
    if path.suffix not in (".yaml", ".yml"):
        raise BadInput(
            f"unknown drive profile {name!r}",
            where="drives.profile",
            next_step=f"use one of {', '.join(profile_names())}, or the path of your own YAML file",
        )
    try:
        status = path.stat()
    except (OSError, ValueError) as error:
        refused = unreadable(path, error)
        refused.next_step += "; drives.profile is relative to the current folder"
        raise refused from None
    return _loaded(path.resolve(), (status.st_ino, status.st_mtime_ns, status.st_size))


@lru_cache(maxsize=16)
def _loaded(path: Path, _version: tuple[int, ...]) -> ProfileDocument:
    """A profile file; an edited one is another version."""
    return load_yaml(path, ProfileDocument)


def profile_of(rig: Rig) -> ProfileDocument:
    """The profile named by a rig file.

    Raises:
        BadInput: There is no such profile, or its file is invalid.
    """
    drives = rig.document.drives
    return load_profile(drives.profile if isinstance(drives, Cia402Document) else "cia402")


def power_bits(profile: ProfileDocument, *, operational: bool = True) -> int:
    """Bits of 6041h that show why a drive without torque cannot be enabled.

    Args:
        operational: It is certainly in the NMT state *operational*; many makes clear bit 9
            (remote) in the others.
    """
    bits = POWER_BITS if profile.power_bits else 0
    return bits if operational else bits & ~REMOTE


def rpdo_parameters(number: int) -> int:
    """Index of an RPDO's communication parameters, by its number from 1. CiA 301, 7.5.2.35."""
    return 0x1400 + number - 1


def tpdo_parameters(number: int) -> int:
    """Index of a TPDO's communication parameters. Source: CiA 301, 7.5.2.37."""
    return 0x1800 + number - 1


_FIRST_PDOS = rpdo_parameters(1), tpdo_parameters(1)


def used_pdos(profile: ProfileDocument) -> tuple[int, int]:
    """Communication parameters of the RPDO and of the TPDO in use."""
    return rpdo_parameters(profile.rpdo), tpdo_parameters(profile.tpdo)


def for_unused_pdos(profile: ProfileDocument, is_there: Callable[[int], bool]) -> None:
    """Visits the unused PDOs that a drive may have, which are switched off.

    All of 1 to 4; beyond these PDOs are numbered without a gap, so that the first absent one ends
    the search.

    Args:
        is_there: Called with the communication parameters of each; returns whether it exists.
    """
    for first, used in zip(_FIRST_PDOS, used_pdos(profile), strict=True):
        for index in range(first, first + MOST_PDOS):
            if index != used and not is_there(index) and index >= first + STANDARD_PDOS:
                break


def unwatched_peers(
    profile: ProfileDocument, nodes: Sequence[int], entries: Sequence[int]
) -> Iterator[str]:
    """One remark for all drives that lack the same number of heartbeat entries.

    Args:
        entries: Number of producers that each can monitor.
    """
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


def limits_out_of_force(profile: ProfileDocument) -> tuple[str, ...]:
    """A remark for drives whose position limits do not apply as they are written."""
    remark = (
        "607Dh software position limits are in force only once they are saved and the drive"
        " restarts: until then it limits set-points by those it started with, if at all"
    )
    return (remark,) if profile.limits_need_restart else ()


def interpolation_time(
    cycle: float, values: Range | None = None, exponents: Range | None = None
) -> tuple[int, int]:
    """Value and power of ten of 60C2h for a cycle [s].

    Args:
        cycle: [s].
        values: Range of 60C2h:01; 1 to 255 if None.
        exponents: Range of 60C2h:02; -6 to -3 if None.

    Raises:
        BadInput: The object cannot hold this cycle.
    """
    most = 0xFF if values is None else min(values.high, 0xFF)
    for exponent in (-3, -4, -5, -6):
        value = cycle * 10.0**-exponent
        taken = exponents is None or exponents.holds(exponent)
        if taken and 0 < round(value) <= most and abs(value - round(value)) < 1e-6:
            return round(value), exponent
    raise BadInput(
        f"the drives cannot interpolate over a cycle of {1000 * cycle:g} ms",
        where="bus.cycle_ms",
        why=f"object 60C2h holds an integer up to {most} times a power of ten"
        + ("" if exponents is None else f" from {exponents.low} to {exponents.high}"),
        next_step="use a rounder number, such as 10, 8 or 4",
    )


def produced_ms(cycle: float, profile: ProfileDocument) -> int:
    """Period of a drive's heartbeat, [ms]: the master's, or the drive's shortest.

    Only other drives monitor it; the master gets a reply every cycle.
    """
    shortest = profile.range_of(0x1017, 0)
    return max(round(1000 * cycle * heartbeat_cycles(cycle)), shortest.low if shortest else 0)


def quick_stop_ramp(rig: Rig, drive: int, cycle: float, profile: ProfileDocument) -> float:
    """Deceleration that stops a drive from top speed within a cycle, in the drive's unit."""
    winch = rig.winches[drive]
    ramp = winch.max_speed / cycle * abs(winch.counts_per_metre)
    turns = ramp / winch.counts_per_turn
    in_unit = {"counts/s^2": ramp, "rpm/s": 60.0 * turns, "rev/s^2": turns}
    return in_unit[profile.acceleration_unit] / profile.acceleration_step


def quick_stop_time(ramp: float, allowed: Range, cycle: float) -> float:
    """Time of a quick stop from top speed, [s]: ``ramp`` would take a cycle, the drive may not."""
    return cycle * max(1.0, ramp / max(1, allowed.high))


# What to do about an object that a drive does not have.

SUPPORTED_MODES = 0x6502
HOW_UNLISTED = "for a drive that has it unlisted, set csp_unlisted: true in its profile"
HOW_WITHOUT_CSP = (
    f"use another drive if it has no cyclic synchronous position (CSP); {HOW_UNLISTED}"
)

_BESIDE = {
    "1006h:00": ", with monitoring: heartbeat",
    "1016h:01": ", with monitoring: sync; the SYNC time-out alone then stops the drive",
    "6072h:00": ", with torque_limit",
    "60C2h:01": ", where the drive needs no interpolation time",
    "60C2h:02": ", where the drive needs no interpolation time",
}
"""Further entries of a profile in which an object is absent."""


def how_without(
    profile: ProfileDocument, index: int, sub: int, read: Callable[[int, int, str], bytes | None]
) -> str:
    """The next step for a required object that is missing.

    Args:
        read: Reads an optional object of the drive by index, sub-index and name.
    """
    if index == SUPPORTED_MODES:
        return HOW_WITHOUT_CSP
    # A drive without the array lacks its entries.
    name = "1016h:01" if index == object_key("1016h:01")[0] else object_name(index, sub)
    if name not in OBJECTS or name in NEEDED:
        return _how_without_standard(profile, index, sub)
    if _is_unmonitored(profile, name, read):
        return "use another drive: nothing stops this one when the master is lost"
    own = f"list it as absent in your own drive profile{_BESIDE.get(name, '')}"
    names = [each for each in profile_names() if name in load_profile(each).absent]
    known = "".join(f"; for {load_profile(each).name} set drives.profile: {each}" for each in names)
    return own + known


def _is_unmonitored(
    profile: ProfileDocument, missing: str, read: Callable[[int, int, str], bytes | None]
) -> bool:
    """Whether a drive that lacks 1006h cannot use 1016h either, or the reverse."""
    if missing == "1006h:00":
        unusable, other = not profile.watches_heartbeats, "1016h:01"
    elif missing == "1016h:01":
        unusable, other = not profile.has(*object_key("1006h:00")), "1006h:00"
    else:
        return False
    if unusable:
        return True
    try:
        data = read(object_key(other)[0], 0, OBJECTS[other])
    except SdoAborted:  # it may have the object
        return False
    return data is None or (other == "1016h:01" and not any(data))  # no entries


def _how_without_standard(profile: ProfileDocument, index: int, sub: int) -> str:
    """The next step for an object that no profile can declare absent."""
    name, limit = object_name(index, sub), profile.torque_limit
    if index == 0x1018:
        return f"remove {'vendor_id' if sub == 1 else 'product_code'} from the rig file"
    if name in {each.object for each in profile.expect}:
        return "if the drive does not need it, remove it from `expect` in your own drive profile"
    if limit is not None and name in (limit.object, limit.rated):
        return "name the drive's own current limit as `torque_limit` in your own drive profile"
    if 0x1400 <= index < 0x1C00:
        kind = "tpdo" if index & 0x800 else "rpdo"
        return (
            f"give the number of another {kind.upper()}, whose mapping can be written, as `{kind}`"
            " in your own drive profile"
        )
    return "use another drive or firmware: no profile can replace it"
