"""Which directions of a rig's parameters the data determine, and the errors of a fit in them.

Information of the data is relative to that of the rig file: along an eigenvector with a value above
1 the data are more accurate. The others cannot be identified and are left as in the rig file.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calibration.geometry.fit import POSE_BEND, RigFit, RigFitter, poses_from_lengths
from calibration.geometry.measurements import RigMeasurements
from calibration.geometry.model import RigModel, tension_variance
from calibration.geometry.parameters import AXES, Parameters, rig_with
from calibration.statistics import huber_weight, rms_bound, student_factor
from model.kinematics import settled_poses_near
from model.pose import Array, read_only, skew

LEAST_INFORMATION = 1.0
"""Of a direction, relative to the rig file's information."""
NAMED_SHARE = 0.85
"""A named direction is unknown if this share of its square lies in unknown directions."""
LARGEST_PARTS = 4
"""Number of unknowns listed for a direction without a name."""


@dataclass(frozen=True, slots=True, eq=False)
class Observability:
    """Identifiable and unidentifiable directions of a rig's unknowns.

    Attributes:
        information: Eigenvalues, descending, shape (p,).
        known: Orthonormal directions the data determine, in standard deviations of the rig file,
            shape (p, r).
        unknown: The others, shape (p, p − r).
    """

    information: Array
    known: Array
    unknown: Array

    @classmethod
    def of(cls, information: Array) -> Observability:
        """From `RigFit.information`, shape (p, p)."""
        directions, values, _ = np.linalg.svd(information)
        known = values > LEAST_INFORMATION
        return cls(values, directions[:, known], directions[:, ~known])


@dataclass(frozen=True, slots=True, eq=False)
class _Named:
    """A named direction; parts of directions with the same name are reported together."""

    name: str
    part: str
    direction: Array


def sentences(observability: Observability, parameters: Parameters) -> list[str]:
    """Sentences about what cannot be identified; empty if everything can."""
    left = observability.unknown.copy()
    found: dict[str, list[str]] = {}
    for named in _named(parameters):
        size = np.linalg.norm(named.direction)
        if size == 0.0 or not left.shape[1]:
            continue
        direction = named.direction / size
        within = left.T @ direction
        if within @ within < NAMED_SHARE:
            continue
        found.setdefault(named.name, []).append(named.part)
        left = _without(left, left @ within)
    lines = [_sentence(name, parts, parameters.rig.cable_count) for name, parts in found.items()]
    if left.shape[1]:
        lines.append(
            f"{left.shape[1]} combinations of parameters, {_by_parts(left[:, -1], parameters)}"
        )
    return lines


def _sentence(name: str, parts: list[str], cables: int) -> str:
    if parts == [""]:
        return name
    if len(parts) == 3 * cables:
        return f"{name}: every cable along x, y and z"
    return f"{name}: {', '.join(parts)}"


def _without(space: Array, direction: Array) -> Array:
    """The subspace of a space orthogonal to a direction in it, one dimension less."""
    unit = direction / np.linalg.norm(direction)
    rest = space - np.outer(unit, unit @ space)
    left, _, _ = np.linalg.svd(rest, full_matrices=False)
    return left[:, : space.shape[1] - 1]


def _named(parameters: Parameters) -> list[_Named]:
    """Directions that have a name, the most important first."""
    rig, slices = parameters.rig, parameters.slices()
    m, p = rig.cable_count, len(parameters)
    zero = np.zeros(p)

    def scaled(**groups: Array) -> Array:
        direction = zero.copy()
        for group, values in groups.items():
            if group in slices:
                direction[slices[group]] = values.ravel()
        return direction / parameters.deviations

    found: list[_Named] = []
    if "outlets" in slices and "anchors" in slices:
        for cable in range(m):
            for axis, name in enumerate(AXES):
                shift = np.zeros((m, 3))
                shift[cable, axis] = 1.0
                what = "outlet and anchor of one cable moved together"
                part = f"cable {cable + 1} along {name}"
                found.append(_Named(what, part, scaled(outlets=shift, anchors=shift)))
    found += _rigid("outlets", "a common motion of all outlets in the world", rig.outlets, scaled)
    found += _rigid(
        "anchors", "a common motion of all anchors on the platform", rig.anchors, scaled
    )
    if "drum_scale" in slices:
        grown = scaled(
            outlets=rig.outlets - rig.outlets.mean(axis=0),
            anchors=rig.anchors,
            drum_scale=np.ones(m),
        )
        found.append(_Named("the size of the whole rig", "", grown))
    if "stiffness" in slices:
        found.append(_Named("the stiffness of the cables", "", scaled(stiffness=np.ones(1))))
    if "cable_stiffness" in slices:
        for cable, own in enumerate(np.eye(m), start=1):
            what = "the stiffness of one cable"
            found.append(_Named(what, f"cable {cable}", scaled(cable_stiffness=own)))
    for number, name in enumerate(parameters.names):
        alone = zero.copy()
        alone[number] = 1.0
        found.append(_Named("single numbers", name, alone))
    return found


