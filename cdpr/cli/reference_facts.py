"""What verbs tell of the reference of a bus, and whether the drives still count from it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from executor.custody import Custody


def reference_told(custody: Custody, stands: Sequence[int] | None = None) -> dict[str, Any]:
    """``counts``, ``why_not``, ``made``, ``how`` and ``file``; what there is none of is null.

    Args:
        custody: Of the bus.
        stands: Where its drives stand, [counts]; left out where nobody asked them.
    """
    from cdpr.errors import Refused

    why = custody.why_unreferenced(stands)
    try:
        kept = custody.kept_reference()
    except Refused:  # then the reason tells it
        kept = None
    return {
        "counts": not why,
        "why_not": why or None,
        "made": kept.made if kept else None,
        "how": kept.how if kept else None,
        "file": str(custody.file.path) if custody.file.path.exists() else None,
    }


def reference_text(told: dict[str, Any]) -> str:
    """The same in a sentence."""
    made = f"made {told['made']} ({told['how']})" if told["made"] else ""
    if not told["counts"]:
        return f"does not count: {told['why_not']}"
    return f"counts, {made}" if made else "none kept: absolute encoders count as the rig file says"
