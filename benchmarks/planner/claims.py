"""What is claimed of our planner against OMPL's, as ratios of figures of the same run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import ours

FIRST_EXACT, FIRST_FCL = 5.0, 1000.0
"""How many times faster our first path is to be than RRTConnect's, with our checker and python-fcl.
"""
OURS_AT_MS, THEIRS_AT_MS = 10.0, 1000.0
_FIRST = "RRTConnect"

Row = dict[str, Any]


def claims(rows: Sequence[Row], marks_ms: Sequence[float], inside_us: Mapping[int, float]) -> str:
    """The claims and whether they hold, as Markdown; those without figures are left out.

    Args:
        rows: Of the run, medians.
        marks_ms: At which lengths were read.
        inside_us: Our mean time to a first path in compiled code by environment, [µs]: without the
            one call from Python, which hands over some fifty arrays and takes longer than the path.
    """
    lines = ["| env. | claim | found | holds |", "|---|---|---|---|"]
    for environment in sorted({row["environment"] for row in rows}):
        here = [row for row in rows if row["environment"] == environment]
        mine = next(row for row in here if row["planner"] == ours.NAME)
        found = [
            _first(spent, here, checker, wanted, where)
            for checker, wanted in (("exact", FIRST_EXACT), ("fcl", FIRST_FCL))
            for spent, where in (
                (inside_us[environment] / 1e3, "in compiled code"),
                (mine["first_median_ms"], "called from Python"),
            )
        ]
        if {OURS_AT_MS, THEIRS_AT_MS} <= set(marks_ms):
            found.append(_shorter(mine, here))
        lines += [f"| {environment} | {text} |" for text in found if text]
    return "\n".join(lines)


def _first(spent_ms: float, rows: Sequence[Row], checker: str, wanted: float, where: str) -> str:
    """Our time to the first path against the median of theirs."""
    for row in rows:
        if (row["planner"], row["checker"]) == (_FIRST, checker) and row["first_median_ms"]:
            theirs = row["first_median_ms"]
            claim = f"first path {where} {wanted:g} times faster than {_FIRST}, {checker} checker"
            found = (
                f"{theirs / spent_ms:.1f} times: {spent_ms * 1e3:.0f} against {theirs * 1e3:.0f} µs"
            )
            return f"{claim} | {found} | {_said(theirs / spent_ms >= wanted)}"
    return ""


def _shorter(mine: Row, rows: Sequence[Row]) -> str:
    """Our median length after a short time against the best of theirs after a long one."""
    theirs = [
        (row[f"excess_percent_{THEIRS_AT_MS:g}_ms"], row["planner"])
        for row in rows
        if row is not mine and row["checker"] == "exact"
    ]
    known = [entry for entry in theirs if entry[0] is not None]
    own = mine[f"excess_percent_{OURS_AT_MS:g}_ms"]
    if not known or own is None:
        return ""
    best, name = min(known)
    claim = f"shorter after {OURS_AT_MS:g} ms than all of OMPL's after {THEIRS_AT_MS:g} ms"
    return f"{claim} | {own:+.2f} % against {best:+.2f} % ({name}) | {_said(own < best)}"


def _said(holds: bool) -> str:
    return "yes" if holds else "no"
