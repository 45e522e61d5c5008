"""`cdpr status`, `reset`, `release`: show a rig's state, clear its latch, release its drives."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import typer

from cdpr.cli.operate.supervision import SignalSupervisor, confirmation
from cdpr.cli.options import JSON, NO_QUESTION, RIG, WITHOUT_REAL_TIME, BusOptions
from cdpr.cli.output import Terminal, err, out, show_facts, show_json, show_line
from executor import service


def status(
    *,
    rig: Path = RIG,
    bus: BusOptions,
    as_json: bool = JSON,
) -> None:
    """Show the state of a rig: faults, reference, drives, tensions, pose. Moves nothing.

    Drives are not queried while a run is in progress or being prepared; `cdpr monitor` shows them.

    Example:
      cdpr status configs/gachon_8_6.yaml --interface socketcan --channel can0
    """
    the_rig = bus.rig(rig)
    result = service.status(the_rig)
    missing = result.missing
    if as_json:
        show_json({**result.as_dict(), **(missing.as_dict() if missing else {})})
    else:
        show_facts("state of the rig", result.facts(rig))
        for line in result.drive_lines(the_rig.drive_names):
            show_line(f"  {line}")
    if missing is not None:
        show_line(f"error: {missing}", err)
        raise typer.Exit(missing.exit_code)


# `cdpr reset`: the only command that clears a latched fault.


def reset(
    *,
    rig: Path = RIG,
    bus: BusOptions,
    yes: bool = NO_QUESTION,
    as_json: bool = JSON,
) -> None:
    """Clear a latched fault once its cause is removed: reset drives in fault, move nothing.

    Drives that hold keep holding. A drive in fault is not reset while others hold the platform.
    The next run must start at the platform's current pose.

    Example:
      cdpr reset configs/gachon_8_6.yaml --interface socketcan --channel can0
    """
    the_rig = bus.rig(rig)
    result = service.reset(
        the_rig,
        confirm=confirmation(asks=not yes, as_json=as_json),
        listener=Terminal(quiet=as_json),
    )
    if as_json:
        show_json(asdict(result))
        return
    show_line(f"drives: {', '.join(sorted(set(result.drives)))}")
    if result.restarted:
        names = ", ".join(the_rig.drive_names[node] for node in result.restarted)
        show_line(f"power-cycled since their last set-up, or set up for another cycle: {names}")
    show_line(f"reference: {result.reference}")
    latch_now = "the fault latch is cleared" if result.was_latched else "no fault was latched"
    out.print(f"{latch_now}; the next run must start from the platform's current pose")


# `cdpr release`: close all brakes, then remove the torque of all drives.


def release(
    *,
    rig: Path = RIG,
    bus: BusOptions,
    yes: bool = NO_QUESTION,
    without_real_time: bool = WITHOUT_REAL_TIME,
    as_json: bool = JSON,
) -> None:
    """Release the drives with the platform on a support: close brakes, remove torque.

    All drives are released together, without motion commands. Winches without brakes pay out
    their cables, so home the rig again afterwards.

    Example:
      cdpr release configs/gachon_8_6.yaml --interface socketcan --channel can0
    """
    result = service.release(
        bus.rig(rig),
        need_real_time_rights=not without_real_time,
        listener=Terminal(quiet=as_json),
        confirm=confirmation(asks=not yes, as_json=as_json),
        supervisor=SignalSupervisor(),
    )
    if as_json:
        show_json(asdict(result))
        return
    out.print(f"torque removed from all drives: {', '.join(sorted(set(result.drives)))}")
    show_line(f"reference: {result.reference}")
