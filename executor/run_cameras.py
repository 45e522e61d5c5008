"""The cameras of a run: asked at the same moments, and measured together as `cdpr track` does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from cdpr.clearance import ClearanceModel
from cdpr.poses import Pose
from executor.camera_eye import CameraEye, CameraRecord
from executor.camera_sight import BLIND_PICTURES
from executor.near_watch import NearWatch
from executor.observer import Look, Trigger, unseen
from tracking.cameras_together import CommonPose
from tracking.measured_clearance import clearance_of
from tracking.measurement import NoPose, PoseMeasurement


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


@dataclass(frozen=True, slots=True)
class CameraNews:
    """Something about a camera that the operator must know.

    Attributes:
        code: Of the event, ``camera`` or ``camera_sees_nothing``.
        text: One sentence.
    """

    code: str
    text: str


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
        self.near = ""
        """Between what the measured clearance fell below the limit, with numbers; else nothing."""
        self._eyes, self._model = eyes, model
        self._watch, self._common = NearWatch(limit), CommonPose(0.5 / rate)
        self._frame, self._now = 0, 0.0
        self._open: list[_Moment] = []
        self._together: list[Look] = []
        self._disagree = 0
        self._told: dict[str, str] = {}
        self._news: list[CameraNews] = []

    def trigger(
        self, time: float, asked: float, true_pose: Pose | None, by_drives: Pose | None
    ) -> None:
        """Takes in what the cameras have seen, and asks for a picture of this moment.

        Args:
            time: Since the start of the run, [s].
            asked: The same moment on the monotonic clock, [s].
            true_pose: Where the simulated platform is; None with real cameras.
            by_drives: Where the drives' positions put it; None when they do not tell.

        Raises:
            CdprError: All cameras failed, for the reason that the first one told.
        """
        self._now = asked
        for eye in self._eyes:
            self._put(eye, eye.collect())
        self._judge()
        self._look_for_trouble()
        trigger = Trigger(self._frame, time, asked, true_pose, by_drives)
        whom = frozenset(eye.name for eye in self._eyes if eye.ask(trigger))
        if whom:
            self._open.append(_Moment(trigger, whom))
        self._frame += 1
        failures = [eye.failed for eye in self._eyes if eye.failed is not None]
        if len(failures) == len(self._eyes):
            raise failures[0]

    def news(self) -> list[CameraNews]:
        """What began since this was asked last."""
        news, self._news = self._news, []
        return news

    def as_dict(self) -> list[dict[str, Any]]:
        """How each camera does; see `executor.status`."""
        return [eye.as_dict(self._now) for eye in self._eyes]

    def finish(self) -> Seen:
        """Waits for the last pictures; what is missing then is told."""
        for eye in self._eyes:
            self._put(eye, eye.finish())
        self._judge(last=True)
        self._look_for_trouble()
        several = len(self._eyes) > 1
        return Seen(
            tuple(self._together),
            {eye.name: tuple(eye.looks) for eye in self._eyes} if several else {},
            tuple(eye.record() for eye in self._eyes),
        )

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
        looks = [moment.looks[eye.name] for eye in self._eyes if eye.name in moment.looks]
        frame = moment.trigger.frame
        if not looks:
            reason = next((e.failed.what for e in self._eyes if e.failed), "no camera answered")
            return unseen(frame, moment.trigger.time, reason)
        picture = next((look.picture for look in looks if look.picture), "")
        if len(self._eyes) == 1:
            found = looks[0].found
        else:
            names = (eye.name for eye in self._eyes if eye.name in moment.looks)
            found = self._common.of(dict(zip(names, (k.found for k in looks), strict=True)))
        if isinstance(found, NoPose):
            disagree = sum(isinstance(look.found, PoseMeasurement) for look in looks) > 1
            self._count_disagreement(found.reason if disagree else "")
            return Look(frame, found, picture)
        self._count_disagreement("")
        clearance = clearance_of(self._model, found)
        self.near = self.near or self._watch.take(clearance)
        return Look(frame, found, picture, clearance=clearance)

    def _count_disagreement(self, reason: str) -> None:
        self._disagree = self._disagree + 1 if reason else 0
        if self._disagree == BLIND_PICTURES:
            times = f"{BLIND_PICTURES} times in a row"
            text = f"{reason}, {times}; clearance is not measured"
            self._news.append(CameraNews("camera_sees_nothing", text))

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
