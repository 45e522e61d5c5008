"""Parts of the state that every page is sent alike, as JSON; pure."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cdpr.console.started import VerbOutcome
from cdpr.console.view import measured_data
from executor.jogging import FASTEST
from executor.recording.run_course import RUNS


@dataclass(frozen=True, slots=True)
class Kept:
    """What is on file for a bus.

    Attributes:
        latched: Cause of the latched fault, if one is.
        referenced: The drives are homed.
        why_not: Why they are not.
    """

    latched: str | None
    referenced: bool
    why_not: str | None


def kept_state(kept: Kept) -> dict[str, Any]:
    """The fault latch and the homing reference."""
    reference = {"counts": kept.referenced, "why_not": kept.why_not}
    return {"latched": kept.latched, "reference": reference}


def outcome_state(ended: VerbOutcome | None) -> dict[str, Any] | None:
    """How the last verb ended, with addresses of its report and of help."""
    if ended is None:
        return None
    return {
        "verb": ended.verb,
        "ok": ended.exit_code == 0,
        "text": ended.text,
        "report": None if ended.report is None else _address_of(ended.report),
        "fault_page": None if ended.fault is None else f"/help/{ended.fault}",
    }


def _address_of(report: Path) -> str | None:
    """Where the console serves a report; only those below the folder of runs."""
    path, root = report.resolve(), RUNS.resolve()
    return f"/runs/{path.relative_to(root)}" if path.is_relative_to(root) else None


def jog_state(status: dict[str, Any] | None) -> dict[str, Any]:
    """Whether the platform can be jogged, and how far.

    Args:
        status: Of what moves, see `executor.remote.status`; None where nothing does.
    """
    why_not = "the drives are not enabled for jogging"
    if status is not None and "cable_jog" in status:
        why_not = "single cables are jogged: end that first"
    jog = None if status is None else status.get("jog")
    limit = jog and jog["limit"] and f"stops in {jog['room_mm']:.1f} mm: {jog['limit']}"
    return {**_session_state(status, jog, why_not), "limit": limit}


def cable_state(status: dict[str, Any] | None) -> dict[str, Any]:
    """Whether single cables can be jogged, which one was, and how far.

    Args:
        status: As for `jog_state`.
    """
    why_not = "the drives are not enabled for single cables"
    if status is not None and "jog" in status:
        why_not = "the platform is jogged: end that first"
    jog = None if status is None else status.get("cable_jog")
    names = ("cable", "press_mm", "session_mm", "limit", "limit_n")
    shown = {name: jog[name] if jog else None for name in names}
    return {**_session_state(status, jog, why_not), **shown}


def _session_state(
    status: dict[str, Any] | None, jog: dict[str, Any] | None, why_not: str
) -> dict[str, Any]:
    """Of a session of jogs, or why there is none."""
    if status is None or jog is None:
        return {"ready": False, "why_not": why_not, "moving": False, "speed_mm_s": 1e3 * FASTEST}
    ready = status["state"] == "moving"
    return {
        "ready": ready,
        "why_not": None if ready else f"the drives are {status['state']}",
        "moving": bool(status["feed_percent"]),
        "speed_mm_s": jog["speed_mm_s"],
    }


def measured_state(status: dict[str, Any] | None, age: float) -> dict[str, Any] | None:
    """The pose by the cameras, while they measure a run.

    Args:
        status: As for `jog_state`.
        age: Of the status, [s].
    """
    measured = None if status is None else status["measured"]
    if status is None or measured is None or status["elapsed_s"] is None:
        return None
    return measured_data(measured, max(0.0, status["elapsed_s"] - measured["time_s"]) + age)
