"""Calibration of a simulated rig that differs from its file, from planning to verification.

    python benchmarks/rig_calibration.py [--count 60] [-o FOLDER]
    python benchmarks/rig_calibration.py --plants 12
    python benchmarks/rig_calibration.py --sensors 60

With the program itself, on configs/gachon_8_6_rehearsal.yaml: plans measurement poses, runs it with
the synthetic camera, calibrates, and runs environment 3 before and after. Then, against the
ground truth: errors at unmeasured poses, and the result without rotations of the platform. The run
is faster than the rig file (50 mm/s, 4 Hz images), which changes nothing at rest. With --plants
only: coverage of the 95 % intervals over N other rigs, with right and wrong stiffness in the rig
file, and with cables that differ. With --sensors only: the same for rigs with pulleys, whose cables
differ by 20 %, with swivel angles and an IMU beside lengths and poses, and the widths of the
geometry's intervals.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from calibration.geometry.calibrate import fit_rig
from calibration.geometry.identifiability import identified, uncertainty_of_rig
from calibration.geometry.parameters import DEFAULT_DEVIATIONS, Parameters
from calibration.geometry.quality import judge_rig
from calibration.result_files import load_result
from model.kinematics import settled_poses_near
from model.rig import Rig, load_rig
from model.winches import WinchMap
from tests.calibration.rig_places import (
    Truth,
    rig_with_errors,
    samples,
    share_inside,
    true_numbers,
    with_nominal_stiffness,
)
from tests.calibration.synthetic_rig import LENGTH_NOISE, built_rig, measured, only

ROOT = Path(__file__).parents[1]
RIG = ROOT / "configs/gachon_8_6_rehearsal.yaml"
HALL = ROOT / "configs/hall_10_6.yaml"
SENSOR_OF = {"swivel_zeros": "swivels", "imu_mounting": "verticals"}
ENVIRONMENT = ROOT / "configs/environment_3.yaml"
FREE = """schema_version: 1
name: measuring
clearance: {obstacle_mm: 10, self_mm: 3}
start: {position_mm: [0, 0, 445]}
goal: {position_mm: [0, 0, 445]}
"""


def cdpr(*arguments: object, allowed: tuple[int, ...] = (0,)) -> dict[str, Any]:
    """The program's JSON output."""
    command = [sys.executable, "-c", "from cdpr.cli import main; main()", *map(str, arguments)]
    done = subprocess.run(
        [*command, "--json"], cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False
    )
    if done.returncode not in allowed:
        raise SystemExit(f"cdpr {' '.join(map(str, arguments))}: {done.stdout}")
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer


def fast_rig(folder: Path) -> Path:
    """The same rig with faster motion and fewer images."""
    text = RIG.read_text(encoding="utf-8")
    text = text.replace("speed_mm_s: 20\n", "speed_mm_s: 50\n", 1)
    text = text.replace("acceleration_mm_s2: 100\n", "acceleration_mm_s2: 300\n", 1)
    text = text.replace("jerk_mm_s3: 1000\n", "jerk_mm_s3: 3000\n", 1)
    path = folder / "fast.yaml"
    path.write_text(text.replace("rate_hz: 10", "rate_hz: 4"), encoding="utf-8")
    return path


def position_error(rig: Rig, truth: Truth) -> float:
    """Error of the platform position by forward kinematics of a rig, RMS, [mm]."""
    winches, data = WinchMap(rig), truth.measured
    lengths = winches.strained(winches.unstrained_from_counts(data.counts), data.tensions)
    found, _ = settled_poses_near(rig, lengths, truth.positions, truth.rotations)
    squares = np.sum((found - truth.positions) ** 2, axis=1)
    return float(np.sqrt(np.mean(squares))) * 1e3


def run_of_environment_3(folder: Path, name: str, *calibration: object) -> dict[str, Any]:
    """The summary of a run, passed or not."""
    plan = folder / f"{name}.json"
    cdpr("plan", RIG, ENVIRONMENT, "-o", plan, "--rounds", 300, *calibration)
    run = ("run", plan, "--rig", RIG, "-o", folder / name, "--fast", *calibration)
    return cdpr(*run, allowed=(0, 1))


def show(name: str, value: str) -> None:
    """Prints a line."""
    print(f"{name:58s} {value}", flush=True)


