"""Laws of winch motion without a path: the next set-point of each winch. Pure.

Drives stay in their position mode: a tension is reached by winding cable in by less, each cycle,
than could overstretch it before its tension is seen. No law pays cable out to cure a tension.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from executor.safety.monitor import Alarm, StopReaction
from executor.trajectory.time_scaling import PEAK, smooth_step
from model.kinematics import cable_lengths
from model.pose import Array
from model.rig import Rig

# How much tension is left while winches move without a path: they slow down, and stop. Pure.


#: Cycles in a row beyond the limit, all winches at rest, that end the motion.
OVER_CYCLES = 5
#: Near the limit all go on more slowly, down to this share of their speed; beyond it none goes on.
CREEP = 0.05


class TensionHeadroom:
    """What is left to the limit of the tension, and whether it is used up."""

    def __init__(self, target: float, limit: float) -> None:
        """All of it is left.

        Args:
            target: Up to this tension winches go on at their speed, [N].
            limit: Beyond this one none goes on, [N].
        """
        self._target, self._limit = target, limit
        self._cycles = 0

    def share(self, tensions: Sequence[float]) -> float:
        """Of their speed at which winches go on, by the tensions [N] now; asked once a cycle."""
        most = float(np.max(tensions))
        # "Not at most", so that a tension that is no number counts as too large.
        over = not most <= self._limit
        self._cycles = self._cycles + 1 if over else 0
        room = (self._limit - most) / (self._limit - self._target)
        return 0.0 if over else min(1.0, max(CREEP, room))

    def used_up(self, tensions: Sequence[float]) -> list[Alarm]:
        """Cables that carry more than the limit, and did so for too long."""
        if self._cycles < OVER_CYCLES:
            return []
        return [
            Alarm(
                StopReaction.PATH_STOP,
                "over_tension",
                f"cable {cable} carries {tension:.1f} N, more than {self._limit:.1f} N",
                cable,
            )
            for cable, tension in enumerate(tensions, start=1)
            if not tension <= self._limit
        ]


#: A cable that was taut stays so while its tension is above this share of what was asked for.
STAYS_TAUT = 0.8
#: Cycles in which all cables must be taut, and in which one that was taut must not be slack.
TAUT_CYCLES, SLACK_CYCLES = 20, 5
#: A step may raise a tension by this share of what is left to the limit: its effect is seen only
#: two cycles later, three where torques are a cycle late, and the cables opposite may be wound
#: in meanwhile, too.
SHARE_OF_ROOM = 0.125

Targets = tuple[int, ...]


class WinchLaw(Protocol):
    """Computes the next set-point of each winch."""

    @property
    def reach(self) -> tuple[Targets, Targets]:
        """Where it begins, and how far it may go, [counts]."""
        ...

    @property
    def done(self) -> bool:
        """It has nothing left to do."""
        ...

    @property
    def progress(self) -> float:
        """How much of it is done, from 0 to 1."""
        ...

    def next(self, pace: float, tensions: Sequence[float]) -> tuple[Targets, tuple[Alarm, ...]]:
        """One more cycle.

        Args:
            pace: Share of a cycle that passes for the law; less than 1 while the feed is slowed.
            tensions: Of the cables now, shape (m,), [N].

        Returns:
            Targets of all winches, [counts], and what makes going on wrong.
        """
        ...


class PretensionLaw:
    """Winds all cables in, slowly and together, each until it is taut."""

    def __init__(
        self, rig: Rig, begin: Sequence[int], *, target: float, limit: float, reach: float,
        speed: float,
    ) -> None:  # fmt: skip
        """Nothing is wound in yet.

        Args:
            rig: The robot.
            begin: Positions of the drives, [counts].
            target: Tension at which a cable is taut, [N].
            limit: Tension that none may have, [N].
            reach: Longest way that one cable is wound in, [m].
            speed: At most so fast, [m/s].
        """
        self._rig, self._begin = rig, np.array(begin, dtype=np.float64)
        self._target, self._reach = target, reach
        self._room = TensionHeadroom(target, limit)
        self._per_metre = np.array([winch.counts_per_metre for winch in rig.winches])
        self._step = wind_in_speed(rig, target, limit, speed) * _cycle(rig)
        self._wound = np.zeros(rig.cable_count)
        self._taut = np.zeros(rig.cable_count, dtype=bool)
        self._cycles = 0

    @property
    def reach(self) -> tuple[Targets, Targets]:
        """See `WinchLaw`."""
        return self._targets(0.0 * self._wound), self._targets(0.0 * self._wound + self._reach)

    @property
    def done(self) -> bool:
        """Every cable has been taut for a while."""
        return self._cycles >= TAUT_CYCLES

    @property
    def progress(self) -> float:
        """Share of cables that are taut."""
        return float(np.mean(self._taut))

    def next(self, pace: float, tensions: Sequence[float]) -> tuple[Targets, tuple[Alarm, ...]]:
        """See `WinchLaw`."""
        pull = np.asarray(tensions)
        pace *= self._room.share(tensions)
        self._taut = pull >= np.where(self._taut, STAYS_TAUT, 1.0) * self._target
        self._cycles = self._cycles + 1 if self._taut.all() else 0
        wanting = ~self._taut
        short = wanting & (self._wound >= self._reach)
        self._wound = np.where(
            wanting, np.minimum(self._wound + pace * self._step, self._reach), self._wound
        )
        still_slack = (
            self._still_slack(int(cable), float(pull[cable])) for cable in np.flatnonzero(short)
        )
        return self._targets(self._wound), (*self._room.used_up(tensions), *still_slack)

    def _targets(self, wound: Array) -> Targets:
        counts = self._begin - self._per_metre * wound
        return tuple(int(c) for c in np.rint(counts))

    def _still_slack(self, cable: int, tension: float) -> Alarm:
        text = (
            f"cable {cable + 1} carries {tension:.1f} N after {self._reach * 1000:g} mm were wound"
            f" in; the target is {self._target:.1f} N. It may be off its drum or pulley, or broken"
        )
        return Alarm(StopReaction.PATH_STOP, "not_taut", text, cable + 1)


class CableStep:
    """Moves one winch by a length of cable, smoothly, while all others stand."""

    def __init__(
        self, rig: Rig, begin: Sequence[int], *, cable: int, way: float, limit: float, speed: float
    ) -> None:
        """Nothing moves yet.

        Args:
            rig: The robot.
            begin: Positions of the drives, [counts].
            cable: Which, from 0.
            way: Cable to pay out, [m]; negative to wind in.
            limit: Tension that no cable may have, [N].
            speed: At most so fast, [m/s].
        """
        self._begin = tuple(begin)
        speed = float(_fastest(rig, speed)[cable])
        self._cable, self._counts = cable, way * rig.winches[cable].counts_per_metre
        self._least = rig.min_tension / 2.0
        self._room = TensionHeadroom(self._least, limit)
        self._duration = max(1.0, PEAK * abs(way) / (speed * _cycle(rig)))
        # A cable that is taut is moved as carefully as it would be wound in.
        careful = wind_in_speed(rig, self._least, limit, speed)[cable]
        self._pace_if_taut = float(careful) / speed
        self._time = 0.0
        self._was_taut: list[bool] | None = None
        self._slack = [0] * rig.cable_count

    @property
    def reach(self) -> tuple[Targets, Targets]:
        """See `WinchLaw`."""
        return self._begin, self._at(1.0)

    @property
    def done(self) -> bool:
        """The winch is where it was to go."""
        return self._time >= self._duration

    @property
    def progress(self) -> float:
        """Share of the time that it takes."""
        return min(1.0, self._time / self._duration)

    def next(self, pace: float, tensions: Sequence[float]) -> tuple[Targets, tuple[Alarm, ...]]:
        """See `WinchLaw`."""
        taut = tensions[self._cable] >= self._least
        pace *= (self._pace_if_taut if taut else 1.0) * self._room.share(tensions)
        self._time = min(self._time + pace, self._duration)
        smooth = smooth_step(self._time / self._duration)
        return self._at(smooth), (*self._room.used_up(tensions), *self._made_slack(tensions))

    def _at(self, share: float) -> Targets:
        targets = list(self._begin)
        targets[self._cable] += round(share * self._counts)
        return tuple(targets)

    def _made_slack(self, tensions: Sequence[float]) -> list[Alarm]:
        """Other cables that were taut and are slack; one that hung slack before may go on so."""
        if self._was_taut is None:
            self._was_taut = [tension >= self._least for tension in tensions]
        found = []
        for cable, tension in enumerate(tensions):
            slack = self._was_taut[cable] and tension < self._least and cable != self._cable
            self._slack[cable] = self._slack[cable] + 1 if slack else 0
            if self._slack[cable] >= SLACK_CYCLES:
                text = (
                    f"cable {cable + 1} went slack ({tension:.1f} N, less than {self._least:.1f})"
                    f" while only cable {self._cable + 1} was moved"
                )
                found.append(Alarm(StopReaction.PATH_STOP, "went_slack", text, cable + 1))
        return found


def wind_in_speed(rig: Rig, target: float, limit: float, speed: float) -> Array:
    """How fast each cable may be wound in while its tension is looked at, shape (m,), [m/s].

    Never faster than its winch; cables are taken to be as stiff as they are at home.
    """
    lengths = cable_lengths(rig, rig.home) + [winch.drum_to_outlet for winch in rig.winches]
    careful = SHARE_OF_ROOM * (limit - target) / (rig.cable_stiffness / lengths) / _cycle(rig)
    return np.minimum(_fastest(rig, speed), careful)


def _fastest(rig: Rig, speed: float) -> Array:
    """The speed that is wished for, where the winch has it, shape (m,), [m/s]."""
    return np.minimum(speed, [winch.max_speed for winch in rig.winches])


def _cycle(rig: Rig) -> float:
    return rig.document.bus.cycle_ms / 1000.0