def _rigid(group: str, what: str, points: Array, scaled: Callable[..., Array]) -> list[_Named]:
    centred = points - points.mean(axis=0)
    moves = {f"along {a}": np.tile(np.eye(3)[i], (len(points), 1)) for i, a in enumerate(AXES)}
    turns = {f"about {a}": centred @ skew(np.eye(3)[i]).T for i, a in enumerate(AXES)}
    return [_Named(what, part, scaled(**{group: v})) for part, v in (moves | turns).items()]


def _by_parts(direction: Array, parameters: Parameters) -> str:
    largest = np.argsort(-np.abs(direction))[:LARGEST_PARTS]
    parts = ", ".join(f"{parameters.names[i]} {direction[i]:+.2f}" for i in largest)
    return f"one of them mostly {parts} (in standard deviations of the rig file)"


def identified(
    parameters: Parameters, measured: RigMeasurements, length_deviation: float
) -> tuple[RigFit, Observability]:
    """The fit restricted to the directions that the data determine, and these directions.

    Args:
        length_deviation: Of a cable's length from the encoder, [m].

    Raises:
        Fault: The measurements cannot be fitted.
    """
    fitter = RigFitter(parameters, measured, length_deviation)
    observability = Observability.of(fitter.fit().information)
    return fitter.fit(observability.known), observability


# Scatter of the measurements, relative to what is stated.


def _numbers(measured: RigMeasurements, fit: RigFit) -> int:
    """Number of measurements beyond those that determine the poses."""
    return int(np.isfinite(fit.deviations).sum() - measured.unmeasured.sum())


_MEDIAN_DISTANCE, _MEDIAN_DEVIATION = 1.54, 0.87
"""Median of a distance along three axes, in deviations; its own deviation with n samples, by √n."""


def pose_scales(measured: RigMeasurements, fit: RigFit, observability: Observability) -> Array:
    """Deviations of measured positions and rotations, relative to the stated ones, shape (2,).

    They follow from the medians of the distances from estimated poses, since ten cables fit their
    lengths whatever the poses. Where cables and sensors scatter more than stated as well, only the
    excess beyond that counts. Excess within chance, two standard deviations, does not: 1.

    Args:
        fit: In the directions that the samples determine.
    """
    numbers, unknowns = _numbers(measured, fit), observability.known.shape[1]
    usual = max(numbers - unknowns, fit.squares, 1.0) / max(numbers, 1)
    errors = measured.pose_errors(fit.positions, fit.rotations)
    errors[:, :3] = measured.measured_points(fit.positions, fit.rotations) - measured.positions
    rotated = measured.has_position & measured.has_rotation
    scales = np.ones(2)
    for k, known in enumerate((measured.has_position, rotated)):
        if not known.any():
            continue
        axes = slice(3 * k, 3 * k + 3)
        own, gaps = measured.covariances[known, axes, axes], errors[known, axes, None]
        distances = np.sqrt(np.sum(gaps * np.linalg.solve(own, gaps), axis=(1, 2)))
        scale = float(np.median(distances)) / (_MEDIAN_DISTANCE * np.sqrt(usual))
        by_chance = 2.0 * _MEDIAN_DEVIATION / (_MEDIAN_DISTANCE * np.sqrt(len(own)))
        scales[k] = scale if scale > 1.0 + by_chance else 1.0
    return scales


