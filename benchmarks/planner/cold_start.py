"""Time of `cdpr plan` from shell prompt to shell prompt, with machine code compiled before.

    python benchmarks/planner/cold_start.py --runs 10

Measured alternately with it: a Python that ends at once, and one that imports the libraries that a
compiled planner needs. Wall time is meaningful on a quiet machine, processor time also on a busy
one. Python caches byte code as by default, whatever PYTHONDONTWRITEBYTECODE is set to here.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

CONFIGS = Path(__file__).parents[2] / "configs"
LIBRARIES = "import numpy, pydantic, yaml, typer, numba, numba.np.arraymath"


@dataclass(frozen=True)
class Start:
    """One start of a program, [s]."""

    wall: float
    processor: float


def main() -> None:
    """Measures and prints."""
    options = _options()
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    with tempfile.TemporaryDirectory() as folder:
        commands = _commands(Path(folder) / "plan.json")
        for command in commands.values():
            started(command, environment)  # compiles byte code and machine code
        starts: dict[str, list[Start]] = {name: [] for name in commands}
        for _ in range(options.runs):
            for name, command in commands.items():
                starts[name].append(started(command, environment))
    print(f"{'':28s}{'wall: median, best':>22s}{'processor: median, best':>28s}  [s]")
    for name, measured in starts.items():
        wall = np.array([start.wall for start in measured])
        processor = np.array([start.processor for start in measured])
        print(
            f"{name:28s}{np.median(wall):14.2f}, {wall.min():.2f}"
            f"{np.median(processor):20.2f}, {processor.min():.2f}"
        )


def started(command: Sequence[str], environment: dict[str, str]) -> Start:
    """Runs a program to its end.

    Raises:
        subprocess.CalledProcessError: It failed.
    """
    before, began = _processor_time(), time.perf_counter()
    subprocess.run(command, env=environment, check=True, capture_output=True)
    return Start(time.perf_counter() - began, _processor_time() - before)


def _processor_time() -> float:
    """Processor time of all finished child processes, [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _commands(output: Path) -> dict[str, list[str]]:
    python, cdpr = sys.executable, str(Path(sys.executable).with_name("cdpr"))
    plans = {
        f"cdpr plan, environment {n}": [
            cdpr,
            "plan",
            str(CONFIGS / "gachon_8_6.yaml"),
            str(CONFIGS / f"environment_{n}.yaml"),
            "-o",
            str(output),
            "--force",
        ]
        for n in (1, 2, 3)
    }
    return {
        "python": [python, "-c", ""],
        "libraries alone": [python, "-c", LIBRARIES],
        **plans,
    }


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--runs", type=int, default=10, help="starts of each program")
    return parser.parse_args()


if __name__ == "__main__":
    main()
