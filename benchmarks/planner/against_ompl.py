"""Our planner against OMPL's, in one process and one run, with both checkers shown separately.

    pip install ompl==2.0.1   # for this benchmark only
    python benchmarks/planner/against_ompl.py -o results          # all of it: about half an hour
    python benchmarks/planner/against_ompl.py --runs 5 --checkers exact

Writes a table (Markdown, CSV, JSON), the claims as ratios from this run, and a plot. All times are
processor time of this process, one run after the other; machine code is compiled before the first
run. Lengths are given relative to the best known ones at 10 mm clearance.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import ompl_runs
import ours
from checkers import EdgeCheck, FclStates, exact_edges
from claims import claims
from figures import curves_figure
from result import Result
from rich.progress import Progress

from model.rig import Rig, load_rig
from model.scene import Scene, load_scene

OMPL_RANGE = 0.2
"""OMPL's default range, as part of the space's extent."""
CONFIGS = Path(__file__).parents[2] / "configs"
BEST_MM = {1: 628.5, 2: 661.0, 3: 813.5}
"""Source: a fine reference search, polished; see docs/paper.md."""


@dataclass(frozen=True)
class Run:
    """One run. Lengths are those of the best path at each mark, None without one."""

    environment: int
    checker: str
    planner: str
    number: int
    first_ms: float | None
    lengths_mm: list[float | None]
    checks: int
    kept: bool | None
    """Whether the last path passes our exact check; None without a path."""


def main() -> None:
    """Runs everything requested."""
    options = _options()
    ompl_runs.seed(options.seed)
    rig = load_rig(CONFIGS / "gachon_8_6.yaml")
    runs: list[Run] = []
    inside_us: dict[int, list[float]] = {}
    with Progress(disable=not sys.stderr.isatty()) as bar:
        contests = 1 + len(ompl_runs.PLANNERS) * len(options.checkers)
        total = contests * options.runs * len(options.environments)
        task = bar.add_task("running", total=total)
        for environment in options.environments:
            scene = load_scene(CONFIGS / f"environment_{environment}.yaml")
            for run in contest(rig, scene, environment, options, inside_us):
                runs.append(run)
                bar.advance(task)
    rows = [row for group in _groups(runs) for row in [summarised(group, options.marks_ms)]]
    text = table(rows, options.marks_ms) + "\n\n" + claims(rows, options.marks_ms, inside_us)
    print(text)
    if options.output:
        write(options.output, runs, rows, text, options.marks_ms)


def contest(
    rig: Rig, scene: Scene, environment: int, options: argparse.Namespace,
    inside_us: dict[int, list[float]],
) -> Iterator[Run]:  # fmt: skip
    """All runs in one environment; also writes mean times to a first path in compiled code.

    Ours, and those of RRTConnect at OMPL's default range and without a limit of steps.
    """
    marks_s = tuple(mark / 1e3 for mark in options.marks_ms)
    exact = exact_edges(rig, scene)
    contestant = ours.Contestant(rig, scene)
    rivals = [contestant.mean_rival_us(share) for share in (OMPL_RANGE, 1.0)]
    inside_us[environment] = [contestant.mean_first_us(), *rivals]
    for number in range(options.runs):
        result = contestant.run(options.seed + number, marks_s)
        yield _run(result, environment, "exact", ours.NAME, number, exact)
    for checker in options.checkers:
        question = ompl_runs.Question(rig, scene, exact if checker == "exact" else
                                      FclStates(rig, scene))  # fmt: skip
        question.run("RRTConnect", (0.05,))
        for planner in ompl_runs.PLANNERS:
            for number in range(options.runs):
                result = question.run(planner, marks_s)
                yield _run(result, environment, checker, planner, number, exact)


def _run(
    result: Result, environment: int, checker: str, planner: str, number: int,
    exact: EdgeCheck,
) -> Run:  # fmt: skip
    path = result.path.tolist()
    kept = all(exact(*a, *b) for a, b in pairwise(path)) if path else None
    lengths = [_known(length * 1e3) for length in result.lengths_m]
    first = _known(result.first_s * 1e3)
    return Run(environment, checker, planner, number, first, lengths, result.checks, kept)


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _groups(runs: Sequence[Run]) -> list[list[Run]]:
    groups: dict[tuple[int, str, str], list[Run]] = {}
    for run in runs:
        groups.setdefault((run.environment, run.checker, run.planner), []).append(run)
    return list(groups.values())


def summarised(group: Sequence[Run], marks_ms: Sequence[float]) -> dict[str, Any]:
    """Medians over the runs of one planner; a run without a path counts as infinitely long."""
    one = group[0]
    first = _floats([run.first_ms for run in group])
    excess = {
        f"excess_percent_{mark:g}_ms": _known(
            (float(np.median(_floats([r.lengths_mm[k] for r in group])))
             / BEST_MM[one.environment] - 1.0) * 100.0
        )
        for k, mark in enumerate(marks_ms)
    }  # fmt: skip
    kept = [run.kept for run in group if run.kept is not None]
    return {
        "environment": one.environment,
        "planner": one.planner,
        "checker": one.checker,
        "runs": len(group),
        "success_percent": 100.0 * float(np.mean(np.isfinite(first))),
        "first_median_ms": _known(float(np.median(first))),
        "first_worst_ms": _known(float(np.max(first))),
        **excess,
        "paths_kept_percent": 100.0 * float(np.mean(kept)) if kept else None,
        "checks_median": float(np.median([run.checks for run in group])),
    }


def _floats(values: Sequence[float | None]) -> Any:
    return np.array([np.inf if value is None else value for value in values])


def table(rows: Sequence[dict[str, Any]], marks_ms: Sequence[float]) -> str:
    """The rows as Markdown."""
    marks = [f"excess_percent_{mark:g}_ms" for mark in marks_ms]
    head = ["env.", "planner", "checker", "success", "first path, median (worst) [ms]"]
    head += [f"+% at {mark:g} ms" for mark in marks_ms] + ["paths truly free"]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for row in rows:
        cells = [f"{row['environment']}", row["planner"], row["checker"]]
        cells.append(f"{row['success_percent']:.0f} %")
        cells.append(f"{_text(row['first_median_ms'], 3)} ({_text(row['first_worst_ms'], 3)})")
        cells += [_text(row[mark], 2) for mark in marks]
        kept = row["paths_kept_percent"]
        cells.append("–" if kept is None else f"{kept:.0f} %")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _text(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def write(
    folder: Path, runs: Sequence[Run], rows: Sequence[dict[str, Any]], text: str,
    marks_ms: Sequence[float],
) -> None:  # fmt: skip
    """Everything as files."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "against_ompl.md").write_text(text + "\n", encoding="utf-8")
    document = {"marks_ms": list(marks_ms), "rows": list(rows), "runs": [asdict(r) for r in runs]}
    (folder / "against_ompl.json").write_text(json.dumps(document, indent=1), encoding="utf-8")
    with (folder / "against_ompl.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    figure = curves_figure(rows, marks_ms)
    for ending in ("png", "svg"):
        figure.savefig(folder / f"against_ompl.{ending}", dpi=150)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--environments", type=int, nargs="+", default=[1, 2, 3], choices=BEST_MM)
    parser.add_argument("--runs", type=int, default=30, help="runs of every planner")
    parser.add_argument("--checkers", nargs="+", default=["exact", "fcl"], choices=["exact", "fcl"])
    parser.add_argument("--marks-ms", type=float, nargs="+", default=[1.0, 10.0, 100.0, 1000.0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("-o", "--output", type=Path, help="folder for table, numbers and plot")
    return parser.parse_args()


if __name__ == "__main__":
    main()
