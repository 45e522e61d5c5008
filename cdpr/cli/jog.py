"""`cdpr jog`: moves the platform a little, straight, slowly, from where it stands."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cdpr.cli.calibrations import CalibrationOption
from cdpr.cli.motion_options import (
    ChannelOption,
    FastOption,
    InterfaceOption,
    WithoutRealTimeOption,
    YesOption,
    require_unused,
)

if TYPE_CHECKING:
    from cdpr.rig import Rig
    from cdpr.scene import Scene

#: A jog is no faster than this, [mm/s].
FASTEST_MM_S = 20.0


def jog(
    rig: Annotated[Path, typer.Argument(help="rig file (YAML)", metavar="RIG")],
    by_mm: Annotated[
        tuple[float, float, float] | None,
        typer.Option("--by-mm", help="how far: x y z, at most 50 mm"),
    ] = None,
    to_home: Annotated[
        bool, typer.Option("--to-home", help="instead: to the rig's home pose, and turned as there")
    ] = False,
    cable: Annotated[
        int | None, typer.Option("--cable", min=1, help="move one winch alone, with --mm")
    ] = None,
    mm: Annotated[
        float | None, typer.Option("--mm", help="pay out so much; negative winds in; at most 50")
    ] = None,
    limit_n: Annotated[
        float | None, typer.Option(help="with --cable: no cable may carry more (default: 60 %)")
    ] = None,
    scene: Annotated[
        Path | None, typer.Option(help="what is in the way, and what the platform carries")
    ] = None,
    no_scene: Annotated[
        bool, typer.Option("--no-scene", help="jog although nobody says what is in the way")
    ] = False,
    clearance_mm: Annotated[
        float | None, typer.Option(min=0.0, help="obstacle clearance instead of the scene's")
    ] = None,
    speed_mm_s: Annotated[
        float, typer.Option(min=0.1, max=FASTEST_MM_S, help="at most the rig's own speed")
    ] = 5.0,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="run folder to make (default: runs/jog, runs/jog-2 …)"),
    ] = None,
    interface: InterfaceOption = None,
    channel: ChannelOption = None,
    calibration: CalibrationOption = None,
    fast: FastOption = False,
    yes: YesOption = False,
    without_real_time: WithoutRealTimeOption = False,
    as_json: Annotated[bool, typer.Option("--json", help="print the summary as JSON")] = False,
) -> None:
    """Move the platform straight by a few millimetres, slowly, from where it stands.

    A jog is a run: planned, proved, checked and gated like any other, and it can be stopped, held
    and watched. With the interface 'virtual' the simulated platform hangs at home. With --cable one
    winch alone is moved: for commissioning, with cables that carry no load.

    [dim]Examples:[/dim]

      cdpr jog rig.yaml --cable 3 --mm -5

      cdpr jog configs/gachon_8_6.yaml --by-mm 0 0 10 --scene configs/environment_1.yaml --fast
    """
    from cdpr.cli.calibrations import calibrated_rig
    from cdpr.cli.carry_out import carry_out, prepared_run
    from cdpr.cli.jog_way import moved, require_short, straight_way, where_it_stands
    from cdpr.cli.named_bus import require_own_time, rig_on_bus
    from cdpr.cli.run_folders import free_folder
    from cdpr.errors import BadInput
    from cdpr.plan import plan_from_document
    from drivers.bus import IN_PROCESS
    from executor.custody import Custody
    from executor.run_folder import RunFolder

    told = calibrated_rig(rig_on_bus(rig, interface, channel), calibration)
    the_rig = _slow(told, speed_mm_s)
    in_process = the_rig.document.bus.interface == IN_PROCESS
    require_own_time(fast, in_process)
    if cable is not None or mm is not None:
        require_unused(
            "cdpr jog",
            {
                "--by-mm": by_mm,
                "--to-home": to_home,
                "--scene": scene,
                "--no-scene": no_scene,
                "--clearance-mm": clearance_mm,
                "--output": output,
            },
            "one cable alone is moved without a path, and nothing in its way is looked at",
        )
        _one_cable(the_rig, cable, mm, limit_n, fast, yes, without_real_time, as_json)
        return
    require_unused(
        "cdpr jog", {"--limit-n": limit_n}, "only with --cable; a path has the rig's own limits"
    )
    if (by_mm is None) != to_home:
        raise BadInput(
            "say how far: --by-mm X Y Z, --to-home, or --cable N --mm X",
            where="cdpr jog",
            next_step="see `cdpr jog --help`",
        )
    if by_mm is not None:
        require_short(by_mm)
    the_scene = _scene(scene, no_scene, clearance_mm, the_rig)
    folder = output or free_folder("jog")
    RunFolder.require_free(folder)
    Custody(the_rig).require_free()
    the_rig = Custody(the_rig).referenced_rig()
    start = the_rig.home if in_process else where_it_stands(the_rig, the_scene)
    goal = the_rig.home if by_mm is None else moved(start, by_mm)
    document = straight_way(the_rig, the_scene, start, goal, not as_json)
    code = carry_out(
        prepared_run(plan_from_document(document), the_rig, quiet=as_json),
        folder,
        {},
        fast=fast,
        start=start,
        yes=yes,
        without_real_time=without_real_time,
        as_json=as_json,
    )
    raise typer.Exit(code)


def _one_cable(
    rig: Rig,
    cable: int | None,
    mm: float | None,
    limit_n: float | None,
    fast: bool,
    yes: bool,
    without_real_time: bool,
    as_json: bool,
) -> None:
    from cdpr.cli.jog_cable import jog_cable
    from cdpr.errors import BadInput

    if cable is None or mm is None:
        raise BadInput(
            "one cable is moved with --cable N and --mm X together",
            where="cdpr jog",
            next_step="pass both, or --by-mm X Y Z to move the platform",
        )
    jog_cable(
        rig, cable, mm, limit_n=limit_n, fast=fast, yes=yes, without_real_time=without_real_time,
        as_json=as_json,
    )  # fmt: skip


def _slow(rig: Rig, speed_mm_s: float) -> Rig:
    """The same rig with a lower speed; plans do not rest on it."""
    from cdpr.rig import rig_from_document

    document = rig.document
    slower = min(speed_mm_s, document.motion.speed_mm_s)
    motion = document.motion.model_copy(update={"speed_mm_s": slower})
    return rig_from_document(document.model_copy(update={"motion": motion}))


def _scene(path: Path | None, without: bool, clearance_mm: float | None, rig: Rig) -> Scene:
    """What is around; nothing only when somebody says so."""
    from cdpr.errors import BadInput
    from cdpr.scene import load_scene, nothing_in_the_way

    if (path is None) != without:
        raise BadInput(
            "say what is in the way: either --scene SCENE or --no-scene",
            where="--scene",
            next_step="pass --scene with the file, or --no-scene if there is nothing to hit",
        )
    scene = nothing_in_the_way(rig) if path is None else load_scene(path).changed(stops=())
    clearance = None if clearance_mm is None else clearance_mm / 1000.0
    return scene.changed(clearance=clearance)
