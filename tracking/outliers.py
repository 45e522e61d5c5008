"""Edges that do not belong to a pose that the others agree on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cdpr.poses import read_only
from tracking.bundle import BundlePose, TagView

#: An edge farther off than this many times the usual error is left out.
FAR = 4.5


def without_outliers(views: list[TagView], bundle: BundlePose) -> list[TagView] | None:
    """Views without edges that lie far off beside the others, or None when all belong."""
    errors = bundle.edge_errors
    measured = np.array([view.seen.edges for view in views])
    usual = max(1.0, float(np.median(errors[measured])) / 1.18)  # of two normal errors
    off = measured & (errors > FAR * usual)
    if not off.any():
        return None
    kept = []
    for view, wrong in zip(views, off, strict=True):
        edges = view.seen.edges & ~wrong
        if edges.sum() < 2:
            continue
        keep = np.repeat(edges, 2)
        seen = replace(
            view.seen,
            edges=edges,
            whitening=read_only(view.seen.whitening * keep[:, None]),
            target=read_only(view.seen.target * keep),
        )
        kept.append(TagView(view.tag, seen))
    return kept
