"""Length against average kinematic cost: the length that a better average costs, per environment.

    python benchmarks/planner/pareto.py -o results             # both boxes: some minutes

The best paths known (`reference.py`) for ∫ (c + λ) ds with prices λ from those of the shortest path
to negative ones, which prefer longer paths to a lower average, in the rig's own box and in the wide
one (±350, 100–750 mm). Beside them what `cdpr plan --cost kinematic` finds in its default budget.
Averages and integrals come from the model along the path, scaled over the box that they are in.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from figures import pareto_figure
from reference import LIGHT, Question, question, reference_of
from rich.progress import track

from model.pose import Array, Pose
from model.rig import Rig, load_rig
from model.scene import load_scene
from planner.campaign.trial import OWN, SHARES, WIDE, box_text, with_box
from planner.check import check_path
from planner.planning import make_plan
from planner.settings import OBJECTIVES, OptimalSettings

CONFIGS = Path(__file__).parents[2] / "configs"
CLAIM = 18.2
"""Improvement of the average that the paper claims, [%]."""
PRICES = (np.inf, 1.0, 0.4, 0.2, 0.1, 0.0, -0.4, -0.7, -0.9)
"""λ in units of the average along the shortest path; the negative ones of the least cost."""


@dataclass(frozen=True)
class Point:
    """One path; per cent are over those of the shortest path."""

    box: str
    environment: int
    made_by: str
    price: float
    length_mm: float
    average: float
    integral_mm: float
    longer_percent: float
    average_percent: float
    passed: bool


def main() -> None:
    """Searches, prints, writes."""
    options = _options()
    paper = load_rig(CONFIGS / "gachon_8_6.yaml")
    cases = [(box, environment) for box in options.boxes for environment in options.environments]
    points: list[Point] = []
    for box, environment in track(cases, "fronts", disable=not sys.stderr.isatty()):
        points += _front(with_box(paper, box), box, environment)
    for line in _table(points):
        print(line)
    for box in options.boxes:
        print(f"\nIn the box {box_text(with_box(paper, box))}:")
        for environment in options.environments:
            print(_finding([p for p in points if (p.box, p.environment) == (box, environment)]))
    if options.output:
        _write(options.output, points)


def _front(rig: Rig, box: str, environment: int) -> list[Point]:
    """The shortest path first, then the others by price, then the planner's own."""
    asked = question(rig, load_scene(CONFIGS / f"environment_{environment}.yaml"))
    shortest = reference_of(asked, 1.0, 0.0, effort=LIGHT)
    unit = asked.integral(shortest) / asked.length(shortest)
    least = float(asked.fine.kinematic.min())
    paths, path = [(np.inf, shortest)], shortest
    for price in PRICES[1:]:
        path = reference_of(asked, price * (unit if price >= 0.0 else least), 1.0, [path], LIGHT)
        paths.append((price, path))
    made = [_point(asked, box, environment, "reference", *pair, shortest) for pair in paths]
    plan = make_plan(rig, asked.scene, OptimalSettings(weights=OBJECTIVES["kinematic"]))
    own = np.array([pose.position_mm for pose in plan.waypoints]) / 1e3
    return [*made, _point(asked, box, environment, "cdpr plan", 0.0, own, shortest)]


def _point(
    asked: Question,
    box: str,
    environment: int,
    made_by: str,
    price: float,
    path: Array,
    shortest: Array,
) -> Point:
    length, integral = asked.length(path), asked.integral(path)
    average, usual = integral / length, asked.integral(shortest) / asked.length(shortest)
    return Point(
        box,
        environment,
        made_by,
        price,
        length * 1e3,
        average,
        integral * 1e3,
        (length / asked.length(shortest) - 1.0) * 100.0,
        (average / usual - 1.0) * 100.0,
        check_path(asked.rig, asked.scene, [Pose.level(point) for point in path]).passed,
    )


def _table(points: Sequence[Point]) -> list[str]:
    return [
        "| box | environment | made by | price λ | length | longer | average | better | integral"
        " | check |",
        "|---|---|---|---|---|---|---|---|---|---|",
        *(
            f"| {p.box} | {p.environment} | {p.made_by} | {p.price:g} | {p.length_mm:.1f} mm"
            f" | {p.longer_percent:+.1f} % | {p.average:.3f} | {p.average_percent:+.1f} %"
            f" | {p.integral_mm:.1f} mm | {'passed' if p.passed else 'REFUSED'} |"
            for p in points
        ),
    ]


def _finding(points: Sequence[Point]) -> str:
    """The findings in one environment, in words."""
    front = sorted((p for p in points if p.made_by == "reference"), key=lambda p: p.length_mm)
    integral = min(front, key=lambda p: p.integral_mm)
    best = min(front, key=lambda p: p.average)
    at = _longer_for(front, -CLAIM)
    reached = f"is reached at {at:+.1f} % length" if at is not None else "is NOT reached"
    return (
        f"  environment {front[0].environment}: shortest {front[0].length_mm:.1f} mm, average"
        f" {front[0].average:.3f}; least integral: average {integral.average_percent:+.1f} % at"
        f" {integral.longer_percent:+.1f} % length; lowest average found"
        f" {best.average_percent:+.1f} % at {best.longer_percent:+.1f} %; −{CLAIM} % {reached}"
    )


def _longer_for(front: Sequence[Point], percent: float) -> float | None:
    """Excess length for an average, interpolated between the points of the front."""
    for before, after in itertools.pairwise(front):
        if after.average_percent <= percent:
            drop = before.average_percent - after.average_percent
            share = (before.average_percent - percent) / drop if drop > 0.0 else 1.0
            share = min(max(share, 0.0), 1.0)
            return before.longer_percent + share * (after.longer_percent - before.longer_percent)
    return None


def _write(folder: Path, points: Sequence[Point]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "pareto.md").write_text("\n".join(_table(points)) + "\n", encoding="utf-8")
    records = [asdict(p) | {"price": p.price if np.isfinite(p.price) else None} for p in points]
    (folder / "pareto.json").write_text(json.dumps(records, indent=1) + "\n", encoding="utf-8")
    with (folder / "pareto.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(records[0]))
        writer.writeheader()
        writer.writerows(records)
    figure = pareto_figure(records, CLAIM)
    for ending in ("png", "svg"):
        figure.savefig(folder / f"pareto.{ending}", dpi=150)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--environments", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--boxes", nargs="+", default=[OWN, WIDE], choices=list(SHARES))
    parser.add_argument("-o", "--output", type=Path, help="folder for table and plot")
    return parser.parse_args()


if __name__ == "__main__":
    main()
