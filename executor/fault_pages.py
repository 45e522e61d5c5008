"""Where the documentation tells about an event that is a fault: a page for every code."""

from __future__ import annotations

from collections.abc import Iterable

#: Codes of events that belong to a run that goes well, or to what the operator wants.
ORDINARY = frozenset(
    {
        *("enabled", "moving", "hold", "resume", "speed", "stop", "held"),
        *("via", "pick", "place", "leaving", "traceback"),
    }
)


def page_of(code: str) -> str:
    """The page about a fault; nothing for an event that is none."""
    return "" if code in ORDINARY else f"docs/faults/{code}.md"


def pages_of(codes: Iterable[str]) -> list[str]:
    """The pages about the faults among some events, each once, in order."""
    return [page for page in dict.fromkeys(map(page_of, codes)) if page]
