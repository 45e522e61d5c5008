"""`cdpr home`: pretensions the cables and references the drums' counts."""

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
    from cdpr.poses import Pose
    from cdpr.rig import Rig
    from executor.custody import Custody
    from executor.reference import ReferenceDocument
    from executor.winch_motion import WinchesStand
    from executor.wishes import WishBoard

#: A cable is taken up no further than this, [mm], and no faster than that, [mm/s].
FURTHEST_MM, FASTEST_MM_S = 200.0, 10.0
#: Defaults: reach and speed as above, pictures, and how slack simulated cables hang, [mm].
REACH_MM, SPEED_MM_S, PICTURES, SLACK_MM = 50.0, 2.0, 20, 5.0


def home(
    rig: Annotated[Path, typer.Argument(help="rig file (YAML)", metavar="RIG")],
    at_home: Annotated[
        bool, typer.Option("--at-home", help="a jig holds the platform at the rig's home pose")
    ] = False,
    pose_mm: Annotated[
        tuple[float, float, float] | None,
        typer.Option("--pose-mm", help="a jig holds it level at x y z"),
    ] = None,
    camera: Annotated[
        list[str] | None,
        typer.Option(
            help="it hangs free, and this camera measures it: 'synthetic', an index, or of another"
            " camera than the rig file's first NAME=SOURCE",
            metavar="SOURCE",
        ),
    ] = None,
    calibration: CalibrationOption = None,
    as_rig_file: Annotated[
        bool,
        typer.Option(
            "--as-rig-file", help="move nothing: absolute encoders count what the rig file says"
        ),
    ] = False,
    tension_n: Annotated[
        float | None, typer.Option(help="pretension (default: twice the rig's smallest tension)")
    ] = None,
    limit_n: Annotated[
        float | None, typer.Option(help="no cable may carry more (default: 60 % of the range)")
    ] = None,
    reach_mm: Annotated[
        float, typer.Option(min=0.1, max=FURTHEST_MM, help="take up at most so much of a cable")
    ] = REACH_MM,
    speed_mm_s: Annotated[
        float, typer.Option(min=0.01, max=FASTEST_MM_S, help="no winch is faster")
    ] = SPEED_MM_S,
    pictures: Annotated[
        int, typer.Option(min=5, max=1000, help="to measure the pose in")
    ] = PICTURES,
    interface: InterfaceOption = None,
    channel: ChannelOption = None,
    simulated_slack_mm: Annotated[
        float, typer.Option(min=0.0, max=100.0, help="how slack simulated cables hang at most")
    ] = SLACK_MM,
    fast: FastOption = False,
    yes: YesOption = False,
    without_real_time: WithoutRealTimeOption = False,
    as_json: Annotated[bool, typer.Option("--json", help="print the reference as JSON")] = False,
) -> None:
    """Wind slack cables in until all are taut, then reference the drives at a pose that is known.

    All winches together, slowly, each until its cable carries the pretension; a cable that carries
    too much, or none after the whole reach, stops all. The reference is a file of its own, which
    `cdpr run` and `cdpr jog` use. With the interface 'virtual' it is a rehearsal.

    [dim]Examples:[/dim]

      cdpr home rig.yaml --at-home

      cdpr home configs/gachon_8_6.yaml --camera synthetic --fast
    """
    from functools import partial

    from cdpr.cli.calibrations import calibrated_rig
    from cdpr.cli.camera_choice import choose_one_camera, require_simulated_pictures
    from cdpr.cli.carry_out import show_and_ask
    from cdpr.cli.home_facts import show_reference, show_wish
    from cdpr.cli.home_pose import referenced, require_one_way, require_picture, stated_pose
    from cdpr.cli.named_bus import require_own_time, rig_on_bus
    from cdpr.cli.output import show_json
    from cdpr.cli.winches import WinchMotion, carry_out_by_law, limit_of, speed_of
    from drivers.bus import IN_PROCESS
    from executor.custody import Custody
    from executor.winch_laws import TakeUp
    from simulation.power_loss import PowerLoss

    the_rig = calibrated_rig(rig_on_bus(rig, interface, channel), calibration)
    in_process = the_rig.document.bus.interface == IN_PROCESS
    require_own_time(fast, in_process)
    if as_rig_file and not (at_home or pose_mm or camera):
        require_unused(
            "cdpr home",
            {
                "--tension-n": tension_n,
                "--limit-n": limit_n,
                "--reach-mm": reach_mm != REACH_MM,
                "--speed-mm-s": speed_mm_s != SPEED_MM_S,
                "--pictures": pictures != PICTURES,
                "--simulated-slack-mm": simulated_slack_mm != SLACK_MM,
                "--fast": fast,
                "--without-real-time": without_real_time,
            },
            "--as-rig-file moves nothing and measures nothing",
        )
        _go_by_the_rig_file(Custody(the_rig), yes or in_process, as_json)
        return
    require_one_way(at_home, pose_mm, camera, as_rig_file)
    eye = choose_one_camera(the_rig, camera, in_process) if camera else None
    if eye is not None:
        require_simulated_pictures(eye[1:], fast)
    known = stated_pose(the_rig, pose_mm) if eye is None else None
    limit = limit_of(the_rig, limit_n)
    target = _target(the_rig, tension_n, limit)
    speed, reach = speed_of(the_rig, speed_mm_s), reach_mm / 1000.0
    custody = Custody(the_rig)
    custody.require_free()
    if eye is not None:
        require_picture(the_rig, eye, shown=not as_json)
    show_and_ask(
        partial(show_wish, the_rig, target, limit, reach, speed, eye),
        "Wind the cables in now?",
        "nothing was moved",
        asks=not (in_process or yes),
        as_json=as_json,
    )
    made: list[ReferenceDocument] = []

    def at_rest(stand: WinchesStand, true_pose: Pose | None, board: WishBoard) -> ReferenceDocument:
        made.append(referenced(the_rig, stand, true_pose, board, known, eye, pictures))
        return made[0]

    take_up = partial(TakeUp, target=target, limit=limit, reach=reach, speed=speed)

    lost = PowerLoss.drawn(
        the_rig, 0, simulated_slack_mm / 1000.0, on_a_stand=eye is None
    ) if in_process else None  # fmt: skip
    motion = WinchMotion(
        the_rig, known or the_rig.home, limit, speed, take_up, lost, fast, without_real_time,
        as_json, anew=True, name="home",
    )  # fmt: skip
    carry_out_by_law(motion, at_rest)
    (reference,) = made
    where = None if in_process else str(custody.file.path)
    if as_json:
        show_json({"file": where, **reference.model_dump(mode="json")})
    else:
        show_reference(reference, where)


