"""The list of verbs, in the order of the help text."""

from __future__ import annotations

import typer

from cdpr.cli.check import check
from cdpr.cli.demo import demo
from cdpr.cli.doctor import doctor
from cdpr.cli.plan import plan
from cdpr.cli.report import report
from cdpr.cli.run import run
from cdpr.cli.sim import sim
from cdpr.cli.stop import stop
from cdpr.cli.track import track

VERBS = (demo, plan, check, run, stop, track, sim, report, doctor)


def add_verbs(app: typer.Typer) -> None:
    """Adds every verb to the command line."""
    for verb in VERBS:
        app.command()(verb)
