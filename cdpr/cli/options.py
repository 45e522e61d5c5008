"""Options shared by several verbs, and groups of related options."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import numpy as np
import typer

import calibration  # loads names lazily: `cdpr stop` must not wait for scientific libraries
from cdpr.cli.output import Terminal
from model.errors import BadInput
from model.files.documents import millimetres
from model.pose import Array, Pose, matrix_from_quaternion
from model.rig import Rig, load_rig

RigArgument = Annotated[Path, typer.Argument(help="rig file (YAML)", metavar="RIG")]
SceneArgument = Annotated[Path, typer.Argument(help="scene file (YAML)", metavar="SCENE")]
PlanFileOption = Annotated[Path, typer.Option("-o", "--output", help="plan file to write (JSON)")]
ReplacePlanOption = Annotated[bool, typer.Option("--force", help="replace an existing plan file")]
JsonOption = Annotated[bool, typer.Option("--json", help="print the result as JSON")]
Triple = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


def level_pose(position_mm: Triple | None) -> Pose | None:
    """The level pose at an option's position x y z, ``world_from_platform``."""
    return None if position_mm is None else Pose.level(millimetres(list(position_mm)))


def rotation_of(wxyz: Quaternion | None) -> Array | None:
    """The rotation matrix of an option's quaternion w x y z, of any length.

    Raises:
        BadInput: It has no direction.
    """
    if wxyz is None:
        return None
    norm = float(np.linalg.norm(wxyz))
    if not 1e-6 < norm < np.inf:
        raise BadInput(
            "the rotation is not a quaternion w x y z of non-zero length",
            next_step="use 1 0 0 0 for a level platform",
        )
    return matrix_from_quaternion(np.array(wxyz) / norm)


def simulated_start(rig: Rig, position_mm: Triple | None, wxyz: Quaternion | None) -> Pose | None:
    """The pose of options ``--simulated-start-mm`` and ``--simulated-start-wxyz``.

    Raises:
        BadInput: Only the orientation is stated, or it is none.
    """
    rotation = rotation_of(wxyz)
    if position_mm is None:
        if rotation is not None:
            raise BadInput(
                "an orientation without a position", next_step="add --simulated-start-mm X Y Z"
            )
        return None
    position = millimetres(list(position_mm))
    return Pose(position, rig.home.rotation if rotation is None else rotation)


def with_option_groups(command: Callable[..., None]) -> Callable[..., None]:
    """The command with each dataclass parameter expanded into options, one per field.

    Fields are annotated like options, and have defaults.
    """
    whole = inspect.signature(command, eval_str=True)
    groups: dict[str, Any] = {
        p.name: p.annotation for p in whole.parameters.values() if is_dataclass(p.annotation)
    }
    expanded = {name: _parameters(group) for name, group in groups.items()}

    @wraps(command)
    def with_options(**values: Any) -> None:
        for name, group in groups.items():
            values[name] = group(**{p.name: values.pop(p.name) for p in expanded[name]})
        command(**values)

    parameters = [p for one in whole.parameters.values() for p in expanded.get(one.name, [one])]
    as_seen: Any = with_options
    as_seen.__signature__ = whole.replace(parameters=parameters)
    as_seen.__annotations__ = {p.name: p.annotation for p in parameters}
    return with_options


def _parameters(group: Any) -> list[inspect.Parameter]:
    hints = get_type_hints(group, include_extras=True)
    kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
    return [
        inspect.Parameter(option.name, kind, default=option.default, annotation=hints[option.name])
        for option in fields(group)
    ]


# Calibration results that replace values of the rig file.

CalibrationOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--calibration",
        help="result file of `cdpr calibrate`, used instead of the rig file's values; repeatable",
        metavar="FILE",
    ),
]


def calibrated_rig(rig: Rig, files: Sequence[Path] | None) -> Rig:
    """The rig with values replaced by calibration results, in memory only.

    A result that is not good enough is used too, with its verdict as a remark.

    Raises:
        BadInput: A file cannot be used, or belongs to another rig.
    """
    if not files:
        return rig
    results = [calibration.load_result(file) for file in files]
    better = rig.with_calibration(*results)
    for one in results:
        if not one.good_enough:
            Terminal().remark(f"calibration {one.kind} {one.name}, {one.date}: {one.verdict}")
    return better


# Verbs that reach drives: the rig, its bus, and the motion.

InterfaceOption = Annotated[
    str | None,
    typer.Option("--interface", help="python-can interface, overriding the rig file's"),
]
ChannelOption = Annotated[str | None, typer.Option("--channel", help="channel of the interface")]
FastOption = Annotated[bool, typer.Option("--fast", help="simulated time, as fast as possible")]
YesOption = Annotated[
    bool, typer.Option("--yes", help="do not ask before moving drives on a real bus")
]
NoQuestionOption = Annotated[bool, typer.Option("--yes", help="do not ask")]
WithoutRealTimeOption = Annotated[
    bool,
    typer.Option("--without-real-time", help="move even if real-time scheduling is denied"),
]
SummaryJsonOption = Annotated[bool, typer.Option("--json", help="print the summary as JSON")]


@dataclass(frozen=True, slots=True)
class BusOptions:
    """Bus and calibration of a rig; every field is an option."""

    interface: InterfaceOption = None
    channel: ChannelOption = None
    calibration: CalibrationOption = None

    def rig(self, path: Path) -> Rig:
        """See `rig_on_bus`."""
        return rig_on_bus(path, self.interface, self.channel, self.calibration)


DEFAULT_BUS = BusOptions()


def rig_on_bus(
    path: Path,
    interface: str | None,
    channel: str | None,
    calibration: list[Path] | None = None,
) -> Rig:
    """The rig of a file, on another bus if one is given, with calibration results."""
    return calibrated_rig(load_rig(path).with_bus(interface, channel), calibration)


def require_unused(verb: str, options: Mapping[str, object], why: str) -> None:
    """Refuses options that would have no effect.

    Args:
        verb: The command, such as ``cdpr jog``.
        options: Value by name; None and False mean not given.
        why: They have no effect.

    Raises:
        BadInput: With the names of all that were given.
    """
    given = [name for name, value in options.items() if value is not None and value is not False]
    if given:
        raise BadInput(
            f"no effect here: {', '.join(given)}",
            where=verb,
            why=why,
            next_step=f"leave them out, or see `{verb} --help`",
        )
