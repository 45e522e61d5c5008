"""What `cdpr track` measured, in numbers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tracking.pose_log import LoggedPicture
    from tracking.track import TrackCount
    from tracking.track_together import TogetherCount


def track_facts(
    logged: list[LoggedPicture],
    output: Path,
    count: TrackCount,
    shared: TogetherCount | None,
    took: float,
) -> dict[str, Any]:
    """What was measured, in numbers.

    Args:
        logged: What was measured.
        output: Where it is written.
        count: How many pictures were measured, and in which times.
        shared: Of several cameras, what was not taken together.
        took: How long all of it took, [s].
    """
    import numpy as np

    from tracking.measurement import PoseMeasurement

    poses = [p.observation for p in logged if isinstance(p.observation, PoseMeasurement)]
    deviations = np.array([np.linalg.norm(p.position_deviation) for p in poses])
    facts: dict[str, Any] = {
        "poses_file": str(output),
        "pictures": len(logged),
        "poses": len(poses),
        "position_deviation_mm": round(float(np.median(deviations)) * 1000, 4),
        "reprojection_px": round(float(np.median([p.reprojection for p in poses])), 4),
        "pictures_per_second": round(len(logged) / took, 1),
        "measuring_ms": round(float(np.median(count.seconds)) * 1000, 2),
    }
    if shared is not None:
        facts["pictures_without_partner"] = shared.without_partner
        facts["moments_apart"] = shared.apart
        facts["moments_without_speed"] = shared.without_speed
    clearances = [p.clearance for p in logged if p.clearance is not None]
    if clearances:
        nearest = min(clearances, key=lambda c: c.distance)
        facts["smallest_clearance_mm"] = round(nearest.distance * 1000, 3)
        facts["clearance_uncertainty_mm"] = round(nearest.uncertainty * 1000, 3)
        facts["clearance_at_most_mm"] = round(nearest.at_most * 1000, 3)
    return facts
