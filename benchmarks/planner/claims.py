"""Claims about our planner against OMPL's, as ratios of figures of the same run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import ours

FIRST_COMPILED, FIRST_FCL = 1.0, 1000.0
"""Claimed speed ratio of our first path to RRTConnect's: both compiled with our checker, and as a
user gets it from OMPL and python-fcl."""
OURS_AT_MS, THEIRS_AT_MS = 10.0, 1000.0
_FIRST = "RRTConnect"

Row = dict[str, Any]


def claims(
    rows: Sequence[Row], marks_ms: Sequence[float], inside_us: Mapping[int, Sequence[float]]
) -> str:
    """The claims and whether they hold, as Markdown; those without figures are left out.

    Args:
        rows: Of the run, medians.
        marks_ms: Times at which lengths were read.
        inside_us: By environment, mean times to a first path in compiled code, [µs]: ours, and
            RRTConnect's at OMPL's default range and without a limit of steps.
    """
    lines = ["| env. | claim | found | holds |", "|---|---|---|---|"]
    for environment in sorted({row["environment"] for row in rows}):
        here = [row for row in rows if row["environment"] == environment]
        mine = next(row for row in here if row["planner"] == ours.NAME)
        called_ms, compiled_ms = mine["first_median_ms"], inside_us[environment][0] / 1e3
        found = [
            *_compiled(inside_us[environment]),
            _first(called_ms, here, "exact", 1.0, "called from Python"),
            _first(called_ms, here, "fcl", FIRST_FCL, "called from Python"),
            _first(compiled_ms, here, "fcl", FIRST_FCL, "in compiled code"),
        ]
        if {OURS_AT_MS, THEIRS_AT_MS} <= set(marks_ms):
            found.append(_shorter(mine, here))
        lines += [f"| {environment} | {text} |" for text in found if text]
    return "\n".join(lines)


def _compiled(inside_us: Sequence[float]) -> list[str]:
    """Our mean time to the first path against RRTConnect's, both in compiled code."""
    lines = []
    for name, theirs in zip(("at OMPL's range", "unlimited"), inside_us[1:], strict=True):
        ratio = theirs / inside_us[0]
        claim = f"first path before {_FIRST} {name}, both compiled"
        found = f"{ratio:.1f} times: {inside_us[0]:.1f} against {theirs:.1f} µs"
        lines.append(f"{claim} | {found} | {_yes_or_no(ratio >= FIRST_COMPILED)}")
    return lines


def _first(spent_ms: float, rows: Sequence[Row], checker: str, wanted: float, where: str) -> str:
    """Our time to the first path against the median of theirs."""
    for row in rows:
        if (row["planner"], row["checker"]) == (_FIRST, checker) and row["first_median_ms"]:
            theirs = row["first_median_ms"]
            claim = f"first path {where} {wanted:g} times as fast as {_FIRST}, {checker} checker"
            found = (
                f"{theirs / spent_ms:.1f} times: {spent_ms * 1e3:.0f} against {theirs * 1e3:.0f} µs"
            )
            return f"{claim} | {found} | {_yes_or_no(theirs / spent_ms >= wanted)}"
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
    return f"{claim} | {own:+.2f} % against {best:+.2f} % ({name}) | {_yes_or_no(own < best)}"


def _yes_or_no(holds: bool) -> str:
    return "yes" if holds else "no"
