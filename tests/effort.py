"""How many random cases the campaigns try: all of them with HYPOTHESIS_PROFILE=explore."""

from __future__ import annotations

import os

EXPLORE = os.environ.get("HYPOTHESIS_PROFILE") == "explore"


def cases(everything: int, share: float = 0.2) -> int:
    """A share of the cases, all when exploring."""
    return everything if EXPLORE else max(1, round(share * everything))
