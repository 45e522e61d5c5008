"""Alarms of the running rig: how each is worded, what stop it requires, and which is new."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from enum import IntEnum

from executor.state_machine import REMARK, SIMULATED
from model.errors import BadInput
from model.files.reading import ready_folder


class StopReaction(IntEnum):
    """Reaction that an alarm requires; the largest one wins."""

    NOTE = 0
    PATH_STOP = 1
    QUICK_STOP = 2


@dataclass(frozen=True, slots=True)
class Alarm:
    """A condition found by a monitor.

    Attributes:
        reaction: Required reaction.
        code: Stable code.
        text: Condition, measured value and limit.
        drive: Number of the cable and drive, from 1 as in the rig file; 0 for all.
    """

    reaction: StopReaction
    code: str
    text: str
    drive: int = 0


def _cycles(count: int) -> str:
    return f"{count} cycle{'s' if count > 1 else ''}"


def drive_fault(drive: int, text: str) -> Alarm:
    """A drive, or with drive 0 the bus, reports a fault."""
    return Alarm(StopReaction.QUICK_STOP, "drive_fault", text, drive)


def drive_warning(drive: int, text: str) -> Alarm:
    """A drive that stays enabled reports a warning."""
    return Alarm(StopReaction.NOTE, "drive_warning", text, drive)


def reply_missing(drive: int, name: str, cycles: int, *, fault: bool) -> Alarm:
    """A drive did not answer, in the last cycles."""
    text = f"{name} did not answer for {_cycles(cycles)}"
    if fault:
        return Alarm(StopReaction.QUICK_STOP, "drive_silent", text, drive)
    return Alarm(StopReaction.NOTE, "reply_lost", text, drive)


def replies_missing(drive: int, name: str, missing: int, cycles: int) -> Alarm:
    """A drive did not answer in too many of the last cycles, if not in consecutive ones."""
    text = f"{name} did not answer in {missing} of the last {cycles} cycles"
    return Alarm(StopReaction.PATH_STOP, "drive_silent", text, drive)


def stuck(drive: int, name: str, cycles: int, *, fault: bool, may_disarm: bool) -> Alarm:
    """A drive did not follow its set-points, in the last cycles."""
    text = f"{name} did not move for {_cycles(cycles)} while its set-points advanced"
    if fault:
        text += ": it may be jammed or disarmed" if may_disarm else ""
        return Alarm(StopReaction.QUICK_STOP, "drive_stuck", text, drive)
    return Alarm(StopReaction.NOTE, "set_point_missed", text, drive)


def following_error(cable: int, error: float, limit: float) -> Alarm:
    """A cable is too far from its set-point; both in cable length, [m]."""
    text = f"cable {cable} is {error * 1000:.2f} mm from its set-point, limit {limit * 1000:.2f} mm"
    return Alarm(StopReaction.QUICK_STOP, "following_error", text, cable)


def cable_loose(cable: int, tension: float, may_disarm: bool) -> Alarm:
    """A cable has no tension, [N]; its drive may disarm before it reports that."""
    text = f"cable {cable} carries {tension:.1f} N, no tension: it is broken or slack"
    if may_disarm:
        text += ", or its drive is disarmed"
    return Alarm(StopReaction.QUICK_STOP, "cable_loose", text, cable)


def all_loose(cables: int) -> Alarm:
    """No cable has any tension, and drives disarm before they report it; see `cable_loose`."""
    text = (
        f"all {cables} cables carry no tension: they are broken or slack,"
        " or their drives are disarmed"
    )
    return Alarm(StopReaction.QUICK_STOP, "cable_loose", text)


def slack(cable: int, tension: float, limit: float) -> Alarm:
    """A cable has too little tension, [N]."""
    text = f"cable {cable} carries {tension:.1f} N, less than {limit:.1f} N: it may be slack"
    return Alarm(StopReaction.PATH_STOP, "slack", text, cable)


def over_tension(cable: int, tension: float, limit: float) -> Alarm:
    """A cable has too much tension, [N]."""
    text = f"cable {cable} carries {tension:.1f} N, more than {limit:.1f} N"
    if tension < 0.0:
        text = (
            f"the torque of cable {cable} pays it out with {-tension:.1f} N, more than"
            f" {limit:.1f} N: check its sign (607Eh, `direction` of the winch)"
        )
    return Alarm(StopReaction.PATH_STOP, "over_tension", text, cable)


def not_taut(cable: int, tension: float, wound: float, target: float, stretch: float) -> Alarm:
    """A cable is not taut, [N], after a length was wound in, its stretch to the target included."""
    text = (
        f"cable {cable} carries {tension:.1f} N after {wound * 1000:.4g} mm were wound"
        f" in; the target is {target:.1f} N, at which it is stretched by {stretch * 1000:.2g} mm."
        " It may have more slack, be off its drum or pulley, or be broken"
    )
    return Alarm(StopReaction.PATH_STOP, "not_taut", text, cable)


def went_slack(cable: int, tension: float, limit: float, moved: int) -> Alarm:
    """A cable went slack, [N], while only another one was moved."""
    text = (
        f"cable {cable} went slack ({tension:.1f} N, less than {limit:.1f})"
        f" while only cable {moved} was moved"
    )
    return Alarm(StopReaction.PATH_STOP, "went_slack", text, cable)


def late(cycles: float, *, too_late: bool) -> Alarm:
    """A cycle began late; too late if drives may have stopped on their own meanwhile."""
    reaction = StopReaction.QUICK_STOP if too_late else StopReaction.PATH_STOP
    return Alarm(reaction, "late", f"a cycle began {cycles:.1f} cycles late")


#: Events of one note, such as the missed set-points of one drive, in a motion: a disturbed bus
#: would fill the record with more.
NOTE_EVENTS = 10
#: End of the text of the last one.
NO_MORE = "; no more are recorded"
#: Beginning of the event (`reply_lost`) at the end of a motion with lost replies.
LARGEST_SHARE = "largest share of lost replies: "


class AlarmHistory:
    """Finds which alarms of a motion are new, so that each is one event.

    A condition that persists is new in its first cycle only. A note is new again whenever it
    returns, up to `NOTE_EVENTS` times; the last text states that no more follow.
    """

    def __init__(self) -> None:
        self._seen: dict[tuple[str, str], tuple[int, int]] = {}  # its last cycle, its events

    def new_text(self, alarm: Alarm, cycle: int) -> str:
        """Text of the event for an alarm of a cycle; empty if it is not a new one."""
        last, events = self._seen.get(_identity(alarm), (cycle, 0))
        returns = alarm.reaction is StopReaction.NOTE and cycle > last + 1
        is_new = events == 0 or (returns and events < NOTE_EVENTS)
        events += is_new
        self._seen[_identity(alarm)] = cycle, events
        if not is_new:
            return ""
        return f"{alarm.text}{NO_MORE}" if events == NOTE_EVENTS else alarm.text


def _identity(alarm: Alarm) -> tuple[str, str]:
    """A drive may report several faults, each once; measured values change the text."""
    has_fixed_text = alarm.code in ("drive_fault", "drive_warning")
    return alarm.code, alarm.text if has_fixed_text else str(alarm.drive)


#: Alarms that several drives raise at once for a common cause.
_SHARED = frozenset({"drive_silent", "reply_lost"})


def shared_causes(alarms: Sequence[Alarm], names: Sequence[str]) -> tuple[Alarm, ...]:
    """The alarms of a cycle, with missing replies of several drives merged into one.

    Args:
        names: Of all drives, as the alarms name them.
    """
    merged: list[Alarm] = []
    for alarm in alarms:
        rest = _without_name(alarm, names)
        same = [f for f in alarms if f.code == alarm.code and _without_name(f, names) == rest]
        if alarm.code not in _SHARED or len(same) == 1:
            merged.append(alarm)
        elif alarm is same[0]:
            which, cause = name_drives([names[f.drive - 1] for f in same], len(names))
            merged.append(replace(alarm, text=f"{which} {rest}{cause}", drive=0))
    return tuple(merged)


def name_drives(failed: Sequence[str], drives: int) -> tuple[str, str]:
    """Names of drives that fail alike, as the subject of a sentence, and a cause to append.

    Args:
        drives: Number of drives of the rig.
    """
    if len(failed) == drives:
        return f"all {drives} drives", ": bus or supply"
    return ", ".join(failed), ""


def _without_name(alarm: Alarm, names: Sequence[str]) -> str:
    return alarm.text.removeprefix(f"{names[alarm.drive - 1]} ") if alarm.drive else ""


# Documentation of faults: a page for every event code that is a fault.


#: Codes of events of a good run, or of operator requests.
ORDINARY = frozenset(
    {
        *("enabled", "moving", "hold", "resume", "speed", "stop", "held"),
        *("pass", "pick", "place", "leaving", SIMULATED, REMARK, "traceback"),
    }
)
#: Codes of events with a page that do not stop a run.
HARMLESS = {"reply_lost", "set_point_missed", "drive_warning", "no_real_time", "jog_not_begun"}
#: Those of cameras: a run that measured nothing, or a platform elsewhere, does not pass.
_HARMLESS_OF_CAMERAS = frozenset({"camera_sees_nothing", "pictures_dropped", "pose_differs"})


def page_of(code: str) -> str:
    """Path of the page about a fault; empty for other events."""
    return f"docs/faults/{code}.md" if code in fault_codes() else ""


def fault_codes() -> list[str]:
    """Codes of all faults that have a page."""
    pages = ready_folder("docs/faults").glob("*.md")
    return sorted(page.stem for page in pages if page.stem != "index")


def faults_among(codes: Iterable[str]) -> list[str]:
    """Fault codes among event codes, each once, in order; those that stop no run are last."""
    known = fault_codes()
    found = [code for code in dict.fromkeys(codes) if code in known]
    return sorted(found, key=lambda code: (code in HARMLESS, code in _HARMLESS_OF_CAMERAS))


def page_text(code: str) -> str:
    """The page about a fault of `fault_codes`, as Markdown without links."""
    text = (ready_folder("docs/faults") / f"{code}.md").read_text(encoding="utf-8")
    return re.sub(r"\[([^]]+)\]\([^)]*\)", r"\1", text)


def page_of_fault(code: str) -> str:
    """The page about a fault of a user-given code; see `page_text`.

    Raises:
        BadInput: There is no such code; with the nearest, or all codes.
    """
    codes = fault_codes()
    if code in codes:
        return page_text(code)
    near = get_close_matches(code, codes, n=1)
    next_step = f"run `cdpr explain {near[0]}`" if near else f"use one of: {', '.join(codes)}"
    raise BadInput(f"there is no fault code {code!r}", where="cdpr explain", next_step=next_step)


def fault_titles() -> dict[str, str]:
    """Titles of all pages about faults, by code."""
    first_lines = ((code, page_text(code).split("\n", 1)[0]) for code in fault_codes())
    return {code: line.removeprefix("# ") for code, line in first_lines}
