"""Settings of a search: sampler, cost, mode, seed and sizes; also built from named options."""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Literal

from model.errors import BadInput, NoSolution, distinct_figures, is_masked, real_number
from model.files.documents import LARGEST, SEED_LARGEST, WHOLE_LARGEST
from planner.path import Progress
from planner.rrt.variants import DEFAULT, AlgorithmVariant

SamplerName = Literal["adaptive", "goal-bias"]
CostName = Literal["kinematic", "length"]
Mode = Literal["rewire", "paper"]

CLEARANCE_RESERVE = 0.05e-3
"""Added to every clearance the scene requires, [m], so that round-off in a plan file (1 nm), and
between the distances of planner and check, never makes the check refuse a plan."""

ATTEMPT_WITH_ROOM = 0.25
"""Part of the iterations after which the rewiring mode no longer requires room for blends."""

MARGIN_RESERVE = 0.002
"""Capacity margin that ends and edges must keep at least, as part of the largest tension; see
`planner.costs.margin_reserve`. An edge is proved in intervals that shrink with its margin: on a
robot with pulleys at a margin of 0.05 %, edges of 200 mm stay unproved even without a reserve."""

IMPROVING_ITERATIONS = 500
"""Iterations of the rewiring mode after its first path. Source: measured on the paper's scenes;
twice as many made the paths 1 % cheaper, as post-processing does the rest."""


def whole_number(name: str, value: int, least: int = 0, most: int = WHOLE_LARGEST) -> int:
    """A Python integer from any integer type, such as NumPy's.

    Args:
        name: Of the value, for the message.

    Raises:
        BadInput: It is not a whole number, or outside the limits.
    """
    try:
        number = None if isinstance(value, bool) or is_masked(value) else operator.index(value)
    except TypeError:
        number = None
    if number is None or not least <= number <= most:
        raise BadInput(f"{name} must be a whole number from {least} to {most}, it is {value!r}")
    return number


@dataclass(frozen=True, slots=True)
class PlannerSettings:
    """Settings of the paper's planners; sizes from its Table 2, SI.

    Attributes:
        sampler: "adaptive" (paper, section 4.2) or "goal-bias" (the goal with probability 0.5).
        cost: "kinematic" (integral of γ_d + γ_f along the path) or "length".
        mode: "paper" stops at the first path and never rewires (Algorithm 1); "rewire" is RRT*.
        seed: Of the random generator.
        step: Length η of an edge, [m].
        neighbour_radius: r_c, [m].
        goal_radius: r_g, within which a node tries the goal itself, [m].
        max_iterations: After which the search gives up.
        readings: Of the paper where its text is ambiguous.
    """

    sampler: SamplerName = "adaptive"
    cost: CostName = "kinematic"
    mode: Mode = "rewire"
    seed: int = 0
    step: float = 0.040
    neighbour_radius: float = 0.080
    goal_radius: float = 0.050
    max_iterations: int = 20000
    readings: AlgorithmVariant = DEFAULT

    def __post_init__(self) -> None:
        """Refuses unusable settings.

        Raises:
            BadInput: A name is unknown, a size is not positive, or a number is out of range.
        """
        known = {
            "sampler": ("adaptive", "goal-bias"),
            "cost": ("kinematic", "length"),
            "mode": ("paper", "rewire"),
        }
        for name, choices in known.items():
            if getattr(self, name) not in choices:
                what = f"unknown {name} {getattr(self, name)!r}"
                raise BadInput(what, next_step=f"use one of: {', '.join(choices)}")
        for name in ("step", "neighbour_radius", "goal_radius"):
            if not 0 < getattr(self, name) < float("inf"):
                raise BadInput(f"{name} must be above 0, it is {getattr(self, name)}")
        most = whole_number("max_iterations", self.max_iterations, least=1)
        object.__setattr__(self, "max_iterations", most)
        object.__setattr__(self, "seed", whole_number("the seed", self.seed, most=SEED_LARGEST))


