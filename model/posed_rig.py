"""A rig at one pose: cable lengths, structure matrix, tensions and margins."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from model.kinematics import cables_at, structure_matrix_of
from model.pages.page import html_table
from model.pose import Array, Pose, ReadOnly, read_only
from model.statics.feasibility import WrenchBox, capacity_margin
from model.statics.gravity import weight_wrench, working_tensions
from model.statics.tension_distribution import TensionInfeasible
from model.statics.wrench_sets import condition_number, rms_anchor_radius

if TYPE_CHECKING:
    from model.rig import Rig
    from model.scene import Load


@dataclass(frozen=True, slots=True, eq=False)
class PosedRig(ReadOnly):
    """Kinematics and statics of a rig at one pose; the arrays are read-only.

    Attributes:
        rig: The robot with m cables.
        pose: ``world_from_platform``.
        exits: Where the cables leave outlet or pulley, world frame, shape (m, 3), [m].
        anchors: The platform's anchors, world frame, shape (m, 3), [m].
        lengths: Free cable lengths from outlet to anchor, shape (m,), [m].
        structure_matrix: J of J t + w = 0 for tensions t and the external wrench w, shape (6, m);
            force rows [-], moment rows about the platform's origin [m].
        tensions: Commanded tensions, shape (m,), [N]; NaN where no tensions within the limits hold
            the weight.
        capacity_margin: Distance of the required wrenches from the boundary of the available set,
            [N]; negative outside it, minus infinity where the cables act in too few directions.
        condition_number: σ_max / σ_min of the structure matrix, moments divided by the RMS anchor
            radius; 1 at best, infinite where it is rank-deficient.
    """

    rig: Rig
    pose: Pose
    exits: Array
    anchors: Array
    lengths: Array
    structure_matrix: Array
    tensions: Array
    capacity_margin: float
    condition_number: float

    @property
    def is_wrench_feasible(self) -> bool:
        """Whether tensions within the limits hold the weight and the load's wrench box."""
        return self.capacity_margin >= 0.0

    @property
    def dexterity(self) -> float:
        """Reciprocal of the condition number, between 0 (singular) and 1 (isotropic)."""
        return 1.0 / self.condition_number

    def __repr__(self) -> str:
        """Position, feasibility and margins."""
        x, y, z = self.pose.position * 1000.0
        held = "feasible" if self.is_wrench_feasible else "not feasible"
        return (
            f"<PosedRig {self.rig.name} at [{x:.1f}, {y:.1f}, {z:.1f}] mm: {held},"
            f" capacity margin {self.capacity_margin:.1f} N, dexterity {self.dexterity:.3f}>"
        )

    def _repr_html_(self) -> str:
        """For notebooks."""
        x, y, z = self.pose.position * 1000.0
        rows = [
            ("position", f"{x:.1f}, {y:.1f}, {z:.1f} mm"),
            ("lengths", f"{', '.join(f'{length * 1e3:.1f}' for length in self.lengths)} mm"),
            ("tensions", f"{', '.join(f'{tension:.1f}' for tension in self.tensions)} N"),
            ("wrench feasible", "yes" if self.is_wrench_feasible else "no"),
            ("capacity margin", f"{self.capacity_margin:.1f} N"),
            ("dexterity", f"{self.dexterity:.3f}"),
        ]
        return html_table(f"Rig {self.rig.name} at a pose", rows)


def posed_rig(rig: Rig, pose: Pose, load: Load | None = None) -> PosedRig:
    """Kinematics and statics of a rig at one pose.

    Args:
        pose: ``world_from_platform``.
        load: Payload and external wrenches; only the platform's weight when left out.

    Raises:
        NoCable: A cable has no path at this pose.
    """
    cables = cables_at(rig, pose)
    matrix = structure_matrix_of(cables, pose.position)
    radius = rms_anchor_radius(rig.anchors)
    weight = weight_wrench(rig, pose, load)
    box = np.zeros(6) if load is None else np.concatenate([load.force, load.moment])
    margin = capacity_margin(
        matrix, rig.min_tension, rig.max_tension, WrenchBox(weight, box), radius
    )
    return PosedRig(
        rig=rig,
        pose=pose,
        exits=read_only(cables.exits),
        anchors=read_only(cables.anchors),
        lengths=read_only(cables.lengths),
        structure_matrix=read_only(matrix),
        tensions=read_only(_tensions(rig, pose, load)),
        capacity_margin=float(margin),
        condition_number=float(condition_number(matrix, radius)),
    )


def _tensions(rig: Rig, pose: Pose, load: Load | None) -> Array:
    try:
        return working_tensions(rig, pose, load).tensions
    except TensionInfeasible:
        return np.full(rig.cable_count, np.nan)
