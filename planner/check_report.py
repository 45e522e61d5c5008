"""Result of a check: figures with pair and pose, violations, and the plan that passed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Any

import numpy as np

from model.clearance import Nearest
from model.errors import Refused, distinct_figures
from model.pages.page import html_table
from model.plan import Plan
from model.pose import Array, Pose

_SCALE = {"mm": 1000.0, "mm/s": 1000.0, "N": 1.0, "°": 180.0 / math.pi}


@dataclass(frozen=True, slots=True, eq=False)
class Closest:
    """The smallest distance along a path.

    Attributes:
        nearest: The two bodies and their distance.
        pose: Of the platform there.
        at: Motion from the path's start to there, [m].
    """

    nearest: Nearest
    pose: Pose
    at: float

    def sentence(self, proved: float, required: float) -> str:
        """The distance, where it occurs, and the proved and required distances, [m]."""
        near = self.nearest
        x, y, z = self.pose.position * 1000
        return (
            f"{near.distance * 1000:.2f} mm, {near.first} to {near.second}, with the platform at"
            f" {x:z.1f}, {y:z.1f}, {z:z.1f} mm; proved {proved * 1000:.2f} mm,"
            f" required {required * 1000:g} mm"
        )

    def as_dict(self) -> dict[str, Any]:
        """For `--json`, and with the keys of a plan's quality."""
        return {
            "first": self.nearest.first,
            "second": self.nearest.second,
            "distance_mm": self.nearest.distance * 1000.0,
            "position_mm": [float(x) * 1000.0 for x in self.pose.position],
        }


