"""`cdpr explain`: what a fault means, its likely cause, and the next step."""

from __future__ import annotations

import difflib
from typing import Annotated

import typer

from cdpr.cli.output import out
from executor.recording.verdict import fault_codes, page_text
from model.errors import BadInput


def explain(
    code: Annotated[
        str | None, typer.Argument(help="code of the fault, such as drive_silent", metavar="CODE")
    ] = None,
) -> None:
    """Explain a fault that a run reported: meaning, likely cause, state of the machine, next step.

    Without a code, list all of them.

    [dim]Example:[/dim]

      cdpr explain drive_silent
    """
    codes = fault_codes()
    if code is None:
        for known in codes:
            title = page_text(known).split("\n", 1)[0].removeprefix("# ")
            out.print(f"  {known:<22} {title}", markup=False, soft_wrap=True)
        return
    if code not in codes:
        near = difflib.get_close_matches(code, codes, n=1)
        raise BadInput(
            f"there is no fault code {code!r}",
            where="cdpr explain",
            next_step=f"run `cdpr explain {near[0]}`"
            if near
            else f"use one of: {', '.join(codes)}",
        )
    out.print(page_text(code).rstrip(), markup=False, soft_wrap=True)
