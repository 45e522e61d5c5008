"""Quality of a rig calibration: verdict, reasons and next steps.

This includes whether the data contradict the rig file's stiffness, or one stiffness for all
cables: one step of the fit with the compliance (1 / stiffness) as a further parameter without a
prior, all others and the poses eliminated. Only a wrong stiffness makes residuals grow with both
tension and length. The other parameters would absorb a part of it, which makes their intervals too
narrow. Where the stiffness is among the parameters, its prior counts too.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from calibration.geometry.calibrate import MOST_SCATTER, RigCalibration, workspace_poses
from calibration.geometry.identifiability import ALL_OR_NONE, LEAST_SHARE
from calibration.geometry.model import RigModel
from calibration.geometry.parameters import (
    CableCompliances,
    Compliance,
    common_changes,
    deviation_text,
    option_of,
)
from calibration.results import CalibrationVerdict, Issue, beyond
from calibration.statistics import CONFIDENCE
from model.pose import Array


def estimate_compliance(result: RigCalibration) -> Compliance | None:
    """Estimates the compliance; None where tensions are missing, or the data do not determine it.

    Args:
        result: The fit with the rig file's stiffness.
    """
    found = _compliance_changes(result, np.ones((result.rig.cable_count, 1)))
    if found is None:
        return None
    (change,), covariance = found
    nominal = float(_nominal_compliance(result).mean())
    compliance = float(np.mean(1.0 / result.rig.cable_stiffness))
    deviation = float(covariance[0, 0]) ** 0.5
    return Compliance(nominal * compliance, (nominal + change) * compliance, deviation * compliance)


def estimate_cable_compliances(result: RigCalibration) -> CableCompliances | None:
    """Estimates each cable's compliance; None as for `estimate_compliance`.

    Args:
        result: The fit with one stiffness for all cables.
    """
    cables = result.rig.cable_count
    found = _compliance_changes(result, np.eye(cables))
    if found is None:
        return None
    change, covariance = found
    chance = float(chdtrc(cables, change @ np.linalg.solve(covariance, change)))
    estimated: Array = (_nominal_compliance(result) + change) / result.rig.cable_stiffness
    return CableCompliances(estimated, chance)


def _nominal_compliance(result: RigCalibration) -> Array:
    """Relative compliances of the rig file, linearised about the fit, shape (m,).

    Changes are solved about the fit, whose unknown is the logarithm of the stiffness: the rig
    file's deviation follows the tangent there, not the reciprocal of its own value.
    """
    ratio = result.geometry.stiffness / result.rig.cable_stiffness
    shares: Array = (1.0 + np.log(ratio)) / ratio
    return shares


_ROUND_OFF = 1e-9
"""Information below this share of that with all else known is round-off."""


def _compliance_changes(result: RigCalibration, groups: Array) -> tuple[Array, Array] | None:
    """Changes of compliances, relative to the rig file's, that the data ask for.

    With u the unknowns of the fit, c the compliances and the poses eliminated, one step solves

        N_uu du + N_uc dc = 0    (the fit has settled)
        N_cu du + N_cc dc = −p   (p: half the gradient of the squares by c)

    so S dc = −p with S = N_cc − N_cu N_uu⁻¹ N_uc, and the covariance of dc is S⁻¹.

    Args:
        groups: 1 where a cable is in a group of one compliance, shape (m, q).

    Returns:
        Changes, shape (q,), and their covariance, shape (q, q), bias by errors of the tensions
        included; None where tensions are missing in some samples, or the information is round-off,
        as with six lengths and no pose, which fit any compliance.
    """
    if not np.isfinite(result.measured.tensions).all():
        return None
    information, gradient, with_all_known = _compliance_information(result, groups)
    r = len(information) - groups.shape[1]
    by_free = np.linalg.solve(information[:r, :r], information[:r, r:])
    schur = information[r:, r:] - information[r:, :r] @ by_free
    scale = np.sqrt(with_all_known)
    if not scale.all() or np.linalg.eigvalsh(schur / np.outer(scale, scale))[0] < _ROUND_OFF:
        return None
    change = -np.asarray(np.linalg.solve(schur, gradient))
    covariance = result.uncertainty.scatter * np.linalg.inv(schur)
    # Bias by errors of the tensions, from the squares that these changes leave.
    squares, nominal = result.uncertainty.tension_squares, _nominal_compliance(result)
    left = max(1.0 + float(gradient @ change) / squares.sum(), 0.0) if squares.any() else 0.0
    by_share = left * squares / np.maximum(nominal + groups @ change, LEAST_SHARE * nominal)
    by_logarithm = by_share * result.rig.cable_stiffness / result.geometry.stiffness
    free_scores = result.observability.known.T @ result.parameters.tension_scores(by_logarithm)
    biased = np.linalg.solve(schur, groups.T @ by_share + by_free.T @ free_scores) * ALL_OR_NONE
    # Errors of tensions only make cables seem stiffer.
    explained = np.where(change < 0.0, biased, 0.0)
    return change, covariance + np.outer(explained, explained)


def _compliance_information(result: RigCalibration, groups: Array) -> tuple[Array, Array, Array]:
    """Information on the fit's r unknowns and q compliances, the poses eliminated.

    Args:
        groups: 1 where a cable is in a group of one compliance, shape (m, q).

    Returns:
        The information, shape (r + q, r + q), prior of the unknowns included; half the gradient of
        the squares by the compliances, shape (q,); the information on each of them with all else
        known, shape (q,).
    """
    data, fit, parameters = result.measured, result.fit, result.parameters
    model = RigModel(parameters, data)
    line = model.linearised(fit.values, fit.positions, fit.rotations)
    by_shares = -model.counted.by_compliance(result.geometry) / result.rig.cable_stiffness
    by_compliance = np.zeros((*line.residuals.shape, groups.shape[1]))
    by_compliance[:, : result.rig.cable_count] = by_shares[..., None] * groups
    free = parameters.deviations[:, None] * result.observability.known
    by_all = np.concatenate([line.by_values @ free, by_compliance], axis=2)
    weights = fit.weights / fit.deviations**2
    weighted = weights[..., None] * line.by_pose
    poses = np.swapaxes(line.by_pose, 1, 2) @ weighted
    poses += data.pose_information(fit.rotations)
    mixed = np.swapaxes(by_all, 1, 2) @ weighted
    gained = np.linalg.solve(poses, np.swapaxes(mixed, 1, 2))
    information = np.einsum("nmp,nm,nmq->pq", by_all, weights, by_all)
    information -= np.einsum("npi,niq->pq", mixed, gained)
    information[: free.shape[1], : free.shape[1]] += np.eye(free.shape[1])
    gradient = np.einsum("nmq,nm,nm->q", by_compliance, weights, fit.residuals)
    with_all_known = np.einsum("nmp,nm,nmp->p", by_compliance, weights, by_compliance)
    return information, gradient, with_all_known


# The verdict.


FAR = 5.0
"""Largest credible deviation from the rig file, in stated standard deviations."""
SCATTERED = 2.0
"""Largest acceptable scatter of a sensor or of measured poses, in stated standard deviations."""
_SCALE = (
    "the scale of the measured positions: the tracker's units and reflector (--reflector-mm, in"
    " Python reflector=), the camera matrix, size_mm of the tags"
)
"""What to check where the whole rig seems to be of another size."""
_FRAME = (
    "whether the measured poses are in the world frame of the rig file: the camera's pose, or the"
    " tracker's frame and reflector (--reflector-mm, in Python reflector=)"
)
"""What to check where outlets seem to have moved together."""
CHECK_POSES = (
    "the measured poses (positions of the platform's origin, or of the point that --reflector-mm,"
    " in Python reflector=, states; qw first, by world_from_platform; in the rows of their counts)"
)
"""What to check where measured poses contradict the cables grossly."""
_COMMON = (
    "calibrate the camera's lens, its pose and the tags more accurately, and pass their error as"
    " --pose-mm and --pose-deg, in Python pose_deviations=: all measured poses share it, so more of"
    " them do not help"
)
"""Next step where errors common to all measured poses are the larger part."""
_TENSIONS = (
    "measure tensions with smaller errors (friction, gears, gains that differ), or with the"
    " platform rotated, since their errors make the cables seem too stiff; or enter a measured"
    " stiffness_n in the rig file and pass --known stiffness, in Python leave stiffness out of"
    " deviations="
)
"""Next step where errors of measured tensions are the larger part."""


def _shared_cause(error: float, common: float, by_tensions: float) -> str | None:
    """Next step if an error is mostly shared by all poses; parts as by `position_errors`."""
    if max(common, by_tensions) ** 2 <= 0.5 * error**2:
        return None
    return _COMMON if common > by_tensions else _TENSIONS


@dataclass(frozen=True, slots=True)
class RigQuality:
    """Quality of a rig's calibration.

    Attributes:
        verdict: On the calibration as a whole.
        before: Error of samples with the rig file, RMS, [m].
        held_out: Error of held-out samples, RMS, [m].
        level: Position error of the platform in the orientation of home, 95 %, [m].
        rotated: The same, rotated by `tilt`, 95 %, [m].
        tilt: About any horizontal axis, [rad].
    """

    verdict: CalibrationVerdict
    before: float
    held_out: float
    level: float
    rotated: float
    tilt: float

    def facts(self, found: RigCalibration) -> list[tuple[str, str]]:
        """Human-readable details beside the estimates."""
        what = "positions" if found.held_out.poses else "cables"
        facts = [
            (
                "held out",
                f"{what} RMS error at held-out samples {self.held_out * 1e3:.3f} mm;"
                f" with the rig file {self.before * 1e3:.3f} mm; {len(found.measured)} samples",
            ),
            (
                "in the workspace",
                f"within {self.level * 1e3:.2g} mm, rotated within {self.rotated * 1e3:.2g} mm"
                " (95 %)",
            ),
        ]
        return facts + [("not identified", line) for line in found.not_identified]


def judge_rig(result: RigCalibration, wanted: float, tilt: float) -> RigQuality:
    """The verdict.

    Args:
        wanted: Required error, 95 %, [m].
        tilt: Largest rotation of the platform from its orientation at home, [rad].
    """
    at_level, at_tilt = (
        [float(e.max()) for e in result.position_errors(*workspace_poses(result.rig, angle))]
        for angle in (0.0, tilt)
    )
    level, rotated, out = at_level[0], at_tilt[0], result.held_out
    missed = float(np.quantile(out.after, CONFIDENCE))
    before, after = (float(np.sqrt(np.mean(e**2))) for e in (out.before, out.after))
    issues = [
        *_deviation_issues(result),
        *_common_issues(result),
        *_stiffness_issues(result),
        *_tension_issues(result),
        *_sensor_issues(result),
        *_pose_issues(result),
        *_held_out_issues(out.poses, missed, wanted, before, after, max(level, rotated)),
        *_position_issues(result, at_level, at_tilt, wanted, tilt),
    ]
    error = max(missed, level, rotated)
    verdict = CalibrationVerdict.of(
        error, wanted, f"rotated by up to {math.degrees(tilt):.3g}°", issues
    )
    if verdict.good and after >= before:
        step = (
            f"keep the rig file: with it, held-out samples are {before * 1e3:.2g} mm off, with this"
            f" calibration {after * 1e3:.2g} mm (RMS)"
        )
        verdict = replace(verdict, next_steps=(step,))
    return RigQuality(verdict, before, after, level, rotated, tilt)


def _deviation_issues(result: RigCalibration) -> Iterator[Issue]:
    """An issue if the parameter farthest from the rig file is not credible."""
    parameters, values = result.parameters, result.fit.values
    times = np.abs(values) / parameters.deviations
    k = int(np.argmax(times))
    if times[k] <= FAR:
        return
    group = next(g for g, s in parameters.slices().items() if s.start <= k < s.stop)
    option = option_of(group)
    yield Issue(
        f"{parameters.names[k]} is {deviation_text(group, float(values[k]))},"
        f" {times[k]:.3g} times {option}",
        "check units, the order of the cables and the rig file; if it is truly that far"
        f" off, pass a larger {option}",
    )


def _common_issues(result: RigCalibration) -> Iterator[Issue]:
    """Issues for changes that outlets and drums share, which residuals do not show."""
    found = result.uncertainty
    covariance = found.by_scatter + found.common @ found.common.T
    changes, covariance = common_changes(result.parameters, result.fit.values, covariance)
    scale, sizes = changes[6] * 1e2, [float(np.linalg.norm(changes[k : k + 3])) for k in (0, 3)]
    compared = f"{abs(scale):.2g} % {'larger' if scale > 0.0 else 'smaller'}"
    cases = (
        (slice(6, 7), f"outlets and drums give a rig {compared} than its file", _SCALE),
        (slice(3, 6), f"all outlets are rotated together by {math.degrees(sizes[1]):.2g}°", _FRAME),
        (slice(0, 3), f"all outlets are displaced together by {sizes[0] * 1e3:.3g} mm", _FRAME),
    )
    for part, what, check in cases:
        own = changes[part]
        times = math.sqrt(own @ np.linalg.solve(covariance[part, part], own))
        if times > FAR:
            reason = f"{what}, {times:.3g} standard deviations"
            step = (
                f"check {check}; if the rig file is truly that far off, pass a larger --outlets-mm,"
                " in Python outlets in deviations="
            )
            yield Issue(reason, step)


def _stiffness_issues(result: RigCalibration) -> Iterator[Issue]:
    compliance = estimate_compliance(result)
    if compliance is None or "cable_stiffness" in result.parameters.groups:
        return
    if compliance.contradicts:
        yield Issue(
            f"the data give a cable stiffness of {compliance}, the rig file"
            f" {result.rig.cable_stiffness.mean():.6g} N",
            "check cables: stiffness_n of the rig file, and the measured tensions;"
            " if it is truly that far off, pass a larger --stiffness-percent, in Python"
            " stiffness in deviations=",
        )
    else:
        yield from _difference_issues(result)


def _difference_issues(result: RigCalibration) -> Iterator[Issue]:
    differences = estimate_cable_compliances(result)
    if differences is None or not differences.contradict:
        return
    yield Issue(
        f"the cables differ: the data give stiffnesses of {differences}; the result has"
        f" {result.geometry.stiffness.mean():.4g} N for all",
        "check for a cable that is worn, loose on its drum or of another kind, and check its"
        " measured tensions; if they truly differ, pass --stiffness-per-cable, in Python"
        " cable_stiffness in deviations=",
    )


def _tension_issues(result: RigCalibration) -> Iterator[Issue]:
    """An issue if missing tensions matter: their errors are correlated between samples."""
    usual = result.length_deviation
    lengths = result.fit.deviations[:, : result.rig.cable_count]
    stretch = float(np.sqrt(np.max(lengths**2) - usual**2))
    if stretch <= usual:
        return
    missing = int((~np.isfinite(result.measured.tensions)).any(axis=1).sum())
    yield Issue(
        f"tensions were not measured at {missing} poses, which makes cable lengths"
        f" uncertain by {stretch * 1e3:.2g} mm; with measured tensions it is"
        f" {usual * 1e3:.2g} mm",
        "measure tensions as well: use run folders, or tables with the columns tension_1_n …",
    )


def _sensor_issues(result: RigCalibration) -> Iterator[Issue]:
    """An issue if sensors scatter more than stated, as with a wrong pulley axis."""
    fit, m = result.fit, result.rig.cable_count
    times = fit.sensor_rms / fit.deviations[:, m:].min(axis=0)
    bad = np.flatnonzero(times > SCATTERED)
    if not len(bad):
        return
    names = ", ".join(fit.sensors[k] for k in bad)
    yield Issue(
        f"residuals of {names} are up to {times[bad].max():.2g} times their stated deviation",
        "check feed_directions in the rig file and the axes of the IMU (--imu-mounting-deg"
        " finds its mounting), or pass a larger --swivel-deg or --imu-deg; in Python"
        " imu_mounting in deviations=, swivel_deviation= and imu_deviation=",
    )


def _pose_issues(result: RigCalibration) -> Iterator[Issue]:
    """An issue for measured positions or rotations that scatter more than stated."""
    by_camera = bool(result.rig.cameras)
    causes = ["the camera's lens, the layout of the tags"] if by_camera else []
    if not by_camera or result.pose_scales.max() > MOST_SCATTER:
        causes.insert(0, CHECK_POSES)
    step = (
        f"check {', '.join(causes)} and the stated errors of the poses, or pass a larger --pose-mm"
        " or --pose-deg, in Python pose_deviations="
    )
    for what, times in zip(("positions", "rotations"), result.pose_scales, strict=True):
        if times > SCATTERED:
            yield Issue(f"the measured {what} scatter {times:.3g} times as much as stated", step)


def _held_out_issues(
    has_poses: bool, missed: float, wanted: float, before: float, after: float, stated: float
) -> Iterator[Issue]:
    """Issues for held-out samples: their error, and the RMS with the rig file and after; [m]."""
    if missed > wanted:
        what = "samples" if has_poses else "cable lengths of samples"
        yield Issue(
            f"errors of held-out {what} reach {beyond(missed, wanted)}",
            "calibrate the camera and its pose, and check for worn guides, slack cables, errors"
            " of measured tensions and outliers in the report's list of poses",
        )
    # A fit to noise is worse than a rig file that is right, by no more than the fit states.
    if math.sqrt(max(after**2 - before**2, 0.0)) > stated:
        yield Issue(
            f"the rig file without calibration fits better ({before * 1e3:.2g} mm)",
            "check units, the order of the cables and the homing of the drives",
        )


def _position_issues(
    result: RigCalibration,
    at_level: Sequence[float],
    at_tilt: Sequence[float],
    wanted: float,
    tilt: float,
) -> Iterator[Issue]:
    """Issues for the platform's position; errors and their parts as for `_shared_cause`."""
    level, rotated = at_level[0], at_tilt[0]
    if level > wanted:
        yield Issue(
            f"between the measured poses, the platform may be off by {beyond(level, wanted)}",
            _shared_cause(*at_level)
            or "measure at more poses all over the workspace"
            + ("" if result.held_out.poses else ", and with a camera"),
        )
    if rotated > max(wanted, level):
        angle = f"{math.degrees(tilt):.3g}°"
        yield Issue(
            f"rotated by {angle}, the platform may be off by {beyond(rotated, wanted)}",
            _shared_cause(*at_tilt)
            or (
                f"measure with the platform rotated by ±{angle} or more (`cdpr calibrate poses`"
                " plans it)"
                if result.measured.has_rotation.any()
                else "measure the platform's rotation as well (camera, or several reflectors),"
                f" or at more poses rotated by ±{angle} or more"
            )
            + "; if it never rotates, pass --tilt-deg 0, in Python tilt=0",
        )
