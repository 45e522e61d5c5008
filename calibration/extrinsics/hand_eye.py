"""A camera's pose from the rig's own motion: the platform's tags seen at encoder poses.

With Z = world_from_camera, X = the tags' frame in the platform's, P the encoder pose
and M the tags' pose in the camera's frame, Z M = P X at every image. X is known from the rig file
up to a small error; motion without rotation cannot separate it from Z, and then the rig file holds.

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

from calibration.extrinsics.result import ExtrinsicCalibration, widths_of, workspace_corners
from calibration.results import Issue
from calibration.tag_map.observations import TagObservations, platform_pose
from model.errors import BadInput, InvalidFile, Problem
from model.files.reading import CsvFile
from model.pose import Array, Pose, read_only
from model.rig import Camera, Rig
from tracking.pnp import moved

LEAST_POSES = 8
"""Fewer poses do not show how accurate the rig's poses are."""
_LEAST_SPAN = 0.1
"""Along the axis of the largest, [m]."""
DRAWING = (1e-3, np.radians(0.5))
"""Deviation of the tags' frame from the rig file, [m] and [rad]."""
_FIRST = (1e-3, np.radians(0.2))
"""Of encoder poses, to begin with; then as the residuals say."""
_LEAST = (2e-5, np.radians(0.002))
_HUBER = 2.0
"""Errors beyond this many deviations count linearly."""
_PRIOR = 1.0 / np.repeat(DRAWING, 3)


@dataclass(frozen=True, slots=True, eq=False)
class _CameraLook:
    """One image: encoder pose and camera pose; covariance in the camera's frame."""

    world_from_platform: Pose
    camera_from_tags: Pose
    covariance: Array
    corner_error: float
    numbers: tuple[int, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Stack:
    """All looks as arrays, for n of them."""

    told: Rotation  # n rotations world_from_platform
    told_position: Array  # (n, 3)
    seen: Rotation  # n rotations camera_from_tags
    seen_position: Array  # (n, 3)
    covariance: Array  # (n, 6, 6)

    @classmethod
    def of(cls, looks: Sequence[_CameraLook]) -> _Stack:
        return cls(
            Rotation.from_matrix([look.world_from_platform.rotation for look in looks]),
            np.array([look.world_from_platform.position for look in looks]),
            Rotation.from_matrix([look.camera_from_tags.rotation for look in looks]),
            np.array([look.camera_from_tags.position for look in looks]),
            np.array([look.covariance for look in looks]),
        )

    def gaps(self, camera: Pose, tags: Pose) -> Array:
        """From where the camera sees the tags to where the drives put them, (n, 6), [m, rad]."""
        turn, own = Rotation.from_matrix(camera.rotation), Rotation.from_matrix(tags.rotation)
        there = self.told.apply(np.array(tags.position)) + self.told_position
        here = turn.apply(self.seen_position) + camera.position
        turns = (self.told * own) * (turn * self.seen).inv()
        return np.hstack([there - here, turns.as_rotvec()])

    def whitening(self, camera: Pose, noise: tuple[float, float]) -> Array:
        """Of the gaps, shape (n, 6, 6); ``noise`` is that of the drives' poses."""
        turn = np.kron(np.eye(2), camera.rotation)
        told = np.diag(np.repeat(np.square(noise), 3))
        covariance = turn @ self.covariance @ turn.T + told
        return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))


@dataclass(frozen=True, slots=True, eq=False)
class _HandEyeFit:
    world_from_camera: Pose
    platform_from_tags: Pose
    slopes: Array  # (n, 6, 12), whitened and weighted
    errors: Array  # (n, 6), likewise

    @property
    def information(self) -> Array:
        """Of both unknowns, shape (12, 12)."""
        flat = self.slopes.reshape(-1, 12)
        return np.asarray(flat.T @ flat + np.diag(np.concatenate([np.zeros(6), _PRIOR**2])))

    def without_each(self) -> list[Array]:
        """How the camera's place changes without each look, to first order, shape (6,) each."""
        whole = self.information
        return [
            np.linalg.solve(whole - slope.T @ slope, slope.T @ error)[:6]
            for slope, error in zip(self.slopes, self.errors, strict=True)
        ]


