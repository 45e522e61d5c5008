"""Pictures of the run at a few instants, with what was measured in them (paper, Fig. 12)."""

from __future__ import annotations

import base64

import numpy as np

from executor.report.markup import prose
from executor.report.run_data import RunData

COUNT = 6
WIDEST = 960
_QUALITY = 80


def frames(run: RunData) -> str:
    """Up to six pictures, evenly over the kept ones; nothing for a run without pictures."""
    kept = [i for i, name in enumerate(run.poses.picture) if name]
    if not kept:
        return ""
    places = np.unique(np.linspace(0, len(kept) - 1, min(COUNT, len(kept))).astype(int))
    figures = "".join(_figure(run, kept[k]) for k in places.tolist())
    return f'<div class="frames">{figures}</div>'


def _figure(run: RunData, row: int) -> str:
    poses = run.poses
    time = f"{float(poses.time[row]):.1f} s"
    data = base64.b64encode(_smaller(run.folder.picture(poses.picture[row]))).decode()
    return (
        f'<figure><div><img src="data:image/jpeg;base64,{data}" alt="Camera picture after {time}">'
        f"<p><b>{time}</b> {prose(_clearance(run, row))}</p></div>"
        f"<figcaption>{prose(_measured(run, row))}</figcaption></figure>"
    )


def _clearance(run: RunData, row: int) -> str:
    rows = run.clearance.of("tag")
    near = np.flatnonzero(np.abs(rows.time - run.poses.time[row]) < 1e-3)
    if not near.size:
        return ""
    k = int(near[0])
    distance, spread, at_most, planned = (
        float(values[k]) * 1e3
        for values in (rows.distance, rows.uncertainty, rows.at_most, rows.planned_distance)
    )
    span = f"{distance - spread:.1f} to {at_most:.1f}"
    return f"clearance {distance:.1f} mm, surely {span} (plan {planned:.1f})"


def _measured(run: RunData, row: int) -> str:
    poses = run.poses
    if not poses.ok[row]:
        return f"No pose: {poses.status[row]}"
    place = ", ".join(f"{value * 1e3:.1f}" for value in poses.position[row])
    tags = len(poses.tags[row].split())
    error = float(poses.error[row]) * 1e3
    return f"{place} mm · {error:.2f} mm from the plan · {tags} tag{'s' if tags != 1 else ''}"


def _smaller(jpeg: bytes) -> bytes:
    """The same picture, at most ``WIDEST`` wide, so that the page stays small."""
    import cv2

    image = cv2.imdecode(np.frombuffer(jpeg, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.shape[1] <= WIDEST:
        return jpeg
    height = round(image.shape[0] * WIDEST / image.shape[1])
    small = cv2.resize(image, (WIDEST, height), interpolation=cv2.INTER_AREA)
    done, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return data.tobytes() if done else jpeg
