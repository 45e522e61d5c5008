"""Prints the lowest version that pyproject.toml declares for each dependency of cdpr.

python tools/lowest.py > lowest.txt    # constraints for pip
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LOWER_BOUND = re.compile(r"([\w.-]+)(?:\[[\w,]+\])?>=([\w.]+)")


def main() -> None:
    """Prints one line per package."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    for requirement in [*project["dependencies"], *extras["odrive"]]:
        bound = LOWER_BOUND.fullmatch(requirement)
        if bound is None:
            raise SystemExit(f"pyproject.toml: {requirement!r} declares no lowest version")
        print(f"{bound[1]}=={bound[2]}")


if __name__ == "__main__":
    main()
