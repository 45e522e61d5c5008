"""A camera's pose from the rig's own motion: platform tags observed at encoder poses.

With Z = world_from_camera, X = platform_from_tags, P the encoder pose and M = camera_from_tags,
Z M = P X in every image. X is known from the rig file up to a small error; motion without rotation
cannot separate it from Z, and then the rig file's X holds.

Source: Tsai & Lenz 1989; solved for both at once as in Zhuang & Shiu 1993, by least squares.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from calibration.extrinsics.result import (
    ExtrinsicCalibration,
    scaled_to,
    widths_of,
    workspace_corners,
)
from calibration.results import Issue
from calibration.tag_map.observations import TagObservations, platform_pose, platform_views
from model.cameras import Z_95
from model.errors import BadInput, InvalidFile, Problem
from model.files.csv_table import CsvTable
from model.pose import Array, Pose, moved, read_only
from model.rig import Camera, Rig
from tracking.shared_errors import moved_by_pixels, pixels_by_lens

LEAST_POSES = 8
"""Fewer poses do not show how accurate the rig's poses are."""
_LEAST_SPAN = 0.1
"""Required span of the positions along their longest axis, [m]."""
TAG_FRAME_DEVIATION = (1e-3, np.radians(0.5))
"""Standard deviation of the tags' frame from the rig file, [m] and [rad]."""
_FIRST = (1e-3, np.radians(0.2))
"""Initial standard deviation of encoder poses, [m] and [rad]; then from the residuals."""
_LEAST = (2e-5, np.radians(0.002))
_HUBER = 2.0
"""Errors beyond this many deviations count linearly."""
_PRIOR = 1.0 / np.repeat(TAG_FRAME_DEVIATION, 3)


@dataclass(frozen=True, slots=True, eq=False)
class _PoseObservation:
    """One image: encoder pose and camera pose; covariance in the camera's frame."""

    world_from_platform: Pose
    camera_from_tags: Pose
    covariance: Array
    corner_error: float
    numbers: tuple[int, ...]
    by_lens: Array  # (6, n), of camera_from_tags by the lens's parameters, camera axes


@dataclass(frozen=True, slots=True, eq=False)
class _Stack:
    """n observations as arrays."""

    encoder: Rotation  # n rotations world_from_platform
    encoder_position: Array  # (n, 3)
    camera: Rotation  # n rotations camera_from_tags
    camera_position: Array  # (n, 3)
    covariance: Array  # (n, 6, 6)

    @classmethod
    def of(cls, samples: Sequence[_PoseObservation]) -> _Stack:
        return cls(
            Rotation.from_matrix([s.world_from_platform.rotation for s in samples]),
            np.array([s.world_from_platform.position for s in samples]),
            Rotation.from_matrix([s.camera_from_tags.rotation for s in samples]),
            np.array([s.camera_from_tags.position for s in samples]),
            np.array([s.covariance for s in samples]),
        )

    def gaps(self, camera: Pose, tags: Pose) -> Array:
        """Tag poses from the encoders minus those from the camera, shape (n, 6), [m, rad]."""
        turn, own = Rotation.from_matrix(camera.rotation), Rotation.from_matrix(tags.rotation)
        there = self.encoder.apply(np.array(tags.position)) + self.encoder_position
        here = turn.apply(self.camera_position) + camera.position
        turns = (self.encoder * own) * (turn * self.camera).inv()
        return np.hstack([there - here, turns.as_rotvec()])

    def whitening(self, camera: Pose, noise: tuple[float, float]) -> Array:
        """Whitening of the gaps, shape (n, 6, 6); ``noise`` is that of the encoder poses."""
        turn = np.kron(np.eye(2), camera.rotation)
        of_encoder = np.diag(np.repeat(np.square(noise), 3))
        covariance = turn @ self.covariance @ turn.T + of_encoder
        return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))


