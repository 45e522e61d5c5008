"""The option that puts calibration results in place of the rig file's numbers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from cdpr.rig import Rig

CalibrationOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--calibration",
        help="result file of `cdpr calibrate`, in place of the rig file's numbers; again for more",
        metavar="FILE",
    ),
]


def calibrated_rig(rig: Rig, files: Sequence[Path] | None) -> Rig:
    """The rig with the results of files in place of its file's numbers, in memory only.

    Of each result that was not good enough it is told why: it may be used all the same.

    Raises:
        BadInput: A file cannot be used, or is not about this rig.
    """
    if not files:
        return rig
    from calibration.kinds import calibrated, load_result
    from cdpr.cli.output import err

    results = [load_result(file) for file in files]
    better = calibrated(rig, results)
    for result in results:
        if not result.good_enough:
            what = f"calibration {result.kind} {result.name}, {result.date}"
            err.print(f"note: {what}: {result.verdict}", markup=False, soft_wrap=True)
    return better
