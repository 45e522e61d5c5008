"""`cdpr examples`: the ready rigs, scenes and sessions; lists and copies them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import cdpr
from cdpr.cli.output import out, show_json
from model.errors import BadInput
from model.files.examples import copy_examples, find_examples, select_examples


def examples(
    names: Annotated[
        list[str] | None, typer.Argument(help="examples to copy; without a name, all are listed")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", help="folder to copy to (default: the current one)", metavar="DIR"
        ),
    ] = None,
    everything: Annotated[
        bool,
        typer.Option("--all", help="copy all, into configs/ and examples/ as in the repository"),
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="replace files that exist")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="the list as JSON")] = False,
) -> None:
    """List the ready rigs, scenes and recorded sessions, or copy some of them.

    [dim]Examples:[/dim]

      cdpr examples

      cdpr examples gachon_8_6 environment_1 -o my_robot

      cdpr examples --all
    """
    if names and everything:
        raise BadInput("--all copies every example already", next_step="leave out the names")
    if output is not None and not (names or everything):
        raise BadInput("-o needs something to copy", next_step="name an example, or pass --all")
    known = find_examples(configs(), configs("examples"))
    if not names and not everything:
        if as_json:
            show_json([{"name": e.name, "kind": e.kind, "about": e.about} for e in known])
            return
        for example in known:
            line = f"  {example.kind:<8} {example.name:<22} {example.about}"
            out.print(line, markup=False, soft_wrap=True)
        out.print("next: copy one with `cdpr examples NAME`, or all with `cdpr examples --all`")
        return
    wanted = known if everything else select_examples(known, names or [])
    copies = copy_examples(wanted, output or Path(), grouped=everything, replace=force)
    if as_json:
        show_json([str(path) for path in copies])
        return
    for path in copies:
        out.print(f"copied {path}", markup=False, soft_wrap=True)


def configs(name: str = "configs") -> Path:
    """The folder of the ready rigs and scenes: in the package, or in the repository.

    Args:
        name: ``examples`` for the recorded sessions instead.
    """
    package = Path(cdpr.__file__).resolve().parent
    inside = package / name
    return inside if inside.is_dir() else package.parent / name