@dataclass(frozen=True, slots=True, eq=False)
class _HandEyeFit:
    world_from_camera: Pose
    platform_from_tags: Pose
    slopes: Array  # (n, 6, 12), whitened and weighted
    errors: Array  # (n, 6), whitened and weighted
    whitening: Array  # (n, 6, 6), of the gaps, weighted

    @property
    def information(self) -> Array:
        """Information on both unknowns, shape (12, 12)."""
        flat = self.slopes.reshape(-1, 12)
        return np.asarray(flat.T @ flat + np.diag(np.concatenate([np.zeros(6), _PRIOR**2])))

    def without_each(self) -> list[Array]:
        """Changes of the camera's pose without each observation, to first order, shape (6,)."""
        whole = self.information
        return [
            np.linalg.solve(whole - slope.T @ slope, slope.T @ error)[:6]
            for slope, error in zip(self.slopes, self.errors, strict=True)
        ]

    def by_tags(self, shifts: Array) -> Array:
        """Change of the camera's pose with the tags' poses in the camera frame, to first order.

        Args:
            shifts: Of those poses by each of k causes, camera axes, shape (n, 6, k), [m, rad].

        Returns:
            Shift and rotation along the world's axes, shape (6, k).
        """
        turn = np.kron(np.eye(2), self.world_from_camera.rotation)
        causes = np.einsum("nji,njk->ik", self.slopes, self.whitening @ turn @ shifts)
        return np.asarray(np.linalg.solve(self.information, causes)[:6])


def locate_by_motion(
    rig: Rig, camera: Camera, observations: TagObservations, poses: Mapping[str, Pose]
) -> ExtrinsicCalibration:
    """Finds a camera's pose from images of the platform at known poses.

    Args:
        rig: Its platform tags.
        camera: Its matrix and distortion are taken as known; its pose in the rig file is not used.
        observations: Of platform tags.
        poses: ``world_from_platform`` at each image.

    Raises:
        BadInput: Too few images have a pose.
    """
    observations = observations.without_duplicates(camera)
    unknown = {name: "has no pose" for name in observations.squares if name not in poses}
    observations = observations.without(unknown)
    found = {
        name: _observe(rig, camera, observations, name, poses[name])
        for name in observations.squares
    }
    unsure = {name: "allows no unique pose" for name, one in found.items() if one is None}
    observations = observations.without(unsure)
    samples = [one for one in found.values() if one is not None]
    if len(samples) < 3:
        raise BadInput(
            f"{len(samples)} images show the platform at a known pose; at least 3 are required",
            where=f"camera {camera.name}",
            why="; ".join(f"{name} {why}" for name, why in list(observations.unused.items())[:4]),
            next_step="take images at more poses, and list each in the pose file",
        )
    best = _reweighted_fit(samples)
    scatter = np.asarray(np.linalg.inv(best.information))[:6, :6]
    covariance = scaled_to(scatter, widths_of(scatter, best.without_each()))
    by_lens = None
    if camera.lens_covariance is not None:
        by_lens = read_only(best.by_tags(np.array([one.by_lens for one in samples])))
        covariance = covariance + by_lens @ camera.lens_covariance @ by_lens.T
    return ExtrinsicCalibration(
        camera=replace(camera, world_from_camera=best.world_from_camera),
        by="rig motion",
        covariance=read_only(covariance),
        half_widths=read_only(Z_95 * np.sqrt(np.diag(covariance))),
        by_lens=by_lens,
        points=workspace_corners(rig),
        tag_errors=_tag_errors(samples),
        pictures=len(samples),
        unused=observations.unused,
        issues=tuple(_issues(samples)),
        data_hash=observations.data_hash(),
    )


def _observe(
    rig: Rig, camera: Camera, observations: TagObservations, name: str, pose: Pose
) -> _PoseObservation | None:
    squares = observations.squares[name]
    found = platform_pose(rig, camera, squares)
    if found is None:
        return None
    seen, views = found.camera_from_body, platform_views(rig, squares)
    by_lens = moved_by_pixels(camera, views, seen, pixels_by_lens(camera, views))
    return _PoseObservation(
        pose, seen, found.covariance, found.reprojection, tuple(squares), by_lens
    )


def _reweighted_fit(samples: Sequence[_PoseObservation]) -> _HandEyeFit:
    """The fit, with the noise of the encoder poses estimated from residuals."""
    guesses = [s.world_from_platform.compose(s.camera_from_tags.inverse()) for s in samples]
    middle = np.median([guess.position for guess in guesses], axis=0)
    start = min(guesses, key=lambda guess: float(np.linalg.norm(guess.position - middle)))
    stack = _Stack.of(samples)
    fit = _fit(stack, start, _FIRST)
    for _ in range(4):
        gaps = np.abs(stack.gaps(fit.world_from_camera, fit.platform_from_tags))
        noise = (
            max(float(1.4826 * np.median(gaps[:, :3])), _LEAST[0]),
            max(float(1.4826 * np.median(gaps[:, 3:])), _LEAST[1]),
        )
        fit = _fit(stack, fit.world_from_camera, noise)
    return fit


