"""The commented text of a new rig file, from the answers of `model.files.new_rig`."""

from __future__ import annotations

import json
import math
from typing import Any

from pydantic import ValidationError

from model.errors import BadInput
from model.files.new_rig import Answers, shown_value
from model.files.rig_file import RigDocument
from model.files.validation import key_path, parse_yaml, problems_of


def rig_text(answers: Answers) -> str:
    """The text of the rig file.

    Raises:
        BadInput: The rig is invalid, with every reason.
    """
    text = _TEMPLATE.format(
        **{key: _yaml(value) for key, value in answers.items()},
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
    drum = 2.0 * math.pi * answers["drum_radius_mm"]
    parts = {
        "node_id": number,
        "drum_mm_per_rev": drum,
        "gear_ratio": answers["gear_ratio"],
        "counts_per_rev": answers["counts_per_rev"],
        "direction": 1,
        "encoder": answers["encoder"],
        "max_speed_mm_s": answers["max_speed_mm_s"],
        "torque_constant_n": answers["torque_constant_n"],
    }
    return "  - {" + ", ".join(f"{key}: {shown_value(part)}" for key, part in parts.items()) + "}"


_TEMPLATE = """\
# The rig {name}, written by `cdpr new`. What every key means, and the keys left out here:
# docs/rig-file.md. Lengths in mm, forces in N, masses in kg; the world frame has z up.
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
#   radius_mm: 13
#   feed_directions: [[0, 0, 1], ...]  # of each cable: its travel where it enters the pulley

# A winch for each cable, in the same order. Of each winch check node_id and direction with
# `cdpr jog RIG --cable N --mm 5`: +1 where positive counts pay cable out.
# drum_mm_per_rev is the cable for one turn of a drum of {drum_radius_mm} mm radius.
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

# Tags on the platform and cameras, to measure its pose: docs/rig-file.md.
"""
