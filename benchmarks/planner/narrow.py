"""First paths through narrow passages: ours, RRTConnect compiled, and OMPL's planners.

    pip install ompl==2.0.1   # for this benchmark only
    python benchmarks/planner/narrow.py -o results                 # half an hour
    python benchmarks/planner/narrow.py --runs 3 --limit-s 0.5 --gaps-mm 0.2 5

All use the same compiled test of whole edges, with the planner's reserves; OMPL's planners call it
from Python. Processor time of this process to the first path; a run ends at the limit. Machine code
is compiled before the first run. Ours leads a row where no other planner finds a path more often,
and none that finds it as often is faster at the median.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import ompl_runs
from checkers import EdgeCheck, exact_edges
from compiled_rrt import new_trees, trees_handle, trees_met
from ompl import base, geometric
from ours import first_path
from passages import Passage, passages

from model.pose import Array
from planner.anytime.path import handle_of
from planner.anytime.problem import PathProblem, problem_of
from planner.anytime.state import new_search
from planner.costs import KinematicCost
from planner.settings import CLEARANCE_RESERVE, Weights

OURS = "ours, called from Python"
OMPL = ("RRTConnect", "RRTConnect*", "LBKPIECE1", "BKPIECE1", "RRT")
_RANGE = 0.2
"""OMPL's default range, as part of the space's extent."""
_CHUNK, _ENOUGH = 200, 5

Run = Callable[[int], float]
"""Processor time to the first path with a seed, [s]; infinite without one."""


@dataclass(frozen=True)
class Row:
    """All runs of one planner in one passage."""

    passage: str
    gap_mm: float
    planner: str
    found: int
    runs: int
    median_ms: float
    """Of all runs, infinite where fewer than half of them found a path."""
    worst_ms: float


def main() -> None:
    """Runs everything, prints the table, and writes it if requested."""
    options = _options()
    ompl_runs.seed(1)
    rows: list[Row] = []
    for passage in passages():
        is_asked = (
            passage.name in options.passages and round(passage.gap * 1e3, 6) in options.gaps_mm
        )
        if not is_asked:
            continue
        here = _rows(passage, _contestants(passage, options.limit_s), options.runs)
        rows += here
        print(table(here).splitlines()[-1], flush=True)
    led = [_is_led(group) for group in _groups(rows)]
    print(f"ours leads in {sum(led)} of {len(led)} passages")
    print(table(rows))
    if options.output:
        options.output.mkdir(parents=True, exist_ok=True)
        (options.output / "narrow.md").write_text(table(rows) + "\n", encoding="utf-8")
        with (options.output / "narrow.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(asdict(rows[0])))
            writer.writeheader()
            writer.writerows(asdict(row) for row in rows)


def _contestants(passage: Passage, limit: float) -> dict[str, Run]:
    rotation = passage.scene.start.rotation
    cost = KinematicCost(passage.rig, rotation)
    problem = problem_of(passage.rig, passage.scene, Weights(length=1.0), cost)
    extent = float(np.linalg.norm(problem.world.limits[1] - problem.world.limits[0]))
    kept = passage.scene.changed(clearance=passage.scene.obstacle_clearance + CLEARANCE_RESERVE)
    asked = replace(passage, scene=kept)
    check = exact_edges(asked.rig, asked.scene)
    made: dict[str, Run] = {
        OURS: lambda seed: _ours(problem, passage, seed, limit),
        "RRTConnect, compiled": lambda seed: _rrt(problem, passage, _RANGE * extent, seed, limit),
        "RRTConnect*, compiled": lambda seed: _rrt(problem, passage, extent, seed, limit),
    }
    for run in made.values():  # compiles machine code
        run(0)
    for name in OMPL:
        made[f"{name}, OMPL"] = _of_ompl(asked, check, name, extent, limit)
    return made


def _ours(problem: PathProblem, passage: Passage, seed: int, limit: float) -> float:
    search = new_search(passage.path[0], passage.path[-1], seed)
    handle = handle_of(problem, search)
    begin, spent, found = time.process_time(), 0.0, 0
    while found == 0 and spent < limit:
        found = first_path(handle)
        spent = time.process_time() - begin
    return spent if found else np.inf


def _rrt(problem: PathProblem, passage: Passage, longest: float, seed: int, limit: float) -> float:
    trees = trees_handle(problem, new_trees(passage.path[0], passage.path[-1], seed))
    begin, spent, met = time.process_time(), 0.0, False
    while not met and spent < limit:
        met = trees_met(trees, longest, _CHUNK)
        spent = time.process_time() - begin
    return spent if met else np.inf


def _of_ompl(passage: Passage, check: EdgeCheck, name: str, extent: float, limit: float) -> Run:
    question = ompl_runs.Question(passage.rig, passage.scene, check)

    def run(_seed: int) -> float:
        problem = base.ProblemDefinition(question.information)
        problem.setStartAndGoalStates(*question.ends)
        made = getattr(geometric, name.rstrip("*"))(question.information)
        if name.endswith("*"):
            made.setRange(extent)
        if "KPIECE" in name:
            made.setProjectionEvaluator("all")
        made.setProblemDefinition(problem)
        made.setup()
        begin = time.process_time()
        made.solve(base.PlannerTerminationCondition(lambda: time.process_time() - begin > limit))
        spent = time.process_time() - begin
        return spent if problem.hasExactSolution() else np.inf

    return run


def _rows(passage: Passage, contestants: dict[str, Run], runs: int) -> list[Row]:
    """All planners alternate in random order: other work on the machine slows all of them alike.

    One that finds nothing in `_ENOUGH` runs is not run again.
    """
    spent: dict[str, list[float]] = {name: [] for name in contestants}
    rng = np.random.default_rng(0)
    for seed in range(1, runs + 1):
        for name in rng.permutation(list(contestants)).tolist():
            if len(spent[name]) < _ENOUGH or np.isfinite(spent[name]).any():
                spent[name].append(contestants[name](seed) * 1e3)
    return [_row(passage, name, np.sort(times)) for name, times in spent.items()]


def _row(passage: Passage, name: str, spent_ms: Array) -> Row:
    runs, found = len(spent_ms), int(np.isfinite(spent_ms).sum())
    worst = float(spent_ms[found - 1]) if found else np.inf
    median = float(spent_ms[(runs - 1) // 2])
    return Row(passage.name, passage.gap * 1e3, name, found, runs, median, worst)


def _groups(rows: Sequence[Row]) -> list[list[Row]]:
    groups: dict[tuple[str, float], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.passage, row.gap_mm), []).append(row)
    return list(groups.values())


def _is_led(group: Sequence[Row]) -> bool:
    mine = next(row for row in group if row.planner == OURS)
    others = [row for row in group if row is not mine]
    return mine.found > 0 and all(
        (row.found / row.runs, -row.median_ms) < (mine.found / mine.runs, -mine.median_ms)
        for row in others
    )


def table(rows: Sequence[Row]) -> str:
    """The rows as Markdown: one line per passage, found and median in each cell."""
    names = list(dict.fromkeys(row.planner for row in rows))
    lines = [
        "| passage | gap | " + " | ".join(names) + " |",
        "|---|---|" + "---|" * len(names),
    ]
    for group in _groups(rows):
        cells = {row.planner: f"{row.found}/{row.runs}, {_time(row.median_ms)}" for row in group}
        lines.append(
            f"| {group[0].passage} | {group[0].gap_mm:g} mm | "
            + " | ".join(cells[name] for name in names)
            + " |"
        )
    return "\n".join(lines)


def _time(spent_ms: float) -> str:
    return f"{spent_ms:.3g} ms" if np.isfinite(spent_ms) else "–"


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--runs", type=int, default=10, help="runs of every planner")
    parser.add_argument("--limit-s", type=float, default=1.0, help="processor time of a run")
    parser.add_argument("--gaps-mm", type=float, nargs="+", default=[0.2, 0.5, 1.0, 2.0, 5.0])
    kinds = sorted({passage.name for passage in passages()})
    parser.add_argument("--passages", nargs="+", default=kinds, choices=kinds)
    parser.add_argument("-o", "--output", type=Path, help="folder for the table")
    return parser.parse_args()


if __name__ == "__main__":
    main()
