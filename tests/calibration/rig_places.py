"""Stationary samples of a rig that differs from its file, with exact ground truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.geometry.measurements import RigMeasurements
from calibration.statistics import Interval
from model.kinematics import cables_at
from model.pose import Array, Pose, matrix_from_rotation_vector
from model.rig import Rig, rig_from_document
from model.statics.gravity import working_tensions
from model.statics.tension_distribution import TensionInfeasible
from model.winches import WinchMap
from simulation.ground_truth import rig_as_built, stiffness_as_built
from simulation.plant import Plant

POSITION_NOISE, TURN_NOISE = 0.2e-3, 0.5e-3


@dataclass(frozen=True)
class Truth:
    """Measurements and their ground truth."""

    measured: RigMeasurements
    positions: Array
    rotations: Array


def samples(rig: Rig, count: int, *, tilt: float, seed: int, noise: float = 1.0) -> Truth:
    """Samples of a simulated rig whose drives are commanded to random poses."""
    random = np.random.default_rng(seed)
    winches, plant = WinchMap(rig), _plant(rig)
    span = rig.workspace_upper - rig.workspace_lower
    rows: list[tuple[Array, Array, Pose]] = []
    while len(rows) < count:
        position = rig.workspace_lower + random.uniform(0.1, 0.9, 3) * span
        angle, amount = random.uniform(0.0, 2.0 * np.pi), tilt * np.sqrt(random.uniform())
        turn = amount * np.array([np.cos(angle), np.sin(angle), 0.0])
        pose = Pose(position, matrix_from_rotation_vector(turn))
        try:
            tensions = working_tensions(rig, pose).tensions
        except TensionInfeasible:
            continue
        lengths = cables_at(rig, pose).lengths
        counts = np.rint(winches.counts(winches.unstrained(lengths, tensions)))
        plant.settle_counts(counts)
        if plant.tensions.min() > rig.min_tension / 2.0:
            rows.append((counts, plant.tensions, plant.pose))
    shaken = [
        (
            pose.position + noise * POSITION_NOISE * random.standard_normal(3),
            matrix_from_rotation_vector(noise * TURN_NOISE * random.standard_normal(3))
            @ pose.rotation,
        )
        for _, _, pose in rows
    ]
    covariance = np.diag([POSITION_NOISE**2] * 3 + [TURN_NOISE**2] * 3)
    measured = RigMeasurements(
        names=tuple(f"sample {k}" for k in range(count)),
        counts=np.array([counts for counts, _, _ in rows]),
        tensions=np.array([t for _, t, _ in rows]),
        positions=np.array([p for p, _ in shaken]),
        rotations=np.array([r for _, r in shaken]),
        covariances=np.tile(covariance, (count, 1, 1)),
    )
    return Truth(
        measured,
        np.array([pose.position for _, _, pose in rows]),
        np.array([pose.rotation for _, _, pose in rows]),
    )


def rig_with_errors(rig: Rig, seed: int, stiffness: Sequence[float] | None = None) -> Rig:
    """A rig with random errors of the usual size relative to its file.

    Args:
        rig: Of the rehearsal.
        seed: Of the errors.
        stiffness: Of each cable, [N]; as in the rig file when left out.
    """
    random, document = np.random.default_rng(seed), rig.document
    assert document.simulation is not None
    assert document.simulation.as_built is not None
    m, drums = rig.cable_count, [w.drum_mm_per_rev for w in document.winches]
    homes = [w.home_counts for w in document.winches]
    slips = 2e-3 * np.array([w.counts_per_metre for w in rig.winches])
    built = document.simulation.as_built.model_copy(
        update={
            "outlets_mm": (1e3 * rig.outlets + 4.0 * random.standard_normal((m, 3))).tolist(),
            "anchors_mm": (1e3 * rig.anchors + random.standard_normal((m, 3))).tolist(),
            "drums_mm_per_rev": (drums * (1.0 + 0.005 * random.standard_normal(m))).tolist(),
            "stiffness_n": None if stiffness is None else list(stiffness),
            "home_counts": (homes + slips * random.standard_normal(m)).tolist(),
        }
    )
    simulation = document.simulation.model_copy(update={"as_built": built})
    return rig_from_document(document.model_copy(update={"simulation": simulation}))


def with_nominal_stiffness(rig: Rig, stiffness: float) -> Rig:
    """The rig with another stiffness in its file, [N]."""
    cables = rig.document.cables.model_copy(update={"stiffness_n": stiffness})
    return rig_from_document(rig.document.model_copy(update={"cables": cables}))


def true_numbers(rig: Rig) -> dict[str, float]:
    """True values by the names of a calibration, without the offsets."""
    truth = rig_as_built(rig)
    found = {
        f"{what}_{i}_{axis}_mm": 1e3 * float(value)
        for what, points in (("outlet", truth.outlets), ("anchor", truth.anchors))
        for i, point in enumerate(points, start=1)
        for axis, value in zip("xyz", point, strict=True)
    }
    drums = enumerate((w.drum_mm_per_rev for w in truth.document.winches), start=1)
    found |= {f"drum_{i}_mm_per_rev": drum for i, drum in drums}
    return {**found, "stiffness_n": float(truth.cable_stiffness.mean())}


def share_inside(intervals: Mapping[str, Interval], true: Mapping[str, float]) -> float:
    """Share of the intervals that contain the truth."""
    found = [
        abs(intervals[name].value - value) < intervals[name].half_width
        for name, value in true.items()
    ]
    return sum(found) / len(found)


def _plant(rig: Rig) -> Plant:
    return Plant(rig_as_built(rig), rig.home, None, stiffness_as_built(rig))


def write_samples(path: Path, measured: RigMeasurements, *, poses: bool = True) -> None:
    """Writes a CSV file as in docs/data-formats.md."""
    m = measured.counts.shape[1]
    names = [f"actual_{i}_counts" for i in range(1, m + 1)]
    names += [f"tension_{i}_n" for i in range(1, m + 1)]
    table = [measured.counts, measured.tensions]
    if poses:
        names += ["x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz"]
        quaternions = [Pose(np.zeros(3), r).quaternion for r in measured.rotations]
        table += [measured.positions * 1e3, np.array(quaternions)]
    rows = [",".join(f"{x:.9g}" for x in row) for row in np.concatenate(table, axis=1)]
    path.write_text("\n".join([",".join(names), *rows]) + "\n", encoding="utf-8")
