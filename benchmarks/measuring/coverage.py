"""Coverage of 95 % intervals from lens to clearance, and rate of correct verdicts.

    python benchmarks/measuring/coverage.py [--labs 200] [--kind "careful, 4 tags"] [--seed 1]

A lab draws a lens, images of a board, a camera pose, a survey of floor tags, tags on the platform,
outlets and anchors, each with random errors as stated. It calibrates camera and extrinsics,
measures the platform in five images and the clearance of cables and platform. The truth is drawn
and projected here, with OpenCV's projection and none of the code under test.

NEES is the squared error of a pose in units of its covariance, 6 if that is exact. A verdict is
correct if it is good in kinds of labs whose 95 % error level, over all labs of that kind, is below
the required one, and not good otherwise. It is tested for the limits of each kind and near the
error level: for 1.5 times and two thirds of it.
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
from calibration.tag_map.observations import TagObservations
from calibration.targets.boards import DetectedBoard
from model.clearance import ClearanceModel
from model.pose import Array, Pose, matrix_from_rotation_vector, rotation_vector_from_matrix
from model.rig import Camera, Rig, Tag, load_rig
from model.scene import Scene, load_scene
from tracking.camera_model import undistort_pixels
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
"""Factor between the error level and the limits tested near it."""
BOARD = np.array([[0.03 * x, 0.03 * y, 0.0] for y in range(6) for x in range(9)])


@dataclass(frozen=True)
class Kind:
    """A kind of labs.

    Attributes:
        views: Images of the board.
        tilt: Largest tilt of the board, [deg].
        tags: Number of tags on the floor.
        survey: Standard deviation of their survey, [m].
        lens_wanted: Limit of the camera's verdict, [m].
        pose_wanted: Limit of the verdict on its pose, [m].
    """

    views: int
    tilt: float
    tags: int
    survey: float
    lens_wanted: float = 1e-3
    pose_wanted: float = 4e-3

    def wanted(self, name: str) -> float:
        """Limit of the verdict on ``camera`` or ``pose``, [m]."""
        return self.lens_wanted if name == "camera" else self.pose_wanted


KINDS = {
    "careful, 4 tags": Kind(40, 40.0, 4, 0.3e-3),
    "careful, 8 tags": Kind(40, 40.0, 8, 0.3e-3),
    "few flat views, rough survey": Kind(14, 24.0, 4, 1e-3, 0.2e-3, 1e-3),
}


Judge = Callable[[float], bool]
"""Whether a lab's verdict is good, by the limit, [m]."""


@dataclass
class Tally:
    """Results of labs, by quantity."""

    inside: dict[str, list[bool]] = field(default_factory=lambda: defaultdict(list))
    nees: list[float] = field(default_factory=list)
    judges: dict[str, list[Judge]] = field(default_factory=lambda: defaultdict(list))
    errors: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))


def random_rotation(size: float, rng: np.random.Generator) -> Array:
    """A random rotation of a standard deviation about any axis, [rad]."""
    return matrix_from_rotation_vector(size * rng.standard_normal(3))


def true_lens(camera: Camera, rng: np.random.Generator) -> Camera:
    """A lens of five coefficients near the rig file's."""
    matrix = camera.matrix.copy()
    matrix[[0, 1], [0, 1]] *= 1.0 + 0.02 * rng.standard_normal()
    matrix[1, 1] *= 1.0 + 5e-4 * rng.standard_normal()
    matrix[:2, 2] += 8.0 * rng.standard_normal(2)
    wide = np.array([0.02, 0.02, 5e-4, 5e-4, 0.01])
    distortion = np.array([-0.08, 0.03, 0.0, 0.0, 0.0]) + wide * rng.standard_normal(5)
    pose = camera.world_from_camera
    rotation = random_rotation(0.01, rng) @ pose.rotation
    moved = Pose(pose.position + 0.02 * rng.standard_normal(3), rotation)
    return replace(camera, matrix=matrix, distortion=distortion, world_from_camera=moved)


def seen_by(camera: Camera, points: Array) -> Array:
    """Pixels of points in the camera's frame, shape (n, 2), by OpenCV alone."""
    zero = np.zeros(3)
    pixels = cv2.projectPoints(points, zero, zero, camera.matrix, camera.distortion)[0]
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)


def board_views(camera: Camera, kind: Kind, rng: np.random.Generator) -> dict[str, DetectedBoard]:
    """Random views of the board all over the image."""
    views: dict[str, DetectedBoard] = {}
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
        views[str(len(views))] = DetectedBoard(BOARD, noisy)
    return views


def floor_tags(count: int) -> tuple[Tag, ...]:
    """Tags on a ring around the rig."""
    angles = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    positions = [[0.42 * np.cos(a), 0.42 * np.sin(a), 0.0] for a in angles]
    return tuple(Tag(401 + k, 0.12, Pose.level(position)) for k, position in enumerate(positions))


def moved_tag(tag: Tag, shift: float, turn: float, rng: np.random.Generator) -> Tag:
    """The true tag, with random errors along and about any axis."""
    position = tag.pose.position + shift * rng.standard_normal(3)
    return replace(tag, pose=Pose(position, random_rotation(turn, rng) @ tag.pose.rotation))


