"""`cdpr run` runs a plan on the drives and measures it; `cdpr report` writes its report again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import typer
from rich.markup import escape

from cdpr.cli.arguments import argument, flag, option
from cdpr.cli.operate.supervision import (
    RunSupervisor,
    SignalSupervisor,
    confirmation,
    print_safely,
)
from cdpr.cli.options import (
    CALIBRATION,
    CHANNEL,
    FAST,
    INTERFACE,
    SUMMARY_JSON,
    WITHOUT_REAL_TIME,
    YES,
    Triple,
    calibrated_rig,
    level_pose,
    require_unused,
    rig_on_bus,
)
from cdpr.cli.output import Terminal, err, out, show_json, show_line
from drivers.can_bus import IN_PROCESS
from executor import runner
from executor.drives import is_simulated
from executor.evaluation import rewrite_report
from executor.proposals import Proposal
from executor.recording.run_folder import RunFolder
from executor.report.run_data import missing_images
from executor.runner import RunResult
from model.errors import BadInput
from model.plan import load_plan
from model.rig import Rig

COLOURS = {"PASSED": "green", "STOPPED": "yellow", "FAILED": "red"}


def run(
    *,
    plan: Path = argument("plan file (JSON)", "PLAN"),
    rig: Path | None = option(
        "rig file (YAML; default: the plan's rig, on simulated drives)", metavar="RIG"
    ),
    output: Path | None = option(
        "run folder to create, with its parents (default: runs/TIME)",
        "-o",
        "--output",
        metavar="RUNDIR",
    ),
    fast: bool = FAST,
    camera: list[str] | None = option(
        "camera index, or 'synthetic' for all of the rig file's cameras (default with the"
        " interface 'virtual'); for several cameras NAME=SOURCE, repeated",
        metavar="SOURCE",
    ),
    calibration: list[Path] | None = CALIBRATION,
    no_camera: bool = flag("run without a camera"),
    interface: str | None = INTERFACE,
    channel: str | None = CHANNEL,
    simulated_start_mm: Triple | None = option(
        "initial position of the simulated platform x y z (default: the start)"
    ),
    yes: bool = YES,
    without_real_time: bool = WITHOUT_REAL_TIME,
    no_clearance_stop: bool = flag("do not stop when the measured clearance is too small"),
    plan_hash: str | None = option(
        "refuse another plan than that of this `hash`, as the console does"
    ),
    as_json: bool = SUMMARY_JSON,
) -> None:
    """Run a plan: check it, compute set-points, arm the drives, move, measure, report.

    With the interface 'virtual' the drives, the platform and the camera are simulated in this
    process. Ctrl-C and `cdpr stop` slow all drives down together along the path; they then hold.

    Examples:
      cdpr run plan.json --fast
      cdpr run plan.json --rig rig.yaml -o runs/second --camera 0
      cdpr run plan.json --rig rig.yaml -o runs/third --camera front=0 --camera side=1
    """
    the_plan = load_plan(plan)
    if plan_hash not in (None, the_plan.document.hash):
        raise BadInput(
            "the plan's file was replaced after it was shown",
            where=str(plan),
            next_step="reload and review it, then run it",
        )
    if rig is None:
        the_rig = calibrated_rig(_simulated(the_plan.rig, interface, channel), calibration)
    else:
        the_rig = rig_on_bus(rig, interface, channel, calibration)
    if no_camera:
        _refuse_camera_options(camera, no_clearance_stop)
    motion = partial(
        runner.run,
        the_plan,
        the_rig,
        folder=output,
        cameras=[] if no_camera else camera or None,
        realtime=not fast,
        start=level_pose(simulated_start_mm),
        clearance_stop=not no_clearance_stop,
        need_real_time_rights=not without_real_time,
        plan_file=plan,
    )
    raise typer.Exit(supervise(motion, the_rig, yes=yes, as_json=as_json))


def supervise(
    motion: Callable[..., RunResult], rig: Rig, *, yes: bool = False, as_json: bool = False
) -> int:
    """Runs a motion for the operator at the terminal, shows its result, returns its exit code.

    Args:
        motion: Called with ``listener``, ``confirm`` and ``supervisor``; signals go to the run once
            the operator agreed.
        rig: Simulated drives move without a question.
        as_json: Standard output is for a program.
    """
    ask = confirmation(asks=not (is_simulated(rig) or yes), as_json=as_json)
    with RunSupervisor(lambda result: show(result, as_json)) as supervisor:

        def confirm(proposal: Proposal) -> bool:
            agreed = ask(proposal)
            if agreed:
                supervisor.take_over()
            return agreed

        result = motion(listener=Terminal(quiet=as_json), confirm=confirm, supervisor=supervisor)
        show_files(result, as_json)
    return result.exit_code


@dataclass(frozen=True, slots=True)
class MotionOptions:
    """Time and confirmation of a motion; every field is an option."""

    fast: bool = FAST
    yes: bool = YES
    without_real_time: bool = WITHOUT_REAL_TIME

    def confirmation(self, rig: Rig, as_json: bool) -> Callable[[Proposal], bool]:
        """See `confirmation`; simulated drives move without a question."""
        return confirmation(asks=not (is_simulated(rig) or self.yes), as_json=as_json)

    def arguments(self, rig: Rig, as_json: bool) -> dict[str, Any]:
        """Arguments that the library's functions to wind winches and to jog have in common."""
        return {
            "realtime": not self.fast,
            "need_real_time_rights": not self.without_real_time,
            "listener": Terminal(quiet=as_json),
            "confirm": self.confirmation(rig, as_json),
            "supervisor": SignalSupervisor(),
        }


