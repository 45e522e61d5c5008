"""Which programs took part in a run."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version

LIBRARIES = (
    "cdpr",
    "numpy",
    "python-can",
    "canopen",
    "opencv-python-headless",
    "python-fcl",
    "ruckig",
)


def versions() -> dict[str, str]:
    """Name and version of Python and of the libraries that matter."""
    found = {"python": platform.python_version()}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found
