"""`cdpr status`, `reset`, `release`: the state of a rig, out of a fault, the end of a day."""

from __future__ import annotations

from dataclasses import asdict

from cdpr.cli.operate.supervision import SignalSupervisor, confirmation
from cdpr.cli.options import (
    CalibrationOption,
    ChannelOption,
    InterfaceOption,
    JsonOption,
    NoQuestionOption,
    RigArgument,
    WithoutRealTimeOption,
    rig_on_bus,
)
from cdpr.cli.output import Terminal, out, show_facts, show_json
from executor import service


def status(
    rig: RigArgument,
    interface: InterfaceOption = None,
    channel: ChannelOption = None,
    calibration: CalibrationOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show the state of a rig: faults, reference, drives, tensions, pose. Moves nothing.

    While a run is under way, or being prepared, the drives are not asked; `cdpr monitor` shows
    them.

    [dim]Example:[/dim]

      cdpr status configs/gachon_8_6.yaml --interface socketcan --channel can0
    """
    the_rig = rig_on_bus(rig, interface, channel, calibration)
    result = service.status(the_rig)
    if as_json:
        show_json(result.as_dict())
    else:
        show_facts("state of the rig", result.facts(rig))
        for line in result.drive_lines(the_rig.drive_names):
            out.print(f"  {line}", soft_wrap=True, markup=False)
    if result.missing is not None:
        raise result.missing


# `cdpr reset`: the only way out of a latched fault.


def reset(
    rig: RigArgument,
    interface: InterfaceOption = None,
    channel: ChannelOption = None,
    calibration: CalibrationOption = None,
    yes: NoQuestionOption = False,
    as_json: JsonOption = False,
) -> None:
    """Release a latched fault once its cause is removed: resets drives in fault, moves nothing.

    Drives that hold keep holding. A drive in fault is not reset while others hold the platform.
    Afterwards a run starts only from where the platform stands.

    [dim]Example:[/dim]

      cdpr reset configs/gachon_8_6.yaml --interface socketcan --channel can0
    """
    the_rig = rig_on_bus(rig, interface, channel, calibration)
    result = service.reset(
        the_rig,
        confirm=confirmation(asks=not yes, as_json=as_json),
        listener=Terminal(quiet=as_json),
    )
    if as_json:
        show_json(asdict(result))
        return
    out.print(f"drives: {', '.join(sorted(set(result.drives)))}", soft_wrap=True)
    if result.restarted:
        names = ", ".join(the_rig.drive_names[node] for node in result.restarted)
        out.print(f"power-cycled since their last configuration: {names}", soft_wrap=True)
    out.print(f"reference: {result.reference}", soft_wrap=True, markup=False)
    latch_now = "the fault latch is released" if result.was_latched else "no fault was latched"
    out.print(f"{latch_now}; the next run must start from the platform's present pose")


# `cdpr release`: the end of a day; brakes close and the torque goes, of all drives together.


def release(
    rig: RigArgument,
    interface: InterfaceOption = None,
    channel: ChannelOption = None,
    calibration: CalibrationOption = None,
    yes: NoQuestionOption = False,
    without_real_time: WithoutRealTimeOption = False,
    as_json: JsonOption = False,
) -> None:
    """Release the drives with the platform on a support: close brakes, remove torque.

    All drives together; set-points move nothing. Winches without brakes let their cables go, so
    that the drives have to be referenced again.

    [dim]Example:[/dim]

      cdpr release configs/gachon_8_6.yaml --interface socketcan --channel can0
    """
    result = service.release(
        rig_on_bus(rig, interface, channel, calibration),
        need_real_time_rights=not without_real_time,
        listener=Terminal(quiet=as_json),
        confirm=confirmation(asks=not yes, as_json=as_json),
        supervisor=SignalSupervisor(),
    )
    if as_json:
        show_json(asdict(result))
        return
    out.print(f"all drives are without torque: {', '.join(sorted(set(result.drives)))}")
    out.print(f"reference: {result.reference}", soft_wrap=True, markup=False)
