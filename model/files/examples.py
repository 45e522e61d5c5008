"""What a lab starts from: the ready rigs, scenes and sessions, and the text of a new rig file."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from model.errors import AlreadyExists, BadInput
from model.files.documents import write_atomic, write_bytes_atomic
from model.files.new_rig import Answers, shown_value
from model.files.output import make_missing_folder
from model.files.reading import read_bytes, read_text, ready_folder, shown
from model.files.rig_file import RigDocument
from model.files.validation import key_path, parse_yaml, problems_of

_SCHEMA = re.compile(r"(?<=\$schema=).*/(rig|scene)\.schema\.json")
_DESCRIPTION = re.compile(r"^description: *(.+)$", re.MULTILINE)
_ABOUT = "README.md"
PAPER_RIG = "gachon_8_6.yaml"
"""The rig file of the paper's robot, in the folder of the examples."""


@dataclass(frozen=True)
class Example:
    """One rig or scene file, or the folder of a recorded session.

    Attributes:
        name: Name on the command line.
        kind: ``rig``, ``scene`` or ``session``.
        about: One line of description.
        source: The file or folder.
        group: Its folder in a clone of the repository.
    """

    name: str
    kind: str
    about: str
    source: Path
    group: str

    @property
    def file_name(self) -> str:
        """Name of a copy."""
        return self.source.name


def find_examples(configs: Path, sessions: Path) -> list[Example]:
    """All examples: rigs, then scenes, then sessions, each by name.

    Files of the user's own that name no schema, and an editor's hidden ones, are left out.

    Args:
        configs: The folder of the example rigs and scenes.
        sessions: The folder of the recorded sessions.
    """
    files = [each for path in configs.glob("[!.]*.yaml") if (each := _ready_file(path))]
    folders = [_session(path) for path in sessions.iterdir() if (path / _ABOUT).is_file()]
    order = ("rig", "scene", "session")
    return sorted([*files, *folders], key=lambda example: (order.index(example.kind), example.name))


def _ready_file(path: Path) -> Example | None:
    """The rig or scene; None where the first line names no schema, or there is no text."""
    try:
        text = read_text(path)
    except BadInput:
        return None
    first, second, *_ = [*text.splitlines(), "", ""]
    kind = _SCHEMA.search(first)
    if kind is None:
        return None
    described = _DESCRIPTION.search(text)
    about = described.group(1) if described else second.removeprefix("# ")
    return Example(path.stem, kind.group(1), about, path, "configs")


def _session(path: Path) -> Example:
    title = read_text(path / _ABOUT).partition("\n")[0].removeprefix("# ")
    return Example(path.name, "session", title, path, "examples")


def select_examples(examples: Iterable[Example], names: Iterable[str]) -> list[Example]:
    """The examples with these names.

    Raises:
        BadInput: A name is unknown; the message lists the known ones.
    """
    by_name = {example.name: example for example in examples}
    wanted = [name.removesuffix(".yaml") for name in names]
    unknown = [name for name in wanted if name not in by_name]
    if unknown:
        raise BadInput(
            f"unknown example {unknown[0]!r}",
            where="cdpr examples",
            next_step=f"name one of these: {', '.join(by_name)}",
        )
    return [by_name[name] for name in dict.fromkeys(wanted)]


def copy_examples(
    examples: Iterable[Example], folder: Path, *, grouped: bool, replace: bool
) -> list[Path]:
    """Copies all examples, or none when a copy exists already.

    Args:
        folder: Target; created with its parents.
        grouped: In ``configs`` and ``examples`` below the folder, as in a clone.
        replace: Replace files that exist.

    Returns:
        The copies.

    Raises:
        BadInput: A copy exists already, or a file cannot be written.
    """
    wanted = [(e, folder / (e.group if grouped else "") / e.file_name) for e in examples]
    existing = [target for _, target in wanted if os.path.lexists(target)]
    if existing and not replace:
        raise AlreadyExists(
            "the file exists already",
            shown(existing[0]),
            f"{len(existing)} of the {len(wanted)} copies exist; nothing was copied",
        )
    for example, target in wanted:
        _copy(example.source, target)
    return [target for _, target in wanted]


def _copy(source: Path, target: Path) -> None:
    if source.is_file():
        make_missing_folder(target.parent)
        write_atomic(target, _SCHEMA.sub(lambda found: _schema(found[1]), read_text(source), 1))
        return
    for path in source.rglob("*"):
        if path.is_file():
            copy = target / path.relative_to(source)
            make_missing_folder(copy.parent)
            write_bytes_atomic(copy, read_bytes(path))


def _schema(kind: str) -> str:
    """The address of the installed schema, which editors find from any folder."""
    return (ready_folder("docs/schema") / f"{kind}.schema.json").as_uri()


# The commented text of a new rig file, from the answers of `model.files.new_rig`.