def whole_round(folder: Path, count: int) -> None:
    """Run before, measurement, calibration, run after."""
    free, fast = folder / "free.yaml", fast_rig(folder)
    free.write_text(FREE, encoding="utf-8")
    before = run_of_environment_3(folder, "before")
    show("environment 3 before, by tag", tracking_error(before))
    plan = folder / "measure.json"
    planned = cdpr("calibrate", "poses", RIG, free, "-o", plan, "--count", count)
    rotated = max(planned["turned_deg"])
    show("poses for measuring", f"{count}, rotated by up to {rotated:.1f} deg")
    cdpr("run", plan, "--rig", fast, "-o", folder / "measuring", "--fast", allowed=(0, 1))
    out = folder / "calibration"
    result = cdpr("calibrate", "rig", RIG, folder / "measuring", "-o", out, allowed=(0, 3))
    show("verdict", result["verdict"])
    show(
        "held out, by tag (RMS)",
        f"{result['held_out_mm']:.3f} mm, by the rig file {result['before_mm']:.3f} mm",
    )
    for line in result["not_identified"]:
        show("not identified", line)
    (file,) = out.glob("*.yaml")
    rig = load_rig(RIG)
    corrected = rig.with_calibration(load_result(file))
    for name, tilt in (("level", 0.0), ("rotated by up to 8 deg", math.radians(8.0))):
        truth = samples(rig, 100, tilt=tilt, seed=77, noise=0.0)
        errors = (position_error(rig, truth), position_error(corrected, truth))
        show(
            f"100 unmeasured poses, {name}, against the truth",
            f"{errors[0]:.3f} mm before, {errors[1]:.3f} mm after (RMS)",
        )
    after = run_of_environment_3(folder, "after", "--calibration", file)
    show("environment 3 after, by tag", tracking_error(after))


def tracking_error(summary: dict[str, Any]) -> str:
    """Tracking error of a run by the camera, and its verdict."""
    error = summary["tag_error_mm"]
    return f"{error['rms']:.3f} mm RMS, at most {error['max']:.3f} mm; {summary['verdict']}"


def without_rotation(count: int) -> None:
    """Results of level samples, with poses and from lengths alone."""
    rig = load_rig(RIG)
    level = samples(rig, count, tilt=0.0, seed=5).measured
    for name, data in (("poses, never rotated", level), ("lengths alone", level.without_poses())):
        result = fit_rig(rig, data, DEFAULT_DEVIATIONS, 1e-4)
        quality = judge_rig(result, 1e-3, math.radians(5.0))
        unknown = result.observability.unknown
        moved = unknown.T @ (result.fit.values / result.parameters.deviations)
        show(name, str(quality.verdict))
        for line in result.not_identified:
            show("  not identified", line)
        show(
            f"  {unknown.shape[1]} directions left as in the rig file, moved by",
            f"{np.abs(moved).max(initial=0.0):.1e} deviations",
        )


def coverage(plants: int, count: int) -> None:
    """Coverage for outlets, anchors, drums and stiffness of random rigs."""
    rig = load_rig(RIG)
    for share in (1.0, 0.5, 2.0, 4.0, 100.0):
        inside, good, false = [], 0, 0
        for seed in range(plants):
            built = rig_with_errors(rig, seed)
            data = samples(built, count, tilt=math.radians(8.0), seed=1000 + seed).measured
            drawn = with_nominal_stiffness(built, share * rig.document.cables.stiffness_n)
            result = fit_rig(drawn, data, DEFAULT_DEVIATIONS, 1e-4)
            verdict = judge_rig(result, 1e-3, math.radians(5.0)).verdict
            inside.append(share_inside(result.intervals, true_numbers(built)))
            good += verdict.good
            false += verdict.good and inside[-1] < 0.8
        show(
            f"rig file's stiffness {share:g} of the true one, {plants} plants",
            f"{np.mean(inside):.1%} inside, worst plant {min(inside):.1%}; {good} verdicts good,"
            f" {false} of them with less than 80 % inside",
        )


