"""Where is kept, from one program to the next, what is known of a bus: its latch, its reference.

One folder for all users where an administrator made it, else the user's own: a fault that one user
saw is then unknown to another one. A file is named after the bus, however its name is spelled.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

from drivers.bus import BusSettings

#: Used by everybody once it exists: ``sudo install -d -m 2775 -g GROUP /var/lib/cdpr``.
SHARED = Path("/var/lib/cdpr")


def state_folder() -> Path:
    """The folder, which may not exist yet."""
    if SHARED.is_dir():
        return SHARED
    base = os.environ.get("XDG_STATE_HOME")
    return (Path(base) if base else Path.home() / ".local" / "state") / "cdpr"


def state_file(kind: str, settings: BusSettings) -> Path:
    """The file of a kind, such as ``latched``, for a bus."""
    name = re.sub(r"[^A-Za-z0-9.]+", "-", settings.canonical)
    return state_folder() / f"{kind}-{name}.json"
