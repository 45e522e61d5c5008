"""How every `cdpr calibrate` verb ends: result file, report, verdict and exit code."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cdpr.cli.finite import finite

if TYPE_CHECKING:
    from calibration.result_file import ResultDocument

FolderOption = Annotated[
    Path | None, typer.Option("-o", "--output", help="folder for the result and its report")
]
ForceOption = Annotated[
    bool, typer.Option("--force", help="replace the result of the same name and day")
]
JsonOption = Annotated[bool, typer.Option("--json", help="print the result as JSON")]
WantedOption = Annotated[
    float, typer.Option(min=0.001, callback=finite, help="what is good enough, 95 %")
]


def begin(kind: str, name: str, output: Path | None, force: bool) -> date:
    """Before the work, so that it is not lost: makes the folder; returns the result's date.

    Args:
        kind: Of the result.
        name: Of what is calibrated.
        output: The folder; None to write nothing.
        force: Whether files that exist are replaced.

    Raises:
        BadInput: The folder cannot be made or written to, or holds such a result or report.
    """
    from datetime import UTC, datetime

    from calibration.result_file import result_file_name
    from cdpr.cli.plan import check_output
    from cdpr.cli.workers import make_place

    today = datetime.now(UTC).date()
    if output is not None:
        result = output / result_file_name(kind, name, today.isoformat())
        if output.is_dir():
            for file in (result, result.with_suffix(".html")):
                check_output(file, force)
        make_place(output)
    return today


def finish(
    result: ResultDocument,
    page: str,
    facts: Sequence[tuple[str, str]],
    output: Path | None,
    as_json: bool,
) -> None:
    """Writes the result and its report, tells them, and exits with 3 if it is not good enough.

    Args:
        result: What was found.
        page: The report.
        facts: More that people want to know.
        output: The folder; None to write nothing.
        as_json: Whether a program reads it.

    Raises:
        BadInput: The folder cannot be written to.
    """
    from calibration.result_file import write_result
    from cdpr.cli.output import show_facts, show_json
    from cdpr.documents import write_atomic

    files = []
    if output is not None:
        written = write_result(output, result)
        report = written.with_suffix(".html")
        write_atomic(report, page)
        files = [("result", str(written)), ("report", str(report))]
    if as_json:
        show_json(result.sealed().model_dump(mode="json"))
    else:
        lines = [("verdict", result.verdict), *(("next", step) for step in result.next_steps)]
        lines += [
            *result.in_words(),
            *facts,
            *(("not used", f"{k} {why}") for k, why in result.unused.items()),
        ]
        show_facts(f"{result.kind} {result.name}", [*lines, *files])
    if not result.good_enough:
        raise typer.Exit(3)