def show(result: RunResult, as_json: bool) -> None:
    """Shows the verdict of a run."""
    if as_json:
        show_json({"run": str(result.shown_folder), **result.summary})
        return
    verdict = f"[bold {COLOURS[result.verdict]}]{result.verdict}[/]"
    out.print(f"{verdict} {escape(result.sentence)}", soft_wrap=True)
    for line in result.details():
        show_line(f"  {line}")


def show_files(result: RunResult, as_json: bool) -> None:
    """Shows the path of a run's report, and what could not be written."""
    if result.report is not None and not as_json:
        line = f"report: {result.shown_folder / result.report.name}"
        print_safely(lambda: show_line(line), result)
    if missing := result.missing_text():
        show_line(f"error: {missing}", err)


def _simulated(rig: Rig, interface: str | None, channel: str | None) -> Rig:
    """The rig of a plan, with drives simulated in this process."""
    if channel is not None or interface not in (None, IN_PROCESS):
        raise BadInput(
            "a run on a bus needs the rig file",
            where="--rig",
            why="without it the plan's rig runs on simulated drives",
            next_step="pass the rig file with --rig, or leave out --interface and --channel",
        )
    return rig.with_bus(IN_PROCESS)


def _refuse_camera_options(camera: list[str] | None, no_clearance_stop: bool) -> None:
    if camera:
        raise BadInput(
            "--camera and --no-camera contradict each other", next_step="leave out one of them"
        )
    why = "without a camera no clearance is measured, so it cannot stop the run"
    require_unused("cdpr run", {"--no-clearance-stop": no_clearance_stop}, why)


# `cdpr report`: the report of a run, from its folder.


def report(
    *,
    run: Path = argument("run folder", "RUNDIR"),
    as_json: bool = flag("print the run's summary", "--json"),
) -> None:
    """Write the report of a run again, from the files of its folder.

    For a run that was killed, or whose disk was full, missing results are recovered from the files
    that exist.

    Example:
      cdpr report runs/first
    """
    folder = RunFolder.open_cut_short(run)
    terminal = Terminal(quiet=as_json)
    with terminal.waiting("writing the report"):
        rewrite_report(folder)
    tables = (folder.poses(), *folder.poses_by_camera().values())
    if missing := missing_images(folder, tables):
        terminal.remark(missing)
    if as_json:
        show_json(folder.summary())
        return
    show_line(f"report: {folder.report}")
