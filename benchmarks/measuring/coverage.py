"""How often 95 % intervals hold the truth, from the lens to the clearance, and verdicts are right.

    python benchmarks/measuring/coverage.py [--labs 200] [--kind "careful, 4 tags"] [--seed 1]

A lab draws a lens, pictures of a board, a camera's place, a survey of floor tags, tags on the
platform, outlets and anchors, each off by chance as it is told. It calibrates camera and place,
measures the platform in five pictures and the clearance of cables and platform. The truth is drawn
and projected here, with OpenCV's projection and nothing of the estimators that are judged.

NEES is the squared error of a pose in units of its covariance, 6 when that is exact. A verdict is
right when it says good in labs of a kind whose errors, 95 %, are below what is wanted, and not good
in those whose errors are above: the errors that were made, over all labs of that kind. It is asked
for the limits of each kind, and near the level of the errors: for 1.5 times and two thirds of that.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from calibration.extrinsics.result import judge_extrinsics
from calibration.extrinsics.surveyed_tags import Survey, locate_by_frame_tags
from calibration.intrinsics.calibrate import CameraCalibration, calibrate_from_views
from calibration.intrinsics.quality import judge_camera
from calibration.tag_map.observations import TagSights
from calibration.targets.boards import Seen
from model.clearance import ClearanceModel
from model.pose import Array, Pose, matrix_from_rotation_vector, rotation_vector_from_matrix
from model.rig import Camera, Rig, Tag, load_rig
from model.scene import Scene, load_scene
from tracking.camera_model import ideal_from_pixels
from tracking.clearance import clearance_of
from tracking.detection.tags import tag_corners
from tracking.edges.refine import RefinedTag
from tracking.measurement import PoseMeasurement
from tracking.pnp import TagView, solve_pnp
from tracking.shared_errors import SharedErrors

CONFIGS = Path(__file__).parents[2] / "configs"
CORNER_PX, TAG_PX = 0.1, 0.03
"""Noise of corners of boards and of tags."""
DISTANCE, PICTURES = 1.6, 5
NEAR = 1.5
"""How far from the level of the errors verdicts near it are asked for, as a factor."""
BOARD = np.array([[0.03 * x, 0.03 * y, 0.0] for y in range(6) for x in range(9)])


@dataclass(frozen=True)
class Kind:
    """Labs that take the same care.

    Attributes:
        views: Pictures of the board.
        tilt: Of the board, most, [deg].
        tags: On the floor.
        survey: Of them, one standard deviation, [m].
        lens_wanted: Of the camera's verdict, [m].
        place_wanted: Of the verdict of its place, [m].
    """

    views: int
    tilt: float
    tags: int
    survey: float
    lens_wanted: float = 1e-3
    place_wanted: float = 4e-3

    def wanted(self, name: str) -> float:
        """Of the verdict on ``camera`` or ``place``, [m]."""
        return self.lens_wanted if name == "camera" else self.place_wanted


KINDS = {
    "careful, 4 tags": Kind(40, 40.0, 4, 0.3e-3),
    "careful, 8 tags": Kind(40, 40.0, 8, 0.3e-3),
    "few flat views, rough survey": Kind(14, 24.0, 4, 1e-3, 0.2e-3, 1e-3),
}


Judge = Callable[[float], bool]
"""Whether a lab's verdict says good, by what is wanted, [m]."""


@dataclass
class Tally:
    """What came of labs, by what was asked."""

    inside: dict[str, list[bool]] = field(default_factory=lambda: defaultdict(list))
    nees: list[float] = field(default_factory=list)
    judges: dict[str, list[Judge]] = field(default_factory=lambda: defaultdict(list))
    errors: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))


def turned(size: float, rng: np.random.Generator) -> Array:
    """A rotation by chance, one deviation about any axis, [rad]."""
    return matrix_from_rotation_vector(size * rng.standard_normal(3))


