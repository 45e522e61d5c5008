"""The fault table: stop time, spread and worst step of every fault, and a soak of random ones.

    python benchmarks/faults.py -o DIR [--transport virtual,udp] [--seeds 200] [--minutes 10]
        [--hours 0] [--jobs 2] [--drive-behaviour NAME[=VALUE] ...] [--only TEXT]

writes `faults.json` and `faults.md` (one row per fault and transport), and `soak.csv` with a line
for every random run: seed, faults, how it ended, violated invariants, memory of its process. It
lasts until all of its minimum numbers of runs, minutes and simulated hours are reached; processes
share it, and a seed gives the same run in each of them. All drives have the behaviours of
`--drive-behaviour` (`cdpr sim RIG --drive-behaviour list`) beside those of their row. The rows of
`vcan` come from the tests on a CAN bus of the kernel: `--vcan FILE` names their `faults.json`
(`make hil`, then ~/.cache/cdpr/hil/last/table/faults.json). The exit code is 1 on any violation.
Not a test: it takes minutes.
"""

from __future__ import annotations

import argparse
import csv
import gc
import json
import os
import resource
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

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
from simulation.drives.behaviour import (  # noqa: E402
    DriveBehaviour,
    behaviour_named,
)
from tests.cli.plans import (  # noqa: E402
    RIG,
    write_short_plan,
)
from tests.scenarios.faults.bench import (  # noqa: E402
    live,
    simulated,
)
from tests.scenarios.faults.cases import (  # noqa: E402
    Fault,
    complaints,
    held_up,
    row,
)
from tests.scenarios.faults.drive_cases import ROWS  # noqa: E402
from tests.scenarios.faults.masters import Masters  # noqa: E402
from tests.scenarios.faults.random_faults import (  # noqa: E402
    RandomRun,
    random_run,
)

ATTEMPTS = 5
SHARE = 16
"""Runs of the soak that each process is given at a time."""


def on_virtual(
    prepared: PreparedRun, folder: Path, faults: dict[str, Fault], base: DriveBehaviour
) -> list[dict[str, Any]]:
    """Every fault in simulated time."""
    rows = []
    for number, (name, fault) in enumerate(faults.items()):
        with simulated(
            prepared,
            folder / f"virtual {number}",
            fault.script(),
            bitrate=fault.bitrate,
            behaviour=fault.drives(base),
            profile=fault.profile,
        ) as bench:
            ended = bench.run()
            cycle = prepared.checked.table.cycle
            found = complaints(fault, bench, ended, bench.cause, cycle)
            rows.append(row(name, fault, "virtual", bench, ended, bench.cause, found))
        print_row(rows[-1])
    return rows


def on_udp(
    prepared: PreparedRun,
    folder: Path,
    masters: Masters,
    faults: dict[str, Fault],
    base: DriveBehaviour,
) -> list[dict[str, Any]]:
    """Faults that are possible between two processes, in real time."""
    channel = f"239.74.163.26:{20000 + os.getpid() % 20000}"
    settings = BusSettings("udp_multicast", channel)
    rows = []
    for name, fault in faults.items():
        if fault.live:
            rows.append(_one_on_udp(prepared, folder, masters, settings, name, fault, base))
            print_row(rows[-1])
    return rows


def _one_on_udp(
    prepared: PreparedRun,
    folder: Path,
    masters: Masters,
    settings: BusSettings,
    name: str,
    fault: Fault,
    base: DriveBehaviour,
) -> dict[str, Any]:
    """One fault; repeated if this computer delayed the simulated drives."""
    for attempt in range(ATTEMPTS):
        path = folder / f"udp {name.replace('/', ' ')} {attempt}"
        behaviour = fault.drives(base)
        with live(prepared, path, fault.script(), settings, masters, behaviour=behaviour) as bench:
            ended = bench.run()
            cause = str(bench.outcome.get("cause", ""))
            if held_up(fault, bench, cause) and attempt < ATTEMPTS - 1:
                continue
            if bench.since is None:
                return {"fault": name, "transport": "udp", "violations": [f"never came: {cause}"]}
            cycle = prepared.checked.table.cycle
            found = complaints(fault, bench, ended, cause, cycle)
            return row(name, fault, "udp", bench, ended, cause, found)
    raise AssertionError("the last attempt returned")


def print_row(entry: dict[str, Any]) -> None:
    """Prints a row as soon as it is measured."""
    print(json.dumps(entry, ensure_ascii=False), flush=True)


_soaked: PreparedRun
"""The run of a process of the soak."""
_behaviour: DriveBehaviour
"""The behaviour of its drives."""