# The objective of a search: a weighted sum of length, kinematic cost, clearance and margin.


_TIE = 0.02
"""Cost of a metre added to an objective that leaves most of the path undetermined: 1 mm of
clearance or 1 N of margin is worth 50 mm of path."""


@dataclass(frozen=True, slots=True)
class Weights:
    """Weights of a sum: the first two terms are minimised, the last two maximised.

    Attributes:
        length: Of the length, [m].
        kinematic: Of the line integral of c = γ_d + γ_f, [m].
        clearance: Of the smallest distance to an obstacle, [m].
        capacity: Of the smallest capacity margin, [N].
    """

    length: float = 0.0
    kinematic: float = 0.0
    clearance: float = 0.0
    capacity: float = 0.0

    def __post_init__(self) -> None:
        """Refuses weights that leave nothing to minimise.

        Raises:
            BadInput: A weight is negative or larger than files hold, or neither the length nor
                the kinematic cost has one.
        """
        for entry in fields(self):
            value = getattr(self, entry.name)
            if not 0.0 <= value <= LARGEST:
                raise BadInput(
                    f"the weight of {entry.name} must be 0 or more, it is {value:g}",
                    next_step=f"leave it out, or give it a number of at most {LARGEST:g}",
                )
        if self.length + self.kinematic == 0.0:
            raise BadInput(
                "without a weight of length or kinematic the path length is unbounded",
                next_step="give length a small weight as well, such as length=0.02",
            )

    @property
    def is_length(self) -> bool:
        """Whether only the length counts."""
        return self.kinematic + self.clearance + self.capacity == 0.0

    @property
    def scale(self) -> float:
        """The largest weight, where 1 N of margin counts as 1 mm; 1 for the named objectives."""
        return max(self.length, self.kinematic, self.clearance, self.capacity * 1e3)

    def normalized(self) -> Weights:
        """The same objective with a scale of 1, as searches have absolute tolerances of cost."""
        return Weights(*(getattr(self, entry.name) / self.scale for entry in fields(self)))


OBJECTIVES = {
    "length": Weights(length=1.0),
    "kinematic": Weights(kinematic=1.0),
    "clearance": Weights(clearance=1.0, length=_TIE),
    "capacity": Weights(capacity=1e-3, length=_TIE),
}
"""Weights of the named objectives."""


LEAST_ROUNDS, LEAST_ROUNDS_WITH_CLEARANCE, LEAST_ROUNDS_WITH_LIMIT = 12, 30, 80
"""Done whatever the clock says, so that a busy machine finds a path too; with clearance some eight
searches begin in them; with a limit of the length its price changes only every few rounds."""


def least_rounds(*, has_limit: bool, has_clearance: bool) -> int:
    """Rounds that a search does at least: with a limit of the length, or a weight of clearance."""
    if has_limit:
        return LEAST_ROUNDS_WITH_LIMIT
    return LEAST_ROUNDS_WITH_CLEARANCE if has_clearance else LEAST_ROUNDS


