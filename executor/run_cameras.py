"""The cameras of a run: asked at the same moments, and measured together as `cdpr track` does."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from cdpr.clearance import ClearanceModel
from cdpr.poses import Pose
from executor.camera_eye import CameraEye, CameraRecord
from executor.common_look import CameraNews, CommonLook
from executor.observer import Look, Trigger, unseen

#: At the end of a run the last pictures are waited for no longer than this, [s],
PATIENCE = 20.0
#: and after a stop no longer than this, [s]; whether there is one is asked every so often, [s].
HURRY, ROUND = 2.0, 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """What the cameras of a run saw.

    Attributes:
        together: A look a moment, from all cameras.
        alone: Each camera's own looks by its name, where there are several.
        cameras: What became of each.
    """

    together: Sequence[Look] = ()
    alone: Mapping[str, Sequence[Look]] = field(default_factory=dict)
    cameras: tuple[CameraRecord, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class _Moment:
    """What was asked at a moment, and whom; their answers by name."""

    trigger: Trigger
    asked: frozenset[str]
    looks: dict[str, Look] = field(default_factory=dict)


class RunCameras:
    """All cameras of one run.

    A moment is taken for what it is when all cameras that were asked have answered; one that takes
    more than another period is not waited for where another has seen it.
    """

    def __init__(
        self, eyes: Sequence[CameraEye], model: ClearanceModel, limit: float, rate: float
    ) -> None:
        """Nothing was asked for yet.

        Args:
            eyes: One or more cameras.
            model: Where obstacles are.
            limit: Clearance that the scene asks for, [m].
            rate: Moments a second, [Hz].
        """
        self._eyes = eyes
        self._common = CommonLook([eye.name for eye in eyes], model, limit, rate)
        self._frame, self._now = 0, 0.0
        self._open: list[_Moment] = []
        self._together: list[Look] = []
        self._told: dict[str, str] = {}
        self._news: list[CameraNews] = []

    @property
    def near(self) -> str:
        """Between what the measured clearance fell below the limit, with numbers; else nothing."""
        return self._common.near

    @property
    def all_failed(self) -> str:
        """Why there is no camera any more, as a clause; nothing while there is one."""
        failed = {eye.name: eye.failed.what for eye in self._eyes if eye.failed is not None}
        if len(failed) < len(self._eyes):
            return ""
        return "all cameras failed: " + "; ".join(f"{name}: {why}" for name, why in failed.items())

    def trigger(
        self, time: float, asked: float, true_pose: Pose | None, by_drives: Pose | None
    ) -> None:
        """Takes in what the cameras have seen, and asks for a picture of this moment.

        Args:
            time: Since the start of the run, [s].
            asked: The same moment on the monotonic clock, [s].
            true_pose: Where the simulated platform is; None with real cameras.
            by_drives: Where the drives' positions put it; None when they do not tell.
        """
        self._now = asked
        for eye in self._eyes:
            self._put(eye, eye.collect())
        self._judge()
        trigger = Trigger(self._frame, time, asked, true_pose, by_drives)
        whom = frozenset(eye.name for eye in self._eyes if eye.ask(trigger))
        if whom:
            self._open.append(_Moment(trigger, whom))
        self._frame += 1
        self._look_for_trouble()

    def news(self) -> list[CameraNews]:
        """What began since this was asked last."""
        news = [*self._news, *self._common.news]
        self._news.clear()
        self._common.news.clear()
        return news

    def as_dict(self) -> list[dict[str, Any]]:
        """How each camera does; see `executor.status`."""
        return [eye.as_dict(self._now) for eye in self._eyes]

    def finish(self, stopped: Callable[[], bool]) -> Seen:
        """Waits for the last pictures of all cameras; what is missing then is told.

        Args:
            stopped: Whether a stop is wished; the wait is a short one then.
        """
        self._wait_for_all(stopped)
        for eye in self._eyes:
            self._put(eye, eye.finish())
        self._judge(last=True)
        self._common.finish()
        self._look_for_trouble()
        several = len(self._eyes) > 1
        return Seen(
            tuple(self._together),
            {eye.name: tuple(eye.looks) for eye in self._eyes} if several else {},
            tuple(eye.record() for eye in self._eyes),
        )

    def _wait_for_all(self, stopped: Callable[[], bool]) -> None:
        """In rounds that share one patience, however many cameras hang."""
        rounds = 0
        while waiting := [eye for eye in self._eyes if eye.busy]:
            if rounds * ROUND >= (HURRY if stopped() else PATIENCE):
                return
            for eye in waiting:
                self._put(eye, eye.wait(ROUND / len(waiting)))
            rounds += 1

    def _put(self, eye: CameraEye, look: Look | None) -> None:
        for moment in self._open:
            if look is not None and moment.trigger.frame == look.frame:
                moment.looks[eye.name] = look

    def _judge(self, last: bool = False) -> None:
        """Takes moments, in their order, for what they are."""
        gone = {eye.name for eye in self._eyes if eye.failed is not None}
        while self._open:
            moment = self._open[0]
            answered = moment.asked - gone <= moment.looks.keys()
            late = bool(moment.looks) and moment.trigger.frame < self._frame - 1
            if not (answered or late or last):
                return
            self._together.append(self._joined(self._open.pop(0)))

    def _joined(self, moment: _Moment) -> Look:
        """What all cameras say of a moment together."""
        looks = {eye.name: moment.looks[eye.name] for eye in self._eyes if eye.name in moment.looks}
        if looks:
            return self._common.of(looks)
        reason = next((e.failed.what for e in self._eyes if e.failed), "no camera answered")
        return unseen(moment.trigger.frame, moment.trigger.time, reason)

    def _look_for_trouble(self) -> None:
        troubles = {eye.name: eye.trouble(self._now) for eye in self._eyes}
        well = [name for name, trouble in troubles.items() if not trouble]
        then = (
            f"clearance is measured by {', '.join(well)}" if well else "clearance is not measured"
        )
        for eye in self._eyes:
            trouble = troubles[eye.name]
            if trouble and self._told.get(eye.name) != trouble:
                text = f"camera {eye.name} {trouble}; {then}"
                failed = eye.failed is not None
                self._news.append(
                    CameraNews("camera", text)
                    if failed
                    else CameraNews("camera_sees_nothing", text)
                )
            self._told[eye.name] = trouble