def square_of(truth: Camera, known: Camera, points: Array, rng: np.random.Generator) -> RefinedTag:
    """Observed corners of points in the camera frame, undistorted with the known lens."""
    pixels = seen_by(truth, points) + TAG_PX * rng.standard_normal((4, 2))
    undistorted = undistort_pixels(known, pixels)
    whitening = np.eye(8) / TAG_PX
    return RefinedTag(undistorted, whitening, whitening @ undistorted.ravel(), np.ones(4, bool))


def poses(rng: np.random.Generator) -> Iterator[Pose]:
    """Random poses of the platform in the workspace."""
    for _ in range(PICTURES):
        position = rng.uniform([-0.1, -0.1, 0.35], [0.15, 0.1, 0.55])
        yield Pose(position, random_rotation(np.radians(5.0), rng))


def step_between(found: Pose, truth: Pose) -> Array:
    """Shift [m] and rotation [rad] from the truth, world axes."""
    turn = rotation_vector_from_matrix(found.rotation @ truth.rotation.T)
    return np.concatenate([found.position - truth.position, turn])


def lens_error(found: CameraCalibration, truth: Camera) -> float:
    """RMS error of points at the distance over the image, after the best rotation, [m]."""
    # Centres of cells: the image border would count twice as much as the rest.
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
    """One lab with its ground truth.

    Args:
        rig: As in its file.
        scene: The obstacles.
        kind: Of the lab.
        rng: Source of all randomness.
    """

    def __init__(self, rig: Rig, scene: Scene, kind: Kind, rng: np.random.Generator) -> None:
        self._rig, self._scene, self._kind, self._rng = rig, scene, kind, rng
        self._truth = true_lens(rig.cameras[0], rng)

    def into(self, tally: Tally) -> None:
        """Calibrates and measures, and adds the results to the tally."""
        camera = self._lens(tally)
        camera = self._extrinsics(camera, tally)
        self._platform(camera, tally)

    def _lens(self, tally: Tally) -> Camera:
        views = board_views(self._truth, self._kind, self._rng)
        size = (self._truth.width, self._truth.height)
        found = calibrate_from_views(views, size, lens="five")
        m = self._truth.matrix
        numbers = [m[0, 0], m[1, 1], m[0, 2], m[1, 2], *self._truth.distortion]
        stated = list(found.intervals.values())
        tally.inside["camera parameters"] += [
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

    def _extrinsics(self, camera: Camera, tally: Tally) -> Camera:
        kind, rng = self._kind, self._rng
        turn = 2.0 * kind.survey / 0.12
        tags = floor_tags(kind.tags)
        there = self._truth.world_from_camera.inverse()
        squares = {}
        for tag in tags:
            true = moved_tag(tag, kind.survey, turn, rng)
            squares[tag.id] = square_of(self._truth, camera, there.apply(tag_corners(true)), rng)
        rig = replace(self._rig, frame_tags=tags)
        observations = TagObservations({"picture": squares}, {})
        found = locate_by_frame_tags(rig, camera, observations, Survey(kind.survey, turn))
        off = step_between(found.world_from_camera, self._truth.world_from_camera)
        tally.inside["extrinsics"] += (np.abs(off) <= found.half_widths).tolist()
        back = found.world_from_camera.apply(there.apply(found.points)) - found.points
        error = float(np.sqrt(np.mean(np.sum(back**2, axis=1))))
        tally.inside["pose's stated error"].append(error <= found.error)
        tally.errors["pose"].append(error)
        tally.judges["pose"].append(lambda w: judge_extrinsics(found, w).good)
        return replace(
            camera,
            world_from_camera=found.world_from_camera,
            pose_covariance=found.stated_covariance,
            pose_by_lens=found.by_lens,
        )

    def _platform(self, camera: Camera, tally: Tally) -> None:
        rig, rng = self._rig, self._rng
        # The stated corner error, 95 %, is half from a shift and half from a rotation of each tag.
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
        stated = replace(
            rig, tag_error=tag_error, outlet_error=float(ends[0]), anchor_error=float(ends[1])
        )
        models = ClearanceModel(stated, self._scene), ClearanceModel(built, self._scene)
        shared = SharedErrors(stated, camera)
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
    """Share of correct verdicts, as text and as a number."""
    level = float(np.quantile(tally.errors[name], 0.95))
    good = level <= wanted
    share = float(np.mean([judge(wanted) is good for judge in tally.judges[name]]))
    return (
        f"  verdict of the {name:7s} 95 % of errors < {level * 1e3:.3g} mm,"
        f" wanted {wanted * 1e3:.3g}: {'good' if good else 'not good'}, said in {share:.1%}",
        share,
    )


def wanted_of(kind: Kind, name: str, tally: Tally) -> Iterator[float]:
    """Limits to test: the kind's own, and close to both sides of the error level."""
    level = float(np.quantile(tally.errors[name], 0.95))
    yield from (kind.wanted(name), level * NEAR, level / NEAR)


def main() -> int:
    """Prints coverage by kind; returns 1 if anything is outside its limits."""
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
        for which in ("camera", "pose"):
            for wanted in wanted_of(kind, which, tally):
                line, share = verdict_line(which, tally, wanted)
                bad += share < 0.95
                print(line + ("" if share >= 0.95 else "  <--"), flush=True)
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