def _fit(stack: _Stack, start: Pose, noise: tuple[float, float]) -> _HandEyeFit:
    """Fits both unknowns with Huber's loss."""
    whitening = stack.whitening(start, noise)
    nominal = Pose.level(np.zeros(3))

    def own(x: Array) -> Array:
        gaps = stack.gaps(moved(start, x[:6]), moved(nominal, x[6:]))
        return np.asarray(np.einsum("nij,nj->ni", whitening, gaps))

    found = least_squares(
        lambda x: np.concatenate([own(x).ravel(), _PRIOR * x[6:]]),
        np.zeros(12),
        loss="huber",
        f_scale=_HUBER,
        x_scale=1e-3,
        xtol=1e-12,
    )
    x = found.x
    slopes = np.stack([(own(x + d) - own(x - d)) / 2e-6 for d in 1e-6 * np.eye(12)], axis=-1)
    errors = own(x)
    weight = np.sqrt(np.minimum(1.0, _HUBER / np.maximum(np.abs(errors), 1e-12)))
    return _HandEyeFit(
        moved(start, x[:6]),
        moved(nominal, x[6:]),
        slopes * weight[..., None],
        errors * weight,
        whitening * weight[..., None],
    )


def _tag_errors(samples: Sequence[_PoseObservation]) -> dict[int, float]:
    numbers = sorted({number for s in samples for number in s.numbers})
    return {
        number: float(np.sqrt(np.mean([s.corner_error**2 for s in samples if number in s.numbers])))
        for number in numbers
    }


def _issues(samples: Sequence[_PoseObservation]) -> list[Issue]:
    issues = []
    if len(samples) < LEAST_POSES:
        what = f"{len(samples)} poses were observed; {LEAST_POSES} are required"
        issues.append(Issue(what, "take images at more poses, far apart"))
    positions = np.array([s.world_from_platform.position for s in samples])
    span = float(np.ptp(positions, axis=0).max())
    if span < _LEAST_SPAN:
        what = f"all poses lie within {span * 1e3:.0f} mm; {_LEAST_SPAN * 1e3:.0f} mm are required"
        issues.append(Issue(what, "take images at more poses, far apart"))
    return issues


# CSV file of platform poses by image name, with units in its column names.


COLUMNS = ("picture", "x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz")
"""As in the pose log of `cdpr track`; other columns are ignored."""


def read_poses(path: Path) -> dict[str, Pose]:
    """Reads ``world_from_platform`` by image; rows without a pose are left out.

    Raises:
        BadInput: The file cannot be read, or a column or a value is missing.
        InvalidFile: With every invalid row.
    """
    table = CsvTable(path)
    table.require(COLUMNS)
    names, *columns = (table.texts(name) for name in COLUMNS)
    states = table.texts("status") if "status" in table.names else None
    poses: dict[str, Pose] = {}
    problems = []
    for row, (name, *values) in enumerate(zip(names, *columns, strict=True)):
        picture = Path(name).name
        kept = states is None or (picture and states[row] == "ok")
        if not kept or not any(values):  # a log's row without a pose, or without a kept image
            continue
        found = _pose(values)
        if isinstance(found, str):
            problems.append(Problem(picture, found, table.line(row), 1))
        elif not picture or picture in poses:
            what = "this image appears twice" if picture else "no image is named"
            problems.append(Problem(picture, what, table.line(row), 1))
        else:
            poses[picture] = found
    if problems:
        raise InvalidFile(str(path), problems)
    return poses


def _pose(values: list[str]) -> Pose | str:
    """The pose, or a message about what is wrong with it."""
    try:
        numbers = np.array([float(value) for value in values])
    except ValueError:
        return f"{', '.join(values)} are not seven numbers"
    if not all(map(math.isfinite, numbers)):
        return "a number is not finite"
    length = float(np.linalg.norm(numbers[3:]))
    if abs(length - 1.0) > 1e-3:
        return f"qw, qx, qy, qz must have length 1; the length is {length:.4g}"
    return Pose.from_quaternion(numbers[:3] / 1e3, numbers[3:] / length)
