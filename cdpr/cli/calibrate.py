"""`cdpr calibrate`: cameras, from pictures of a board."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cdpr.cli.board_options import (
    BoardName,
    BoardOption,
    ColumnsOption,
    DictionaryOption,
    FamilyOption,
    FirstOption,
    GapOption,
    LegacyOption,
    MarkerOption,
    RowsOption,
    SquareOption,
    TagOption,
    board_of,
)

if TYPE_CHECKING:
    from calibration.boards import Image
    from calibration.camera import CameraCalibration
    from calibration.verdict import Verdict
    from drivers.picture_folder import OneCamerasPictures


def camera(
    folder: Annotated[
        Path, typer.Argument(help="folder with pictures of the board", metavar="DIR")
    ],
    columns: ColumnsOption,
    rows: RowsOption,
    board: BoardOption = BoardName.chessboard,
    square_mm: SquareOption = None,
    marker_mm: MarkerOption = None,
    dictionary: DictionaryOption = "4X4_50",
    legacy: LegacyOption = False,
    tag_mm: TagOption = None,
    gap_mm: GapOption = None,
    family: FamilyOption = "tag36h11",
    first: FirstOption = 0,
    name: Annotated[str, typer.Option(help="of the camera in the rig file")] = "camera",
    wanted_mm: Annotated[
        float, typer.Option(min=0.001, help="how well points must be seen to be good enough")
    ] = 1.0,
    distance_m: Annotated[
        float | None,
        typer.Option(min=0.01, help="from which the camera measures, else the boards'"),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="folder for the result and its report")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="replace what the folder holds")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="print the result as JSON")] = False,
) -> None:
    """Find a camera's matrix and lens distortion, and say whether they are good enough.

    Exit code 3 where they are not. Files that cannot be used are named; the others are used.

    [dim]Examples:[/dim]

      cdpr calibrate camera pictures/ --columns 9 --rows 6 --square-mm 25 -o calibration

      cdpr calibrate camera pictures/ --board charuco --columns 7 --rows 5 --square-mm 30
      --marker-mm 22 --dictionary 4X4_50
    """
    from datetime import UTC, datetime

    from calibration.camera import calibrate_camera
    from calibration.camera_page import camera_page
    from calibration.result_file import camera_result, write_result
    from calibration.verdict import judge
    from cdpr.cli.output import progress_bar, show_facts, show_json
    from cdpr.cli.workers import make_folder
    from cdpr.documents import write_atomic
    from drivers.picture_folder import OneCamerasPictures

    _require_file_name(name)
    sizes = {"square": square_mm, "marker": marker_mm, "tag": tag_mm, "gap": gap_mm}
    the_board = board_of(board, columns, rows, sizes, dictionary, legacy, family, first)
    pictures = OneCamerasPictures(folder)
    if output is not None:
        make_folder(output, force)
    with progress_bar("looking for the board", len(pictures.names), not as_json) as advance:
        result = calibrate_camera(_told(pictures, advance), the_board, pictures.unused)
    verdict = judge(result, wanted_mm / 1000.0, distance_m)
    today = datetime.now(UTC).date()
    document = camera_result(result, verdict, name, today)
    if output is not None:
        write_result(output / f"calibration_camera_{name}_{today}.yaml", document)
        page = camera_page(result, verdict, name, today.isoformat())
        write_atomic(output / "report.html", page)
    if as_json:
        show_json(document)
    else:
        show_facts(f"camera {name}", _facts(result, verdict, output))
    if not verdict.good:
        raise typer.Exit(3)


def _require_file_name(name: str) -> None:
    """The camera's name becomes part of a file's; told before the long fit, not after it.

    Raises:
        BadInput: It cannot.
    """
    from cdpr.errors import BadInput

    if not name or "/" in name or "\0" in name:
        raise BadInput(
            f"{name!r} cannot be part of a file name",
            where="--name",
            next_step="name the camera as in the rig file, without a slash",
        )


def _told(
    pictures: OneCamerasPictures, advance: Callable[[float], None]
) -> Iterator[tuple[str, Image]]:
    """Pictures, each told when it was looked at."""
    for number, picture in enumerate(pictures, 1):
        yield picture
        advance(number)


def _facts(
    result: CameraCalibration, verdict: Verdict, output: Path | None
) -> list[tuple[str, str]]:
    """What was found, for people."""
    widths = result.uncertainty.half_widths
    facts = [("verdict", str(verdict)), *(("next", step) for step in verdict.next_steps)]
    facts += [
        (key, f"{value:.5g} ± {width:.2g}")
        for (key, value), width in zip(result.values.items(), widths, strict=True)
    ]
    facts += [
        ("corners", f"{result.error:.3f} px off (RMS) in {len(result.views)} pictures"),
        ("covered", f"{verdict.covered:.0%} of the picture"),
        (
            "precision",
            f"{verdict.error * 1e3:.2g} mm at {verdict.distance:.2f} m (95 %); two halves of the"
            f" pictures are {verdict.halves * 1e3:.2g} mm apart",
        ),
    ]
    facts += [("not used", f"{name} {reason}") for name, reason in result.unused.items()]
    if output is not None:
        facts.append(("report", str(output / "report.html")))
    return facts