# Uncertainty of a rig's parameters: from the scatter of residuals, and by the jackknife.
#
# Scatter alone is too optimistic if residuals within a sample are correlated, as by a cable model
# that differs from the rig file's. The jackknife over samples, to first order, covers that.
# The rig file acts as a prior that is never left out. Neither shows errors that all measured poses
# share, such as of the camera's pose: the fit follows them, and what it does is added to both.
#
# A measured tension multiplies the compliance, so its random errors do not only scatter: they make
# the compliance too small (attenuation). Such an error is in the residual and in its derivative by
# the logarithm of the stiffness, with the same factor: the expected gradient is the growth of the
# squares. That growth is the larger of two: what the scatter of the force on the platform implies,
# and the excess of residuals over what is stated, but no more than all residuals. Both may have
# other causes: that tensions cause all of it, or nothing, is taken as equally likely.
#
# Sources: Efron & Tibshirani, "An Introduction to the Bootstrap", 1993, ch. 11; Fuller,
# "Measurement Error Models", 1987, section 1.1.


ALL_OR_NONE = 0.5**0.5
"""RMS of a bias that is as likely there as not, relative to the bias."""
LEAST_SHARE = 0.5
"""Errors of tensions are not taken to reduce a compliance to less than this share."""


@dataclass(frozen=True, slots=True, eq=False)
class RigUncertainty:
    """Uncertainty of a rig's parameters.

    Attributes:
        by_scatter: Covariance, shape (p, p); of unidentified directions it is the rig file's.
        by_jackknife: The same, from leaving out each sample.
        common: Changes of the unknowns by one deviation of each error common to all measured
            poses, shape (p, q); no scatter shows them.
        by_tensions: Changes of the unknowns by one deviation of the bias that errors of measured
            tensions cause, shape (p, 1).
        tension_squares: Part of the squares of residuals that errors of each cable's tensions may
            cause, shape (m,).
        scatter: Ratio of the variance of residuals and measured poses to the stated one, at
            least 1.
        quantile: Half width of a 95 % interval in standard deviations.
    """

    by_scatter: Array
    by_jackknife: Array
    common: Array
    by_tensions: Array
    tension_squares: Array
    scatter: float
    quantile: float

    @property
    def half_widths(self) -> Array:
        """Half widths of the 95 % intervals, the larger of both, shape (p,)."""
        return self.worst(np.eye(len(self.by_scatter))[:, None])

    def worst(self, slopes: Array) -> Array:
        """95 % error of vectors that depend on the parameters, along their worst direction.

        Errors common to all poses count by their magnitude, since they are the same everywhere.

        Args:
            slopes: Their derivatives by the parameters, shape (k, d, p).

        Returns:
            Shape (k,).
        """
        variances = [
            np.linalg.eigvalsh(slopes @ covariance @ np.swapaxes(slopes, 1, 2))[:, -1]
            for covariance in (self.by_scatter, self.by_jackknife)
        ]
        alone = self.quantile * np.sqrt(np.maximum(*variances))
        biased = _bounds(slopes, np.hstack([self.common, self.by_tensions]))
        return np.asarray(np.hypot(alone, biased))

    def worst_by_common(self, slopes: Array) -> Array:
        """The part of `worst` that errors common to all poses cause, shape (k,)."""
        return _bounds(slopes, self.common)

    def worst_by_tensions(self, slopes: Array) -> Array:
        """The part of `worst` that errors of measured tensions cause, shape (k,)."""
        return _bounds(slopes, self.by_tensions)


def _bounds(slopes: Array, changes: Array) -> Array:
    """95 % bounds on vectors, from changes of the unknowns by one deviation each, shape (k,)."""
    unit = np.eye(changes.shape[1])
    bounds = [rms_bound(unit, slope @ changes) for slope in slopes]
    return np.asarray(np.sqrt(slopes.shape[1]) * np.array(bounds))


def _tension_squares(
    parameters: Parameters,
    measured: RigMeasurements,
    fit: RigFit,
    moved_by: Callable[[Array], Array],
    ratio: float,
) -> Array:
    """As in `RigUncertainty`.

    Args:
        moved_by: Changes of the unknowns, shape (p,), by such squares.
        ratio: Of the variance of residuals to the stated one.
    """
    numbers = _numbers(measured, fit)
    if not numbers:  # the poses follow all errors
        return read_only(np.zeros(len(fit.tension_squares)))
    at = (parameters.geometry(fit.values), measured, fit.positions, fit.rotations)
    by_statics = tension_variance(parameters.rig, *at) * fit.tension_squares
    is_stiffness = np.array([name.startswith("stiffness") for name in parameters.names])

    def reduced(squares: Array) -> float:
        """Largest change of a stiffness, logarithmic."""
        return float(moved_by(squares)[is_stiffness].max(initial=0.0))

    by_statics /= max(1.0 - reduced(by_statics), LEAST_SHARE)  # they are of the reduced compliance
    share = min(max(float(by_statics.sum()) / numbers, ratio - 1.0), ratio)
    squares = share * numbers * fit.tension_squares / fit.tension_squares.sum()
    return read_only(squares / max(reduced(squares) / np.log(1.0 / LEAST_SHARE), 1.0))


