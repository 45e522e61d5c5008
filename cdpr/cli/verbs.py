"""The verbs of the command line: a table, and groups that import a verb only when it is called."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from itertools import islice
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from cdpr.cli.arguments import check_arguments
from model.errors import StoppedByOperator


@dataclass(frozen=True, slots=True)
class Verb:
    """A line of the help text, and where the verb is.

    Attributes:
        name: As it is typed.
        help: The first line of the verb's own help, or all of a group's.
        target: ``module:function`` below `cdpr.cli`; ``name:name`` when left out.
        verbs: Of a group.
    """

    name: str
    help: str
    target: str = ""
    verbs: tuple[Verb, ...] = ()


CALIBRATE = (
    Verb(
        "camera",
        "Calibrate a camera's matrix and lens distortion, with a verdict on the accuracy.",
        "calibrate.camera:camera",
    ),
    Verb(
        "extrinsics",
        "Find a camera's pose, from surveyed tags on the frame or from the rig's motion.",
        "calibrate.extrinsics:extrinsics",
    ),
    Verb(
        "readout",
        "Measure a rolling shutter, from images of the platform while it moves.",
        "calibrate.camera:readout",
    ),
    Verb(
        "tags",
        "Find the tags' poses on the platform, from images that show two or more at once.",
        "calibrate.extrinsics:tags",
    ),
    Verb(
        "poses",
        "Choose the most informative poses for calibration, and plan a path with stops at them.",
        "calibrate.rig:poses",
    ),
    Verb(
        "rig",
        "Calibrate outlets, anchors, pulleys, drum scales, home lengths and cable stiffness.",
        "calibrate.rig:rig",
    ),
    Verb(
        "print",
        "Make a calibration board, or the tags of a rig, as a PDF in exact size.",
        "calibrate.boards:print_",
    ),
    Verb(
        "diff",
        "Compare two calibration results: every number against its interval, and the effect in mm.",
        "calibrate.results:diff",
    ),
    Verb(
        "apply",
        "Write a new rig file with calibration results in place of its own values.",
        "calibrate.results:apply",
    ),
    Verb(
        "export",
        "Write a camera's matrix and lens for OpenCV, ROS, Kalibr or mrcal.",
        "calibrate.results:export",
    ),
    Verb(
        "import",
        "Write a new rig file with a camera's matrix and lens from another program.",
        "calibrate.results:import_",
    ),
)
BENCH = (
    Verb(
        "paper",
        "Repeat the paper's evaluation (section 5.3, Fig. 9) and report which claims hold.",
        "bench:paper",
    ),
)
PLAN = (
    Verb(
        "demo",
        "Plan, check, run on simulated drives, track with a synthetic camera, and report.",
        "operate.run:demo",
    ),
    Verb(
        "examples",
        "List the ready rigs, scenes and recorded sessions, or copy some of them.",
        "start:examples",
    ),
    Verb("new", "Ask for the essentials of a rig, and write a commented rig file.", "start:new"),
    Verb("plan", "Plan a collision-free path and write it to a file.", "planning:plan"),
    Verb(
        "check",
        "Check a plan with an independent method: distances at dense poses, with bounds.",
        "planning:check",
    ),
)
OPERATE = (
    Verb(
        "run",
        "Run a plan: check it, compute set-points, arm the drives, move, measure, report.",
        "operate.run:run",
    ),
    Verb(
        "stop",
        "Stop every run of this user: all drives slow down together along the path, then hold.",
        "operate.requests:stop",
    ),
    Verb(
        "hold",
        "Feed hold: the platform slows down along the path and waits there under tension.",
        "operate.requests:hold",
    ),
    Verb(
        "resume",
        "Continue after `cdpr hold`, at the last requested speed.",
        "operate.requests:resume",
    ),
    Verb(
        "speed",
        "Scale the speed along the path to a percentage of the planned one.",
        "operate.requests:speed",
    ),
    Verb(
        "console",
        "Open the operator's page: see the robot live, jog, teach, preview, run, hold, stop.",
        "operate.console:console",
    ),
    Verb(
        "monitor",
        "Show a run live: state, drives, tensions, lateness, progress and events.",
        "operate.monitor:monitor",
    ),
    Verb(
        "status",
        "Show the state of a rig: faults, reference, drives, tensions, pose. Moves nothing.",
        "operate.service:status",
    ),
    Verb(
        "reset",
        "Release a latched fault once its cause is removed: resets drives in fault, moves nothing.",
        "operate.service:reset",
    ),
    Verb(
        "home",
        "Pretension all cables, then set the encoder reference at a known pose.",
        "operate.home:home",
    ),
    Verb(
        "jog",
        "Move the platform straight slowly by a few millimetres from its present pose.",
        "operate.jog:jog",
    ),
    Verb(
        "release",
        "Release the drives with the platform on a support: close brakes, remove torque.",
        "operate.service:release",
    ),
)
SET_UP = (
    Verb(
        "doctor",
        "Check that this machine can run a rig; with a rig file, also its bus and cameras.",
    ),
    Verb(
        "sim",
        "Simulate the drives and the platform of a rig on a bus, in real time, until Ctrl-C.",
    ),
    Verb("calibrate", "Calibrate and compare.", verbs=CALIBRATE),
)
MEASURE = (Verb("track", "Measure the platform's pose from its tags, image by image."),)
ANALYSE = (
    Verb("report", "Write the report of a run folder again from its files."),
    Verb(
        "explain",
        "Explain a fault that a run reported: meaning, likely cause, state of the"
        " machine, next step.",
        "report:explain",
    ),
    Verb(
        "workspace",
        "Map the workspace: feasibility, wrench closure, capacity margin and dexterity.",
    ),
    Verb("bench", "Measure the planner.", verbs=BENCH),
)
PANELS: dict[str, tuple[Verb, ...]] = {
    "Plan": PLAN,
    "Operate": OPERATE,
    "Set up": SET_UP,
    "Measure": MEASURE,
    "Analyse": ANALYSE,
}
VERBS = tuple(verb for verbs in PANELS.values() for verb in verbs)


class LazyGroup(TyperGroup):
    """Verbs of a table; the help text and completion of names need no module of theirs."""

    verbs: tuple[Verb, ...] = VERBS

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        panels = {verb: panel for panel, verbs in PANELS.items() for verb in verbs}
        self.commands = {
            verb.name: TyperCommand(verb.name, help=verb.help, rich_help_panel=panels.get(verb))
            for verb in self.verbs
        }

    def loaded(self, name: str) -> TyperCommand | TyperGroup:
        """The verb itself, with its options, from its module."""
        return _loaded(next(verb for verb in self.verbs if verb.name == name))

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """As Typer does; the verb that is called is imported."""
        name, command, rest = super().resolve_command(ctx, args)
        return name, self.loaded(name) if command is not None and name else command, rest


class _CalibrateGroup(LazyGroup):
    verbs = CALIBRATE


class _BenchGroup(LazyGroup):
    verbs = BENCH


_GROUPS = {"calibrate": _CalibrateGroup, "bench": _BenchGroup}


def _loaded(verb: Verb) -> TyperCommand | TyperGroup:
    if verb.verbs:
        return _GROUPS[verb.name](
            name=verb.name, help=verb.help, no_args_is_help=True, rich_markup_mode="rich"
        )
    module, _, function = (verb.target or f"{verb.name}:{verb.name}").partition(":")
    app = typer.Typer(rich_markup_mode="rich", add_completion=False)
    called = getattr(import_module(f"cdpr.cli.{module}"), function)
    app.command(verb.name, cls=_VerbCommand)(_guarded(called))
    command: Any = typer.main.get_command(app)
    return command  # type: ignore[no-any-return]


class _VerbCommand(TyperCommand):
    """A verb whose points are typed as X Y Z everywhere."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """As Typer does, once points are one word each."""
        return super().parse_args(ctx, joined_points(args))


def joined_points(arguments: Sequence[str]) -> list[str]:
    """The arguments with the three words after each ``--via-mm`` as one.

    Typer knows options of three values and options that may be repeated, not both at once.
    """
    words = iter(arguments)
    joined: list[str] = []
    for word in words:
        joined.append(word)
        if word == "--via-mm":
            joined.append(" ".join(islice(words, 3)))
    return joined


def _guarded(verb: Callable[..., None]) -> Callable[..., None]:
    """With arguments that can be used; Ctrl-C where no run is going on is the operator's stop."""

    @functools.wraps(verb)
    def guarded(*args: object, **options: object) -> None:
        try:
            check_arguments(options)
            verb(*args, **options)
        except KeyboardInterrupt:
            raise StoppedByOperator("interrupted") from None

    return guarded
