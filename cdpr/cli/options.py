"""Options shared by several verbs, and groups of related options.

Each belongs to one name: a dataclass that has it as a field writes the name into it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from shlex import join

import numpy as np

import calibration  # loads names lazily: `cdpr stop` must not wait for scientific libraries
from cdpr.cli.arguments import argument, flag, option, required
from cdpr.cli.output import Terminal
from model.errors import BadInput
from model.files.documents import millimetres
from model.pose import Array, Pose, matrix_from_quaternion
from model.rig import Rig, load_rig

RIG = argument("rig file (YAML)", "RIG")
SCENE = argument("scene file (YAML)", "SCENE")
PLAN_FILE = required("plan file to write (JSON)", "-o", "--output")
REPLACE_PLAN = flag("replace an existing plan file")
JSON = flag("print the result as JSON", "--json")
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


# Calibration results that replace values of the rig file.

CALIBRATION = option(
    "result file of `cdpr calibrate`, used instead of the rig file's values; repeatable",
    metavar="FILE",
)


def calibrated_rig(rig: Rig, files: Sequence[Path] | None) -> Rig:
    """The rig with values replaced by calibration results, in memory only.

    Raises:
        BadInput: A file cannot be used, or belongs to another rig.
    """
    if not files:
        return rig
    results = [calibration.load_result(file) for file in files]
    return rig.with_calibration(*results, listener=Terminal())


# Verbs that reach drives: the rig, its bus, and the motion.

INTERFACE = option("python-can interface, overriding the rig file's")
CHANNEL = option("channel of the interface")
FAST = flag("simulated time, as fast as possible")
YES = flag("do not ask before moving drives on a real bus")
NO_QUESTION = flag("do not ask")
WITHOUT_REAL_TIME = flag("move even if real-time scheduling is denied")
SUMMARY_JSON = flag("print the summary as JSON", "--json")


@dataclass(frozen=True, slots=True)
class BusOptions:
    """Bus and calibration of a rig; every field is an option."""

    interface: str | None = INTERFACE
    channel: str | None = CHANNEL
    calibration: list[Path] | None = CALIBRATION

    def rig(self, path: Path) -> Rig:
        """See `rig_on_bus`."""
        return rig_on_bus(path, self.interface, self.channel, self.calibration)


def rig_on_bus(
    path: Path,
    interface: str | None,
    channel: str | None,
    calibration: list[Path] | None = None,
) -> Rig:
    """The rig of a file, on another bus if one is given, with calibration results."""
    return calibrated_rig(load_rig(path).with_bus(interface, channel), calibration)


def words_of(**options: object) -> tuple[str, ...]:
    """Options as typed in another command: one for each value of a list, none for None."""
    lists = {key: value if isinstance(value, list) else [value] for key, value in options.items()}
    pairs = [(f"--{key}", str(one)) for key, values in lists.items() for one in values if one]
    return tuple(word for pair in pairs for word in pair)


def run_command(plan: Path, rig_file: Path, rig: Rig, calibration: list[Path] | None) -> str:
    """`cdpr run` of a plan, on the rig that it was made for."""
    words = [str(plan), *words_of(rig=rig_file, calibration=calibration)]
    if not rig.is_tracked:
        words.append("--no-camera")
    elif rig.document.bus.interface != "virtual":  # there images are rendered
        words += words_of(camera="SOURCE")
    return f"cdpr run {join(words)} -o RUNDIR"


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