def locate_by_motion(
    rig: Rig, camera: Camera, observations: TagObservations, poses: Mapping[str, Pose]
) -> ExtrinsicCalibration:
    """Finds a camera's place from images of the platform at known poses.

    Args:
        rig: Its platform tags.
        camera: Its matrix and distortion hold; its place in the rig file does not matter.
        observations: Of platform tags.
        poses: ``world_from_platform`` at each image, from the rig's file of poses.

    Raises:
        BadInput: Too few images have a pose.
    """
    observations = observations.without_duplicates()
    unknown = {name: "has no pose" for name in observations.squares if name not in poses}
    observations = observations.without(unknown)
    found = {
        name: _look(rig, camera, observations, name, poses[name]) for name in observations.squares
    }
    unsure = {name: "allows no unique pose" for name, look in found.items() if look is None}
    observations = observations.without(unsure)
    looks = [look for look in found.values() if look is not None]
    if len(looks) < 3:
        raise BadInput(
            f"{len(looks)} images show the platform at a known pose; at least 3 are required",
            where=f"camera {camera.name}",
            why="; ".join(f"{name} {why}" for name, why in list(observations.unused.items())[:4]),
            next_step="take images at more poses, and list each in the pose file",
        )
    best = _settled(looks)
    covariance: Array = np.asarray(np.linalg.inv(best.information))[:6, :6]
    return ExtrinsicCalibration(
        camera=replace(camera, world_from_camera=best.world_from_camera),
        by="rig motion",
        covariance=read_only(covariance),
        half_widths=read_only(widths_of(covariance, best.without_each())),
        by_lens=None,
        points=workspace_corners(rig),
        tag_errors=_tag_errors(looks),
        pictures=len(looks),
        unused=observations.unused,
        issues=tuple(_lacks(looks)),
        data_hash=observations.data_hash(),
    )


def _look(
    rig: Rig, camera: Camera, observations: TagObservations, name: str, pose: Pose
) -> _CameraLook | None:
    squares = observations.squares[name]
    found = platform_pose(rig, camera, squares)
    if found is None:
        return None
    return _CameraLook(
        pose, found.camera_from_body, found.covariance, found.reprojection, tuple(squares)
    )


def _settled(looks: Sequence[_CameraLook]) -> _HandEyeFit:
    """The fit, weighted by how well the drives' poses turn out to hold."""
    guesses = [look.world_from_platform.compose(look.camera_from_tags.inverse()) for look in looks]
    middle = np.median([guess.position for guess in guesses], axis=0)
    start = min(guesses, key=lambda guess: float(np.linalg.norm(guess.position - middle)))
    stack = _Stack.of(looks)
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
    """Both unknowns; an image far off counts less (Huber)."""
    whitening = stack.whitening(start, noise)
    at_drawing = Pose.level(np.zeros(3))

    def own(x: Array) -> Array:
        gaps = stack.gaps(moved(start, x[:6]), moved(at_drawing, x[6:]))
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
        moved(at_drawing, x[6:]),
        slopes * weight[..., None],
        errors * weight,
    )


def _tag_errors(looks: Sequence[_CameraLook]) -> dict[int, float]:
    numbers = sorted({number for look in looks for number in look.numbers})
    return {
        number: float(
            np.sqrt(np.mean([look.corner_error**2 for look in looks if number in look.numbers]))
        )
        for number in numbers
    }


def _lacks(looks: Sequence[_CameraLook]) -> list[Issue]:
    issues = []
    if len(looks) < LEAST_POSES:
        what = f"{len(looks)} poses were seen; {LEAST_POSES} are required"
        issues.append(Issue(what, "take images at more poses, far apart"))
    places = np.array([look.world_from_platform.position for look in looks])
    span = float(np.ptp(places, axis=0).max())
    if span < _LEAST_SPAN:
        what = f"all poses lie within {span * 1e3:.0f} mm; {_LEAST_SPAN * 1e3:.0f} mm are required"
        issues.append(Issue(what, "take images at more poses, far apart"))
    return issues


# Poses of the platform by the names of images, from a CSV file with units in its columns.


COLUMNS = ("picture", "x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz")
"""As in the pose log of `cdpr track`; other columns are not looked at."""


def read_poses(path: Path) -> dict[str, Pose]:
    """Reads ``world_from_platform`` by image; rows without a pose are left out.

    Raises:
        BadInput: The file cannot be read.
        InvalidFile: With every row that cannot be used.
    """
    file = CsvFile(path)
    header = file.rows[0] if file.rows else []
    if missing := [name for name in COLUMNS if name not in header]:
        raise InvalidFile(str(path), [Problem("", f"no column {', '.join(missing)}", 1, 1)])
    poses: dict[str, Pose] = {}
    problems = []
    for line, row in zip(file.lines[1:], file.rows[1:], strict=True):
        texts = dict(zip(header, row, strict=False))
        picture = Path(texts.get("picture", "")).name
        values = [texts.get(name, "").strip() for name in COLUMNS[1:]]
        if not any(values):  # as of an image that gave no pose
            continue
        found = _pose(values)
        if isinstance(found, str):
            problems.append(Problem(picture, found, line, 1))
        elif not picture or picture in poses:
            what = "this image appears twice" if picture else "no image is named"
            problems.append(Problem(picture, what, line, 1))
        else:
            poses[picture] = found
    if problems:
        raise InvalidFile(str(path), problems)
    return poses


def _pose(values: list[str]) -> Pose | str:
    """The pose, or what is wrong with it."""
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
