"""`cdpr doctor`: looks whether this machine has what a run needs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

PACKAGES = ("cdpr", "planner", "executor", "drivers", "tracking", "calibration", "simulation")
LIBRARIES = {
    "pydantic": "pydantic",
    "yaml": "pyyaml",
    "rich": "rich",
    "numpy": "numpy",
    "numba": "numba",
    "scipy": "scipy",
    "cv2": "opencv-python-headless",
    "fcl": "python-fcl",
    "can": "python-can",
    "canopen": "canopen",
    "msgpack": "msgpack",
    "ruckig": "ruckig",
    "daqp": "daqp",
    "mcap": "mcap",
    "matplotlib": "matplotlib",
}


@dataclass(frozen=True, slots=True)
class Answer:
    """One thing that was looked at.

    Attributes:
        name: What.
        good: Whether it is as a run needs it.
        text: What was found.
        fix: The next step where it is not good.
    """

    name: str
    good: bool
    text: str
    fix: str = ""


def doctor(
    rig: Annotated[
        Path | None, typer.Argument(help="also look at this rig's bus", metavar="[RIG]")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="print the result as JSON")] = False,
) -> None:
    """Look whether this machine has what a run needs; with a rig file, whether its bus opens.

    [dim]Examples:[/dim]

      cdpr doctor

      cdpr doctor configs/gachon_8_6.yaml
    """
    from cdpr.cli.output import out, show_json

    answers = [python_version(), *own_packages(), *libraries(), *machine()]
    if rig is not None:
        answers += rig_bus(rig)
    if as_json:
        keys = ("name", "good", "text", "fix")
        show_json([{key: getattr(answer, key) for key in keys} for answer in answers])
    else:
        for answer in answers:
            mark = "[green]ok  [/]" if answer.good else "[red]miss[/]"
            out.print(f"{mark} {answer.name}: {answer.text}", soft_wrap=True)
            if not answer.good and answer.fix:
                out.print(f"     next: {answer.fix}", soft_wrap=True)
    if not all(answer.good for answer in answers):
        raise typer.Exit(4)


def python_version() -> Answer:
    """Python itself."""
    import platform
    import sys

    good = sys.version_info >= (3, 11)
    return Answer("python", good, platform.python_version(), "install Python 3.11 or newer")


def own_packages() -> list[Answer]:
    """Whether the imported packages are ours: others of the same names exist."""
    from importlib.util import find_spec

    ours = Path(__file__).resolve().parents[2]
    answers = []
    for name in PACKAGES:
        spec = find_spec(name)
        origin = Path(spec.origin).resolve() if spec and spec.origin else None
        good = origin is not None and origin.parents[1] == ours
        text = "ours" if good else f"another package: {origin}" if origin else "not found"
        fix = f"uninstall the other {name!r}, or use an environment of its own for cdpr"
        answers.append(Answer(f"package {name}", good, text, fix))
    return answers


def libraries() -> list[Answer]:
    """Whether every library can be imported, and its version."""
    from importlib import import_module
    from importlib.metadata import version

    answers = []
    for module, package in LIBRARIES.items():
        try:
            import_module(module)
            answers.append(Answer(package, True, version(package)))
        except ImportError as error:
            answers.append(Answer(package, False, str(error), f"pip install {package}"))
    return answers


def machine() -> list[Answer]:
    """What real time and real buses need; only told, since a rehearsal needs none of it."""
    import os
    import socket

    cores = os.cpu_count() or 1
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
        kernel = "SocketCAN is there"
    except (AttributeError, OSError) as error:
        kernel = f"no SocketCAN in this kernel ({error}); other interfaces work"
    return [
        Answer("processors", cores >= 2, f"{cores}", "use a machine with two or more cores"),
        Answer("kernel", True, kernel),
    ]


def rig_bus(path: Path) -> list[Answer]:
    """Whether the bus of a rig file is fast enough and can be opened."""
    from cdpr.errors import CdprError
    from cdpr.rig import load_rig
    from drivers.bus import BusSettings, open_bus
    from drivers.bus_load import check_bus_load

    rig = load_rig(path)
    settings = BusSettings.of(rig)
    try:
        load = check_bus_load(rig)
        open_bus(settings).shutdown()
    except CdprError as error:
        return [Answer(f"bus {settings}", False, error.what, error.next_step)]
    return [Answer(f"bus {settings}", True, f"opens; load {load:.0%} at worst")]