def cables_that_differ(plants: int, count: int) -> None:
    """Coverage with one stiffness for all cables, and one for each, of cables that differ."""
    rig = load_rig(RIG)
    each = {"cable_stiffness" if g == "stiffness" else g: d for g, d in DEFAULT_DEVIATIONS.items()}
    for spread in (0.1, 0.2, 0.3):
        for name, deviations in (("one stiffness", DEFAULT_DEVIATIONS), ("of each", each)):
            inside, good = [], 0
            for seed in range(plants):
                shares = np.exp(spread * np.random.default_rng(seed).standard_normal(8))
                stiffness = rig.document.cables.stiffness_n * shares
                built = rig_with_errors(rig, seed, stiffness.tolist())
                data = samples(built, count, tilt=math.radians(8.0), seed=1000 + seed).measured
                result = fit_rig(built, data, deviations, 1e-4)
                true = true_numbers(built)
                del true["stiffness_n"]
                if name == "of each":
                    true |= {f"stiffness_{i}_n": float(s) for i, s in enumerate(stiffness, start=1)}
                inside.append(share_inside(result.intervals, true))
                good += judge_rig(result, 1e-3, math.radians(5.0)).verdict.good
            show(
                f"cables differ by {spread:.0%}, {name}, {plants} plants",
                f"{np.mean(inside):.1%} inside, worst plant {min(inside):.1%}; {good} good",
            )


KINDS: dict[str, tuple[str, ...]] = {
    "lengths": (),
    "lengths, swivels": ("swivels",),
    "lengths, IMU": ("verticals",),
    "lengths, swivels, IMU": ("swivels", "verticals"),
}


def sensors(plants: int, count: int) -> None:
    """Coverage by group, and interval widths relative to those without sensors."""
    rig, degree = load_rig(HALL), math.radians(1.0)
    for poses in (True, False):
        shares: dict[tuple[str, str], list[float]] = {}
        wider: dict[str, list[np.ndarray]] = {}
        for seed in range(plants):
            built = built_rig(rig, seed)
            data = measured(built, count, 1000 + seed)
            alone: dict[str, float] = {}
            for kind, which in KINDS.items():
                estimated = {g: d for g, d in DEFAULT_DEVIATIONS.items() if g != "stiffness"}
                estimated |= {"cable_stiffness": 0.2, "imu_mounting": degree}
                estimated = {
                    g: d
                    for g, d in estimated.items()
                    if SENSOR_OF.get(g) is None or SENSOR_OF[g] in which
                }
                parameters = Parameters.of(rig, estimated)
                part = only(data if poses else data.without_poses(), *which)
                fit, observability = identified(parameters, part, LENGTH_NOISE)
                found = uncertainty_of_rig(parameters, part, fit, observability)
                off = np.abs(fit.values - built.values(parameters.groups)) < found.half_widths
                for group, where in parameters.slices().items():
                    shares.setdefault((kind, group), []).append(float(np.mean(off[where])))
                widths = dict(zip(parameters.names, found.half_widths.tolist(), strict=True))
                alone = alone or widths
                ratios = np.array([widths[name] / alone[name] for name in alone])
                wider.setdefault(kind, []).append(ratios)
        for kind in KINDS:
            held = [f"{g} {np.mean(s):.1%}" for (k, g), s in shares.items() if k == kind]
            name = f"{kind}{', poses' if poses else ''}, {plants} plants"
            show(f"{name}: inside", ", ".join(held))
            ratios = np.array(wider[kind])
            show(
                f"{name}: geometry's intervals, share of those without",
                f"mean {ratios.mean():.3f}, largest of a number's means"
                f" {ratios.mean(axis=0).max():.3f}, largest {ratios.max():.3f}",
            )


def main() -> None:
    """Prints one line per figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("-o", "--output", type=Path, help="keep the files in this new folder")
    parser.add_argument("--plants", type=int, help="only coverage, over this many rigs")
    parser.add_argument("--sensors", type=int, help="only further sensors, over this many rigs")
    options = parser.parse_args()
    if options.sensors is not None:
        sensors(options.sensors, options.count)
        return
    if options.plants is not None:
        coverage(options.plants, options.count)
        cables_that_differ(options.plants, options.count)
        return
    if options.output is not None:
        options.output.mkdir(parents=True)
        whole_round(options.output, options.count)
    else:
        with tempfile.TemporaryDirectory() as folder:
            whole_round(Path(folder), options.count)
    without_rotation(options.count)


if __name__ == "__main__":
    main()
