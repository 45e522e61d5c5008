"""SIGSTOP of the executor for 5 to 60 ms while it moves drives over UDP, in real time.

    python benchmarks/sigstop.py [--from 5] [--to 60] [--step 1] [--seed 0] [-o FILE]

prints a row for each duration: its start within the cycle, the lateness of the next cycle, how the
run ended, "enable operation" frames that reached a drive after it had stopped, and drives that such
a frame enabled again, of which there must be none (exit code 1 otherwise). States and frames are
those on the drives' side. Not a test: it takes about five minutes.
"""

from __future__ import annotations

import argparse
import os
import random
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from drivers.can_bus import BusSettings  # noqa: E402
from executor.trajectory.setpoints import (  # noqa: E402
    PreparedRun,
    prepare,
)
from model.plan import load_plan  # noqa: E402
from model.rig import load_rig  # noqa: E402
from planner.check import verify  # noqa: E402
from tests.cli.plans import (  # noqa: E402
    RIG,
    write_short_plan,
)
from tests.scenarios.faults.bench import (  # noqa: E402
    Bench,
    LiveBench,
    live,
)
from tests.scenarios.faults.masters import Masters  # noqa: E402
from tests.scenarios.faults.samples import emergencies  # noqa: E402
from tests.scenarios.faults.suspension import (  # noqa: E402
    Seen,
    Suspension,
    seen_by,
)

HEAD = "|   ms | from SYNC | late by | ended    | 0Fh after | again | EMCY before |"


def one(
    prepared: PreparedRun, folder: Path, masters: Masters, milliseconds: int, after: float
) -> tuple[Seen, str, float, int]:
    """One run: observations by the drives, how it ended, worst lateness, EMCY before."""
    settings = BusSettings("udp_multicast", f"239.74.163.37:{20000 + os.getpid() % 20000}")
    suspension = Suspension(lambda: running[0].process, milliseconds, after)
    running: list[LiveBench] = []

    def script(bench: Bench) -> None:
        if bench.cycle >= bench.fault_cycle:
            bench.happens()
            suspension.begin()

    with live(prepared, folder / f"{milliseconds}", script, settings, masters) as bench:
        running.append(bench)
        bench.fault_cycle = 60
        ended = bench.run()
        suspension.join()
        early = emergencies(bench.rehearsal, bench.since or float("inf"))
        late = float(bench.outcome.get("worst_late", float("nan"))) / prepared.checked.table.cycle
        how = ended.value if ended else "killed"
        how = how if suspension.done.is_set() else f"{how}, never suspended"
        return seen_by(bench.rehearsal), how, late, len(early)


def main() -> int:
    """Runs all durations; returns 1 if a drive was enabled again."""
    parser = argparse.ArgumentParser(description="SIGSTOP of the executor while it moves drives")
    parser.add_argument("--from", dest="first", type=int, default=5)
    parser.add_argument("--to", dest="last", type=int, default=60)
    parser.add_argument("--step", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    dice = random.Random(options.seed)
    lines, again = [HEAD, "|---:|---:|---:|---|---:|---:|---:|"], 0
    print("\n".join(lines), flush=True)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        plan = write_short_plan(folder / "plan.json")
        prepared = prepare(verify(load_plan(plan)), load_rig(RIG))
        masters = Masters(plan, RIG)
        for milliseconds in range(options.first, options.last + 1, options.step):
            after = dice.uniform(0.0, prepared.checked.table.cycle)
            seen, ended, late, early = one(prepared, folder, masters, milliseconds, after)
            again += len(seen.returned)
            lines.append(
                f"| {milliseconds:4} | {1e3 * after:6.1f} ms | {late:5.2f} T | {ended:8} |"
                f" {seen.enabled_after_stop:9} | {len(seen.returned):5} | {early:11} |"
            )
            print(lines[-1], flush=True)
        masters.close()
    lines.append(f"\n{len(lines) - 2} runs, {again} drives enabled again")
    print(lines[-1])
    if options.output:
        options.output.write_text("\n".join(lines) + "\n")
    return int(again > 0)


if __name__ == "__main__":
    sys.exit(main())