def _go_by_the_rig_file(custody: Custody, yes: bool, as_json: bool) -> None:
    """Drops the reference, so that the rig file's counts are the drives' again."""
    from cdpr.cli.carry_out import show_and_ask
    from cdpr.cli.output import out, show_json
    from cdpr.cli.reference_facts import reference_text, reference_told

    text = f"the reference that is given up: {reference_text(reference_told(custody))}"
    show_and_ask(
        lambda on: on.print(text, soft_wrap=True, markup=False),
        "Do all drives count what the rig file says?",
        "the reference is as it was",
        asks=not yes,
        as_json=as_json,
    )
    custody.go_by_the_rig_file()
    if as_json:
        show_json({"file": None})
    else:
        out.print("no reference is kept; drives count what the rig file says at home")


def _target(rig: Rig, tension_n: float | None, limit: float) -> float:
    from cdpr.errors import Refused

    target = 2.0 * rig.min_tension if tension_n is None else tension_n
    if not rig.min_tension <= target <= 0.8 * limit:
        raise Refused(
            f"a pretension of {target:g} N is not from {rig.min_tension:g} N up to 80 % of the"
            f" limit of {limit:g} N",
            where="--tension-n",
            why="cables must be taut afterwards, and winding in must have room below the limit",
            next_step="name another pretension or limit",
        )
    return target
