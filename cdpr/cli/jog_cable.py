"""`cdpr jog --cable`: moves one winch alone, a little and slowly, for commissioning."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cdpr.rig import Rig


def jog_cable(
    rig: Rig,
    cable: int,
    mm: float,
    *,
    limit_n: float | None,
    fast: bool,
    yes: bool,
    without_real_time: bool,
    as_json: bool,
) -> None:
    """Moves one winch, no faster than the rig, and tells what its cable did.

    On a taut platform one cable alone moves by hardly more than its stretch before a tension is
    too large, or another cable slack: both stop it.

    Raises:
        BadInput: There is no such cable, or no way to go.
        Refused: The way is too long, or the bus is latched.
        Fault: A tension left its bounds; all drives stopped together.
    """
    import math
    from functools import partial

    from cdpr.cli.carry_out import show_and_ask
    from cdpr.cli.jog_way import LONGEST_MM
    from cdpr.cli.output import out, show_facts, show_json
    from cdpr.cli.winches import WinchMotion, carry_out_by_law, limit_of
    from cdpr.errors import BadInput, Refused
    from drivers.bus import IN_PROCESS
    from executor.custody import Custody
    from executor.winch_laws import CableStep

    if not cable <= rig.cable_count:
        raise BadInput(
            f"there is no cable {cable}",
            where="--cable",
            next_step=f"name one from 1 to {rig.cable_count}, in the order of the rig file",
        )
    if mm == 0.0 or not math.isfinite(mm):
        raise BadInput("that is no way to go", where="--mm", next_step="give mm, not 0")
    if abs(mm) > LONGEST_MM:
        raise Refused(
            f"{abs(mm):g} mm are more than {LONGEST_MM:g} mm",
            where="--mm",
            why="one cable alone is moved in short steps, somebody looking",
            next_step="go there in several steps",
        )
    limit, speed = limit_of(rig, limit_n), rig.motion.speed
    in_process = rig.document.bus.interface == IN_PROCESS
    Custody(rig).require_free()
    winch = rig.winches[cable - 1]
    way = f"{abs(mm):g} mm {'out' if mm > 0 else 'in'}, at most {speed * 1000:g} mm/s"
    facts = [
        ("rig", rig.name),
        ("cable", rig.drive_names[winch.node_id]),
        ("way", way),
        ("tension", f"at most {limit:g} N in any cable; none that is taut may go slack"),
    ]
    show_and_ask(
        partial(show_facts, "ready to move one cable", facts),
        "Move this cable now?",
        "nothing was moved",
        asks=not (in_process or yes),
        as_json=as_json,
    )
    step = partial(CableStep, cable=cable - 1, way=mm / 1000.0, limit=limit, speed=speed)
    motion = WinchMotion(
        rig, rig.home, limit, speed, step, None, fast, without_real_time, as_json,
        anew=False, name="jog-cable",
    )  # fmt: skip
    stand = carry_out_by_law(motion, lambda _stand, _true_pose, _board: None)
    moved = (stand.counts - stand.began)[cable - 1] / winch.counts_per_metre * 1000.0
    tensions = [round(float(t), 2) for t in stand.tensions]
    if as_json:
        show_json({"cable": cable, "moved_mm": round(float(moved), 4), "tensions_n": tensions})
        return
    out.print(f"cable {cable} moved by {moved:+.3f} mm, positive pays out; the drives hold")
    out.print(f"tensions: {', '.join(f'{t:.1f}' for t in tensions)} N", soft_wrap=True)
