"""The verdict, the key figures and the marks of a run at the top of its page."""

from __future__ import annotations

from html import escape
from typing import Any

from executor.report.markup import known, prose

_CLASS = {"PASSED": "pass", "STOPPED": "stop"}


def verdict_banner(summary: dict[str, Any]) -> str:
    """The verdict in a word, a sentence, and check by check."""
    checks = "".join(_check(check) for check in summary["checks"])
    return (
        f'<section class="verdict {_CLASS.get(summary["verdict"], "fail")}" id="verdict">'
        f"<h2>{escape(summary['verdict'])}</h2>"
        f'<p class="sentence">{escape(summary["sentence"])}</p>'
        f'<ul class="checks">{checks}</ul></section>'
    )


def _check(check: dict[str, Any]) -> str:
    sign, name, word = ("✓", "yes", "met") if check["passed"] else ("✗", "no", "not met")
    return (
        f'<li><span class="mark {name}" role="img" aria-label="{word}">{sign}</span>'
        f"<span>{prose(check['text'])}</span></li>"
    )


def chips(summary: dict[str, Any]) -> str:
    """What kind of run it was, in a few words each."""
    drives = "simulated drives" if summary["simulated"] else "real drives"
    time = "simulated time" if summary["fast"] else "real time"
    words = [summary["started"].replace("T", " ").split(".")[0] + " UTC"]
    words += [
        f"{drives}, bus {summary['interface']}",
        f"{time}, {summary['cycle_ms']:g} ms a cycle",
    ]
    words.append("no camera" if summary["tag_error_mm"] is None else "camera and tags")
    return f'<ul class="chips">{"".join(f"<li>{escape(word)}</li>" for word in words)}</ul>'


def key_figures(summary: dict[str, Any]) -> str:
    """The figures that a reader looks for first."""
    tiles = [
        _tile("Path", known(summary["path_length_mm"], 0, "mm"), _path_note(summary)),
        *_clearance(summary["clearance_mm"]),
        _following(summary["following_error_mm"]),
        *_camera(summary["tag_error_mm"]),
        _tension(summary["tension_n"]),
        _tile("Replies lost", str(summary["lost_replies"]), f"in {summary['cycles']} cycles"),
        *_lateness(summary["lateness_ms"]),
    ]
    return f'<dl class="tiles">{"".join(tiles)}</dl>'


def _tile(name: str, value: str, note: str) -> str:
    number, _, unit = value.partition(" ")
    return (
        f"<div><dt>{escape(name)}</dt><dd>{escape(number)} <small>{escape(unit)}</small>"
        f'<span class="note">{prose(note)}</span></dd></div>'
    )


def _path_note(summary: dict[str, Any]) -> str:
    return f"{known(summary['travelled_mm'], 0, 'mm')} driven in {summary['duration_s']:.1f} s"


def _clearance(key: dict[str, Any] | None) -> list[str]:
    if key is None:
        return []
    by = "camera" if key["source"] == "tag" else "drives"
    note = (
        f"surely {_span(key)} mm by the {by};"
        f" planned {known(key['planned_min'], 1, '')}, required {key['required']:g}"
    )
    return [_tile("Smallest clearance", known(key["measured_min"], 1, "mm"), note)]


def _span(key: dict[str, Any]) -> str:
    """Between what the smallest true clearance lies."""
    if key["measured_min"] is None:
        return "–"
    low = key["measured_min"] - key["measured_uncertainty"]
    return f"{low:.1f} to {key['measured_at_most']:.1f}"


def _following(key: dict[str, Any]) -> str:
    text = known(key["max"], 3, "mm")
    if text.startswith("0.000"):
        text = "<\u00a00.001 mm"
    return _tile("Following error", text, f"largest; limit {key['limit']:g} mm")


def _camera(key: dict[str, Any] | None) -> list[str]:
    if key is None:
        return []
    seen = key["frames"] - key["frames_without_pose"]
    note = f"RMS; largest {known(key['max'], 2, 'mm')}, {seen} of {key['frames']} pictures"
    return [_tile("Camera to plan", known(key["rms"], 2, "mm"), note)]


def _tension(key: dict[str, Any]) -> str:
    note = f"limits {key['lower_limit']:g} to {key['upper_limit']:g} N"
    if key["min"] is None:
        return _tile("Tension", "– N", note)
    return _tile("Tension", f"{key['min']:.1f}–{key['max']:.1f} N", note)


def _lateness(key: dict[str, Any] | None) -> list[str]:
    if key is None:
        return []
    note = f"99 % of cycles; largest {known(key['max'], 2, 'ms')}"
    return [_tile("Lateness", known(key["p99"], 2, "ms"), note)]
