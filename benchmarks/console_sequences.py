"""Random sequences of console events against a session of jogs in simulated time.

    python benchmarks/console_sequences.py [--count 100000] [--seed 1] [--cables]

`tests/console/sequences.py` defines the events and the checks of each cycle. Prints what was done
and what was wrong; exit code 1 if anything was. 100 000 sequences take half an hour.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from alone import alone  # noqa: E402

from tests.console.sequences import sequences  # noqa: E402


def main() -> int:
    """Prints the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--cables", action="store_true", help="sessions of single cables")
    options = parser.parse_args()
    with alone():
        began = time.monotonic()
        figures = sequences(options.count, options.seed, cables=options.cables)
        seconds = time.monotonic() - began
    print(figures.report())
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    print(f"{seconds:.0f} s, {most:.0f} MB at most")
    return 1 if figures.wrong else 0


if __name__ == "__main__":
    sys.exit(main())
