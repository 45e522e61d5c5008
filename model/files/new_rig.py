"""A new rig file: the questions for its values, with units and defaults.

`collect_answers` asks the questions in order through a callback; `model.files.examples` makes
the file from the answers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from model.errors import BadInput
from model.files.csv_table import CsvTable
from model.files.documents import Name, NonNegative, Number, Positive, findings_of_sound_parts
from model.files.rig_file import RigDocument

Answers = Mapping[str, Any]
CABLES_MOST = 24
"""For which paths are planned: the work grows with the fifth power of their number."""
CSV_COLUMNS = tuple(f"{end}_{axis}_mm" for end in ("outlet", "anchor") for axis in "xyz")


def _no_objection(_value: Any, _answers: Answers) -> str:
    return ""


@dataclass(frozen=True)
class RigQuestion:
    """A question about one value of a rig file.

    Attributes:
        key: Name of the answer, as in ``--key`` of the command line.
        text: The question.
        unit: Of the answer; empty where it has none.
        parse: Converts the typed answer to a value.
        default: The value for no answer, from the previous answers.
        objection: Why a value is invalid, given the previous answers; empty where it is valid.
    """

    key: str
    text: str
    unit: str
    parse: Callable[[str], Any]
    default: Callable[[Answers], Any]
    objection: Callable[[Any, Answers], str] = _no_objection

    def read(self, text: str, default: Any, answers: Answers) -> Any:
        """The value of a typed answer; an empty answer is the default.

        Raises:
            ValueError: With the reason, as displayed.
        """
        value = self.parse(text) if text else default
        if reason := self.objection(value, answers):
            raise ValueError(reason)
        return value


def shown_value(value: Any) -> str:
    """A value as typed."""
    if isinstance(value, (list, tuple)):
        return " ".join(shown_value(part) for part in value)
    return f"{value:.10g}" if isinstance(value, float) else str(value)


def _valid(kind: Any, value: Any) -> Any:
    try:
        return TypeAdapter(kind).validate_python(value)
    except ValidationError as error:
        reason = error.errors()[0]["msg"].removeprefix("Value error, ")
        raise ValueError(reason[:1].lower() + reason[1:]) from None


def _number(kind: Any = Positive) -> Callable[[str], float]:
    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            raise ValueError(f"{text[:40]!r} is not a number") from None
        return float(_valid(kind, value))

    return parse


def _whole(lowest: int, highest: int) -> Callable[[str], int]:
    def parse(text: str) -> int:
        if not text.lstrip("+-").isdecimal() or not lowest <= int(text[:40]) <= highest:
            raise ValueError(f"{text[:40]!r} is not a whole number from {lowest} to {highest}")
        return int(text)

    return parse


def _point(kind: Any = Number) -> Callable[[str], list[float]]:
    def parse(text: str) -> list[float]:
        words = text.replace(",", " ").split()
        if len(words) != 3:
            raise ValueError(f"three numbers X Y Z are needed, {len(words)} were given")
        return [_number(kind)(word) for word in words]

    return parse


def _one_of(*choices: str) -> Callable[[str], str]:
    def parse(text: str) -> str:
        if text not in choices:
            raise ValueError(f"{text[:40]!r} is not one of {', '.join(choices)}")
        return text

    return parse


def _name(text: str) -> str:
    return str(_valid(Name, text))


def _always(value: Any) -> Callable[[Answers], Any]:
    return lambda _answers: value


def _channel(answers: Answers) -> str:
    known = {"virtual": "cdpr", "socketcan": "can0", "udp_multicast": "239.74.163.2"}
    return known.get(answers["interface"], "can0")


def _suggested_outlet(index: int, count: int) -> list[float]:
    """High and low pairs on a circle of 700 mm, 10 degrees apart so that cables do not cross."""
    pair, low = divmod(index, 2)
    aside = math.radians(5.0) * (-1.0) ** (pair + low)
    angle = 2.0 * math.pi * (pair + 0.5) / math.ceil(count / 2) + aside
    return [
        round(700.0 * math.cos(angle), 1),
        round(700.0 * math.sin(angle), 1),
        80.0 if low else 860.0,
    ]


def _suggested_anchor(outlet: list[float], answers: Answers) -> list[float]:
    """The nearest edge of the platform: below for a high outlet and above for a low one."""
    frame = _Frame.of(answers)
    x, y, z = (size / 2.0 for size in answers["platform_mm"])
    high = frame.is_level or outlet[2] > frame.centre[2]
    return [
        math.copysign(x, outlet[0] - frame.centre[0]),
        math.copysign(y, outlet[1] - frame.centre[1]),
        -z if high else z,
    ]


_LEVEL = 0.2
"""Outlets are level, and the robot is suspended, if heights differ by less, as a share of width."""


@dataclass(frozen=True)
class _Frame:
    """The box around the outlets, [mm]: its centre, larger width, lowest and level outlets."""

    centre: list[float]
    width: float
    lowest: float
    is_level: bool

    @staticmethod
    def of(answers: Answers) -> _Frame:
        columns = list(zip(*answers["outlets_mm"], strict=True))
        centre = [(min(column) + max(column)) / 2.0 for column in columns]
        *sides, height = (max(column) - min(column) for column in columns)
        return _Frame(centre, max(sides), min(columns[2]), height < _LEVEL * max(sides))


def _middle(answers: Answers) -> list[float]:
    """Between the outlets; below them if they are level."""
    frame = _Frame.of(answers)
    x, y, z = frame.centre
    if frame.is_level:
        z = frame.lowest - 0.4 * frame.width
        z = max(z, 0.3 * frame.lowest) if frame.lowest > 0.0 else z
    return [round(value, 1) for value in (x, y, z)]


def _box(answers: Answers, side: int) -> list[float]:
    """Halfway from home to the outlets on that side, and at least 10 mm.

    Below a suspended robot's home there are none: there a quarter of the height up to them counts.
    """
    columns = list(zip(*answers["outlets_mm"], strict=True))
    ends = [(min(column), max(column))[side] for column in columns]
    least, (low, home_z) = (-10.0, 10.0)[side], (ends[2], answers["home_mm"][2])
    if not side and low > home_z:
        ends[2] = home_z - (low - home_z) / 2.0
    return [
        round(home + (min, max)[side](least, (end - home) / 2.0), 1)
        for home, end in zip(answers["home_mm"], ends, strict=True)
    ]


def _box_around_home(value: list[float], answers: Answers, side: int) -> str:
    for axis, bound, home in zip("xyz", value, answers["home_mm"], strict=True):
        if (home - bound, bound - home)[side] < 0.0:
            return f"the home position {axis} = {home:g} mm would be outside"
    if side and any(a >= b for a, b in zip(answers["lower_mm"], value, strict=True)):
        return f"it must be above the lower corner {shown_value(answers['lower_mm'])} on all axes"
    return ""


def _above_least(value: float, answers: Answers) -> str:
    least = answers["min_tension_n"]
    return "" if value > least else f"it must be more than the smallest tension, {least:g} N"


def coordinate_questions(ends: str, answers: Answers) -> list[RigQuestion]:
    """The questions about ``outlets_mm`` or ``anchors_mm``; a repeated one has its last answer."""
    count = answers["cables"]
    if ends == "outlets_mm":
        what, frame = "outlet", "world"
        suggested = [_suggested_outlet(i, count) for i in range(count)]
    else:
        what, frame = "anchor", "platform"
        suggested = [_suggested_anchor(outlet, answers) for outlet in answers["outlets_mm"]]
    return [
        RigQuestion(
            f"{what} {i + 1}",
            f"{what} of cable {i + 1}, X Y Z in the {frame} frame",
            "mm",
            _point(),
            _always(default),
        )
        for i, default in enumerate(answers.get(ends, suggested))
    ]


def _box_of(anchors_mm: Sequence[Sequence[float]]) -> list[float]:
    """Edges of the box that the anchors span, none very thin."""
    edges = np.ptp(np.array(anchors_mm, dtype=np.float64), axis=0)
    return [math.ceil(10.0 * max(edge, 0.1 * max(edges))) / 10.0 for edge in edges.tolist()]


def size_remarks(given: Answers) -> list[str]:
    """Edges of the platform that `collect_answers` assumes, as the anchors hardly span them."""
    if "platform_mm" in given or "anchors_mm" not in given:
        return []
    spans = np.ptp(given["anchors_mm"], axis=0)
    return [
        f"platform.size_mm: {size:g} mm along {axis} is assumed, as the anchors span {span:g} mm"
        " there; measure the platform and correct it"
        for axis, span, size in zip("xyz", spans, _box_of(given["anchors_mm"]), strict=True)
        if span < 0.1 * max(spans)
    ]


def _geometry_problems(answers: Answers) -> list[str]:
    """What is wrong with platform, outlets and anchors, as far as they are answered."""
    known: dict[str, Any] = {
        key: answers[key] for key in ("outlets_mm", "anchors_mm") if key in answers
    }
    known["platform"] = {"size_mm": answers["platform_mm"]}
    return [what for _, what in findings_of_sound_parts(known, RigDocument)]


_PLATFORM = RigQuestion(
    "platform_mm",
    "platform size X Y Z, a box about the origin of its frame",
    "mm",
    _point(Positive),
    lambda answers: answers.get("platform_mm", [130.0] * 3),
)
BEFORE_COORDINATES = (
    RigQuestion("name", "name of the rig", "", _name, lambda answers: answers["name"]),
    _PLATFORM,
    RigQuestion("mass_kg", "mass of the platform", "kg", _number(), _always(0.4)),
    RigQuestion("cables", "number of cables", "", _whole(6, CABLES_MOST), _always(8)),
)
AFTER_COORDINATES = (
    RigQuestion("home_mm", "home position of the platform X Y Z", "mm", _point(), _middle),
    RigQuestion(
        "lower_mm",
        "lower corner of the workspace X Y Z, limits of the platform's origin",
        "mm",
        _point(),
        lambda answers: _box(answers, 0),
        lambda value, answers: _box_around_home(value, answers, 0),
    ),
    RigQuestion(
        "upper_mm",
        "upper corner of the workspace X Y Z",
        "mm",
        _point(),
        lambda answers: _box(answers, 1),
        lambda value, answers: _box_around_home(value, answers, 1),
    ),
    RigQuestion("radius_mm", "radius of the cables", "mm", _number(NonNegative), _always(0.5)),
    RigQuestion(
        "stiffness_n", "axial stiffness E·A of the cables", "N", _number(), _always(50000.0)
    ),
    RigQuestion(
        "min_tension_n", "smallest allowed tension of a cable", "N", _number(), _always(5.0)
    ),
    RigQuestion(
        "max_tension_n",
        "largest tension of a cable",
        "N",
        _number(),
        lambda answers: 20.0 * answers["min_tension_n"],
        _above_least,
    ),
    RigQuestion(
        "drum_radius_mm",
        "radius of the bare drums, at the bottom of the groove; the cable's radius is added",
        "mm",
        _number(),
        _always(32.3),
    ),
    RigQuestion("gear_ratio", "motor turns for one drum turn", "", _number(), _always(1.0)),
    RigQuestion(
        "counts_per_rev",
        "encoder counts per motor turn",
        "counts",
        _whole(1, 2**31 - 1),
        _always(131072),
    ),
    RigQuestion(
        "encoder",
        "encoders: absolute keep their position without power, incremental do not",
        "",
        _one_of("absolute", "incremental"),
        _always("incremental"),
    ),
    RigQuestion("max_speed_mm_s", "largest cable speed", "mm/s", _number(), _always(100.0)),
    RigQuestion(
        "torque_constant_n",
        "cable tension at the drives' rated torque",
        "N",
        _number(),
        lambda answers: answers["max_tension_n"],
    ),
    RigQuestion(
        "interface",
        "bus: virtual for simulated drives, or python-can's name such as socketcan",
        "",
        _name,
        _always("virtual"),
    ),
    RigQuestion("channel", "channel of the bus", "", _name, _channel),
    RigQuestion("bitrate", "bit rate", "bit/s", _whole(10_000, 1_000_000), _always(1_000_000)),
)


def collect_answers(
    name: str,
    given: Answers,
    ask: Callable[[RigQuestion, str], str] | None = None,
    refuse: Callable[[str], None] = lambda _reason: None,
) -> dict[str, Any]:
    """The answers to all questions.

    Platform, outlets and anchors that do not fit together are asked for again, options included.

    Args:
        name: Of the rig, where no other is given.
        given: Answers that need no question, by their keys.
        ask: Asks a question with its default and returns what was typed; without it, the remaining
            questions take their defaults.
        refuse: Receives the reason why an answer is invalid, before the question is repeated.

    Raises:
        BadInput: A given answer is invalid.
    """
    answers: dict[str, Any] = {"name": name}
    if "anchors_mm" in given and np.ptp(given["anchors_mm"], axis=0).any():  # the default
        answers["platform_mm"] = _box_of(given["anchors_mm"])

    def answer(question: RigQuestion, given: Answers = given) -> Any:
        if question.key in given:
            return _given(question, given[question.key], answers)
        while ask is not None:
            default = question.default(answers)
            try:
                return question.read(ask(question, shown_value(default)), default, answers)
            except ValueError as error:
                refuse(str(error))
        return _default(question, answers)

    for question in BEFORE_COORDINATES:
        answers[question.key] = answer(question)
    asked: list[str] = []
    for ends in ("outlets_mm", "anchors_mm"):
        asked.append(ends)
        answers[ends] = given.get(ends) or [
            answer(question) for question in coordinate_questions(ends, answers)
        ]
        while ask is not None and (problems := _geometry_problems(answers)):
            refuse("; ".join(problems))
            answers["platform_mm"] = answer(_PLATFORM, {})
            for again in asked:
                answers[again] = [answer(q, {}) for q in coordinate_questions(again, answers)]
    for question in AFTER_COORDINATES:
        answers[question.key] = answer(question)
    return answers


def _given(question: RigQuestion, value: Any, answers: Answers) -> Any:
    try:
        return question.read(shown_value(value), value, answers)
    except ValueError as error:
        raise _invalid(question, error, "give another value") from None


def _default(question: RigQuestion, answers: Answers) -> Any:
    value = question.default(answers)
    try:
        return question.read("", value, answers)
    except ValueError as error:
        hint = "give it with its option: its default does not fit the other values"
        raise _invalid(question, error, hint) from None


def _invalid(question: RigQuestion, error: ValueError, hint: str) -> BadInput:
    what = f"--{question.key.replace('_', '-')}: {error}"
    return BadInput(what, where="cdpr new", next_step=hint)


def read_coordinates(path: Path) -> dict[str, Any]:
    """Outlets and anchors from a CSV file with one line per cable.

    Args:
        path: Its columns are `CSV_COLUMNS`; others are ignored.

    Raises:
        BadInput: The file cannot be read, a column is missing, a line in between is empty, or a
            value is not a number.
    """
    table = CsvTable(path)
    table.require_no_gap()
    points = table.of(CSV_COLUMNS).tolist()
    if not 6 <= len(points) <= CABLES_MOST:
        what = f"{len(points)} cables; a rig has from 6 to {CABLES_MOST}"
        raise table.bad(what, "give one line per cable, 6 or more")
    return {
        "cables": len(points),
        "outlets_mm": [point[:3] for point in points],
        "anchors_mm": [point[3:] for point in points],
    }
