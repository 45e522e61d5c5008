"""`cdpr reset`: the only way out of a latched fault."""

from __future__ import annotations

from cdpr.cli.facts import reference_dict, reference_text, show_reset
from cdpr.cli.operate.supervision import confirmation
from cdpr.cli.options import (
    CalibrationOption,
    ChannelOption,
    InterfaceOption,
    JsonOption,
    NoQuestionOption,
    RigArgument,
    rig_on_bus,
)
from cdpr.cli.output import Terminal, out, show_json
from executor import service


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
        confirm=confirmation(show_reset, asks=not yes, as_json=as_json),
        listener=Terminal(quiet=as_json),
    )
    if as_json:
        show_json(
            {
                "was_latched": result.was_latched,
                "cause": result.cause,
                "drives": list(result.drives),
                "restarted": list(result.restarted),
                "reference": reference_dict(result.reference),
            }
        )
        return
    out.print(f"drives: {', '.join(sorted(set(result.drives)))}", soft_wrap=True)
    if result.restarted:
        names = ", ".join(the_rig.drive_names[node] for node in result.restarted)
        out.print(f"power-cycled since their last configuration: {names}", soft_wrap=True)
    out.print(f"reference: {reference_text(result.reference)}", soft_wrap=True, markup=False)
    latch_now = "the fault latch is released" if result.was_latched else "no fault was latched"
    out.print(f"{latch_now}; the next run must start from the platform's present pose")
