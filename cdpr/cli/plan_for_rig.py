"""A plan is for one rig: its geometry, platform, cables and workspace."""

from __future__ import annotations

from pathlib import Path

from cdpr.errors import BadInput
from cdpr.plan import Plan
from cdpr.rig import NOT_IN_PLAN_HASH, Rig


def require_same_rig(plan: Plan, rig: Rig, plan_path: Path) -> None:
    """Rejects a plan that was made for another rig, and names what differs.

    Raises:
        BadInput: The rig's plan hash is not the plan's.
    """
    if plan.rig.plan_hash == rig.plan_hash:
        return
    ours = rig.document.model_dump(mode="json")
    theirs = plan.rig.document.model_dump(mode="json")
    differing = [k for k in ours if k not in NOT_IN_PLAN_HASH and ours[k] != theirs[k]]
    raise BadInput(
        f"the plan was made for the rig {plan.rig.name!r}, not for {rig.name!r} as it is now",
        where=str(plan_path),
        why=f"these parts of the rig file differ: {', '.join(differing)}",
        next_step="plan again for this rig with `cdpr plan`",
    )