def soak(plan: Path, output: Path, options: argparse.Namespace) -> int:
    """Runs random faults up to all minimums; returns the number of runs with a violation."""
    begin, bad, passed, number = time.monotonic(), 0, 0.0, 0
    with (
        (output / "soak.csv").open("w", newline="") as file,
        ProcessPoolExecutor(
            options.jobs, initializer=_get_ready, initargs=(plan, options.drive_behaviour)
        ) as pool,
    ):
        table = csv.writer(file, lineterminator="\n")
        table.writerow(
            ("seed", "faults", "ended", "violations", "simulated_s", "resident_mb", "objects")
        )
        while (
            number < options.seeds
            or time.monotonic() - begin < 60.0 * options.minutes
            or passed < 3600.0 * options.hours
        ):
            seeds = range(number, number + SHARE * options.jobs)
            if options.seeds > number:
                seeds = seeds[: options.seeds - number]
            for seed, (done, size, objects) in zip(seeds, pool.map(_one, seeds), strict=True):
                faults, ended = (
                    " + ".join(done.faults),
                    done.ended.value if done.ended else "killed",
                )
                bad += bool(done.violations)
                passed += done.simulated_s
                broken, simulated = "; ".join(done.violations), f"{done.simulated_s:.2f}"
                table.writerow((seed, faults, ended, broken, simulated, f"{size:.1f}", objects))
                if done.violations:
                    print(seed, faults, done.violations[:3], flush=True)
            file.flush()
            number = seeds.stop
    print(_soak_line(number, passed, time.monotonic() - begin, bad), flush=True)
    return bad


def _soak_line(runs: int, passed: float, took: float, bad: int) -> str:
    rate = passed / took if took > 0.0 else 0.0
    return (
        f"{runs} runs, {passed / 3600.0:.2f} h of simulated time in {took / 60.0:.1f} min"
        f" ({rate:.1f} times real time), {bad} with a violation"
    )


def _get_ready(plan: Path, behaviour: list[str]) -> None:
    """Initializes a process of the soak."""
    global _soaked, _behaviour
    _soaked, _behaviour = (
        prepare(verify(load_plan(plan)), load_rig(RIG)),
        behaviour_named(behaviour),
    )


def _one(seed: int) -> tuple[RandomRun, float, int]:
    """A random run, with its process's memory [MB] and number of objects."""
    with tempfile.TemporaryDirectory() as folder:
        done = random_run(_soaked, Path(folder) / "run", seed, _behaviour)
    if seed % 50 == 0:
        gc.collect()
    resident = int(Path("/proc/self/statm").read_text().split()[1])
    return done, resident * resource.getpagesize() / 2**20, len(gc.get_objects())


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as a Markdown table."""
    lines = [
        "| fault | transport | ended | stopped after | spread | worst step | travel | as it must |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for entry in rows:
        numbers = (("stop_ms", "ms"), ("spread_ms", "ms"), ("step_mm", "mm"), ("travel_mm", "mm"))
        cells = [
            "–" if entry.get(key) is None else f"{entry[key]:.{2 if unit == 'mm' else 1}f} {unit}"
            for key, unit in numbers
        ]
        good = "yes" if not entry["violations"] else "; ".join(entry["violations"])
        name, transport = entry["fault"], entry["transport"]
        lines.append(f"| {' | '.join([name, transport, str(entry.get('ended')), *cells, good])} |")
    return "\n".join(lines) + "\n"


def main() -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(description="measure the fault table")
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--transport", default="virtual,udp", help="virtual, udp, or none")
    parser.add_argument("--seeds", type=int, default=200, help="random runs at least")
    parser.add_argument("--minutes", type=float, default=10.0, help="of random runs at least")
    parser.add_argument("--hours", type=float, default=0.0, help="of simulated time at least")
    parser.add_argument("--jobs", type=int, default=2, help="processes of the soak")
    parser.add_argument("--vcan", type=Path, help="faults.json of `make hil`")
    parser.add_argument("--drive-behaviour", action="append", default=[], metavar="NAME[=VALUE]")
    parser.add_argument("--only", default="", help="rows with this text in their name")
    options = parser.parse_args()
    base = behaviour_named(options.drive_behaviour)
    faults = {name: fault for name, fault in ROWS.items() if options.only in name}
    output: Path = options.output
    output.mkdir(parents=True, exist_ok=True)
    plan = write_short_plan(output / "plan.json")
    prepared = prepare(verify(load_plan(plan)), load_rig(RIG))
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as scratch:
        if "virtual" in options.transport:
            rows += on_virtual(prepared, Path(scratch), faults, base)
        if "udp" in options.transport:
            masters = Masters(plan, RIG)
            rows += on_udp(prepared, Path(scratch), masters, faults, base)
            masters.close()
    if options.vcan:
        rows += [json.loads(line) for line in options.vcan.read_text().splitlines()]
    (output / "faults.json").write_text(json.dumps(rows, indent=1, ensure_ascii=False))
    (output / "faults.md").write_text(table(rows))
    print(table(rows))
    bad = soak(plan, output, options)
    return int(bad > 0 or any(entry["violations"] for entry in rows))


if __name__ == "__main__":
    sys.exit(main())
