"""`cdpr calibrate apply`: a new rig file with calibration results in place."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calibration.load import load_result, write_calibrated_rig
from cdpr.cli.options import JsonOption
from cdpr.cli.output import err, show_facts, show_json
from model.rig import load_rig


def apply(
    rig: Annotated[Path, typer.Argument(help="rig file (YAML)", metavar="RIG")],
    results: Annotated[
        list[Path], typer.Argument(help="result files of `cdpr calibrate`", metavar="RESULT...")
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="rig file to write; must not exist yet")
    ],
    as_json: JsonOption = False,
) -> None:
    """Write a new rig file with calibration results in place of its own values.

    The rig file itself is never changed, and comments of it are not copied.

    [dim]Example:[/dim]

      cdpr calibrate apply rig.yaml calibration_rig_rig_2026-03-14.yaml -o rig_calibrated.yaml
    """
    loaded = [load_result(path) for path in results]
    new = write_calibrated_rig(output, load_rig(rig), loaded)
    for result in loaded:
        if not result.good_enough:
            what = f"calibration {result.kind} {result.name}, {result.date}"
            err.print(f"remark {what}: {result.verdict}", markup=False, soft_wrap=True)
    if as_json:
        show_json({"rig": str(output), "results": [str(path) for path in results]})
        return
    facts = [(f"{one.kind} {one.name}", f"{one.date}: {one.verdict}") for one in loaded]
    facts += [("rig file", str(output)), ("next", f"`cdpr home {output}`, then plan with it")]
    show_facts(f"{new.name} with its calibration", facts)
