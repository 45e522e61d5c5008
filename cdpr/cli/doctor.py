"""`cdpr doctor`: looks whether this machine has what a run needs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cdpr.cli.doctor_answer import Answer

if TYPE_CHECKING:
    from cdpr.rig import Rig

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


def doctor(
    rig: Annotated[
        Path | None,
        typer.Argument(help="also look at this rig's bus and cameras", metavar="[RIG]"),
    ] = None,
    camera: Annotated[
        str | None, typer.Option(help="also take a picture with the camera of this index")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="print the result as JSON")] = False,
) -> None:
    """Look whether this machine has what a run needs; with a rig file, whether its bus opens.

    Each thing that is missing comes with the command that mends it. Nothing is sent on the bus.

    [dim]Examples:[/dim]

      cdpr doctor

      cdpr doctor rig.yaml --camera 0
    """
    from cdpr.cli.output import out, show_json
    from cdpr.errors import BadInput
    from cdpr.rig import load_rig

    if camera is not None and rig is None:
        raise BadInput(
            "a camera is looked at with the rig file that describes it",
            where="--camera",
            next_step="name the rig file too: cdpr doctor RIG --camera INDEX",
        )
    answers = [python_version(), *own_packages(), *libraries(), *machine()]
    if rig is not None:
        the_rig = load_rig(rig)
        answers += [*rig_drives(the_rig), *rig_bus(the_rig), *rig_cameras(the_rig, camera)]
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

    from cdpr.cli.doctor_bus import kernel_support

    cores = os.cpu_count() or 1
    kernel = kernel_support()
    text = kernel.text if kernel.good else f"{kernel.text}; other interfaces work"
    return [
        Answer("processors", cores >= 2, f"{cores}", "use a machine with two or more cores"),
        Answer("kernel", True, text),
    ]


def rig_drives(rig: Rig) -> list[Answer]:
    """Whether the package and the files are there that the drives of a rig need."""
    from cdpr.drives_file import OdriveDocument
    from cdpr.errors import BadInput

    drives = rig.document.drives
    if not isinstance(drives, OdriveDocument):
        return []
    from drivers.odrive.dbc import OWN_DBC, read_layouts
    from drivers.odrive.endpoints import read_endpoints

    try:
        read_layouts(Path(drives.dbc) if drives.dbc else OWN_DBC)
        if drives.endpoints is not None:
            read_endpoints(Path(drives.endpoints), drives)
    except BadInput as error:
        return [Answer("drives", False, f"{error.where}: {error.what}", error.next_step)]
    known = "read back" if drives.endpoints else "not read back: the rig file names no endpoints"
    return [Answer("drives", True, f"ODrives; their settings are {known}")]


def rig_bus(rig: Rig) -> list[Answer]:
    """Whether the bus of a rig is fast enough, is set up, and can be opened."""
    from cdpr.cli.doctor_bus import kernel_bus
    from cdpr.cli.doctor_real_time import real_time_permission
    from cdpr.errors import CdprError
    from drivers.bus import IN_PROCESS, BusSettings, open_bus
    from drivers.bus_load import check_bus_load
    from drivers.socketcan import can_interfaces

    settings = BusSettings.of(rig)
    answers: list[Answer] = []
    try:
        load = check_bus_load(rig)
        answers.append(Answer("bus load", True, f"{load:.0%} at worst"))
    except CdprError as error:
        answers.append(Answer("bus load", False, error.what, error.next_step))
    if settings.interface == "socketcan":
        try:
            answers += kernel_bus(settings, can_interfaces())
        except CdprError as error:
            answers.append(Answer("interfaces", False, error.what, error.next_step))
    try:
        open_bus(settings).shutdown()
        answers.append(Answer(f"bus {settings}", True, "opens"))
    except CdprError as error:
        answers.append(Answer(f"bus {settings}", False, error.what, error.next_step))
    if settings.interface != IN_PROCESS:
        answers += real_time_permission()
    return answers


def rig_cameras(rig: Rig, source: str | None) -> list[Answer]:
    """Whether a camera opens and its pictures have the size that the rig file states."""
    from cdpr.errors import CdprError

    if not rig.cameras:
        return [Answer("camera", source is None, "the rig file has none", "leave --camera out")]
    camera = rig.cameras[0]
    if source is None:
        devices = ", ".join(str(path) for path in sorted(Path("/dev").glob("video*")))
        text = f"not tried (--camera INDEX tries it); devices here: {devices or 'none'}"
        return [Answer(f"camera {camera.name}", True, text)]
    from drivers.cameras import LiveCamera

    try:
        LiveCamera(source, camera).close()
    except CdprError as error:
        return [Answer(f"camera {camera.name}", False, error.what, error.next_step)]
    text = f"{source} opens and gives pictures of {camera.width} x {camera.height} px"
    return [Answer(f"camera {camera.name}", True, text)]
