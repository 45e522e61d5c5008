"""`cdpr status`: the state of a rig; moves nothing and writes nothing."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import Any

from cdpr.cli.facts import show_status, status_dict
from cdpr.cli.options import (
    CalibrationOption,
    ChannelOption,
    InterfaceOption,
    JsonOption,
    RigArgument,
    rig_on_bus,
)
from cdpr.cli.output import show_json
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
    told = status_dict(result)
    if as_json:
        show_json(told)
    else:
        show_status(the_rig, result, _next_step(rig, told))
    if result.missing is not None:
        raise result.missing


def _next_step(rig: Path, told: dict[str, Any]) -> str:
    """What has to be done before anything can run; nothing where all is well or a run goes on."""
    if told["run"] is not None or told["being_set_up"]:
        return ""
    steps = []
    if told["latched"] is not None:
        steps.append(
            f"find the cause and check the platform, then run cdpr reset {quote(str(rig))}"
        )
    if not told["reference"]["counts"]:
        ways = "--at-home, --pose-mm X Y Z or --camera SOURCE"
        steps.append(f"cdpr home {quote(str(rig))} with {ways}")
    return "; then ".join(steps)