@dataclass(frozen=True, slots=True, kw_only=True)
class AnytimeSettings:
    """Settings of every search in rounds.

    Attributes:
        weights: The objective.
        longest: Longest path allowed, [m]; infinite for no limit.
        seed: Of the random numbers.
        budget: Time to find and improve paths, [s]; preparation is not counted.
        rounds: Exact number of rounds instead of the budget; reproducible.
    """

    weights: Weights = field(default_factory=lambda: OBJECTIVES["length"])
    longest: float = math.inf
    seed: int = 0
    budget: float = 0.050
    rounds: int | None = None

    def __post_init__(self) -> None:
        """Refuses unusable settings.

        Raises:
            BadInput: The seed or the rounds are out of range, or a limit is not positive.
        """
        object.__setattr__(self, "seed", whole_number("the seed", self.seed, most=SEED_LARGEST))
        if not 0.0 < self.budget * 1e3 <= LARGEST:
            what = f"the budget must be above 0 ms and finite, it is {self.budget * 1e3:g} ms"
            raise BadInput(what)
        if self.rounds is not None:
            object.__setattr__(self, "rounds", whole_number("rounds", self.rounds, least=1))
        if not (0.0 < self.longest * 1e3 <= LARGEST or self.longest == math.inf):
            raise BadInput(f"the longest path must be above 0 mm, not {self.longest * 1e3:g} mm")

    def is_over(self, rounds: int, spent: float, least: int = LEAST_ROUNDS) -> bool:
        """Whether a search may end after these rounds and seconds, ``least`` rounds at least."""
        if self.rounds is not None:
            return rounds >= self.rounds
        return rounds >= least and spent >= self.budget

    def report(self, progress: Progress, rounds: int, spent: float, cost: float) -> None:
        """Reports progress in rounds, where given, or seconds, and a normalized cost as weighed."""
        cost *= self.weights.scale
        if self.rounds is not None:
            progress(float(rounds), float(self.rounds), cost)
        else:
            progress(min(spent, self.budget), self.budget, cost)

    @property
    def longer(self) -> str:
        """How a user makes the search longer, with a value to try."""
        if self.rounds is None:
            return f"give it more time, such as `budget={max(10.0 * self.budget, 0.5):g}`"
        rounds = min(max(10 * self.rounds, 100), WHOLE_LARGEST)
        return f"give it more rounds, such as `rounds={rounds}`"

    def not_found(self, rounds: int, gap: float) -> str:
        """Message after rounds without a path; ``gap`` between the trees, [m]."""
        of_budget = f" of the {self.budget * 1e3:g} ms budget" if self.rounds is None else ""
        return (
            f"no path after {rounds} rounds{of_budget}; the trees from start and goal come within"
            f" {gap * 1e3:.1f} mm of each other"
        )

    def too_long(
        self, where: str, found: float, straight: float, values: dict[str, float | str]
    ) -> NoSolution:
        """The error where no path is short enough; lengths of best path and straight line, [m]."""
        figures = self.longest * 1e3, found * 1e3
        limit, length = distinct_figures(figures, 1)
        return NoSolution(
            f"no path of at most {limit} mm was found",
            where=where,
            why=f"the path found is {length} mm long, the straight line {straight * 1e3:.1f} mm",
            next_step=f"allow a longer path, or {self.longer}; `cost='length'` without a limit"
            " shows how short paths can be",
            values={**values, "longest_mm": figures[0], "found_mm": figures[1]},
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class OptimalSettings(AnytimeSettings):
    """Settings of the search that keeps the orientation of the start."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TurningSettings(AnytimeSettings):
    """Settings of the search that may rotate the platform; its moves take longer to check."""

    budget: float = 0.500


Settings = PlannerSettings | OptimalSettings | TurningSettings
"""Of any planner."""


# Settings of a planner from named options; contradictions are refused.


PlannerName = Literal["optimal", "adaptive", "goal-bias"]
"""The one we recommend; the paper's; or the paper's with half of all samples at the goal."""
Objective = Literal["length", "kinematic", "clearance", "capacity"]
"""Named objectives."""

_OPTIMAL = ("weights", "budget", "rounds", "longest", "free_rotation")
_PAPER = ("mode", "max_iterations")
_OPTIONS = {"optimal": _OPTIMAL, "adaptive": _PAPER, "goal-bias": _PAPER}


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanningOptions:
    """Options of a plan; None, or empty, where one was left out.

    Attributes:
        planner: Which planner searches.
        seed: Of the random numbers.
        cost: Objective; when left out ``length``, or ``kinematic`` for the paper's planners.
        weights: Weights of a sum of objectives, by name.
        budget: Optimal: time to find and improve a path, [s].
        rounds: Optimal: rounds instead of the budget, one number or one per leg; reproducible.
        longest: Optimal: length limit of the path, [m].
        free_rotation: Optimal: the platform may rotate, within the scene's limits.
        mode: The paper's planners: RRT* (rewire), or stop at the first path (paper).
        max_iterations: The paper's planners: give up after this number of samples.
    """

    planner: PlannerName = "optimal"
    seed: int = 0
    cost: Objective | None = None
    weights: Mapping[str, float] = field(default_factory=dict)
    budget: float | None = None
    rounds: Sequence[int] = ()
    longest: float | None = None
    free_rotation: bool = False
    mode: Mode | None = None
    max_iterations: int | None = None


def settings_from_options(options: PlanningOptions) -> Settings:
    """The settings of the planner chosen.

    Messages name the arguments of `cdpr.plan`; the command line names its options instead.

    Raises:
        BadInput: An option does not apply to the planner, options contradict each other, or a
            value cannot be used.
    """
    for name in ("planner", "cost", "mode"):
        value = getattr(options, name)
        if not isinstance(value, str | None):
            raise BadInput(f"the {name} must be text, it is {value!r}")
    if not isinstance(options.weights, Mapping):
        what = f"the weights must be a mapping such as {{'length': 1.0}}, not {options.weights!r}"
        raise BadInput(what)
    if options.planner not in _OPTIONS:
        raise BadInput(
            f"unknown planner {options.planner!r}", next_step=f"use one of: {', '.join(_OPTIONS)}"
        )
    _refuse_unused(options)
    if options.planner == "optimal":
        return _optimal_settings(options)
    return _paper_settings(options)


def _refuse_unused(options: PlanningOptions) -> None:
    others = {*_OPTIMAL, *_PAPER} - {*_OPTIONS[options.planner]}
    unused = [name for name in sorted(others) if _is_given(getattr(options, name))]
    if unused:
        named = ", ".join(f"`{name}=`" for name in unused)
        raise BadInput(
            f"`planner={options.planner!r}` does not take {named}",
            next_step="leave it out, or choose another planner",
        )


def _is_given(value: object) -> bool:
    if isinstance(value, list | tuple | Mapping):
        return bool(value)
    return value is not None and value is not False


def _optimal_settings(options: PlanningOptions) -> OptimalSettings | TurningSettings:
    if options.weights and options.cost is not None:
        raise BadInput(
            "`cost=` and `weights=` contradict each other", next_step="leave out one of them"
        )
    if options.budget is not None and options.rounds:
        raise BadInput(
            "`budget=` and `rounds=` contradict each other", next_step="leave out one of them"
        )
    budget = options.budget
    given: dict[str, Any] = {} if budget is None else {"budget": budget}
    cost = "length" if options.cost is None else options.cost
    _require_objective(cost)
    return (TurningSettings if options.free_rotation else OptimalSettings)(
        weights=_weights(options.weights) if options.weights else OBJECTIVES[cost],
        longest=math.inf if options.longest is None else options.longest,
        seed=options.seed,
        rounds=options.rounds[0] if options.rounds else None,
        **given,
    )


def _require_objective(name: str) -> None:
    if name not in OBJECTIVES:
        raise BadInput(
            f"{name!r} is not an objective", next_step=f"use one of: {', '.join(OBJECTIVES)}"
        )


def _weights(given: Mapping[str, float]) -> Weights:
    for name in given:
        _require_objective(name)
    return Weights(**{name: real_number(f"the weight of {name}", x) for name, x in given.items()})


def _paper_settings(options: PlanningOptions) -> PlannerSettings:
    cost = options.cost
    if cost is not None:
        _require_objective(cost)
    if cost in ("clearance", "capacity"):
        raise BadInput(
            f"`planner={options.planner!r}` has no cost {cost!r}",
            next_step="use `planner='optimal'`, or the cost 'kinematic' or 'length'",
        )
    most = options.max_iterations
    given: dict[str, Any] = {} if most is None else {"max_iterations": most}
    return PlannerSettings(
        sampler="adaptive" if options.planner == "adaptive" else "goal-bias",
        cost="length" if cost == "length" else "kinematic",
        mode="rewire" if options.mode is None else options.mode,
        seed=options.seed,
        **given,
    )
