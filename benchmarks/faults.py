"""The fault table: stop time, spread and worst step of every fault, and a soak of random ones.

    python benchmarks/faults.py -o DIR [--transport virtual,udp] [--seeds 200] [--minutes 10]

writes `faults.json` and `faults.md` (a row a fault and transport), and `soak.csv` with a line for
every random run: seed, faults, how it ended, violated invariants, memory. The rows of `vcan` come
from the tests on a CAN bus of the kernel: `--vcan FILE` names the `faults.json` that they left
(`make hil`, then ~/.cache/cdpr/hil/last/faults.json). The exit code is 1 when anything is not as it
must be. Not a test: it takes minutes.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import resource
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from cdpr.plan import load_plan  # noqa: E402
from cdpr.rig import load_rig  # noqa: E402
from drivers.bus import BusSettings  # noqa: E402
from executor.prepare import PreparedRun, prepare  # noqa: E402
from planner.check import verify  # noqa: E402
from tests.cli.plans import RIG, write_short_plan  # noqa: E402
from tests.scenarios.faults.bench import live, simulated  # noqa: E402
from tests.scenarios.faults.cases import TABLE, Fault, complaints, held_up, row  # noqa: E402
from tests.scenarios.faults.masters import Masters  # noqa: E402
from tests.scenarios.faults.random_faults import random_run  # noqa: E402

ATTEMPTS = 5


def on_virtual(prepared: PreparedRun, folder: Path) -> list[dict[str, Any]]:
    """Every fault in simulated time."""
    rows = []
    for name, fault in TABLE.items():
        path = folder / f"virtual {name}"
        with simulated(prepared, path, fault.script(), bitrate=fault.bitrate) as bench:
            ended = bench.run()
            cycle = prepared.checked.table.cycle
            found = complaints(fault, bench, ended, bench.cause, cycle)
            rows.append(row(name, "virtual", bench, ended, bench.cause, found))
        told(rows[-1])
    return rows


def on_udp(prepared: PreparedRun, folder: Path, masters: Masters) -> list[dict[str, Any]]:
    """Those that are possible between two processes, in real time."""
    channel = f"239.74.163.26:{20000 + os.getpid() % 20000}"
    settings = BusSettings("udp_multicast", channel)
    rows = []
    for name, fault in TABLE.items():
        if fault.live:
            rows.append(_one_on_udp(prepared, folder, masters, settings, name, fault))
            told(rows[-1])
    return rows


def _one_on_udp(
    prepared: PreparedRun,
    folder: Path,
    masters: Masters,
    settings: BusSettings,
    name: str,
    fault: Fault,
) -> dict[str, Any]:
    """Again where this computer held the simulated drives up."""
    for attempt in range(ATTEMPTS):
        path = folder / f"udp {name} {attempt}"
        with live(prepared, path, fault.script(), settings, masters) as bench:
            ended = bench.run()
            cause = str(bench.outcome.get("cause", ""))
            if held_up(fault, bench, cause) and attempt < ATTEMPTS - 1:
                continue
            if bench.since is None:
                return {"fault": name, "transport": "udp", "violations": [f"never came: {cause}"]}
            cycle = prepared.checked.table.cycle
            found = complaints(fault, bench, ended, cause, cycle)
            return row(name, "udp", bench, ended, cause, found)
    raise AssertionError("the last attempt returned")


def told(entry: dict[str, Any]) -> None:
    """As soon as it is known."""
    print(json.dumps(entry, ensure_ascii=False), flush=True)


def soak(prepared: PreparedRun, output: Path, seeds: int, minutes: float) -> int:
    """Random faults, at least so many and so long; the number of runs with a violation."""
    begin, bad, passed, number = time.monotonic(), 0, 0.0, 0
    with (output / "soak.csv").open("w") as file:
        file.write("seed,faults,ended,violations,simulated_s,resident_mb,objects\n")
        while number < seeds or time.monotonic() - begin < 60.0 * minutes:
            with tempfile.TemporaryDirectory() as folder:
                done = random_run(prepared, Path(folder) / "run", number)
            bad += bool(done.violations)
            passed += done.simulated_s
            ended = done.ended.value if done.ended else "killed"
            if number % 50 == 0:
                gc.collect()
            resident = int(Path("/proc/self/statm").read_text().split()[1])
            size = resident * resource.getpagesize() / 2**20
            faults = " + ".join(done.faults)
            file.write(f"{number},{faults},{ended},{'; '.join(done.violations)!r},")
            file.write(f"{done.simulated_s:.2f},{size:.1f},{len(gc.get_objects())}\n")
            file.flush()
            if done.violations:
                print(number, faults, done.violations[:3], flush=True)
            number += 1
    hours = passed / 3600.0
    print(f"{number} runs, {hours:.2f} h of simulated time, {bad} with a violation", flush=True)
    return bad


def table(rows: list[dict[str, Any]]) -> str:
    """As Markdown."""
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
        name, way = entry["fault"], entry["transport"]
        lines.append(f"| {name} | {way} | {entry.get('ended')} | {' | '.join(cells)} | {good} |")
    return "\n".join(lines) + "\n"


def main() -> int:
    """Does what the options ask for."""
    parser = argparse.ArgumentParser(description="measure the fault table")
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--transport", default="virtual,udp", help="virtual, udp, or none")
    parser.add_argument("--seeds", type=int, default=200, help="random runs at least")
    parser.add_argument("--minutes", type=float, default=10.0, help="of random runs at least")
    parser.add_argument("--vcan", type=Path, help="faults.json of `make hil`")
    options = parser.parse_args()
    output: Path = options.output
    output.mkdir(parents=True, exist_ok=True)
    plan = write_short_plan(output / "plan.json")
    prepared = prepare(verify(load_plan(plan)), load_rig(RIG))
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as scratch:
        if "virtual" in options.transport:
            rows += on_virtual(prepared, Path(scratch))
        if "udp" in options.transport:
            masters = Masters(plan, RIG)
            rows += on_udp(prepared, Path(scratch), masters)
            masters.close()
    if options.vcan:
        rows += [json.loads(line) for line in options.vcan.read_text().splitlines()]
    (output / "faults.json").write_text(json.dumps(rows, indent=1, ensure_ascii=False))
    (output / "faults.md").write_text(table(rows))
    print(table(rows))
    bad = soak(prepared, output, options.seeds, options.minutes)
    return int(bad > 0 or any(entry["violations"] for entry in rows))


if __name__ == "__main__":
    sys.exit(main())
