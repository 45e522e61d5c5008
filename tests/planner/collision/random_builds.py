"""Random rigs of every build, for what is compared within a robot: cables and platform."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from model.pose import Array
from model.rig import Rig
from tests.configs import GACHON
from tests.planner.collision.sampled_oracle import changed_rig

ANCHORS = ("on", "inside", "above", "around", "mixed")
PLATFORMS = ("cube", "thin", "long")


@dataclass(frozen=True)
class Build:
    """What a random rig is like.

    Attributes:
        cables: How many.
        anchors: Of `ANCHORS`: on the faces of the platform's box, a little inside, above it or
            around it as on an open frame, or each anchor one of these.
        platform: Of `PLATFORMS`.
        suspended: Whether all cables come from above.
        pulley_mm: Radius of the pulleys; 0 for point exits.
        radius_mm: Of the cables.
    """

    cables: int
    anchors: str
    platform: str
    suspended: bool
    pulley_mm: float
    radius_mm: float


def random_build(rng: np.random.Generator) -> Build:
    """A build, all kinds equally often."""
    return Build(
        cables=int(rng.integers(6, 17)),
        anchors=str(rng.choice(ANCHORS)),
        platform=str(rng.choice(PLATFORMS)),
        suspended=bool(rng.random() < 0.5),
        pulley_mm=float(rng.choice([0.0, 0.0, 15.0, 40.0])),
        radius_mm=float(rng.choice([0.0, 1.0, 2.5])),
    )


def rig_of(build: Build, rng: np.random.Generator) -> Rig:
    """A rig of a build; everything else is drawn."""
    count = build.cables
    size = {
        "cube": rng.uniform(80.0, 200.0, 3),
        "thin": np.append(rng.uniform(150.0, 400.0, 2), rng.uniform(5.0, 20.0)),
        "long": np.append(rng.uniform(300.0, 600.0), rng.uniform(40.0, 90.0, 2)),
    }[build.platform]
    frame = np.append(rng.uniform(700.0, 1200.0, 2), rng.uniform(1200.0, 1800.0))
    around = 2.0 * np.pi * (np.arange(count) + rng.uniform(-0.3, 0.3, count)) / count
    upper = np.ones(count, dtype=bool) if build.suspended else np.arange(count) % 2 == 0
    heights = np.where(upper, frame[2], rng.uniform(0.0, 100.0, count))
    outlets = np.column_stack([_square(around) * frame[:2], heights])
    twist = rng.uniform(0.0, 0.9) * np.where(np.arange(count) % 2 == 0, 1.0, -1.0)
    middle = 0.45 * frame[2]
    feeds = np.where(upper[:, None], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0])
    document = GACHON.document
    platform = document.platform.model_dump(mode="json") | {
        "size_mm": size.tolist(),
        "home": {"position_mm": [0.0, 0.0, middle]},
    }
    winch = document.winches[0].model_dump(mode="json")
    return changed_rig(
        GACHON,
        name="random build",
        platform=platform,
        workspace={
            "lower_mm": [*(-0.3 * frame[:2]), middle - 150.0],
            "upper_mm": [*(0.3 * frame[:2]), middle + 150.0],
        },
        outlets_mm=outlets.tolist(),
        anchors_mm=_anchors(build, rng, size, _square(around + twist), upper).tolist(),
        cables=document.cables.model_dump(mode="json") | {"radius_mm": build.radius_mm},
        pulleys={"radius_mm": build.pulley_mm, "feed_directions": feeds.tolist()}
        if build.pulley_mm
        else None,
        winches=[winch | {"node_id": k + 1} for k in range(count)],
        tags=None,
        cameras=[],
    )


def _anchors(build: Build, rng: np.random.Generator, size: Array, square: Array, upper: Array):
    """Anchors, shape (m, 3), [mm]."""
    anchors = np.column_stack([square * size[:2], np.where(upper, 1.0, -1.0) * size[2]]) / 2.0
    for k in range(build.cables):
        kind = build.anchors if build.anchors != "mixed" else str(rng.choice(ANCHORS[:-1]))
        if kind == "inside":
            anchors[k] *= 1.0 - rng.uniform(0.0, 0.1)
        elif kind == "above":
            anchors[k, 2] += np.sign(anchors[k, 2]) * rng.uniform(5.0, 80.0)
        elif kind == "around":
            anchors[k] *= rng.uniform(1.1, 2.0)
    return anchors


def _square(angles: Array) -> Array:
    """Points on the border of the square of half width 1 in given directions, shape (k, 2)."""
    points = np.column_stack([np.cos(angles), np.sin(angles)])
    border: Array = points / np.abs(points).max(axis=1)[:, None]
    return border
