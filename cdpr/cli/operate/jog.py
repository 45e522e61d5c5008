"""`cdpr jog`: moves the platform a little, straight, slowly, from where it is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from cdpr.cli.facts import show_cable, show_jogging
from cdpr.cli.operate.run import agreement, show, show_files
from cdpr.cli.operate.supervision import RunSupervisor, SignalSupervisor, confirmation
from cdpr.cli.options import (
    CalibrationOption,
    ChannelOption,
    FastOption,
    InterfaceOption,
    RigArgument,
    SummaryJsonOption,
    WithoutRealTimeOption,
    YesOption,
    require_unused,
    rig_on_bus,
    with_option_groups,
)
from cdpr.cli.output import Terminal, out, show_json
from executor import jogging
from executor.drives import is_simulated, require_own_time
from executor.hold_to_run.session import jog_session
from executor.jogging import FASTEST, SPEED
from model.errors import BadInput
from model.files.documents import millimetres
from model.rig import Rig
from model.scene import Scene, load_scene


@dataclass(frozen=True, slots=True)
class PathOptions:
    """How far the platform is moved, among what; every field is an option of `cdpr jog`."""

    by_mm: Annotated[
        tuple[float, float, float] | None,
        typer.Option("--by-mm", help="distance x y z, at most 50 mm"),
    ] = None
    to_home: Annotated[
        bool, typer.Option("--to-home", help="move to the rig's home pose and orientation")
    ] = False
    scene: Annotated[Path | None, typer.Option(help="scene file: obstacles and payload")] = None
    no_scene: Annotated[
        bool, typer.Option("--no-scene", help="jog without a description of obstacles")
    ] = False
    clearance_mm: Annotated[
        float | None, typer.Option(min=0.0, help="obstacle clearance instead of the scene's")
    ] = None
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", help="run folder to create (default: runs/jog, runs/jog-2 …)"
        ),
    ] = None

    def given(self) -> dict[str, object]:
        """Each option by name with its value."""
        return {
            "--by-mm": self.by_mm,
            "--to-home": self.to_home,
            "--scene": self.scene,
            "--no-scene": self.no_scene,
            "--clearance-mm": self.clearance_mm,
            "--output": self.output,
        }


DEFAULT_PATH = PathOptions()


@with_option_groups
def jog(
    rig: RigArgument,
    path: PathOptions = DEFAULT_PATH,
    cable: Annotated[
        int | None, typer.Option("--cable", min=1, help="move one winch alone, with --mm")
    ] = None,
    mm: Annotated[
        float | None, typer.Option("--mm", help="length to pay out, at most 50; negative winds in")
    ] = None,
    hold_to_run: Annotated[
        bool,
        typer.Option(
            "--hold-to-run",
            help="enable the drives and follow held controls, as of `cdpr console`, until it ends",
        ),
    ] = False,
    limit_n: Annotated[
        float | None, typer.Option(help="with --cable: tension limit of any cable (default: 60 %)")
    ] = None,
    speed_mm_s: Annotated[
        float, typer.Option(min=0.1, max=1000.0 * FASTEST, help="largest speed, at most the rig's")
    ] = 1000.0 * SPEED,
    interface: InterfaceOption = None,
    channel: ChannelOption = None,
    calibration: CalibrationOption = None,
    fast: FastOption = False,
    yes: YesOption = False,
    without_real_time: WithoutRealTimeOption = False,
    as_json: SummaryJsonOption = False,
) -> None:
    """Move the platform straight slowly by a few millimetres from its present pose.

    A jog is a run: planned, proved, checked and gated like any other, and it can be stopped, held
    and watched. With the interface 'virtual' the simulated platform hangs at home. With --cable one
    winch alone is moved: for commissioning, with cables that carry no load. With --hold-to-run the
    drives stay enabled, and the platform moves as long as a control is held, over the command
    socket; `cdpr console` has such controls.

    [dim]Examples:[/dim]

      cdpr jog rig.yaml --cable 3 --mm -5

      cdpr jog configs/gachon_8_6.yaml --by-mm 0 0 10 --scene configs/environment_1.yaml --fast
    """
    the_rig = rig_on_bus(rig, interface, channel, calibration)
    require_own_time(the_rig, not fast)
    speed = speed_mm_s / 1000.0
    if cable is not None or mm is not None:
        require_unused(
            "cdpr jog",
            path.given(),
            "a single cable is moved without a path, and obstacles are not checked",
        )
        _one_cable(the_rig, cable, mm, limit_n, speed, fast, yes, without_real_time, as_json)
        return
    require_unused(
        "cdpr jog", {"--limit-n": limit_n}, "only with --cable; a path uses the rig's limits"
    )
    if hold_to_run:
        _held(the_rig, path, speed, fast, yes, without_real_time, as_json)
        return
    by = None if path.by_mm is None else millimetres(list(path.by_mm))
    jogging.require_distance(by, to_home=path.to_home)
    the_scene = _scene(path.scene, path.no_scene, path.clearance_mm)
    with RunSupervisor(lambda result: show(result, as_json)) as supervisor:
        result = jogging.jog(
            the_rig,
            the_scene,
            by=by,
            to_home=path.to_home,
            speed=speed,
            folder=path.output,
            realtime=not fast,
            need_real_time_rights=not without_real_time,
            listener=Terminal(quiet=as_json),
            confirm=agreement(supervisor, the_rig, yes, as_json),
            supervisor=supervisor,
        )
        show_files(result, as_json)
    raise typer.Exit(result.exit_code)


def _held(
    rig: Rig,
    path: PathOptions,
    speed: float,
    fast: bool,
    yes: bool,
    without_real_time: bool,
    as_json: bool,
) -> None:
    require_unused(
        "cdpr jog",
        {
            "--by-mm": path.by_mm,
            "--to-home": path.to_home,
            "--output": path.output,
            "--json": as_json,
            "--fast": fast,
        },
        "held controls say where to go, in real time",
    )
    jog_session(
        rig,
        _scene(path.scene, path.no_scene, path.clearance_mm),
        speed=speed,
        need_real_time_rights=not without_real_time,
        listener=Terminal(quiet=False),
        confirm=confirmation(show_jogging, asks=not (is_simulated(rig) or yes), as_json=False),
        supervisor=SignalSupervisor(),
    )
    out.print("the session is over; the drives hold")


def _one_cable(
    rig: Rig,
    cable: int | None,
    mm: float | None,
    limit_n: float | None,
    speed: float,
    fast: bool,
    yes: bool,
    without_real_time: bool,
    as_json: bool,
) -> None:
    if cable is None or mm is None:
        raise BadInput(
            "a single cable needs both --cable N and --mm X",
            where="cdpr jog",
            next_step="pass both, or --by-mm X Y Z to move the platform",
        )
    done = jogging.jog_cable(
        rig,
        cable,
        mm / 1000.0,
        limit=limit_n,
        speed=speed,
        realtime=not fast,
        need_real_time_rights=not without_real_time,
        listener=Terminal(quiet=as_json),
        confirm=confirmation(show_cable, asks=not (is_simulated(rig) or yes), as_json=as_json),
        supervisor=SignalSupervisor(),
    )
    moved_mm = done.moved * 1000.0
    tensions = [round(float(t), 2) for t in done.tensions]
    if as_json:
        show_json({"cable": cable, "moved_mm": round(moved_mm, 4), "tensions_n": tensions})
        return
    out.print(f"cable {cable} moved by {moved_mm:+.3f} mm, positive pays out; the drives hold")
    out.print(f"tensions: {', '.join(f'{t:.1f}' for t in tensions)} N", soft_wrap=True)


def _scene(path: Path | None, without: bool, clearance_mm: float | None) -> Scene | None:
    """What is around; nothing only when somebody says so."""
    if (path is None) != without:
        raise BadInput(
            "obstacles are not given: pass either --scene SCENE or --no-scene",
            where="--scene",
            next_step="pass --scene with the file, or --no-scene if there are no obstacles",
        )
    if path is None:
        return None
    clearance = None if clearance_mm is None else clearance_mm / 1000.0
    return load_scene(path).changed(stops=()).changed(clearance=clearance)
