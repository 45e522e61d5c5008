"""The cameras of a run: asked at the same moments, and measured together as `cdpr track` does."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from executor.cameras.client import BLIND_PICTURES, CameraClient
from executor.cameras.process import CameraSample, FrameRequest, unseen
from executor.recording.record_files import CameraRecord
from executor.remote.status import RunStatus
from executor.supervision import RequestBoard, StopReason
from model.clearance import ClearanceModel
from model.pose import Pose
from model.progress import SILENT, Listener
from tracking.clearance import INTERVAL, MeasuredClearance, clearance_of
from tracking.fusion import MultiCameraFusion
from tracking.measurement import PoseMeasurement, rates

# Watches measured clearance, image by image, for one whose upper bound is below the limit.


#: This many images in a row must show too little clearance before the run is stopped for it.
NEAR_PICTURES = 2


class ClearanceMonitor:
    """Detects clearance below a limit in the last images, beyond their uncertainty.

    One image alone may be wrong for a reason that its covariance does not know.
    """

    def __init__(self, limit: float) -> None:
        """Begins without an image.

        Args:
            limit: Clearance that the scene asks for, [m].
        """
        self._limit, self._pictures = limit, 0

    def take(self, clearance: MeasuredClearance | None) -> str:
        """What is too near, with numbers, when the last images say so; else nothing.

        Args:
            clearance: Of the newest image with a pose; None in a scene without obstacles.
        """
        if clearance is None or clearance.at_most >= self._limit:
            self._pictures = 0
            return ""
        self._pictures += 1
        if self._pictures < NEAR_PICTURES:
            return ""
        at = clearance.worst_case_obstacle
        near, spread = clearance.nearest[at], float(clearance.uncertainties[at])
        return (
            f"{near.first} to {near.second}: {near.distance * 1e3:.1f} ± {spread * 1e3:.1f} mm"
            f" ({INTERVAL});"
            f" the scene requires {self._limit * 1e3:g} mm"
        )


# What several cameras say of a moment together, and whether something is too near then.


@dataclass(frozen=True, slots=True)
class CameraNews:
    """Something about a camera that the operator must know.

    Attributes:
        code: Of the event, such as ``camera`` or ``camera_sees_nothing``.
        text: One sentence.
    """

    code: str
    text: str


class MultiCameraMonitor:
    """Makes one look of those of all cameras, moment after moment."""

    def __init__(
        self, names: Sequence[str], model: ClearanceModel, limit: float, rate: float
    ) -> None:
        """Nothing was seen yet.

        Args:
            names: Of the cameras.
            model: Where obstacles are.
            limit: Clearance that the scene asks for, [m].
            rate: Moments a second, [Hz].
        """
        self.near = ""
        """Between what the measured clearance fell below the limit, with numbers; else nothing."""
        self.news: list[CameraNews] = []
        """Conditions that began since the reader cleared this."""
        self._model, self._several = model, len(names) > 1
        # Each camera has its own: where they disagree, the right one is unknown.
        self._watches = {name: ClearanceMonitor(limit) for name in names}
        self._within = 0.5 / rate
        self._common = MultiCameraFusion(self._within)
        self._moments = self._disagree = 0

    def of(self, looks: Mapping[str, CameraSample]) -> CameraSample:
        """The look of a moment.

        Args:
            looks: Of each camera that answered, by its name, in their order; not empty.
        """
        self._moments += 1
        frame = next(iter(looks.values())).frame
        picture = next((look.picture for look in looks.values() if look.picture), "")
        each = {name: look.found for name, look in looks.items()}
        found = self._common.of(each) if self._several else next(iter(each.values()))
        if isinstance(found, PoseMeasurement):
            self._count_disagreement("")
            clearance = clearance_of(self._model, found)
            for name in self._watches:
                self._watch(name, clearance, "")
            return CameraSample(frame, found, picture, clearance=clearance)
        poses = {name: one for name, one in each.items() if isinstance(one, PoseMeasurement)}
        self._count_disagreement(found.reason if poses else "")
        for name, one in poses.items():
            self._watch(name, clearance_of(self._model, one), f", measured by camera {name} alone")
        return CameraSample(frame, found, picture)

    def finish(self) -> None:
        """Reports how often a camera was left out because its image was too far apart in time."""
        if self._common.apart:
            text = (
                f"at {self._common.apart} of {self._moments} times not all cameras were used"
                f": images were taken more than {self._within * 1e3:.0f} ms from"
                " the others"
            )
            self.news.append(CameraNews("pictures_dropped", text))

    def _watch(self, name: str, clearance: MeasuredClearance | None, by_whom: str) -> None:
        near = self._watches[name].take(clearance)
        if near and not self.near:
            self.near = near + by_whom

    def _count_disagreement(self, reason: str) -> None:
        self._disagree = self._disagree + 1 if reason else 0
        if self._disagree == BLIND_PICTURES:
            text = (
                f"{reason}, {BLIND_PICTURES} times in a row; fused clearance is not measured,"
                " each camera monitors it alone"
            )
            self.news.append(CameraNews("camera_sees_nothing", text))


#: At the end of a run the last images are waited for no longer than this, [s],
PATIENCE = 20.0
#: and after a stop no longer than this, [s]; whether there is one is asked every so often, [s].
HURRY, ROUND = 2.0, 0.05


@dataclass(frozen=True, slots=True, eq=False)
class CameraRecords:
    """What the cameras of a run saw.

    Attributes:
        together: A look a moment, from all cameras.
        alone: Each camera's own looks by its name, where there are several.
        cameras: What became of each.
    """

    together: Sequence[CameraSample] = ()
    alone: Mapping[str, Sequence[CameraSample]] = field(default_factory=dict)
    cameras: tuple[CameraRecord, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class _FrameSet:
    """What was asked at a moment, and whom; their answers by name."""

    trigger: FrameRequest
    asked: frozenset[str]
    looks: dict[str, CameraSample] = field(default_factory=dict)


class RunCameras:
    """All cameras of one run.

    A moment is taken for what it is when all cameras that were asked have answered; one that takes
    more than another period is not waited for where another has seen it.
    """

    def __init__(
        self, eyes: Sequence[CameraClient], model: ClearanceModel, limit: float, rate: float
    ) -> None:
        """Nothing was asked for yet.

        Args:
            eyes: One or more cameras.
            model: Where obstacles are.
            limit: Clearance that the scene asks for, [m].
            rate: Moments a second, [Hz].
        """
        self._eyes = eyes
        self._common = MultiCameraMonitor([eye.name for eye in eyes], model, limit, rate)
        self._frame, self._now = 0, 0.0
        self._open: list[_FrameSet] = []
        self._together: list[CameraSample] = []
        self.newest: tuple[PoseMeasurement, MeasuredClearance | None] | None = None
        """The newest pose of all cameras together, and the clearance at it; None before one."""
        self._reported: dict[str, str] = {}
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
        """Takes in what the cameras have seen, and asks for an image of this moment.

        Args:
            time: Since the start of the run, [s].
            asked: The same moment on the monotonic clock, [s].
            true_pose: Where the simulated platform is; None with real cameras.
            by_drives: Where the drives' positions put it; None when they are unknown.
        """
        self._now = asked
        for eye in self._eyes:
            self._put(eye, eye.collect())
        self._handle()
        trigger = FrameRequest(self._frame, time, asked, true_pose, by_drives)
        whom = frozenset(eye.name for eye in self._eyes if eye.ask(trigger))
        if whom:
            self._open.append(_FrameSet(trigger, whom))
        self._frame += 1
        self._look_for_trouble()

    def news(self) -> list[CameraNews]:
        """What began since this was asked last."""
        news = [*self._news, *self._common.news]
        self._news.clear()
        self._common.news.clear()
        return news

    def as_dict(self) -> list[dict[str, Any]]:
        """How each camera does; see `executor.remote.status`."""
        return [eye.as_dict(self._now) for eye in self._eyes]

    def finish(self, stopped: Callable[[], bool]) -> CameraRecords:
        """Waits for the last images of all cameras; what is missing then is reported.

        Args:
            stopped: Whether a stop is wished; the wait is a short one then.
        """
        self._wait_for_all(stopped)
        for eye in self._eyes:
            self._put(eye, eye.finish())
        self._handle(last=True)
        self._common.finish()
        self._look_for_trouble()
        several = len(self._eyes) > 1
        return CameraRecords(
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

    def _put(self, eye: CameraClient, look: CameraSample | None) -> None:
        for moment in self._open:
            if look is not None and moment.trigger.frame == look.frame:
                moment.looks[eye.name] = look

    def _handle(self, last: bool = False) -> None:
        """Takes moments, in their order, for what they are."""
        gone = {eye.name for eye in self._eyes if eye.failed is not None}
        while self._open:
            moment = self._open[0]
            answered = moment.asked - gone <= moment.looks.keys()
            late = bool(moment.looks) and moment.trigger.frame < self._frame - 1
            if not (answered or late or last):
                return
            self._keep(self._joined(self._open.pop(0)))

    def _keep(self, sample: CameraSample) -> None:
        self._together.append(sample)
        if isinstance(sample.found, PoseMeasurement):
            self.newest = sample.found, sample.clearance

    def _joined(self, moment: _FrameSet) -> CameraSample:
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
            if trouble and self._reported.get(eye.name) != trouble:
                text = f"camera {eye.name} {trouble}; {then}"
                failed = eye.failed is not None
                self._news.append(
                    CameraNews("camera", text)
                    if failed
                    else CameraNews("camera_sees_nothing", text)
                )
            self._reported[eye.name] = trouble


#: Takes in an event: its code, its text, and when it was, on the loop's clock [s].
EventReport = Callable[[str, str, float], None]


class CameraWatch:
    """Asks the cameras for images, and stops the run when they see too little clearance."""

    def __init__(
        self,
        cameras: RunCameras,
        status: RunStatus,
        board: RequestBoard,
        report: EventReport,
        *,
        clearance_stop: bool,
        listener: Listener = SILENT,
    ) -> None:
        """Nothing was asked for yet.

        Args:
            cameras: Those of the run.
            status: Kept up to date for those who ask.
            board: Where a stop is asked for.
            report: Called with each event.
            clearance_stop: Ask for a stop when clearance is too small.
            listener: Receives the same.
        """
        self.rates = ""
        """How fast each camera is and how many tags it sees, for the progress bar."""
        self._cameras, self._status, self._board = cameras, status, board
        self._report, self._clearance_stop, self._listener = report, clearance_stop, listener

    def trigger(
        self, time: float, asked: float, true_pose: Pose | None, by_drives: Pose | None
    ) -> None:
        """An image is due; arguments as for `RunCameras.trigger`."""
        self._cameras.trigger(time, asked, true_pose, by_drives)
        self._report_news(asked)
        each = self._cameras.as_dict()
        self._status.take_cameras(each)
        if self._cameras.newest is not None:
            self._status.take_measured(*self._cameras.newest)
        self.rates = "; ".join(
            f"{c['name']} {rates(c['pictures_per_second'], c['measuring_ms'], len(c['tags']))}"
            for c in each
        )
        near, all_failed = self._cameras.near, self._cameras.all_failed
        if near and self._clearance_stop:
            who = "the cameras" if len(each) > 1 else "the camera"
            less = f"{who} measured less clearance than the scene requires: {near}"
            self._stop("too near", near, "clearance_low", less)
        if all_failed:
            self._stop("stopping", all_failed, "camera", all_failed)

    def finish(self, at: float) -> CameraRecords:
        """Waits for the last images.

        Args:
            at: The end of the run, on the loop's clock, [s].
        """
        with self._listener.waiting("waiting for the last images"):
            seen = self._cameras.finish(lambda: self._board.read().stop)
        self._report_news(at)
        for camera in seen.cameras:
            if camera.dropped:
                what = f"{camera.dropped} of {camera.dropped + camera.pictures} images skipped"
                text = f"camera {camera.name}: {what}; the previous one was still being processed"
                self._report("pictures_dropped", text, at)
        return seen

    def _stop(self, label: str, told: str, code: str, why: str) -> None:
        """Asks for a stop, unless one is under way."""
        if self._board.read().stop:
            return
        self._board.ask_stop(StopReason(code, why))
        self._listener.warning(f"{label}: {told}")

    def _report_news(self, at: float) -> None:
        for news in self._cameras.news():
            self._report(news.code, news.text, at)
            self._listener.remark(news.text)
