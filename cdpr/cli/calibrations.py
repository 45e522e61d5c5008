"""The option that puts calibration results in place of the rig file's numbers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from cdpr.cli.output import Terminal
from model.rig import Rig

CalibrationOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--calibration",
        help="result file of `cdpr calibrate`, used instead of the rig file's values; repeatable",
        metavar="FILE",
    ),
]


def calibrated_rig(rig: Rig, files: Sequence[Path] | None) -> Rig:
    """See `calibration.load.with_calibrations`.

    Raises:
        BadInput: A file cannot be used, or is not about this rig.
    """
    if not files:
        return rig
    # Scientific libraries, of which `cdpr stop` and others without this option must not wait.
    from calibration.load import with_calibrations

    return with_calibrations(rig, files, Terminal())
