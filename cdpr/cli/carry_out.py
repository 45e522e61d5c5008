"""What `cdpr run`, `jog` and `demo` do once a run is prepared: show, ask, move, tell."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rich.console import Console

    from cdpr.plan import Plan
    from cdpr.poses import Pose
    from cdpr.rig import Camera, Rig
    from executor.prepare import PreparedRun


def prepared_run(plan: Plan, rig: Rig, *, quiet: bool) -> PreparedRun:
    """The checked set-points of a plan, for a rig.

    Raises:
        Refused: The plan, or the curve it would be run on, does not pass the checks.
    """
    from cdpr.cli.output import spinner
    from executor.prepare import prepare
    from planner.check import verify

    with spinner("checking the plan and its set-points", not quiet):
        return prepare(verify(plan, rig), rig)


def carry_out(
    prepared: PreparedRun,
    folder: Path,
    eyes: Mapping[Camera, str],
    *,
    fast: bool,
    start: Pose | None = None,
    yes: bool = False,
    without_real_time: bool = False,
    clearance_stop: bool = True,
    as_json: bool = False,
) -> int:
    """Shows the run, asks before a bus moves, runs, tells what happened; returns the exit code.

    Args:
        prepared: The checked run.
        folder: The run folder to make.
        eyes: From `choose_cameras`; empty for none.
        fast: Simulated time.
        start: Where the simulated platform stands; None at the plan's start.
        yes: Do not ask.
        without_real_time: Move drives on a bus even if real-time scheduling is denied.
        clearance_stop: Stop along the path when the camera sees too little clearance.
        as_json: The summary as JSON, and nothing else on standard output.

    Raises:
        Refused: The bus is latched, or the drives cannot be armed; nothing moved.
        StoppedByOperator: The answer was no.
    """
    from functools import partial

    from cdpr.cli.run_motion import run_prepared
    from cdpr.cli.run_summary import clearance_fact, show_prepared, show_summary
    from drivers.bus import IN_PROCESS

    in_process = prepared.rig.document.bus.interface == IN_PROCESS
    near = clearance_fact(prepared, eyes, clearance_stop)
    show_and_ask(
        partial(show_prepared, prepared, eyes, near, in_process),
        "Move the platform now?",
        "nothing was moved",
        asks=not (in_process or yes),
        as_json=as_json,
    )
    summary = run_prepared(
        prepared,
        folder,
        eyes,
        fast=fast,
        start=start,
        without_real_time=without_real_time,
        clearance_stop=clearance_stop,
        quiet=as_json,
    )
    show_summary(summary, folder, as_json)
    return _exit_code(summary)


def show_and_ask(
    show: Callable[[Console], None], question: str, otherwise: str, *, asks: bool, as_json: bool
) -> None:
    """Shows what is about to happen to whoever is going to be asked, or reads; then asks.

    Args:
        show: Shows it, on standard error where a program reads the other.
        question: As for `ask_operator`.
        otherwise: As for `ask_operator`.
        asks: There is something to ask; False with ``--yes``.
        as_json: Standard output is for a program.

    Raises:
        StoppedByOperator: The answer was no.
        BadInput: There is nobody to ask.
    """
    from cdpr.cli.output import err, out

    if asks or not as_json:
        show(err if as_json else out)
    if asks:
        ask_operator(question, otherwise)


def ask_operator(question: str, otherwise: str) -> None:
    """Goes on only after a yes; silence is none.

    Args:
        question: Shown to whoever sits there.
        otherwise: What a no leaves, such as ``nothing was moved``.

    Raises:
        StoppedByOperator: The answer was no.
        BadInput: There is nobody to ask.
    """
    import sys

    from cdpr.errors import BadInput, StoppedByOperator

    print(f"{question} [y/N] ", end="", file=sys.stderr, flush=True)
    answer = sys.stdin.readline()
    if not answer:
        print(file=sys.stderr)
        raise BadInput(
            f"nobody answered: {question}",
            where="standard input",
            next_step=f"run it in a terminal, or pass --yes; {otherwise}",
        )
    if answer.strip().lower() not in ("y", "yes"):
        raise StoppedByOperator(otherwise, next_step="run it again when the answer is yes")


def _exit_code(summary: dict[str, Any]) -> int:
    """0 for a run that passed, 130 when the operator stopped it, 1 otherwise."""
    if summary["passed"]:
        return 0
    return 130 if summary["verdict"] == "STOPPED" else 1
