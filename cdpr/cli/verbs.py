"""The list of verbs, in the order of the help text."""

from __future__ import annotations

import functools
from collections.abc import Callable

import typer

from cdpr.cli import bench, calibrate
from cdpr.cli.calibrate_diff import diff
from cdpr.cli.calibrate_extrinsics import extrinsics
from cdpr.cli.calibrate_poses import poses
from cdpr.cli.calibrate_print import print_
from cdpr.cli.calibrate_rig import rig
from cdpr.cli.calibrate_tags import tags
from cdpr.cli.check import check
from cdpr.cli.demo import demo
from cdpr.cli.doctor import doctor
from cdpr.cli.home import home
from cdpr.cli.jog import jog
from cdpr.cli.monitor import monitor
from cdpr.cli.operate import hold, resume, speed
from cdpr.cli.plan import plan
from cdpr.cli.release import release
from cdpr.cli.report import report
from cdpr.cli.reset import reset
from cdpr.cli.run import run
from cdpr.cli.sim import sim
from cdpr.cli.status import status
from cdpr.cli.stop import stop
from cdpr.cli.track import track
from cdpr.cli.workspace import workspace
from cdpr.errors import StoppedByOperator

VERBS = (
    demo,
    plan,
    check,
    run,
    stop,
    hold,
    resume,
    speed,
    monitor,
    status,
    reset,
    home,
    jog,
    release,
    track,
    sim,
    report,
    workspace,
    doctor,
)


def add_verbs(app: typer.Typer) -> None:
    """Adds every verb to the command line."""
    for verb in VERBS:
        app.command()(_interruptible(verb))
    calibrations = (calibrate.camera, extrinsics, tags, poses, rig, print_, diff)
    _add_group(app, "calibrate", "Calibrate and compare.", *calibrations)
    _add_group(app, "bench", "Measure the planner.", bench.paper)


def _add_group(app: typer.Typer, name: str, text: str, *verbs: Callable[..., None]) -> None:
    group = typer.Typer(help=text, no_args_is_help=True)
    for verb in verbs:
        group.command(verb.__name__.rstrip("_"))(_interruptible(verb))
    app.add_typer(group, name=name)


def _interruptible(verb: Callable[..., None]) -> Callable[..., None]:
    """Ctrl-C where no run is going on is the operator's stop too, with its exit code."""

    @functools.wraps(verb)
    def guarded(*args: object, **options: object) -> None:
        try:
            verb(*args, **options)
        except KeyboardInterrupt:
            raise StoppedByOperator("interrupted") from None

    return guarded