def true_lens(camera: Camera, rng: np.random.Generator) -> Camera:
    """A lens of five coefficients near the rig file's."""
    matrix = camera.matrix.copy()
    matrix[[0, 1], [0, 1]] *= 1.0 + 0.02 * rng.standard_normal()
    matrix[1, 1] *= 1.0 + 5e-4 * rng.standard_normal()
    matrix[:2, 2] += 8.0 * rng.standard_normal(2)
    wide = np.array([0.02, 0.02, 5e-4, 5e-4, 0.01])
    distortion = np.array([-0.08, 0.03, 0.0, 0.0, 0.0]) + wide * rng.standard_normal(5)
    place = camera.world_from_camera
    moved = Pose(place.position + 0.02 * rng.standard_normal(3), turned(0.01, rng) @ place.rotation)
    return replace(camera, matrix=matrix, distortion=distortion, world_from_camera=moved)


def seen_by(camera: Camera, points: Array) -> Array:
    """Pixels of points in the camera's frame, shape (n, 2), by OpenCV alone."""
    zero = np.zeros(3)
    pixels = cv2.projectPoints(points, zero, zero, camera.matrix, camera.distortion)[0]
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)


def board_views(camera: Camera, kind: Kind, rng: np.random.Generator) -> dict[str, Seen]:
    """The board all over the picture."""
    views: dict[str, Seen] = {}
    size = np.array([camera.width, camera.height])
    middle = BOARD.mean(axis=0)
    while len(views) < kind.views:
        tilt = np.radians(kind.tilt) * rng.uniform(-1.0, 1.0, 2)
        turn = matrix_from_rotation_vector([tilt[0], tilt[1], rng.uniform(-0.3, 0.3)])
        depth = rng.uniform(0.35, 0.8)
        aside = rng.uniform(-0.5, 0.5, 2) * size / camera.matrix[0, 0] * depth
        there = (BOARD - middle) @ turn.T + [*aside, depth]
        pixels = seen_by(camera, there)
        if (pixels < 5).any() or (pixels > size - 5).any():
            continue
        noisy = pixels + CORNER_PX * rng.standard_normal(pixels.shape)
        views[str(len(views))] = Seen(BOARD, noisy)
    return views


def floor_tags(count: int) -> tuple[Tag, ...]:
    """On a ring around the rig."""
    angles = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    places = [[0.42 * np.cos(a), 0.42 * np.sin(a), 0.0] for a in angles]
    return tuple(Tag(401 + k, 0.12, Pose.level(place)) for k, place in enumerate(places))


def moved_tag(tag: Tag, shift: float, turn: float, rng: np.random.Generator) -> Tag:
    """The tag where it truly is: off by so much along and about any axis."""
    place = tag.pose.position + shift * rng.standard_normal(3)
    return replace(tag, pose=Pose(place, turned(turn, rng) @ tag.pose.rotation))


def square_of(truth: Camera, told: Camera, points: Array, rng: np.random.Generator) -> RefinedTag:
    """Corners in the camera's frame as they are seen, freed of the told lens."""
    pixels = seen_by(truth, points) + TAG_PX * rng.standard_normal((4, 2))
    ideal = ideal_from_pixels(told, pixels)
    whitening = np.eye(8) / TAG_PX
    return RefinedTag(ideal, whitening, whitening @ ideal.ravel(), np.ones(4, bool))


def poses(rng: np.random.Generator) -> Iterator[Pose]:
    """Of the platform, anywhere in the workspace."""
    for _ in range(PICTURES):
        place = rng.uniform([-0.1, -0.1, 0.35], [0.15, 0.1, 0.55])
        yield Pose(place, turned(np.radians(5.0), rng))


def step_between(told: Pose, truth: Pose) -> Array:
    """Shift [m] and turn [rad] from the truth, world axes."""
    turn = rotation_vector_from_matrix(told.rotation @ truth.rotation.T)
    return np.concatenate([told.position - truth.position, turn])


def lens_error(found: CameraCalibration, truth: Camera) -> float:
    """How far off points of the picture are at the distance, RMS, turned to fit best, [m]."""
    # The middles of cells: ends of the picture would count twice as much as the rest.
    across, down = np.meshgrid(np.arange(39.5, 1280.0, 80.0), np.arange(29.5, 720.0, 60.0))
    pixels = np.column_stack([across.ravel(), down.ravel()]).reshape(-1, 1, 2)
    rays = [
        np.column_stack([cv2.undistortPoints(pixels, m, d).reshape(-1, 2), np.ones(len(pixels))])
        for m, d in ((truth.matrix, truth.distortion), (found.matrix, found.distortion))
    ]
    units = [part / np.linalg.norm(part, axis=1, keepdims=True) for part in rays]
    u, _, v = np.linalg.svd(units[0].T @ units[1])
    back = rays[1] @ (u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v).T
    gap = back[:, :2] / back[:, 2:] - rays[0][:, :2]
    return DISTANCE * float(np.sqrt(np.mean(np.sum(gap**2, axis=1))))


