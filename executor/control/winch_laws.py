"""Laws of winch motion without a path: the next set-point of each winch. Pure.

Drives stay in position mode: a tension is reached by winding in, each cycle, less cable than
could overload it before the tension is measured. No law pays out cable to reduce a tension.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Protocol

import numpy as np

from executor.safety.fault_messages import Alarm, not_taut, over_tension, went_slack
from executor.trajectory.time_scaling import PEAK, smooth_step
from model.kinematics import cable_lengths
from model.pose import Array
from model.rig import Rig
from model.winches import whole_lengths

# Tension limits while winches move without a path: they slow down, and stop.


#: Consecutive cycles over the limit, all winches at rest, that end the motion.
OVER_CYCLES = 5
#: Near the limit all winches slow down, to no less than this share of their speed; beyond it, 0.
CREEP = 0.05


class TensionHeadroom:
    """Slows winches down near the tension limit, and reports cables that stay over it."""

    def __init__(self, target: float, limit: float) -> None:
        """Headroom between two tensions.

        Args:
            target: Tension up to which winches run at full speed, [N].
            limit: Tension beyond which none moves, [N].
        """
        self._target, self._limit = target, limit
        self._cycles = 0

    def share(self, tensions: Sequence[float]) -> float:
        """Share of the winches' speed allowed at these tensions [N]; call once per cycle.

        A drive whose torque has the wrong sign reports them as negative.
        """
        most = float(np.max(np.abs(tensions)))
        # "not ... <=", so that NaN counts as too large.
        over = not most <= self._limit
        self._cycles = self._cycles + 1 if over else 0
        room = (self._limit - most) / (self._limit - self._target)
        return 0.0 if over else min(1.0, max(CREEP, room))

    def used_up(self, tensions: Sequence[float]) -> list[Alarm]:
        """Alarms of cables that were over the limit for too long."""
        if self._cycles < OVER_CYCLES:
            return []
        return [
            over_tension(cable, tension, self._limit)
            for cable, tension in enumerate(tensions, start=1)
            if not abs(tension) <= self._limit
        ]


#: Share of the range from slack to the limit that a jog leaves unused; at least the tension of this
#: many counts of a drive, at most half the range.
RESERVE, RESERVE_COUNTS, MOST_RESERVE = 0.1, 2.0, 0.5
#: No other taut cable may drop below this share of the least tension.
LEAST_SHARE = 0.75
#: Changes of a tension below this share of the reserve are noise.
UNCHANGED = 0.25


class TensionReserve:
    """Brings a jog of one cable to rest, without a fault, before a tension reaches its limit.

    Winding in ends when any cable nears the limit. Paying out slackens the cable itself, so
    only others count, and only those whose tension rises: otherwise an overtightened platform could
    not be slackened. Either ends before another taut cable goes slack.
    """

    def __init__(self, rig: Rig, cable: int, *, limit: float, pays_out: bool) -> None:
        """A reserve at the start of a jog.

        Args:
            cable: Index, from 0.
            limit: Largest tension of any cable, [N].
            pays_out: Whether the cable is paid out, otherwise wound in.
        """
        reserve = tension_reserve(rig, limit)
        self._slack, self._floor = rig.min_tension / 2.0, LEAST_SHARE * rig.min_tension
        self._ceiling, self._unchanged = limit - reserve, UNCHANGED * reserve
        self._is_other = np.arange(rig.cable_count) != cable
        self._pays_out = pays_out
        self._before: Array | None = None

    def share(self, tensions: Sequence[float]) -> float:
        """Share of the speed allowed at these tensions [N]; 0 to stop."""
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
    """Distance below a tension limit [N] at which a jog of one cable comes to rest, [N]."""
    room = limit - rig.min_tension / 2.0
    per_metre = np.abs([winch.counts_per_metre for winch in rig.winches])
    count = RESERVE_COUNTS * float(np.max(_stiffness(rig) / per_metre))
    return min(max(RESERVE * room, count), MOST_RESERVE * room)


#: A taut cable counts as taut while its tension is above this share of the target.
STAYS_TAUT = 0.8
#: Cycles for which all cables must be taut; cycles after which a taut cable counts as slack.
TAUT_CYCLES, SLACK_CYCLES = 20, 5
#: A step may raise a tension by this share of the distance to the limit: its effect is measured
#: only two cycles later, three where torques are a cycle late, and opposite cables may be wound
#: in meanwhile.
SHARE_OF_ROOM = 0.125

Targets = tuple[int, ...]


class WinchLaw(Protocol):
    """Computes the next set-point of each winch."""

    @property
    def reach(self) -> tuple[Targets, Targets]:
        """First and farthest targets, [counts]."""

    @property
    def done(self) -> bool:
        """Whether the law has finished."""

    @property
    def progress(self) -> float:
        """Share done, from 0 to 1."""

    def next(self, pace: float, tensions: Sequence[float]) -> tuple[Targets, tuple[Alarm, ...]]:
        """Computes the next cycle.

        Args:
            pace: Time step in cycles; less than 1 while the feed is slowed.
            tensions: Present cable tensions, shape (m,), [N].

        Returns:
            Targets of all winches, [counts], and alarms that end the motion.
        """


class PretensionLaw:
    """Winds in all cables slowly and together, each until it is taut."""

    def __init__(
        self, rig: Rig, begin: Sequence[int], *, targets: Array, limit: float, reach: float,
        speed: float, stretch: float | Array = 0.0,
    ) -> None:  # fmt: skip
        """Prepares the law.

        Args:
            begin: Positions of the drives, [counts].
            targets: Tension at which each cable is taut, shape (m,), [N].
            limit: Largest tension of any cable, [N].
            reach: Largest length of a cable wound in besides its stretch, [m].
            speed: Largest cable speed, [m/s].
            stretch: Of each cable at its target, shape (m,), [m].
        """
        self._rig, self._begin = rig, np.array(begin, dtype=np.float64)
        self._targets, self._stretch = targets, np.full(rig.cable_count, stretch)
        self._reach = reach + self._stretch
        self._room = TensionHeadroom(float(np.max(targets)), limit)
        self._per_metre = np.array([winch.counts_per_metre for winch in rig.winches])
        self._step = wind_in_speed(rig, targets, limit, speed) * rig.cycle
        self._wound = np.zeros(rig.cable_count)
        self._taut = np.zeros(rig.cable_count, dtype=bool)
        self._cycles = 0

    @property
    def reach(self) -> tuple[Targets, Targets]:
        """See `WinchLaw`."""
        return self._counts(0.0 * self._wound), self._counts(0.0 * self._wound + self._reach)

    @property
    def done(self) -> bool:
        """Whether all cables have been taut for `TAUT_CYCLES`."""
        return self._cycles >= TAUT_CYCLES

    @property
    def progress(self) -> float:
        """Share of cables that are taut."""
        return float(np.mean(self._taut))

    def next(self, pace: float, tensions: Sequence[float]) -> tuple[Targets, tuple[Alarm, ...]]:
        """See `WinchLaw`."""
        pull = np.asarray(tensions)
        pace *= self._room.share(tensions)
        self._taut = pull >= np.where(self._taut, STAYS_TAUT, 1.0) * self._targets
        self._cycles = self._cycles + 1 if self._taut.all() else 0
        wanting = ~self._taut
        short = wanting & (self._wound >= self._reach)
        self._wound = np.where(
            wanting, np.minimum(self._wound + pace * self._step, self._reach), self._wound
        )
        still_slack = (
            not_taut(
                int(cable) + 1,
                float(pull[cable]),
                self._reach[cable],
                self._targets[cable],
                self._stretch[cable],
            )
            for cable in np.flatnonzero(short)
        )
        return self._counts(self._wound), (*self._room.used_up(tensions), *still_slack)

    def _counts(self, wound: Array) -> Targets:
        counts = self._begin - self._per_metre * wound
        return tuple(int(c) for c in np.rint(counts))


class OneCableLaw:
    """Moves one winch while all others hold; base of a step and a held jog.

    A taut cable moves no faster than it may be wound in. Other taut cables must not go slack
    meanwhile; slack ones may stay slack.

    Attributes:
        stretch: Ratio of the duration to that at constant speed.
        shortest: Shortest duration, [cycles].
    """

    stretch: ClassVar[float] = 1.0
    shortest: ClassVar[float] = 0.0

    def __init__(
        self, rig: Rig, begin: Sequence[int], *, cable: int, length: float, limit: float,
        speed: float, reserve: TensionReserve | None = None,
    ) -> None:  # fmt: skip
        """Prepares the law.

        Args:
            begin: Positions of the drives, [counts].
            cable: Index, from 0.
            length: Largest length to pay out, [m]; negative to wind in.
            limit: Largest tension of any cable, [N].
            speed: Largest cable speed, [m/s].
            reserve: Brings it to rest before the limit; None where the limit is a fault.
        """
        self._begin = tuple(begin)
        self._speed = float(_fastest(rig, speed)[cable])
        self._cable, self._counts = cable, length * rig.winches[cable].counts_per_metre
        self._least = rig.min_tension / 2.0
        self._room, self._reserve = TensionHeadroom(self._least, limit), reserve
        careful = wind_in_speed(rig, self._least, limit, speed)[cable]
        self._pace_if_taut = float(careful) / self._speed
        # A cable that goes slack speeds up again, at limited acceleration.
        self._share, self._rise = 1.0, rig.motion.acceleration / rig.motion.speed * rig.cycle
        at_speed = self.stretch * abs(length) / (self._speed * rig.cycle)
        self._duration, self._passed = max(self.shortest, at_speed), 0.0
        self._was_taut: list[bool] | None = None
        self._slack = [0] * rig.cable_count

    @property
    def reach(self) -> tuple[Targets, Targets]:
        """See `WinchLaw`."""
        return self._begin, self._at(1.0)

    @property
    def done(self) -> bool:
        """Whether the winch has arrived."""
        return self.progress >= 1.0

    @property
    def progress(self) -> float:
        """Elapsed share of the duration."""
        return self._passed / self._duration if self._duration else 1.0

    def _share_done(self) -> float:
        """Share of the length done so far."""
        return self.progress

    def next(self, pace: float, tensions: Sequence[float]) -> tuple[Targets, tuple[Alarm, ...]]:
        """See `WinchLaw`."""
        taut = tensions[self._cable] >= self._least
        share = (self._pace_if_taut if taut else 1.0) * self._room.share(tensions)
        if self._reserve is not None:
            share *= self._reserve.share(tensions)
        self._share = min(share, self._share + self._rise)
        self._passed = min(self._passed + pace * self._share, self._duration)
        targets = self._at(self._share_done())
        return targets, (*self._room.used_up(tensions), *self._made_slack(tensions))

    def _at(self, share: float) -> Targets:
        targets = list(self._begin)
        targets[self._cable] += round(share * self._counts)
        return tuple(targets)

    def _made_slack(self, tensions: Sequence[float]) -> list[Alarm]:
        """Alarms of other cables that went slack."""
        if self._was_taut is None:
            self._was_taut = [tension >= self._least for tension in tensions]
        found = []
        for cable, tension in enumerate(tensions):
            slack = self._was_taut[cable] and tension < self._least and cable != self._cable
            self._slack[cable] = self._slack[cable] + 1 if slack else 0
            if self._slack[cable] >= SLACK_CYCLES:
                found.append(went_slack(cable + 1, tension, self._least, self._cable + 1))
        return found


class CableStep(OneCableLaw):
    """Moves one winch smoothly by a cable length, from rest to rest."""

    stretch, shortest = PEAK, 1.0

    def _share_done(self) -> float:
        return smooth_step(self.progress)


class CableFeed(OneCableLaw):
    """Moves one winch at constant speed up to a largest length; the feed ramps it."""

    @property
    def cycles_left(self) -> float:
        """Cycles to the end of the largest length at full speed."""
        return self._duration - self._passed


def wind_in_speed(rig: Rig, target: float | Array, limit: float, speed: float) -> Array:
    """Speed at which each cable may be wound in under tension control, shape (m,), [m/s].

    Never faster than its winch; cable stiffness is that at home.
    """
    careful = SHARE_OF_ROOM * (limit - target) / _stiffness(rig) / rig.cycle
    return np.minimum(_fastest(rig, speed), careful)


def _stiffness(rig: Rig) -> Array:
    """Cable stiffness at home, shape (m,), [N/m]."""
    return rig.cable_stiffness / whole_lengths(rig, cable_lengths(rig, rig.home))


def _fastest(rig: Rig, speed: float) -> Array:
    """The requested speed, limited by each winch, shape (m,), [m/s]."""
    return np.minimum(speed, [winch.max_speed for winch in rig.winches])
