"""How every `cdpr calibrate` verb ends: result file, report, verdict and exit code."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from calibration.result_file import ResultDocument

FolderOption = Annotated[
    Path | None, typer.Option("-o", "--output", help="folder for the result and its report")
]
ForceOption = Annotated[bool, typer.Option("--force", help="replace what the folder holds")]
JsonOption = Annotated[bool, typer.Option("--json", help="print the result as JSON")]
WantedOption = Annotated[float, typer.Option(min=0.001, help="what is good enough, 95 %")]


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
        files = [("result", str(write_result(output, result)))]
        write_atomic(output / "report.html", page)
        files.append(("report", str(output / "report.html")))
    if as_json:
        show_json(result.model_dump(mode="json"))
    else:
        lines = [("verdict", result.verdict), *(("next", step) for step in result.next_steps)]
        lines += [(name, str(interval)) for name, interval in result.stated.items()]
        lines += [*facts, *(("not used", f"{k} {why}") for k, why in result.unused.items())]
        show_facts(f"{result.kind} {result.name}", [*lines, *files])
    if not result.good_enough:
        raise typer.Exit(3)
