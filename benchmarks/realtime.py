"""Lateness of the real-time process and of a plain `time.sleep` loop, idle and with busy cores.

    python benchmarks/realtime.py                       # 4 cases of 15 s: under 2 minutes
    python benchmarks/realtime.py --seconds 40 --rates 100 250

The real-time process is that of `cdpr run`, with all work of a cycle: requests, gate, set-points,
simulated drives and platform in the same process, replies, monitor, status ring. It follows a path
of the paper's third environment, which takes about 43 s; a longer time is refused. The plain loop
runs in its own process and counts during the motion: a thread sleeps with `time.sleep` until its
next cycle, beside another that writes JSON fifty times a second, as a logging server does. Lateness
is the delay of a cycle's start after its deadline.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from drivers.can_load import SLOWEST_TENTHS_MS, TESTED_HZ, check_bus_load
from executor.control.path_runs import run_along_path
from executor.drives import drives_of
from executor.realtime.scheduling import SimulatedClock
from executor.realtime.shared_memory import SharedRequests
from executor.recording.recorder import Recorder
from executor.recording.run_folder import RunFolder
from executor.remote.status import RunStatus
from executor.trajectory.setpoints import PreparedRun, prepare
from executor.winch_runs import open_mover
from model.errors import BadInput, CdprError
from model.files.examples import PAPER_RIG
from model.files.reading import ready_folder
from model.plan import load_plan, save_plan
from model.pose import Array
from model.progress import SILENT
from model.rig import Rig, load_rig, rig_from_document
from model.scene import load_scene
from planner.check import verify
from planner.check_report import VerifiedPlan
from planner.planning import make_plan
from planner.settings import OptimalSettings

ENVIRONMENT = "environment_3.yaml"


def prepared_runs(rates: Sequence[float], seconds: float, folder: Path) -> list[PreparedRun]:
    """Runs in the paper's third environment, one for each cycle rate [Hz].

    Raises:
        BadInput: They end before the measuring time.
    """
    rig, plan = load_rig(ready_folder() / PAPER_RIG), verified_plan(folder / "plan.json")
    runs = [prepare(plan, with_cycle(rig, 1000.0 / rate)) for rate in rates]
    shortest = min(run.duration for run in runs)
    if seconds > shortest:
        raise BadInput(
            f"the measuring time is {seconds:g} s, the path takes {shortest:.1f} s",
            where="--seconds",
            next_step=f"give at most {math.floor(shortest)} s",
        )
    return runs


def verified_plan(path: Path) -> VerifiedPlan:
    """A plan of the paper's rig for its third environment, saved and checked."""
    rig, scene = load_rig(ready_folder() / PAPER_RIG), load_scene(ready_folder() / ENVIRONMENT)
    save_plan(make_plan(rig, scene, OptimalSettings(seed=0)), path)
    return verify(load_plan(path))


def with_cycle(rig: Rig, cycle_ms: float) -> Rig:
    """The same rig at another cycle time."""
    bus = rig.document.bus.model_copy(update={"cycle_ms": cycle_ms})
    return rig_from_document(rig.document.model_copy(update={"bus": bus}))


@dataclass(frozen=True)
class Motion:
    """A motion of the real-time process.

    Attributes:
        lateness: Of every cycle, [ms].
        begin: When its drives were armed, by the monotonic clock, [s].
        end: When its stop was requested, by the same clock, [s].
        denied: The real-time rights that the system denied.
    """

    lateness: Array
    begin: float
    end: float
    denied: str


def process_lateness(prepared: PreparedRun, folder: Path, seconds: float) -> Motion:
    """The motion of a run that is stopped after a time."""
    board = SharedRequests()
    run = RunFolder.create(folder)
    status = RunStatus(prepared, folder, board, simulated_time=False)
    cycle = prepared.checked.table.cycle
    begin, end, denied = 0.0, math.inf, ""

    def note_start(rights: str) -> None:
        nonlocal begin, denied
        begin, denied = time.monotonic(), rights
        if denied:
            print(f"({denied})")

    def watch_the_time(row: float) -> None:
        nonlocal end
        if row * cycle >= seconds:
            end = min(end, time.monotonic())
            board.ask_stop()

    recorder = Recorder(
        prepared,
        run,
        status,
        trigger=None,
        every=10,
        progress=watch_the_time,
        announce=lambda _text: None,
    )
    start, load = prepared.scene.start, prepared.scene.load
    outcome = run_along_path(
        prepared,
        lambda motion: open_mover(
            prepared.rig,
            motion,
            partial(drives_of, prepared.rig.document, start, load),
            board,
            SimulatedClock(cycle),
            need_real_time_rights=False,
            listener=SILENT,
        ),
        recorder,
        before_motion=note_start,
    )
    print(f"    run ended: {outcome.state.value} {outcome.cause}")
    return Motion(outcome.log.table().lateness * 1e3, begin, end, denied)