def uncertainty_of_rig(
    parameters: Parameters,
    measured: RigMeasurements,
    fit: RigFit,
    observability: Observability,
) -> RigUncertainty:
    """The uncertainty of a fit.

    Args:
        fit: In the directions that the samples determine; residuals larger than assumed widen the
            result.
    """
    known, unknown = observability.known, observability.unknown
    informations = known.T @ fit.informations @ known
    scores = fit.scores @ known
    whole = informations.sum(axis=0) + np.eye(known.shape[1])
    of_poses = float(np.sum(huber_weight(fit.pose_misfits, POSE_BEND) * fit.pose_misfits**2))
    freedom = max(_numbers(measured, fit) - known.shape[1], 1)
    found = (fit.squares + of_poses) / freedom
    scatter = max(1.0, found)
    count = len(measured)
    without = np.linalg.solve(whole - informations, scores[..., None])[..., 0]
    apart = without - without.mean(axis=0)
    by_prior = np.linalg.inv(whole @ whole)
    jackknifed = (count - 1) / count * apart.T @ apart + by_prior
    spread = parameters.deviations
    of_all = (
        known @ inner @ known.T + unknown @ unknown.T
        for inner in (scatter * np.linalg.inv(whole), jackknifed)
    )
    by_scatter, by_jackknife = (read_only(inner * np.outer(spread, spread)) for inner in of_all)
    pulled = known @ np.linalg.solve(whole, known.T @ fit.common_scores)
    common = read_only(-spread[:, None] * pulled)

    def moved_by(squares: Array) -> Array:
        scores = known.T @ parameters.tension_scores(squares)
        return np.asarray(spread * (known @ np.linalg.solve(whole, scores)))

    squares = _tension_squares(parameters, measured, fit, moved_by, found)
    by_tensions = read_only(-ALL_OR_NONE * moved_by(squares)[:, None])
    quantile = student_factor(count - 1)
    return RigUncertainty(by_scatter, by_jackknife, common, by_tensions, squares, scatter, quantile)


# Cross-validation: errors on held-out samples.


FOLDS = 5


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """Cross-validation errors of samples.

    Attributes:
        before: Errors with the rig file, shape (n,), [m].
        after: Errors with fits that left the sample out, shape (n,), [m].
        poses: True for position errors; False for RMS cable residuals, without measured poses.
    """

    before: Array
    after: Array
    poses: bool


def held_out(parameters: Parameters, measured: RigMeasurements, length_deviation: float) -> HeldOut:
    """Five-fold cross-validation.

    Args:
        length_deviation: Of a cable's length from the encoder, [m].

    Raises:
        Fault: A part of the measurements cannot be fitted.
    """
    n = len(measured)
    posed = bool(measured.has_position.all())
    before, after = np.empty(n), np.empty(n)
    for fold in range(FOLDS):
        out = np.arange(n) % FOLDS == fold
        rest, left_out = measured.part(~out), measured.part(out)
        fit, _ = identified(parameters, rest, length_deviation)
        for errors, values in ((before, np.zeros(len(parameters))), (after, fit.values)):
            errors[out] = _errors(parameters, values, left_out, posed)
    return HeldOut(before, after, posed)


def _errors(parameters: Parameters, values: Array, measured: RigMeasurements, posed: bool) -> Array:
    """Errors of held-out samples, shape (n,), [m]."""
    model, geometry = RigModel(parameters, measured), parameters.geometry(values)
    lengths, rig = model.counted.lengths(geometry), rig_with(parameters.rig, geometry)
    if not posed:
        found = poses_from_lengths(rig, lengths, measured.without_poses(), alone=True)
        apart = model.residuals(values, *found)[:, : rig.cable_count]
        return np.asarray(np.sqrt(np.mean(apart**2, axis=1)))
    rotations = measured.first_rotations(rig)
    found = settled_poses_near(rig, lengths, measured.origins(rotations), rotations)
    apart = measured.measured_points(*found) - measured.positions
    return np.asarray(np.linalg.norm(apart, axis=1))
