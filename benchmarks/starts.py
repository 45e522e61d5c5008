"""Starts and releases over UDP in real time on a loaded machine: failures from a gap.

    python benchmarks/starts.py [--pairs 500] [--minutes 60] [--busy 2] [-o FILE]

Each pair is `cdpr run` of a short plan and then `cdpr release`, through the real command line, with
strict simulated drives in their own process that report a missed SYNC, set-point or heartbeat in
any NMT-operational state. Separate counts: starts and releases that finished; those that failed
before a drive was enabled, or with an EMCY 8130h, 8250h or 8700h before that (a gap of the
program); those that failed before that because all eight simulated drives, which are one process,
fell silent; and those that failed while the drives moved, because a cycle was late or the simulated
drives were delayed. The exit code is 1 if there was a gap. Not a test.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from alone import alone  # noqa: E402

from drivers.can_bus import (  # noqa: E402
    BusSettings,
    open_bus,
)
from executor.trajectory.setpoints import (  # noqa: E402
    PreparedRun,
    prepare,
)
from model.plan import (  # noqa: E402
    load_plan,
    save_plan,
)
from model.rig import (  # noqa: E402
    load_rig,
    rig_from_document,
)
from planner.check import verify  # noqa: E402
from tests.cli.plans import (  # noqa: E402
    RIG,
    START_MM,
    free_scene,
    straight_plan,
)
from tests.cli.program import call  # noqa: E402
from tests.scenarios.faults.samples import (  # noqa: E402
    ENABLED,
    WatchedRehearsal,
)

GAPS = {0x8130, 0x8250, 0x8700}
GOAL_MM = (0.0, 5.0, 455.0)


def drives(prepared: PreparedRun, settings: BusSettings, link: Connection) -> None:
    """A process of drives; answers each message on the link with their new reports."""
    with suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(40))
    document = prepared.rig.document.bus.model_copy(
        update={"interface": settings.interface, "channel": settings.channel}
    )
    rig = rig_from_document(prepared.rig.document.model_copy(update={"bus": document}))
    with open_bus(settings) as bus:
        rehearsal = WatchedRehearsal(rig, bus, prepared.scene.start, prepared.scene.load)
        rehearsal.real = True
        link.send(())
        while True:
            rehearsal.serve(link.poll)
            if not link.recv():
                return
            followed = [s.time for s in rehearsal.samples if ENABLED in s.states]
            first = followed[0] if followed else float("inf")
            gaps = [(at < first, code) for at, _, code in rehearsal.emergencies if code in GAPS]
            link.send(([code for early, code in gaps if early], bool(followed)))
            rehearsal.samples, rehearsal.emergencies = rehearsal.samples[-1:], []


@contextmanager
def drives_apart(prepared: PreparedRun, settings: BusSettings) -> Iterator[Connection]:
    """Drives in their own process; yields the link to them."""
    context = multiprocessing.get_context("fork")
    near, far = context.Pipe()
    process = context.Process(target=drives, args=(prepared, settings, far))
    process.start()
    near.recv()
    try:
        yield near
    finally:
        near.send(False)
        process.join()


def busy() -> None:
    """Keeps a processor busy."""
    while True:
        pass


def outcome(what: str, code: int, early: list[int], followed: bool, said: str) -> str:
    """The category of a result."""
    if early:
        return f"{what}: GAP, EMCY {early[0]:04X}h before enabling"
    if code == 0:
        return f"{what}: finished"
    if not followed and "all 8 drives stopped answering" in said:
        return f"{what}: not begun, the simulated drives were delayed"
    if not followed:
        return f"{what}: GAP, failed before enabling"
    late = "a cycle was late" if "cycles late" in said else "drives or replies delayed"
    return f"{what}: stopped in motion, {late}"


def pair(prepared: PreparedRun, rig: Path, plan: Path, folder: Path, number: int) -> list[str]:
    """A start and a release."""
    port = 20000 + (os.getpid() * 31 + number) % 20000
    settings = BusSettings("udp_multicast", f"239.74.163.39:{port}")
    bus = ("--interface", settings.interface, "--channel", settings.channel)
    words = ("--yes", "--without-real-time", *bus)
    found = []
    with drives_apart(prepared, settings) as link:
        run = ("run", plan, "--rig", rig, "-o", folder / f"{number}", "--no-camera")
        for what, command in (("start", run), ("release", ("release", rig))):
            answer = call(*command, *words)
            link.send(True)
            early, followed = link.recv()
            found.append(outcome(what, answer.code, early, followed, answer.said))
            if "GAP" in found[-1] or "delayed" in found[-1]:
                print(number, found[-1], answer.said[-400:], flush=True)
            if answer.code:
                return found  # a fault is latched; the next pair has its own bus
    return found


def main() -> int:
    """Runs pairs up to the number or the time given."""
    parser = argparse.ArgumentParser(description="starts and releases with the machine loaded")
    parser.add_argument("--pairs", type=int, default=500)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--busy", type=int, default=os.cpu_count() or 1, help="busy loops")
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    begin, counts = time.monotonic(), Counter[str]()
    hogs = [multiprocessing.get_context("fork").Process(target=busy) for _ in range(options.busy)]
    with alone() as folder:
        plan, rig = folder / "plan.json", folder / "rig.yaml"
        braked = RIG.read_text().replace("encoder: absolute", "encoder: absolute, brake: true")
        rig.write_text(braked)
        scene = free_scene(START_MM, GOAL_MM)
        save_plan(straight_plan(load_rig(rig), scene, [START_MM, GOAL_MM]), plan)
        prepared = prepare(verify(load_plan(plan)), load_rig(rig))
        for hog in hogs:
            hog.start()
        try:
            for number in range(options.pairs):
                if time.monotonic() - begin > 60.0 * options.minutes:
                    break
                counts.update(pair(prepared, rig, plan, folder, number))
        finally:
            for hog in hogs:
                hog.kill()
    took = (time.monotonic() - begin) / 60.0
    lines = [f"{counts[name]:5}  {name}" for name in sorted(counts)]
    lines.append(f"in {took:.1f} min with {options.busy} busy loops on {os.cpu_count()} processors")
    print("\n".join(lines))
    if options.output:
        options.output.write_text("\n".join(lines) + "\n")
    return int(any("GAP" in name for name in counts))


if __name__ == "__main__":
    sys.exit(main())