class Lab:
    """One lab: what is true, and what it finds.

    Args:
        rig: As in its file.
        scene: Obstacles, where they are.
        kind: How careful it is.
        rng: Of everything that happens by chance.
    """

    def __init__(self, rig: Rig, scene: Scene, kind: Kind, rng: np.random.Generator) -> None:
        self._rig, self._scene, self._kind, self._rng = rig, scene, kind, rng
        self._truth = true_lens(rig.cameras[0], rng)

    def into(self, tally: Tally) -> None:
        """Calibrates and measures, and counts what came of it."""
        camera = self._lens(tally)
        camera = self._place(camera, tally)
        self._platform(camera, tally)

    def _lens(self, tally: Tally) -> Camera:
        views = board_views(self._truth, self._kind, self._rng)
        size = (self._truth.width, self._truth.height)
        found = calibrate_from_views(views, size, lens="five")
        m = self._truth.matrix
        numbers = [m[0, 0], m[1, 1], m[0, 2], m[1, 2], *self._truth.distortion]
        stated = list(found.intervals.values())
        tally.inside["camera numbers"] += [
            abs(one.value - true) <= one.half_width
            for one, true in zip(stated, numbers, strict=True)
        ]
        error = lens_error(found, self._truth)
        stated_error = judge_camera(found, self._kind.lens_wanted, DISTANCE).verdict.error
        tally.inside["camera's stated error"].append(error <= stated_error)
        tally.errors["camera"].append(error)
        tally.judges["camera"].append(lambda w: judge_camera(found, w, DISTANCE).verdict.good)
        return replace(
            self._rig.cameras[0],
            matrix=found.matrix,
            distortion=found.distortion,
            lens_covariance=found.uncertainty.stated_covariance,
            error=None,
        )

    def _place(self, camera: Camera, tally: Tally) -> Camera:
        kind, rng = self._kind, self._rng
        turn = 2.0 * kind.survey / 0.12
        tags = floor_tags(kind.tags)
        there = self._truth.world_from_camera.inverse()
        squares = {}
        for tag in tags:
            true = moved_tag(tag, kind.survey, turn, rng)
            squares[tag.id] = square_of(self._truth, camera, there.apply(tag_corners(true)), rng)
        rig = replace(self._rig, frame_tags=tags)
        sights = TagSights({"picture": squares}, {})
        found = locate_by_frame_tags(rig, camera, sights, Survey(kind.survey, turn))
        off = step_between(found.world_from_camera, self._truth.world_from_camera)
        tally.inside["extrinsics"] += (np.abs(off) <= found.half_widths).tolist()
        back = found.world_from_camera.apply(there.apply(found.points)) - found.points
        error = float(np.sqrt(np.mean(np.sum(back**2, axis=1))))
        tally.inside["place's stated error"].append(error <= found.error)
        tally.errors["place"].append(error)
        tally.judges["place"].append(lambda w: judge_extrinsics(found, w).good)
        return replace(
            camera,
            world_from_camera=found.world_from_camera,
            pose_covariance=found.stated_covariance,
            pose_by_lens=found.by_lens,
        )

    def _platform(self, camera: Camera, tally: Tally) -> None:
        rig, rng = self._rig, self._rng
        # A told error of corners, 95 %, is half of a shift and half of a turn of each tag.
        tag_error, ends = rng.uniform(0.1e-3, 0.4e-3), rng.uniform(0.2e-3, 1.5e-3, 2)
        deviation = tag_error / 1.96
        tags = [
            moved_tag(t, deviation / 6**0.5, deviation / 2.0 / (t.size / 2**0.5), rng)
            for t in rig.platform_tags
        ]
        built = replace(
            rig,
            outlets=rig.outlets + ends[0] / 1.96 * rng.standard_normal(rig.outlets.shape),
            anchors=rig.anchors + ends[1] / 1.96 * rng.standard_normal(rig.anchors.shape),
        )
        told = replace(
            rig, tag_error=tag_error, outlet_error=float(ends[0]), anchor_error=float(ends[1])
        )
        models = ClearanceModel(told, self._scene), ClearanceModel(built, self._scene)
        shared = SharedErrors(told, camera)
        for pose in poses(rng):
            views = self._views(camera, tags, pose)
            bundle = solve_pnp(camera, views) if views else None
            if bundle is None:
                continue
            found = camera.world_from_camera.compose(bundle.camera_from_body)
            turn = np.kron(np.eye(2), camera.world_from_camera.rotation)
            one = PoseMeasurement(
                0.0,
                found,
                turn @ shared.scatter(bundle, views) @ turn.T,
                tuple(v.tag.id for v in views),
                bundle.reprojection,
                "found",
                shared.of(found, views),
                shared.unstated,
            )
            covariance, off = one.covariance + one.shared, step_between(found, pose)
            tally.nees.append(float(off @ np.linalg.solve(covariance, off)))
            tally.inside["platform"] += (
                np.abs(off) <= 1.96 * np.sqrt(np.diag(covariance))
            ).tolist()
            measured = clearance_of(models[0], one)
            true = models[1].obstacles(pose)
            if measured is not None:
                tally.inside["clearance"] += [
                    abs(a.distance - b.distance) <= u
                    for a, b, u in zip(measured.nearest, true, measured.uncertainties, strict=True)
                    if min(a.distance, b.distance) > 1e-3
                ]

    def _views(self, camera: Camera, tags: list[Tag], pose: Pose) -> list[TagView]:
        views = []
        there = self._truth.world_from_camera.inverse().compose(pose)
        for tag, true in zip(self._rig.platform_tags, tags, strict=True):
            at = there.compose(true.pose)
            if -at.rotation[:, 2] @ at.position < 0.35 * np.linalg.norm(at.position):
                continue
            corners = there.apply(tag_corners(true))
            views.append(TagView(tag, square_of(self._truth, camera, corners, self._rng)))
        return views


