"""Laws of winch motion without a path: the next set-point of each winch. Pure.

Drives stay in their position mode: a tension is reached by winding cable in by less, each cycle,
than could overstretch it before its tension is seen. No law pays cable out to cure a tension.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Protocol

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


#: Of what lies between slack and the limit a held control leaves this share unused, at least as
#: much as a drive's whole counts may raise a tension, and at most half, [N].
RESERVE, RESERVE_COUNTS, MOST_RESERVE = 0.1, 2.0, 0.5
#: Another cable that was taut is let become no slacker than this share of the least tension.
LEAST_SHARE = 0.75
#: By less than this share of the reserve a tension may change without having changed.
UNCHANGED = 0.25


class TensionReserve:
    """Brings a jog of one cable to rest before a tension is at its limit: that is no fault.

    Winding in ends where any cable comes near the limit. Paying out slackens the cable itself, so
    that only others count, and only those that become tighter: else nothing could slacken a
    platform that is too taut. Either ends before another cable that was taut goes slack.
    """

    def __init__(self, rig: Rig, cable: int, *, limit: float, pays_out: bool) -> None:
        """Nothing moves yet.

        Args:
            rig: The robot.
            cable: Which, from 0.
            limit: Tension that no cable may have, [N].
            pays_out: The cable is paid out, otherwise wound in.
        """
        reserve = tension_reserve(rig, limit)
        self._slack, self._floor = rig.min_tension / 2.0, LEAST_SHARE * rig.min_tension
        self._ceiling, self._unchanged = limit - reserve, UNCHANGED * reserve
        self._is_other = np.arange(rig.cable_count) != cable
        self._pays_out = pays_out
        self._before: Array | None = None

    def share(self, tensions: Sequence[float]) -> float:
        """Of its speed at which it goes on, by the tensions [N] now; 0 where it must not."""
        now = np.asarray(tensions, dtype=np.float64)
        if not np.isfinite(now).all():
            return 0.0
        if self._before is None:
            self._before = now
        change, range_ = now - self._before, self._ceiling - self._slack
        tighter = self._is_other & (change > self._unchanged)
        counts = tighter if self._pays_out else np.full(len(now), True)
        above = float(np.min(self._ceiling - now[counts], initial=np.inf))
        slacker = self._is_other & (self._before >= self._slack) & (change < -self._unchanged)
        below = float(np.min(now[slacker] - self._floor, initial=np.inf))
        room = min(above, below) / range_
        return min(1.0, max(CREEP, room)) if room > 0.0 else 0.0


def tension_reserve(rig: Rig, limit: float) -> float:
    """How far below a limit [N] of the tension a jog of one cable comes to rest, [N]."""
    room = limit - rig.min_tension / 2.0
    per_metre = np.abs([winch.counts_per_metre for winch in rig.winches])
    count = RESERVE_COUNTS * float(np.max(_stiffness(rig) / per_metre))
    return min(max(RESERVE * room, count), MOST_RESERVE * room)


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
        self._step = wind_in_speed(rig, target, limit, speed) * rig.cycle
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


class OneCableLaw:
    """Moves one winch while all others stand: what is common to a step and a held jog.

    A cable that is taut is moved as carefully as it would be wound in. Other cables that were taut
    must not go slack meanwhile; those that hung slack before may go on so.

    Attributes:
        stretch: How much longer it takes than at an even speed.
        shortest: It takes no less, [cycles].
    """

    stretch: ClassVar[float] = 1.0
    shortest: ClassVar[float] = 0.0

    def __init__(
        self, rig: Rig, begin: Sequence[int], *, cable: int, way: float, limit: float, speed: float,
        reserve: TensionReserve | None = None,
    ) -> None:  # fmt: skip
        """Nothing moves yet.

        Args:
            rig: The robot.
            begin: Positions of the drives, [counts].
            cable: Which, from 0.
            way: Cable to pay out at most, [m]; negative to wind in.
            limit: Tension that no cable may have, [N].
            speed: At most so fast, [m/s].
            reserve: Where it comes to rest before the limit; None where that is a fault.
        """
        self._begin = tuple(begin)
        self._speed = float(_fastest(rig, speed)[cable])
        self._cable, self._counts = cable, way * rig.winches[cable].counts_per_metre
        self._least = rig.min_tension / 2.0
        self._room, self._reserve = TensionHeadroom(self._least, limit), reserve
        careful = wind_in_speed(rig, self._least, limit, speed)[cable]
        self._pace_if_taut = float(careful) / self._speed
        # A cable that goes slack is moved faster again, but not with a jerk.
        self._share, self._rise = 1.0, rig.motion.acceleration / rig.motion.speed * rig.cycle
        at_speed = self.stretch * abs(way) / (self._speed * rig.cycle)
        self._duration, self._passed = max(self.shortest, at_speed), 0.0
        self._was_taut: list[bool] | None = None
        self._slack = [0] * rig.cable_count

    @property
    def reach(self) -> tuple[Targets, Targets]:
        """See `WinchLaw`."""
        return self._begin, self._at(1.0)

    @property
    def done(self) -> bool:
        """The winch is where it was to go."""
        return self.progress >= 1.0

    @property
    def progress(self) -> float:
        """Share of the time that it takes."""
        return self._passed / self._duration if self._duration else 1.0

    def _share_of_way(self) -> float:
        """Share of the way that is done by now."""
        return self.progress

    def next(self, pace: float, tensions: Sequence[float]) -> tuple[Targets, tuple[Alarm, ...]]:
        """See `WinchLaw`."""
        taut = tensions[self._cable] >= self._least
        share = (self._pace_if_taut if taut else 1.0) * self._room.share(tensions)
        if self._reserve is not None:
            share *= self._reserve.share(tensions)
        self._share = min(share, self._share + self._rise)
        self._passed = min(self._passed + pace * self._share, self._duration)
        targets = self._at(self._share_of_way())
        return targets, (*self._room.used_up(tensions), *self._made_slack(tensions))

    def _at(self, share: float) -> Targets:
        targets = list(self._begin)
        targets[self._cable] += round(share * self._counts)
        return tuple(targets)

    def _made_slack(self, tensions: Sequence[float]) -> list[Alarm]:
        """Other cables that were taut and are slack."""
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


class CableStep(OneCableLaw):
    """Moves one winch by a length of cable, smoothly, from rest to rest."""

    stretch, shortest = PEAK, 1.0

    def _share_of_way(self) -> float:
        return smooth_step(self.progress)


class CableFeed(OneCableLaw):
    """Moves one winch at an even speed up to a longest way; its feed speeds up and slows down."""

    @property
    def cycles_left(self) -> float:
        """To the end of the longest way, at its speed."""
        return self._duration - self._passed


def wind_in_speed(rig: Rig, target: float, limit: float, speed: float) -> Array:
    """How fast each cable may be wound in while its tension is looked at, shape (m,), [m/s].

    Never faster than its winch; cables are taken to be as stiff as they are at home.
    """
    careful = SHARE_OF_ROOM * (limit - target) / _stiffness(rig) / rig.cycle
    return np.minimum(_fastest(rig, speed), careful)


def _stiffness(rig: Rig) -> Array:
    """Of each cable at home, shape (m,), [N/m]."""
    lengths = cable_lengths(rig, rig.home) + [winch.drum_to_outlet for winch in rig.winches]
    return rig.cable_stiffness / lengths


def _fastest(rig: Rig, speed: float) -> Array:
    """The speed that is wished for, where the winch has it, shape (m,), [m/s]."""
    return np.minimum(speed, [winch.max_speed for winch in rig.winches])
