"""The reports of a path's legs as one report of the whole path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate

import numpy as np

from planner.check_report import CheckReport, Closest


def joined(reports: Sequence[CheckReport], motions: Sequence[float]) -> CheckReport:
    """One report: sums of lengths, extremes of everything else, all violations.

    Args:
        reports: Of the legs in their order, all of one rig and of the same clearances.
        motions: Of the legs, by which places on the path are told, [m].
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
    return replace(
        reports[0],
        length=sum(r.length for r in reports),
        samples=sum(r.samples for r in reports),
        obstacle_clearance=min(obstacles, key=_distance, default=None),
        proved_obstacle_clearance=min(r.proved_obstacle_clearance for r in reports),
        self_clearance=min(own, key=_distance),
        proved_self_clearance=min(r.proved_self_clearance for r in reports),
        # NaN stands for tensions that do not exist, and stays.
        min_tension=float(np.min([r.min_tension for r in reports])),
        max_tension=float(np.max([r.max_tension for r in reports])),
        capacity_margin=min(r.capacity_margin for r in reports),
        proved_capacity_margin=min(r.proved_capacity_margin for r in reports),
        max_cable_speed=max(r.max_cable_speed for r in reports),
        violations=tuple(v for r in reports for v in r.violations),
    )


def _moved(closest: Closest, begin: float) -> Closest:
    return replace(closest, place=begin + closest.place)


def _distance(closest: Closest) -> float:
    return closest.nearest.distance