@dataclass(frozen=True, slots=True, eq=False)
class Violation:
    """One limit that a path violates.

    Attributes:
        what: The violation, without figures.
        measured: The value at ``position``, SI.
        limit: SI.
        unit: Unit of display: "mm", "mm/s", "°" or "N".
        position: Of the platform there, shape (3,), [m].
        proved: Lower bound of the value along the path, SI, where only that violates the limit.
        cure: What to change in the rig file, where another path would not help; else empty.
    """

    what: str
    measured: float
    limit: float
    unit: str
    position: Array
    proved: float | None = None
    cure: str = ""

    def sentence(self) -> str:
        """The violation in words, with figures and platform position."""
        x, y, z = (float(c) * 1000.0 for c in self.position)
        figures = (self.measured, self.limit, *(() if self.proved is None else (self.proved,)))
        measured, limit, *proved = distinct_figures(
            [figure * _SCALE[self.unit] for figure in figures], 4, "g"
        )
        bound = f", proved {proved[0]} {self.unit}" if proved else ""
        return (
            f"{self.what}: {measured} {self.unit}{bound} (limit {limit} {self.unit})"
            f" with the platform at [{x:.1f}, {y:.1f}, {z:.1f}] mm"
        )


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class CheckReport:
    """The figures of a checked path, SI; those left out are of a path of which nothing is known.

    A ``proved`` value is a lower bound everywhere on the path, between samples too; the smallest
    sample is given beside it with its pose.

    Attributes:
        length: Distance travelled by the platform's origin, [m].
        samples: Poses at which distances were computed; 0 for a path far outside the workspace box,
            of which nothing else is known.
        obstacle_clearance: The smallest; None in a scene without obstacles.
        proved_obstacle_clearance: [m]; infinite without obstacles.
        required_obstacle_clearance: [m].
        self_clearance: The smallest.
        proved_self_clearance: [m].
        required_self_clearance: [m].
        min_tension: Smallest working tension at samples, [N]; NaN where there are none.
        max_tension: Largest working tension at samples, [N]; NaN where there are none.
        capacity_margin: The smallest at samples, [N]; of a path with stops, of the leg whose proved
            margin exceeds the required one least, as are the next two.
        proved_capacity_margin: [N].
        required_capacity_margin: Largest wrench that accelerates the platform, [N].
        max_cable_speed: At the rig's path speed, at samples, [m/s].
        violations: Limits that the path violates; empty when it passed.
    """

    length: float
    samples: int = 0
    obstacle_clearance: Closest | None = None
    proved_obstacle_clearance: float = -math.inf
    required_obstacle_clearance: float
    self_clearance: Closest
    proved_self_clearance: float = -math.inf
    required_self_clearance: float
    min_tension: float = math.nan
    max_tension: float = math.nan
    capacity_margin: float = -math.inf
    proved_capacity_margin: float = -math.inf
    required_capacity_margin: float
    max_cable_speed: float = math.inf
    violations: tuple[Violation, ...]

    @property
    def passed(self) -> bool:
        """Whether the path keeps every limit."""
        return not self.violations

    @property
    def cure(self) -> str:
        """What to change in the rig file, if that alone remedies all violations; else empty."""
        cures = {violation.cure: None for violation in self.violations}
        return "" if "" in cures else "; ".join(cures)

    @property
    def exactness(self) -> float:
        """How far the true smallest obstacle clearance may be below the reported one, [m]."""
        if self.obstacle_clearance is None:
            return 0.0
        return self.obstacle_clearance.nearest.distance - self.proved_obstacle_clearance

    def __repr__(self) -> str:
        """Whether the path passed, and its length."""
        return f"<CheckReport {self._verdict()}, {self.length * 1e3:.1f} mm>"

    def _repr_html_(self) -> str:
        """For notebooks."""
        violations = [("violation", violation.sentence()) for violation in self.violations]
        rows = [("verdict", self._verdict()), *self.facts(), *violations]
        return html_table("Check of a path", rows)

    def _verdict(self) -> str:
        return "passed" if self.passed else f"rejected: {len(self.violations)} violations"

    def facts(self) -> list[tuple[str, str]]:
        """Human-readable figures of the check: name and value."""
        if not self.samples:
            return [("length", f"{self.length * 1000:.1f} mm, no pose checked")]
        own = self.self_clearance
        facts = [
            ("length", f"{self.length * 1000:.1f} mm, {self.samples} poses checked"),
            (
                "self clearance",
                own.sentence(self.proved_self_clearance, self.required_self_clearance),
            ),
            ("tension", self._tensions()),
            (
                "capacity margin",
                f"{self.capacity_margin:.1f} N; proved {self.proved_capacity_margin:.1f} N,"
                f" required {self.required_capacity_margin:.2g} N to accelerate the platform",
            ),
            ("cable speed", f"up to {self.max_cable_speed * 1000:.1f} mm/s at these poses"),
        ]
        near = self.obstacle_clearance
        if near is not None:
            text = near.sentence(self.proved_obstacle_clearance, self.required_obstacle_clearance)
            facts.insert(1, ("clearance", text))
        return facts

    def _tensions(self) -> str:
        if math.isnan(self.min_tension):
            return "no tensions within the limits hold the weight"
        return f"{self.min_tension:.1f} to {self.max_tension:.1f} N at these poses"

    def as_dict(self) -> dict[str, Any]:
        """For `--json`: units in the keys, no NaN and no infinity."""
        obstacle = self.obstacle_clearance
        return {
            "passed": self.passed,
            "violations": [v.sentence() for v in self.violations],
            "length_mm": self.length * 1000.0,
            "samples": self.samples,
            "obstacle_clearance": obstacle.as_dict() if obstacle else None,
            "proved_obstacle_clearance_mm": _finite(self.proved_obstacle_clearance * 1000.0),
            "required_obstacle_clearance_mm": self.required_obstacle_clearance * 1000.0,
            "self_clearance": self.self_clearance.as_dict(),
            "proved_self_clearance_mm": _finite(self.proved_self_clearance * 1000.0),
            "required_self_clearance_mm": self.required_self_clearance * 1000.0,
            "exactness_mm": _finite(self.exactness * 1000.0),
            "min_tension_n": _finite(self.min_tension),
            "max_tension_n": _finite(self.max_tension),
            "capacity_margin_n": _finite(self.capacity_margin),
            "proved_capacity_margin_n": _finite(self.proved_capacity_margin),
            "required_capacity_margin_n": self.required_capacity_margin,
            "max_cable_speed_mm_s": _finite(self.max_cable_speed * 1000.0),
        }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


