"""`cdpr status`: how a rig stands, for whoever comes to it; moves nothing and writes nothing."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cdpr.cli.calibrations import CalibrationOption
from cdpr.cli.motion_options import ChannelOption, InterfaceOption

if TYPE_CHECKING:
    from cdpr.rig import Rig
    from executor.latch import Latch, Latched


def status(
    rig: Annotated[Path, typer.Argument(help="rig file (YAML)", metavar="RIG")],
    interface: InterfaceOption = None,
    channel: ChannelOption = None,
    calibration: CalibrationOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="print the result as JSON")] = False,
) -> None:
    """Tell how a rig stands: faults, reference, drives, tensions, pose. Moves and writes nothing.

    While a run is under way, or being prepared, the drives are not asked; `cdpr monitor` shows
    them.

    [dim]Example:[/dim]

      cdpr status configs/gachon_8_6.yaml --interface socketcan --channel can0
    """
    from cdpr.cli.calibrations import calibrated_rig
    from cdpr.cli.named_bus import require_other_process, rig_on_bus
    from cdpr.cli.output import show_json
    from cdpr.cli.reference_facts import reference_told
    from cdpr.errors import CdprError
    from drivers.bus import BusSettings
    from executor.custody import Custody
    from executor.latch import Latch
    from executor.set_up_lock import SetUpLock

    the_rig = calibrated_rig(rig_on_bus(rig, interface, channel), calibration)
    require_other_process(the_rig)
    settings = BusSettings.of(the_rig)
    latch, custody = Latch(settings), Custody(the_rig)
    latched, under_way = _latch_of(latch)
    told: dict[str, Any] = {
        "rig": the_rig.name,
        "bus": str(settings),
        "run": latched.process if latched and under_way else None,
        "latched": latched.cause if latched and not under_way else None,
        "being_set_up": False,
        "reference": reference_told(custody),
        "drives": None,
        "pose": None,
    }
    missing: CdprError | None = None
    if not under_way:
        try:
            with SetUpLock(settings).tried() as alone:
                told |= _seen(the_rig, custody) if alone else {"being_set_up": True}
        except CdprError as error:  # what is on file is told all the same
            missing = error
    if as_json:
        show_json(told)
    else:
        _show(the_rig, told)
    if missing is not None:
        raise missing


def _latch_of(latch: Latch) -> tuple[Latched | None, bool]:
    """What is latched, and whether a motion is under way, both of one moment."""
    latched = latch.read()
    while True:
        under_way = latch.held_by_another()
        again = latch.read()
        if again == latched:
            return latched, latched is not None and under_way
        latched = again


def _seen(rig: Rig, custody: Any) -> dict[str, Any]:
    """What the drives tell, and where the platform is by it.

    Raises:
        CdprError: A drive does not answer, or the bus cannot be opened.
    """
    from cdpr.cli.reference_facts import reference_told
    from drivers.bus import BusSettings, open_bus
    from drivers.drive_group import drive_states, look_at_drives

    bus = open_bus(BusSettings.of(rig))
    try:
        seen = look_at_drives(rig, bus)
    finally:
        bus.shutdown()
    stands = seen.positions.tolist()
    reference = reference_told(custody, stands)
    forgot = [w.node_id for w in rig.winches if not w.absolute and w.node_id in seen.restarted]
    if reference["counts"] and forgot:
        names = ", ".join(rig.drive_names[node] for node in forgot)
        reference |= {"counts": False, "why_not": f"{names}: switched on since it was made"}
    columns = zip(
        rig.winches,
        drive_states(rig, seen.status_words.tolist()),
        stands,
        rig.tensions_by(seen.torques).tolist(),
        strict=True,
    )
    drives = [
        {
            "node": winch.node_id,
            "state": state,
            "position_counts": position,
            "tension_n": round(tension, 2),
            "set_up": winch.node_id not in seen.restarted,
        }
        for winch, state, position, tension in columns
    ]
    pose = _pose(rig, custody, stands) if reference["counts"] else None
    return {"reference": reference, "drives": drives, "pose": pose}


def _pose(rig: Rig, custody: Any, stands: list[int]) -> dict[str, Any]:
    """By forward kinematics, of the empty platform; or why there is none."""
    import numpy as np

    from cdpr.document_types import PoseDocument
    from cdpr.errors import CdprError
    from cdpr.scene import nothing_in_the_way
    from executor.standing_pose import standing_pose

    as_referenced = custody.referenced_rig()
    load = nothing_in_the_way(as_referenced).load
    try:
        found = standing_pose(as_referenced, np.array(stands, dtype=np.float64), load)
    except CdprError as error:
        return {"why_not": error.what}
    return PoseDocument.of(found).model_dump(mode="json")


def _show(rig: Rig, told: dict[str, Any]) -> None:
    from cdpr.cli.output import out, show_facts
    from cdpr.cli.reference_facts import reference_text

    latched = told["latched"] or "none"
    if told["run"] is not None:
        latched = f"none; process {told['run']} moves or resets it, see `cdpr monitor`"
    facts = [
        ("rig", rig.name),
        ("bus", told["bus"]),
        ("latched fault", latched),
        ("reference", reference_text(told["reference"])),
    ]
    if told["being_set_up"]:
        facts.append(("drives", "not asked: a motion is being prepared, or somebody else asks"))
    pose = told["pose"]
    if pose is not None:
        facts.append(("platform", pose.get("why_not") or _place(pose)))
    show_facts("how the rig stands", facts)
    for drive in told["drives"] or []:
        new = "" if drive["set_up"] else "  not set up since it was switched on"
        out.print(
            f"  {rig.drive_names[drive['node']]:<19} {drive['state']:<24}"
            f" {drive['position_counts']:>11} counts {drive['tension_n']:8.2f} N{new}",
            soft_wrap=True,
            markup=False,
        )


def _place(pose: dict[str, Any]) -> str:
    x, y, z = pose["position_mm"]
    return f"{x:.2f}, {y:.2f}, {z:.2f} mm by the drives, without a load"
