"""Ten thousand random scenes: plan each, and verify every path by a second opinion.

    python benchmarks/random_scenes.py -o scenes --workers 2      # everything; can be continued
    python benchmarks/random_scenes.py --scenes 200 -o scenes
    python benchmarks/random_scenes.py --repeat scenes/failure_17.json

Robots have 6 to 12 cables, some over pulleys, tilted or loaded; scenes have 1 to 8 obstacles of all
shapes and clearances near the robot's limits. Each plan has ``--budget-ms``, with alternating
objectives. The second opinion shares no code with planner and check (`second_opinion.py`); every
twentieth path also goes through `cdpr check`. Where the planner proves that there is no path, a
search of a hundred rounds must not find one. A failed scene is written as JSON to repeat it. Exits
with 1 if one fails.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import Progress

from benchmarks.random_robots import Robot, random_robot, random_scene
from benchmarks.second_opinion import second_opinion
from model.errors import NoSolution
from model.files.rig_file import RigDocument
from model.files.scene_file import SceneDocument
from model.pose import Pose, matrix_from_quaternion
from model.rig import Rig, rig_from_document
from model.scene import Scene, scene_from_document
from planner.anytime.path import optimal_route
from planner.check import check_path
from planner.costs import KinematicCost
from planner.parallel import worker_pool
from planner.settings import OBJECTIVES, OptimalSettings

SCENES_OF_A_ROBOT = 50
NO_ROOM, PLANNED, NOT_FOUND, SEPARATED = "no room", "planned", "not found", "proved separated"
OUTCOMES = (PLANNED, NOT_FOUND, SEPARATED, NO_ROOM)
_OBJECTIVES = ("length", "length", "length", "kinematic", "clearance", "length", "capacity")
_CHECKED_EVERY = 20
_LONGER = 100


@dataclass(frozen=True)
class Result:
    """Result of one scene.

    Attributes:
        number: Of the scene.
        outcome: One of `OUTCOMES`.
        problems: Violations of the path, or why the outcome is wrong.
        slack_mm: Smallest distance beyond the required one; None without a path.
        distances: Number of distances computed for the second opinion.
        checked: Whether `cdpr check` was run too.
        again: Data to repeat a failed scene; empty for all others.
    """

    number: int
    outcome: str
    problems: list[str] = field(default_factory=list)
    slack_mm: float | None = None
    distances: int = 0
    checked: bool = False
    again: dict[str, Any] = field(default_factory=dict)


def scenes_of(seed: int, robot_number: int, numbers: Sequence[int], budget: float) -> list[Result]:
    """Results of some scenes of one robot."""
    robot = random_robot(seed, robot_number)
    kinematic = KinematicCost(robot.rig, matrix_from_quaternion(robot.wxyz))
    return [scene_result(robot, kinematic, seed, number, budget) for number in numbers]


def scene_result(
    robot: Robot, kinematic: KinematicCost, seed: int, number: int, budget: float
) -> Result:
    """Draws a scene, plans in it and verifies the result."""
    scene = random_scene(robot, seed, number)
    if scene is None:
        return Result(number, NO_ROOM)
    objective = _OBJECTIVES[number % len(_OBJECTIVES)]
    settings = OptimalSettings(weights=OBJECTIVES[objective], seed=number, budget=budget)
    return judged(robot.rig, scene, kinematic, settings, objective, number)


def judged(
    rig: Rig,
    scene: Scene,
    kinematic: KinematicCost,
    settings: OptimalSettings,
    objective: str,
    number: int,
) -> Result:
    """Plans in a scene and verifies the result."""
    again = {
        "rig": rig.document.model_dump(mode="json"),
        "scene": scene.document.model_dump(mode="json"),
        "objective": objective,
        "seed": settings.seed,
    }
    try:
        found = optimal_route(rig, scene, settings, kinematic)
    except NoSolution as error:
        if error.values.get("proved") != "yes":
            return Result(number, NOT_FOUND)
        problems = _refuted(rig, scene, kinematic, settings)
        return Result(number, SEPARATED, problems, again=again if problems else {})
    path = found.path
    opinion = second_opinion(rig, scene, path)
    checked = number % _CHECKED_EVERY == 0
    problems = list(opinion.problems)
    if checked or problems:
        report = check_path(rig, scene, [Pose(p, scene.start.rotation) for p in path])
        problems += [f"cdpr check: {violation.sentence()}" for violation in report.violations]
    if problems:
        again |= {"rounds": found.iterations, "path_mm": (1e3 * path).tolist()}
    slack_mm = opinion.slack * 1e3 if np.isfinite(opinion.slack) else None
    kept = again if problems else {}
    return Result(number, PLANNED, problems, slack_mm, opinion.distances, checked, kept)


def _refuted(
    rig: Rig, scene: Scene, kinematic: KinematicCost, settings: OptimalSettings
) -> list[str]:
    """A problem if a longer search finds a path despite the proof."""
    longer = OptimalSettings(seed=settings.seed + 1, budget=settings.budget, rounds=_LONGER)
    try:
        optimal_route(rig, scene, longer, kinematic)
    except NoSolution:
        return []
    return ["a path was found despite a proof that there is none"]


def run(seed: int, numbers: Sequence[int], budget: float, workers: int) -> Iterator[list[Result]]:
    """Runs all scenes, robot by robot, in this process or several."""
    tasks: dict[int, list[int]] = {}
    for number in numbers:
        tasks.setdefault(number // SCENES_OF_A_ROBOT, []).append(number)
    with worker_pool(workers, None) as pool:
        if pool is None:
            for robot, mine in tasks.items():
                yield scenes_of(seed, robot, mine, budget)
            return
        work = [pool.submit(scenes_of, seed, *task, budget) for task in tasks.items()]
        for done in as_completed(work):
            yield done.result()


def repeated(path: Path) -> Result:
    """Repeats a failed scene from its file."""
    again = json.loads(path.read_text(encoding="utf-8"))
    rig = rig_from_document(RigDocument.model_validate(again["rig"]))
    scene = scene_from_document(SceneDocument.model_validate(again["scene"]))
    weights = OBJECTIVES[again["objective"]]
    settings = OptimalSettings(weights=weights, seed=again["seed"], rounds=again.get("rounds"))
    kinematic = KinematicCost(rig, np.array(scene.start.rotation))
    return judged(rig, scene, kinematic, settings, again["objective"], 0)


def summary(results: Sequence[Result]) -> str:
    """The counts as Markdown."""
    outcomes = Counter(result.outcome for result in results)
    failed = [result for result in results if result.problems]
    slacks = [result.slack_mm for result in results if result.slack_mm is not None]
    lines = ["| scenes | " + " | ".join(OUTCOMES) + " | checked too | violations |"]
    lines.append("|" + "---|" * (len(OUTCOMES) + 3))
    counts = [len(results), *(outcomes[name] for name in OUTCOMES)]
    counts += [sum(result.checked for result in results), len(failed)]
    lines.append("| " + " | ".join(str(count) for count in counts) + " |")
    distances = sum(result.distances for result in results)
    lines.append(f"\n{distances} distances; smallest distance beyond the required one:")
    if slacks:
        least, middle = min(slacks), float(np.median(slacks))
        tight = float(np.mean([slack < 1.0 for slack in slacks]))
        lines.append(f"{least:.5f} mm, median {middle:.2f} mm, below 1 mm in {tight:.0%} of paths")
    lines += [f"scene {r.number}: {'; '.join(r.problems)}" for r in failed]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    asked = _asked(arguments)
    if asked.repeat is not None:
        print(summary([result := repeated(asked.repeat)]))
        return 1 if result.problems else 0
    asked.output.mkdir(parents=True, exist_ok=True)
    results = _known(asked.output / _NAME.format(seed=asked.seed))
    known = {result.number for result in results}
    numbers = [number for number in range(asked.scenes) if number not in known]
    with Progress(disable=not sys.stderr.isatty()) as bar:
        task = bar.add_task("planning", total=asked.scenes, completed=len(known))
        for done in run(asked.seed, numbers, asked.budget_ms / 1e3, asked.workers):
            _keep(asked.output, asked.seed, done)
            results += done
            bar.advance(task, len(done))
    text = summary([result for result in results if result.number < asked.scenes])
    print(text)
    (asked.output / "random_scenes.md").write_text(text + "\n", encoding="utf-8")
    return 1 if any(result.problems for result in results) else 0


_NAME = "random_scenes_{seed}.jsonl"


def _known(path: Path) -> list[Result]:
    if not path.exists():
        return []
    lines = path.read_text(encoding="utf-8").splitlines()
    return [Result(**json.loads(line)) for line in lines]


def _keep(folder: Path, seed: int, results: Sequence[Result]) -> None:
    lines = "".join(json.dumps(asdict(result) | {"again": {}}) + "\n" for result in results)
    with (folder / _NAME.format(seed=seed)).open("a", encoding="utf-8") as file:
        file.write(lines)
    for result in results:
        if result.problems:
            text = json.dumps(result.again | {"problems": result.problems}, indent=1)
            (folder / f"failure_{result.number}.json").write_text(text, encoding="utf-8")


def _asked(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--scenes", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--budget-ms", type=float, default=20.0, help="of each plan")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--repeat", type=Path, help="only this failed scene")
    parser.add_argument("-o", "--output", type=Path, default=Path("scenes"), help="folder")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
