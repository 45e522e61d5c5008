"""Where a camera stands, how sure that is, and what it is good for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np
from scipy.stats import t as student

from calibration.results import CalibrationVerdict, Issue
from calibration.statistics import CONFIDENCE, rms_bound
from model.cameras import SURE
from model.pose import Array, Pose, skew
from model.rig import Camera, Rig


@dataclass(frozen=True, slots=True, eq=False)
class ExtrinsicCalibration:
    """A camera's place in the world.

    Attributes:
        camera: The camera at its new place.
        by: ``frame tags``, ``rig motion`` or ``another camera``.
        covariance: Of position [m] and rotation vector [rad] along the world's axes, shape (6, 6).
        half_widths: Of the 95 % intervals of the same, shape (6,).
        by_lens: How errors of the lens's n numbers move the place, shape (6, n), [m, rad]; None
            where nothing is known of them.
        points: Places in the world that matter, shape (n, 3), [m].
        tag_errors: RMS corner error of each tag, by number, [px].
        pictures: How many images it rests on.
        unused: Why each of the others is not used, by name.
        lacks: What it lacks, beside precision.
        data_hash: Of what was seen.
    """

    camera: Camera
    by: Literal["frame tags", "rig motion", "another camera"]
    covariance: Array
    half_widths: Array
    by_lens: Array | None
    points: Array
    tag_errors: Mapping[int, float]
    pictures: int
    unused: Mapping[str, str]
    lacks: tuple[Issue, ...]
    data_hash: str

    @property
    def world_from_camera(self) -> Pose:
        """The pose."""
        return self.camera.world_from_camera

    @property
    def stated_covariance(self) -> Array:
        """The covariance whose 1.96 deviations are the half widths, shape (6, 6), [m, rad]."""
        deviations = np.sqrt(np.diag(self.covariance))
        return np.asarray(self.covariance * np.outer(*2 * [self.half_widths / SURE / deviations]))

    @property
    def error(self) -> float:
        """How far off points of the work space are seen, 95 %, RMS, [m]."""
        arms = self.points - self.world_from_camera.position
        slopes = np.concatenate([np.hstack([np.eye(3), -skew(arm)]) for arm in arms])
        return float(np.sqrt(3.0)) * rms_bound(self.stated_covariance, slopes)  # of all axes


def workspace_corners(rig: Rig) -> Array:
    """Corners of the box that the platform's origin keeps to, shape (8, 3), [m]."""
    ends = zip(rig.workspace_lower, rig.workspace_upper, strict=True)
    return np.array(list(product(*ends)))


def judge_extrinsics(result: ExtrinsicCalibration, wanted: float) -> CalibrationVerdict:
    """Judges a camera's place.

    Args:
        result: What was found.
        wanted: What is good enough, in the work space, [m].
    """
    lacks, error = list(result.lacks), result.error
    if not error <= wanted:
        more = "survey more tags, all around the camera's view"
        if result.by == "rig motion":
            more = "take images at more poses, far apart and rotated up to 20° in every direction"
        if result.by == "another camera":
            more = "take more pairs of images, and calibrate the other camera's extrinsics better"
        what = (
            f"points of the workspace are measured within {error * 1e3:.2g} mm;"
            f" {wanted * 1e3:.2g} mm are required"
        )
        lacks.append(Issue(what, more))
    return CalibrationVerdict.of(error, wanted, "in the workspace", lacks)


def widths_of(covariance: Array, without: Sequence[Array]) -> Array:
    """Half widths of 95 % intervals: by scatter, or by what leaving a part of the data out changes.

    Args:
        covariance: By the scatter, shape (k, k).
        without: Changes of the k numbers when each part is left out (the jackknife over parts).

    Returns:
        The larger of both, shape (k,).
    """
    by_scatter = SURE * np.sqrt(np.diag(covariance))
    count = len(without)
    if count < 3:
        return np.asarray(by_scatter)
    spread = np.array(without) - np.mean(without, axis=0)
    by_parts = np.sqrt((count - 1) / count * np.sum(spread**2, axis=0))
    quantile = float(student.ppf(0.5 + CONFIDENCE / 2.0, count - 1))
    return np.asarray(np.maximum(by_scatter, quantile * by_parts))
