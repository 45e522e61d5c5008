"""The campaign: every environment, many seeds, two clearances; plan, check, run, measure, table.

    python benchmarks/campaign.py                       # everything: about half an hour on one core
    python benchmarks/campaign.py --seeds 2 -o out.jsonl

Each plan is written, read back, and checked as by `cdpr check`. Runs are those of `cdpr run
--fast`: without a camera for the first ``--runs`` seeds, with the synthetic camera for the first
``--camera-runs`` seeds, both at the first clearance. Exits with 1 if any requirement is not met.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from executor import runner
from executor.recording.run_folder import RunFolder
from model.errors import CdprError
from model.files.examples import PAPER_RIG
from model.files.reading import ready_folder
from model.plan import load_plan, save_plan
from model.rig import Rig, load_rig
from model.scene import load_scene
from planner.check import check_path
from planner.planning import make_plan
from planner.settings import OptimalSettings

GOAL_ERROR_M = 1e-6
FOLLOWING_MM = 0.1
TAG_RMS_MM = 1.0


@dataclass(frozen=True)
class PlanResult:
    """One plan and its check; ``problem`` is the reason if there is none."""

    environment: int
    clearance_mm: float
    seed: int
    problem: str = ""
    passed: bool = False
    clearance_proved_mm: float = float("nan")
    goal_error_m: float = float("nan")
    length_mm: float = float("nan")
    plan_s: float = float("nan")
    check_s: float = float("nan")


@dataclass(frozen=True)
class RunResult:
    """One run; tag figures are NaN without a camera.

    ``beyond_mm`` is the largest amount by which a measured clearance was below the planned one at
    the same time, less the stated uncertainty: at most 0 if the intervals hold.
    """

    environment: int
    clearance_mm: float
    seed: int
    camera: bool
    verdict: str
    following_mm: float
    tag_rms_mm: float
    beyond_mm: float
    run_s: float


Result = PlanResult | RunResult


def plan_one(rig: Rig, environment: int, clearance_mm: float, seed: int, path: Path) -> PlanResult:
    """Plans, writes, reads back and checks; leaves the plan in ``path``."""
    key = (environment, clearance_mm, seed)
    scene = load_scene(ready_folder() / f"environment_{environment}.yaml")
    scene = scene.changed(clearance=clearance_mm / 1000.0)
    begin = time.perf_counter()
    try:
        save_plan(make_plan(rig, scene, OptimalSettings(seed=seed)), path)
    except CdprError as error:
        return PlanResult(*key, problem=error.what, plan_s=time.perf_counter() - begin)
    planned = time.perf_counter()
    plan = load_plan(path)
    checked = check_path(rig, scene, plan.waypoints, plan.stops)
    return PlanResult(
        *key,
        passed=checked.passed,
        clearance_proved_mm=checked.proved_obstacle_clearance * 1000.0,
        goal_error_m=plan.waypoints[-1].distance_to(scene.goal),
        length_mm=checked.length * 1000.0,
        plan_s=planned - begin,
        check_s=time.perf_counter() - planned,
    )


def run_one(
    rig: Rig, environment: int, clearance_mm: float, seed: int, path: Path, camera: bool
) -> RunResult:
    """Runs a plan as `cdpr run --fast` does and reads the figures from its folder."""
    begin = time.perf_counter()
    with TemporaryDirectory(prefix="cdpr-campaign-") as folder:
        output = Path(folder) / "run"
        cameras = None if camera else ()
        done = runner.run(load_plan(path), rig, folder=output, cameras=cameras, realtime=False)
        summary = done.summary
        seconds = time.perf_counter() - begin
        rows = RunFolder.open(output).clearance()
        beyond = rows.planned_distance - rows.distance - rows.uncertainty
    tag = summary["tag_error_mm"]
    return RunResult(
        environment,
        clearance_mm,
        seed,
        camera,
        summary["verdict"],
        summary["following_error_mm"]["max"],
        tag["rms"] if tag else float("nan"),
        float(np.max(beyond)) * 1000.0,
        seconds,
    )


def campaign(
    environments: Sequence[int],
    seeds: Sequence[int],
    clearances_mm: Sequence[float],
    runs: int,
    camera_runs: int,
    report: Callable[[Result], None],
) -> list[Result]:
    """Runs the campaign and reports each result; see the top of this file."""
    rig = load_rig(ready_folder() / PAPER_RIG)
    results: list[Result] = []

    def take(result: Result) -> None:
        results.append(result)
        report(result)

    with TemporaryDirectory(prefix="cdpr-campaign-") as folder:
        path = Path(folder) / "plan.json"
        for seed in seeds:
            for environment in environments:
                for clearance in clearances_mm:
                    plan = plan_one(rig, environment, clearance, seed, path)
                    take(plan)
                    if plan.problem or clearance != clearances_mm[0]:
                        continue
                    done = seeds.index(seed)
                    wanted = [False] * (done < runs) + [True] * (done < camera_runs)
                    for camera in wanted:
                        take(run_one(rig, environment, clearance, seed, path, camera))
    return results


def failures(results: Iterable[Result]) -> list[str]:
    """Violated requirements, one line each."""
    found = []
    for result in results:
        key = f"environment {result.environment}, {result.clearance_mm:g} mm, seed {result.seed}"
        if isinstance(result, PlanResult):
            if result.problem:
                found.append(f"{key}: no plan: {result.problem}")
            elif not result.passed or result.clearance_proved_mm < result.clearance_mm - 1e-9:
                found.append(f"{key}: check not passed")
            elif not result.goal_error_m <= GOAL_ERROR_M:
                found.append(f"{key}: ends {result.goal_error_m:.2g} m from the goal")
            continue
        if result.verdict != "PASSED":
            found.append(f"{key}: run {result.verdict}")
        if not result.following_mm <= FOLLOWING_MM:
            found.append(f"{key}: following error {result.following_mm:.3f} mm")
        if result.camera and not result.tag_rms_mm <= TAG_RMS_MM:
            found.append(f"{key}: tags {result.tag_rms_mm:.3f} mm RMS")
        if not result.beyond_mm <= 0.0:
            found.append(f"{key}: clearance {result.beyond_mm:.3f} mm beyond its uncertainty")
    return found


HEAD = (
    "| env | mm | plans passing | least proved mm | goal error m | length mm | plan s | check s"
    " | runs PASSED | following mm | run s | camera runs PASSED | tag RMS mm | worst beyond mm"
    " | camera run s |"
)


def table(results: Sequence[Result]) -> str:
    """A row per environment and clearance; lengths and times are median (largest)."""
    lines = [HEAD, "|" + "---|" * (HEAD.count("|") - 1)]
    for key in sorted({(r.environment, r.clearance_mm) for r in results}):
        ours = [r for r in results if (r.environment, r.clearance_mm) == key]
        plans = [r for r in ours if isinstance(r, PlanResult)]
        runs = [r for r in ours if isinstance(r, RunResult)]
        plain = [r for r in runs if not r.camera]
        seen = [r for r in runs if r.camera]
        good = [p for p in plans if p.passed]
        cells = [
            str(key[0]),
            f"{key[1]:g}",
            f"{len(good)}/{len(plans)}",
            _least([p.clearance_proved_mm for p in good]),
            _most([p.goal_error_m for p in good], ".1e"),
            _spread([p.length_mm for p in good], ".0f"),
            _spread([p.plan_s for p in plans], ".1f"),
            _spread([p.check_s for p in good], ".1f"),
            _passed(plain),
            _most([r.following_mm for r in runs], ".4f"),
            _spread([r.run_s for r in plain], ".1f"),
            _passed(seen),
            _most([r.tag_rms_mm for r in seen], ".3f"),
            _most([r.beyond_mm for r in runs], ".3f"),
            _spread([r.run_s for r in seen], ".1f"),
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _passed(runs: Sequence[RunResult]) -> str:
    return f"{sum(r.verdict == 'PASSED' for r in runs)}/{len(runs)}" if runs else "–"


def _least(values: Sequence[float]) -> str:
    return f"{min(values):.3f}" if values else "–"


def _most(values: Sequence[float], digits: str) -> str:
    return f"{max(values):{digits}}" if values else "–"


def _spread(values: Sequence[float], digits: str) -> str:
    return f"{np.median(values):{digits}} ({max(values):{digits}})" if values else "–"


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(description="Plans, checks, runs and measures in quantity.")
    parser.add_argument("--environments", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--seeds", type=int, default=20, help="number, from --first-seed on")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--clearances-mm", type=float, nargs="+", default=[10.0, 20.0])
    parser.add_argument("--runs", type=int, default=20, help="seeds to run without a camera")
    parser.add_argument("--camera-runs", type=int, default=20, help="seeds to run with the camera")
    parser.add_argument("-o", "--output", type=Path, help="also write every result as a JSON line")
    asked = parser.parse_args(arguments)

    def report(result: Result) -> None:
        line = json.dumps({"kind": type(result).__name__, **asdict(result)})
        print(line, file=sys.stderr, flush=True)
        if asked.output is not None:
            with asked.output.open("a", encoding="utf-8") as file:
                file.write(line + "\n")

    seeds = range(asked.first_seed, asked.first_seed + asked.seeds)
    results = campaign(
        asked.environments, seeds, asked.clearances_mm, asked.runs, asked.camera_runs, report
    )
    print(table(results))
    found = failures(results)
    print("\n".join(found) or "all requirements are met")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
