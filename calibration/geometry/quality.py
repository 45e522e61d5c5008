"""What a rig's calibration is good for, and what to do where it is not."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product

import numpy as np

from calibration.geometry.calibrate import RigCalibration
from calibration.geometry.stiffness import compliance_told, differences_told
from calibration.statistics import CONFIDENCE
from calibration.verdict import CalibrationVerdict, Issue
from model.pose import Array, matrix_from_rotation_vector
from model.rig import Rig

FAR = 5.0
"""No number should be farther from the rig file, in the standard deviations that were stated."""
_INSET = 0.15
"""The workspace is judged at its centre and this share inside its corners."""


@dataclass(frozen=True, slots=True)
class RigQuality:
    """How good a rig's calibration is.

    Attributes:
        verdict: Of all of it.
        before: How far off places are by the rig file, RMS, [m].
        held_out: By fits that did not see them, RMS, [m].
        level: How far off the platform may be at the orientation of home, 95 %, [m].
        turned: Turned by `tilt`, 95 %, [m].
        tilt: About any horizontal axis, [rad].
    """

    verdict: CalibrationVerdict
    before: float
    held_out: float
    level: float
    turned: float
    tilt: float


def judge_rig(result: RigCalibration, wanted: float, tilt: float) -> RigQuality:
    """The verdict.

    Args:
        result: What was found.
        wanted: What is good enough, 95 %, [m].
        tilt: By how much the platform will be turned from its orientation at home, [rad].
    """
    level = float(result.position_error(*judged_places(result.rig, 0.0)).max())
    turned = float(result.position_error(*judged_places(result.rig, tilt)).max()) if tilt else level
    out = result.held_out
    missed = float(np.quantile(out.after, CONFIDENCE))
    before, after = (float(np.sqrt(np.mean(e**2))) for e in (out.before, out.after))
    lacks = _far_numbers(result) + _other_stiffness(result) + _unknown_stretch(result)
    if missed > wanted:
        what = "samples" if out.poses else "cable lengths of samples"
        lacks.append(
            Issue(
                f"errors of held-out {what} reach {missed * 1e3:.2g} mm",
                "calibrate the camera and its pose, and check for worn guides, slack cables and"
                " outliers in the report's list of poses",
            )
        )
    if after > before:
        lacks.append(
            Issue(
                f"the rig file without calibration fits better ({before * 1e3:.2g} mm)",
                "check units, the order of the cables and the homing of the drives",
            )
        )
    if level > wanted:
        lacks.append(
            Issue(
                f"the platform may be {level * 1e3:.2g} mm off between the measured poses",
                "measure at more poses all over the workspace"
                + ("" if out.poses else ", and with a camera"),
            )
        )
    if turned > max(wanted, level):
        lacks.append(
            Issue(
                f"rotated by {math.degrees(tilt):.3g}° it may be {turned * 1e3:.2g} mm off",
                f"measure with the platform rotated by {math.degrees(tilt):.3g}° and more both ways"
                " (`cdpr calibrate poses` plans it), or pass --tilt-deg 0 if it never rotates",
            )
        )
    error = max(missed, level, turned)
    verdict = CalibrationVerdict.of(
        error, wanted, f"rotated by up to {math.degrees(tilt):.3g}°", lacks
    )
    return RigQuality(verdict, before, after, level, turned, tilt)


def _far_numbers(result: RigCalibration) -> list[Issue]:
    """The number farthest from the rig file, where it is too far to be believed."""
    parameters, values = result.parameters, result.fit.values
    times = np.abs(values) / parameters.deviations
    k = int(np.argmax(times))
    if times[k] <= FAR:
        return []
    group = next(g for g, place in parameters.slices().items() if place.start <= k < place.stop)
    share = group in ("drum_scale", "stiffness")
    option = f"--{group.replace('_', '-')}-{'percent' if share else 'mm'}"
    return [
        Issue(
            f"{parameters.names[k]} is {_far(group, float(values[k]))},"
            f" {times[k]:.3g} times {option}",
            "check units, the order of the cables and the rig file; if it is truly that far"
            f" off, pass a larger {option}",
        )
    ]


def _far(group: str, value: float) -> str:
    """How far a number is from the rig file, in words; of a stiffness it is the logarithm."""
    if group == "stiffness":
        return f"{math.exp(value):.3g} times that of the rig file, as a logarithm"
    if group == "drum_scale":
        return f"{abs(value) * 1e2:.3g} % from the rig file"
    return f"{abs(value) * 1e3:.3g} mm from the rig file"


def _other_stiffness(result: RigCalibration) -> list[Issue]:
    compliance = compliance_told(result)
    if compliance is None:
        return []
    if not compliance.contradicts:
        return _cables_that_differ(result)
    return [
        Issue(
            f"the data give a cable stiffness of {compliance}, the rig file"
            f" {result.rig.cable_stiffness:.6g} N",
            "check cables: stiffness_n of the rig file, and the measured tensions;"
            " if it is truly that far off, pass a larger --stiffness-percent",
        )
    ]


def _cables_that_differ(result: RigCalibration) -> list[Issue]:
    differences = differences_told(result)
    if differences is None or not differences.contradict:
        return []
    return [
        Issue(
            f"the cables differ: the data give stiffnesses of {differences}; the result has"
            f" {result.geometry.stiffness:.4g} N for all",
            "check for a cable that is worn, loose on its drum or of another kind, and check its"
            " measured tensions",
        )
    ]


def _unknown_stretch(result: RigCalibration) -> list[Issue]:
    """Tensions that were not measured and matter: they err alike in many places."""
    usual = result.length_deviation
    stretch = float(np.sqrt(np.max(result.fit.deviations**2) - usual**2))
    if stretch <= usual:
        return []
    places = int((~np.isfinite(result.measured.tensions)).any(axis=1).sum())
    return [
        Issue(
            f"tensions were not measured at {places} poses, which makes cable lengths"
            f" uncertain by {stretch * 1e3:.2g} mm; --length-mm is {usual * 1e3:.2g}",
            "measure tensions as well: use run folders, or tables with the columns tension_1_n …",
        )
    ]


def judged_places(rig: Rig, tilt: float) -> tuple[Array, Array]:
    """Centre and corners of the workspace, turned about x and y both ways.

    Args:
        rig: As in its file.
        tilt: How far, [rad]; 0 for the orientation of home alone.

    Returns:
        Positions, shape (k, 3), [m], and rotations, shape (k, 3, 3).
    """
    centre = (rig.workspace_lower + rig.workspace_upper) / 2.0
    half = (0.5 - _INSET) * (rig.workspace_upper - rig.workspace_lower)
    corners = np.array(list(product((-1.0, 1.0), repeat=3))) * half
    positions = centre + np.concatenate([np.zeros((1, 3)), corners])
    axes = [(1, 0), (-1, 0), (0, 1), (0, -1)] if tilt else [(0, 0)]
    turns = [matrix_from_rotation_vector((tilt * x, tilt * y, 0.0)) for x, y in axes]
    rotations = np.array(turns) @ rig.home.rotation
    pairs = list(product(range(len(positions)), range(len(rotations))))
    return (
        np.array([positions[i] for i, _ in pairs]),
        np.array([rotations[j] for _, j in pairs]),
    )
