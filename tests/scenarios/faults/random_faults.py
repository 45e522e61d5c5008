"""Random faults: kind, time, and a second one while the first is handled."""

from __future__ import annotations

import random
from dataclasses import dataclass
from pathlib import Path

from executor.state_machine import State
from executor.trajectory.setpoints import PreparedRun
from simulation.drives.behaviour import STRICT, DriveBehaviour
from tests.scenarios.faults.bench import Bench, simulated
from tests.scenarios.faults.cases import TABLE

#: Without the drives' own SYNC time-outs nothing stops them quickly.
LEFT_OUT = {"F7 a drive and the master fall silent"}
NAMES = [name for name in TABLE if name not in LEFT_OUT]
#: Two simultaneous faults may affect a drive more than one.
MIXED_CYCLES, ROWS = 8.0, 6.0


@dataclass(frozen=True, slots=True)
class RandomRun:
    """Outcome of a run."""

    faults: tuple[str, ...]
    ended: State | None
    cause: str
    simulated_s: float
    violations: list[str]


def random_run(
    prepared: PreparedRun, path: Path, seed: int, behaviour: DriveBehaviour = STRICT
) -> RandomRun:
    """One run in simulated time; the same for the same seed."""
    dice = random.Random(seed)
    names = tuple(dice.sample(NAMES, dice.choice((1, 1, 2))))
    first = dice.randrange(3, 340)
    cycles = (first, first + dice.randrange(0, 40))
    scripts = [TABLE[name].script() for name in names]

    def script(bench: Bench) -> None:
        for cycle, each in zip(cycles, scripts, strict=False):
            bench.fault_cycle = cycle
            each(bench)

    bitrate = max((TABLE[name].bitrate or 0.0 for name in names), default=0.0) or None
    with simulated(prepared, path, script, bitrate=bitrate, behaviour=behaviour) as bench:
        bench.missed_start = first < 20
        ended = bench.run()
        found = bench.violations(MIXED_CYCLES, ROWS)
        if ended is not State.FINISHED and ended is not State.STOPPED:
            found += _not_latched(bench)
        return RandomRun(names, ended, bench.cause, bench.rehearsal.passed, found)


def _not_latched(bench: Bench) -> list[str]:
    """After a fault no drive is commanded to move, whatever happens on the bus.

    A drum rotated by its load against the torque limit may still return to its held position.
    """
    before = [drive.motor.demand for drive in bench.drives]
    bench.rehearsal.pump()
    bench.rehearsal.advance(0.05)
    after = [drive.motor.demand for drive in bench.drives]
    return [] if before == after else ["a drum is moved after the end"]
