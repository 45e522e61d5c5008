"""`cdpr release`: the end of a day; brakes close and the torque goes, of all drives together."""

from __future__ import annotations

from cdpr.cli.facts import reference_dict, reference_text, show_release
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
from cdpr.cli.output import Terminal, out, show_json
from executor import service


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
        confirm=confirmation(show_release, asks=not yes, as_json=as_json),
        supervisor=SignalSupervisor(),
    )
    if as_json:
        reference = reference_dict(result.reference)
        show_json({"drives": list(result.drives), "reference": reference})
        return
    out.print(f"all drives are without torque: {', '.join(sorted(set(result.drives)))}")
    out.print(f"reference: {reference_text(result.reference)}", soft_wrap=True, markup=False)
