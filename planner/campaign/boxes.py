"""Workspace boxes: the rig's own, and larger ones to see what a claim owes to the box."""

from __future__ import annotations

from cdpr.rig import Rig, rig_from_document

GROWTH_MM = ((-100.0, -100.0, -50.0), (100.0, 100.0, 100.0))
"""From the rig's own box to the wide one; the paper's rig goes from ±250, 150 to 650 mm to ±350,
100 to 750 mm."""

OWN, WIDE = "own", "wide"
SHARES = {OWN: 0.0, "25 %": 0.25, "50 %": 0.5, "75 %": 0.75, WIDE: 1.0}
"""Boxes by name: the share of `GROWTH_MM` they are grown by."""


def with_box(rig: Rig, name: str) -> Rig:
    """The same rig with its workspace grown to the box of a name in `SHARES`."""
    share, box = SHARES[name], rig.document.workspace
    lower, upper = (
        [edge + share * growth for edge, growth in zip(edges, grown, strict=True)]
        for edges, grown in zip((box.lower_mm, box.upper_mm), GROWTH_MM, strict=True)
    )
    changed = box.model_copy(update={"lower_mm": lower, "upper_mm": upper})
    return rig_from_document(rig.document.model_copy(update={"workspace": changed}))


def box_text(rig: Rig) -> str:
    """The box in words, such as "x ±250, y ±250, z 150 to 650 mm"."""
    parts = []
    for axis, low, high in zip(
        "xyz", rig.workspace_lower * 1e3, rig.workspace_upper * 1e3, strict=True
    ):
        symmetric = abs(low + high) < 1e-9
        parts.append(f"{axis} ±{high:g}" if symmetric else f"{axis} {low:g} to {high:g}")
    return ", ".join(parts) + " mm"