class PlanRejected(Refused):
    """A path that failed its check.

    Args:
        report: Report of the check, with at least one violation.
        where: Which path.
        next_step: What the user can do now.

    Attributes:
        report: Report of the check.
    """

    def __init__(self, report: CheckReport, *, where: str, next_step: str) -> None:
        sentences = [violation.sentence() for violation in report.violations]
        super().__init__(
            f"the plan fails its check: {'; '.join(sentences)}",
            where=where,
            next_step=next_step,
            values={f"violation_{i}": text for i, text in enumerate(sentences, start=1)},
        )
        self.report = report

    @property
    def violations(self) -> tuple[Violation, ...]:
        """Every violation: what, by how much and where."""
        return self.report.violations


_PROOF = object()


@dataclass(frozen=True, slots=True, eq=False)
class VerifiedPlan:
    """A plan that passed `planner.check.verify`, which alone makes one.

    Attributes:
        plan: The plan.
        report: Report of the check.
    """

    plan: Plan
    report: CheckReport
    proof: object

    def __post_init__(self) -> None:
        """Refuses construction without the check."""
        if self.proof is not _PROOF or not self.report.passed:
            raise TypeError("a VerifiedPlan comes only from planner.check.verify")


def verified(plan: Plan, report: CheckReport) -> VerifiedPlan:
    """For `planner.check.verify` alone."""
    return VerifiedPlan(plan, report, _PROOF)


# The reports of a path's legs as one report of the whole path.


def joined(reports: Sequence[CheckReport], motions: Sequence[float]) -> CheckReport:
    """One report: sums of lengths, extremes of everything else, all violations.

    Args:
        reports: Of the legs in order, all of one rig and with the same clearances.
        motions: Of the legs, [m]; offsets for positions on the path.
    """
    if len(reports) == 1:
        return reports[0]
    begins = list(accumulate(motions, initial=0.0))
    own = [_moved(r.self_clearance, begin) for r, begin in zip(reports, begins, strict=False)]
    obstacles = [
        _moved(r.obstacle_clearance, begin)
        for r, begin in zip(reports, begins, strict=False)
        if r.obstacle_clearance is not None
    ]
    # What acceleration requires depends on the load, so it differs from leg to leg.
    tightest = min(reports, key=lambda r: r.proved_capacity_margin - r.required_capacity_margin)
    return replace(
        reports[0],
        length=sum(r.length for r in reports),
        samples=sum(r.samples for r in reports),
        obstacle_clearance=min(obstacles, key=_distance, default=None),
        proved_obstacle_clearance=min(r.proved_obstacle_clearance for r in reports),
        self_clearance=min(own, key=_distance),
        proved_self_clearance=min(r.proved_self_clearance for r in reports),
        # NaN where no tensions exist; NumPy's min and max keep it.
        min_tension=float(np.min([r.min_tension for r in reports])),
        max_tension=float(np.max([r.max_tension for r in reports])),
        capacity_margin=tightest.capacity_margin,
        proved_capacity_margin=tightest.proved_capacity_margin,
        required_capacity_margin=tightest.required_capacity_margin,
        max_cable_speed=max(r.max_cable_speed for r in reports),
        violations=tuple(v for r in reports for v in r.violations),
    )


def _moved(closest: Closest, begin: float) -> Closest:
    return replace(closest, at=begin + closest.at)


def _distance(closest: Closest) -> float:
    return closest.nearest.distance