def rig_text(answers: Answers) -> str:
    """The text of the rig file.

    Raises:
        BadInput: The rig is invalid, with every reason.
    """
    text = _TEMPLATE.format(
        **{key: _yaml(value) for key, value in answers.items()},
        schema=_schema("rig"),
        pages=ready_folder("docs"),
        outlets=_lines(answers["outlets_mm"]),
        anchors=_lines(answers["anchors_mm"]),
        winches="\n".join(_winch(number, answers) for number in range(1, answers["cables"] + 1)),
    )
    problems = _problems(text)
    if problems:
        raise BadInput(
            "the answers do not give a valid rig",
            where="cdpr new",
            why="; ".join(problems),
            next_step="correct these answers; nothing was written",
        )
    return text


def _problems(text: str) -> list[str]:
    tree = parse_yaml(text)
    try:
        findings = RigDocument.model_validate(tree.data).findings()
    except ValidationError as error:
        return [f"{p.key}: {p.what}" for p in problems_of(error, RigDocument, tree.positions)]
    return [f"{key_path(path)}: {what}" for path, what in findings]


def _yaml(value: Any) -> str:
    if isinstance(value, list):
        return "[" + ", ".join(map(_yaml, value)) + "]"
    return json.dumps(value, ensure_ascii=False) if isinstance(value, str) else shown_value(value)


def _lines(points: list[list[float]]) -> str:
    return "\n".join(f"  - {_yaml(point)}  # cable {i}" for i, point in enumerate(points, start=1))


def _winch(number: int, answers: Answers) -> str:
    centre_line = answers["drum_radius_mm"] + answers["radius_mm"]
    parts = {
        "node_id": number,
        "drum_mm_per_rev": 2.0 * math.pi * centre_line,
        "gear_ratio": answers["gear_ratio"],
        "counts_per_rev": answers["counts_per_rev"],
        "direction": 1,
        "encoder": answers["encoder"],
        "max_speed_mm_s": answers["max_speed_mm_s"],
        "torque_constant_n": answers["torque_constant_n"],
    }
    return "  - {" + ", ".join(f"{key}: {shown_value(part)}" for key, part in parts.items()) + "}"


_TEMPLATE = """\
# yaml-language-server: $schema={schema}
# The rig {name}, written by `cdpr new`. What every key means, and the keys left out here:
# {pages}/rig-file.md. Lengths in mm, forces in N, masses in kg; the world frame has z up.
schema_version: 1
name: {name}

platform:  # a box about the platform frame's origin
  size_mm: {platform_mm}
  mass_kg: {mass_kg}
  centre_of_mass_mm: [0, 0, 0]  # in the platform frame; measure it if a tool is mounted off centre
  home: {{position_mm: {home_mm}}}  # a well-known pose, for `cdpr home --at-home`

workspace:  # limits of the platform's origin
  lower_mm: {lower_mm}
  upper_mm: {upper_mm}

outlets_mm:  # where each cable leaves the frame, in the world frame
{outlets}

anchors_mm:  # where each cable is tied to the platform, in the platform frame, in the same order
{anchors}

cables:
  radius_mm: {radius_mm}
  stiffness_n: {stiffness_n}  # E·A: tension at 100 % strain, extrapolated linearly
  min_tension_n: {min_tension_n}  # enough to keep a cable from sagging
  max_tension_n: {max_tension_n}  # below the limits of cable, winch and drive

# Where swivelling pulleys guide the cables, outlets_mm are the points where cables enter them:
# pulleys:
#   radius_mm: 13  # to the cable's centre line: radius of the bare groove and of the cable
#   feed_directions: [[0, 0, 1], ...]  # of each cable: its travel where it enters the pulley

# A winch for each cable, in the same order. Of each winch check node_id and direction with
# `cdpr jog RIG --cable N --mm 5`: +1 where positive counts pay cable out.
# drum_mm_per_rev is the cable for one turn, 2 pi times the radius of its centre line on the drum:
# {drum_radius_mm} mm of the bare drum and {radius_mm} mm of the cable.
winches:
{winches}

motion:  # along a plan; begin slowly
  speed_mm_s: 20
  acceleration_mm_s2: 100
  jerk_mm_s3: 1000
  blend_tolerance_mm: 1  # largest distance of a rounded corner from the planned one
  following_error_mm: 2  # of a cable; more is a fault
  start_tolerance_mm: 1  # of a cable; a run starts only this close to its plan

bus:
  interface: {interface}  # virtual: simulated drives inside the program
  channel: {channel}
  bitrate: {bitrate}
  cycle_ms: 10

# Without this section the drives are CANopen drives that need no profile ({pages}/drives.md):
# drives:
#   type: cia402  # or odrive, with other keys: {pages}/odrive.md
#   profile: epos4  # or nanotec-c5e, akd, elmo-gold, or the path of your own

# Tags on the platform and cameras, to measure its pose: {pages}/rig-file.md.
"""