def plain_loop(cycle: float, link: Connection) -> None:
    """The reference process: cycles by `time.sleep` in a thread.

    Begin and end of the motion, as a message, end it; the answer is the lateness in between, [ms].
    """
    late: list[tuple[float, float]] = []
    over = threading.Event()

    def cycles() -> None:
        deadline = time.monotonic()
        while not over.is_set():
            deadline += cycle
            time.sleep(max(0.0, deadline - time.monotonic()))
            late.append((deadline, time.monotonic() - deadline))
            if late[-1][1] > cycle:  # as the real loop: a late cycle delays the next ones
                deadline = time.monotonic()

    thread = threading.Thread(target=cycles)
    thread.start()
    document = {"drives": [{"position": k * 0.1, "state": "enabled"} for k in range(3000)]}
    while not link.poll(0.02):
        json.dumps(document)
    begin, end = link.recv()
    over.set()
    thread.join()
    link.send(np.array([delay for due, delay in late if begin <= due <= end]) * 1e3)


def burn() -> None:
    """Keeps a core busy until killed."""
    while True:
        sum(range(100_000))


@contextmanager
def all_cores_busy(wanted: bool) -> Iterator[None]:
    """As many busy processes as there are cores, or none."""
    count = (os.cpu_count() or 1) if wanted else 0
    context = multiprocessing.get_context("spawn")
    hogs = [context.Process(target=burn, daemon=True) for _ in range(count)]
    for hog in hogs:
        hog.start()
    try:
        yield
    finally:
        for hog in hogs:
            hog.kill()
            hog.join()


def row(rate: float, load: str, loop: str, late: Array) -> str:
    """One line of the table."""
    p50, p99, p999 = np.percentile(late, [50.0, 99.0, 99.9])
    return (
        f"| {rate:g} | {load} | {loop} | {len(late)} | {p50:.3f} | {p99:.3f} | {p999:.3f}"
        f" | {late.max():.3f} |"
    )


def measured(prepared: PreparedRun, busy: bool, seconds: float, folder: Path) -> list[str]:
    """Table rows of both loops, measured at the same time."""
    cycle = prepared.checked.table.cycle
    rate = 1.0 / cycle
    load = "all cores busy" if busy else "idle"
    print(f"  {rate:g} Hz, {load} ...", flush=True)
    context = multiprocessing.get_context("spawn")
    link, far_end = context.Pipe()
    plain = context.Process(target=plain_loop, args=(cycle, far_end), daemon=True)
    with all_cores_busy(busy):
        plain.start()
        try:
            ours = process_lateness(prepared, folder / f"{rate:g}-{busy}", seconds)
            link.send((ours.begin, ours.end))
            theirs = link.recv()
        except BaseException:
            plain.kill()
            raise
        finally:
            plain.join()
    loop = "real-time process, rights denied" if ours.denied else "real-time process"
    return [
        row(rate, load, loop, ours.lateness),
        row(rate, load, "thread with `time.sleep`", theirs),
    ]


SLOWEST_HZ = 10_000.0 / SLOWEST_TENTHS_MS


def require_measurable(rates: Sequence[float], seconds: float) -> None:
    """Refuses cases that arming would refuse, before planning and load.

    Raises:
        BadInput: A rate is outside the allowed range, or the time is not above 0 s.
        Refused: The bus has no room for the rate.
    """
    for rate in rates:
        if not SLOWEST_HZ <= rate <= TESTED_HZ:
            raise BadInput(
                f"{rate:g} Hz is outside {SLOWEST_HZ:g} to {TESTED_HZ:g} Hz",
                where="--rates",
                why="arming refuses shorter cycles than were tested, the rig file longer ones",
                next_step="use rates in that range",
            )
        check_bus_load(with_cycle(load_rig(ready_folder() / PAPER_RIG), 1000.0 / rate))
    if not (math.isfinite(seconds) and seconds > 0.0):
        what = f"the measuring time is {seconds:g} s"
        raise BadInput(what, where="--seconds", next_step="give a time above 0 s")


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns 0, or 2 for a case that cannot be measured."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=15.0, help="of motion, each case")
    parser.add_argument("--rates", type=float, nargs="+", default=[100.0, 250.0], help="[Hz]")
    options = parser.parse_args(arguments)
    try:
        require_measurable(options.rates, options.seconds)
        show_measured(options.rates, options.seconds)
    except CdprError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def show_measured(rates: Sequence[float], seconds: float) -> None:
    """Measures and prints the table."""
    began = os.getloadavg()[0]
    rows: list[str] = []
    with TemporaryDirectory(prefix="cdpr-realtime-") as folder:
        for prepared in prepared_runs(rates, seconds, Path(folder)):
            for busy in (False, True):
                rows += measured(prepared, busy, seconds, Path(folder))
    print(f"\n{os.cpu_count()} cores, load average {began:.1f} before; lateness in ms\n")
    print("| Hz | load | loop | cycles | p50 | p99 | p99.9 | max |")
    print("|---|---|---|---|---|---|---|---|")
    print("\n".join(rows))


if __name__ == "__main__":
    sys.exit(main())