def verdict_line(name: str, tally: Tally, wanted: float) -> tuple[str, float]:
    """How many verdicts are right, in words and as a share."""
    level = float(np.quantile(tally.errors[name], 0.95))
    good = level <= wanted
    share = float(np.mean([judge(wanted) is good for judge in tally.judges[name]]))
    return (
        f"  verdict of the {name:7s} 95 % of errors < {level * 1e3:.3g} mm,"
        f" wanted {wanted * 1e3:.3g}: {'good' if good else 'not good'}, said in {share:.1%}",
        share,
    )


def wanted_of(kind: Kind, name: str, tally: Tally) -> Iterator[float]:
    """For what verdicts are asked: the kind's own limit, and close to both sides of the level."""
    level = float(np.quantile(tally.errors[name], 0.95))
    yield from (kind.wanted(name), level * NEAR, level / NEAR)


def main() -> int:
    """Prints coverage by kind; 1 when something is outside its limits."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--labs", type=int, default=200, help="of each kind")
    parser.add_argument("--kind", nargs="*", choices=KINDS, default=list(KINDS))
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    rig, scene = load_rig(CONFIGS / "gachon_8_6.yaml"), load_scene(CONFIGS / "environment_3.yaml")
    bad = 0
    for number, (name, kind) in enumerate(KINDS.items()):
        if name not in options.kind:
            continue
        tally = Tally()
        for lab in range(options.labs):
            rng = np.random.default_rng([options.seed, number, lab])
            Lab(rig, scene, kind, rng).into(tally)
        print(f"{name}: {options.labs} labs")
        for what, inside in tally.inside.items():
            share = float(np.mean(inside))
            ok = share >= 0.92 and (share <= 0.98 or "stated error" in what)
            bad += not ok
            print(f"  {what:22s}{share:7.1%} of {len(inside):5d}{'' if ok else '  <--'}")
        nees = float(np.mean(tally.nees))
        ok = 5.5 <= nees <= 6.5
        bad += not ok
        print(f"  {'NEES of the platform':22s}{nees:7.2f}{'' if ok else '  <--'}")
        for which in ("camera", "place"):
            for wanted in wanted_of(kind, which, tally):
                line, share = verdict_line(which, tally, wanted)
                bad += share < 0.95
                print(line + ("" if share >= 0.95 else "  <--"), flush=True)
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
