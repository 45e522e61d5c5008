"""The cameras of a run: requested simultaneously, and fused as in `cdpr track`."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from executor.cameras.client import BLIND_IMAGES, CameraClient, CameraNews
from executor.cameras.process import CameraSample, FrameRequest, sample_without_pose
from executor.recording.record_files import CameraRecord
from executor.remote.status import RunStatus
from executor.state_machine import PlatformPoses
from executor.supervision import RequestBoard, StopReason
from model.cameras import exchanged_sources
from model.clearance import ClearanceModel
from model.pose import Pose
from model.progress import SILENT, Listener
from tracking.clearance import ClearanceMonitor, MeasuredClearance, clearance_of
from tracking.fusion import MultiCameraFusion
from tracking.measurement import (
    Observation,
    PoseHistory,
    PoseMeasurement,
    PoseMonitor,
    exchanged_cameras,
    rates,
)

# Fusion of several cameras, and monitors of what they measure.


class MultiCameraMonitor:
    """Fuses the samples of all cameras, frame by frame, and monitors their clearance and pose.

    The fused measurement and that of each camera are monitored, so no camera delays or prevents a
    stop for which another one suffices.
    """

    def __init__(
        self, names: Sequence[str], model: ClearanceModel, limit: float, rate: float
    ) -> None:
        """Starts without samples.

        Args:
            limit: Clearance required by the scene, [m].
            rate: Frame rate, [Hz].
        """
        self.near = ""
        """The pair whose measured clearance fell below the limit, with values; else empty."""
        self.news: list[CameraNews] = []
        """New conditions since the reader cleared the list."""
        self._model, self._several = model, len(names) > 1
        # Of the fused pose ("") and of each camera: fusion with a poor one must not hide what a
        # good one measures, and if they disagree, the correct one is unknown.
        self._watches = {name: ClearanceMonitor(limit) for name in ("", *names)}
        self.history, motion = PoseHistory(), model.rig.motion
        tolerance = motion.start_tolerance + motion.following_error
        self._poses = {
            name: PoseMonitor(model.rig.anchors, tolerance, model.rig.platform_error or 0.0)
            for name in self._watches
        }
        self._within = 0.5 / rate
        self._common = MultiCameraFusion(self._within)
        self._moments = self._disagree = 0
        self._differ: set[str] = set()

    def of(self, samples: Mapping[str, CameraSample]) -> CameraSample:
        """The fused sample of a frame.

        Args:
            samples: Of each camera that answered, by its name, in their order; not empty.
        """
        self._moments += 1
        frame = next(iter(samples.values())).frame
        picture = next((sample.picture for sample in samples.values() if sample.picture), "")
        each = {name: sample.found for name, sample in samples.items()}
        found = self._common.of(each) if self._several else next(iter(each.values()))
        clearance = None
        if isinstance(found, PoseMeasurement):
            self._count_disagreement("", each)
            clearance = self._watch("", found)
        else:
            seen = any(isinstance(one, PoseMeasurement) for one in each.values())
            self._count_disagreement(found.reason if seen else "", each)
        if self._several:
            for name, sample in samples.items():
                self.watch_alone(name, sample)
        return CameraSample(frame, found, picture, clearance=clearance)

    def watch_alone(self, name: str, sample: CameraSample) -> None:
        """Monitors what one of several cameras measured, also too late to be fused."""
        if isinstance(sample.found, PoseMeasurement):
            self._watch(name, sample.found)

    def finish(self) -> None:
        """Reports images left out because they were too far apart in time, and unequal clocks."""
        self.news += [CameraNews("remark", text) for text in self._common.clock_remarks()]
        if self._common.apart:
            text = (
                f"at {self._common.apart} of {self._moments} times not all cameras were used"
                f": images were taken more than {self._within * 1e3:.0f} ms from"
                " the others"
            )
            self.news.append(CameraNews("pictures_dropped", text))

    def _watch(self, name: str, found: PoseMeasurement) -> MeasuredClearance | None:
        clearance = clearance_of(self._model, found)
        near = self._watches[name].take(clearance)
        if near and not self.near:
            self.near = near + (f", measured by camera {name} alone" if name else "")
        off = self._poses[name].take(found, *self.history.at(found.time))
        if off and "" not in self._differ:
            self._differ.add(name)
            who = f"camera {name}" if name else "the cameras" if self._several else "the camera"
            self.news.append(CameraNews("pose_differs", f"{who} measured the platform {off}"))
        return clearance

    def _count_disagreement(self, reason: str, found: Mapping[str, Observation]) -> None:
        self._disagree = self._disagree + 1 if reason else 0
        if self._disagree == BLIND_IMAGES:
            exchanged = exchanged_cameras(self._model.rig, found)
            cause = f" ({exchanged_sources(*exchanged)[0]})" if exchanged else ""
            text = (
                f"{reason}, {BLIND_IMAGES} times in a row{cause}; fused clearance is not measured,"
                " each camera monitors it alone"
            )
            self.news.append(CameraNews("camera_sees_nothing", text))


#: Most true poses that wait for a busy camera: a synthetic image shows those of its latency ago.
_TRUE_POSES = 50
#: Largest wait for the last images at the end of a run, and after a stop; interval of checks, [s].
PATIENCE, HURRY, ROUND = 20.0, 2.0, 0.05


@dataclass(frozen=True, slots=True, eq=False)
class CameraRecords:
    """Samples of the cameras of a run.

    Attributes:
        together: Fused samples, one per frame, in order of time.
        alone: Samples of each camera by its name, if there are several.
        cameras: Statistics of each camera.
        skipped: Which cameras skipped images, and why, as sentences.
    """

    together: Sequence[CameraSample] = ()
    alone: Mapping[str, Sequence[CameraSample]] = field(default_factory=dict)
    cameras: tuple[CameraRecord, ...] = ()
    skipped: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class _FrameSet:
    """A request to several cameras, and their answers by name."""

    trigger: FrameRequest
    asked: frozenset[str]
    samples: dict[str, CameraSample] = field(default_factory=dict)

    @property
    def has_pose(self) -> bool:
        return any(isinstance(one.found, PoseMeasurement) for one in self.samples.values())


class RunCameras:
    """All cameras of one run.

    A frame is complete when all requested cameras have answered, or one frame later if one of them
    gave a pose. Without a pose it waits for the others, and later frames do not wait for it.
    """

    def __init__(
        self, clients: Sequence[CameraClient], model: ClearanceModel, limit: float, rate: float
    ) -> None:
        """Starts without requests.

        Args:
            clients: One or more cameras.
            limit: Clearance required by the scene, [m].
            rate: Frame rate, [Hz].
        """
        self._clients = clients
        self._common = MultiCameraMonitor([client.name for client in clients], model, limit, rate)
        self._frame, self._now = 0, 0.0
        self._open: list[_FrameSet] = []
        self._together: list[CameraSample] = []
        self.newest: tuple[PoseMeasurement, MeasuredClearance | None] | None = None
        """The newest fused pose and its clearance; None at first."""
        self._reported: dict[str, str] = {}
        self._true_poses: deque[tuple[float, Pose]] = deque(maxlen=_TRUE_POSES)
        self._news: list[CameraNews] = []

    @property
    def near(self) -> str:
        """The pair whose measured clearance fell below the limit, with values; else empty."""
        return self._common.near

    @property
    def all_failed(self) -> str:
        """Why all cameras failed, as a clause; empty while one works."""
        failed = {
            client.name: client.failed.what for client in self._clients if client.failed is not None
        }
        if len(failed) < len(self._clients):
            return ""
        return "all cameras failed: " + "; ".join(f"{name}: {why}" for name, why in failed.items())

    def trigger(self, poses: PlatformPoses) -> None:
        """Collects samples, and requests an image of the present time."""
        self._now = poses.at
        self.drive(poses)
        for client in self._clients:
            self._put(client, client.collect())
        self._process_complete()
        known = tuple(self._true_poses)
        trigger = FrameRequest(self._frame, poses, known)
        asked_clients = frozenset(client.name for client in self._clients if client.ask(trigger))
        if asked_clients:
            self._open.append(_FrameSet(trigger, asked_clients))
        if len(asked_clients) == sum(client.failed is None for client in self._clients):
            self._true_poses.clear()
        self._frame += 1
        self._report_trouble()

    def drive(self, poses: PlatformPoses) -> None:
        """Takes poses between which images are taken."""
        self._common.history.add(poses.time, poses.planned, poses.encoder)
        if poses.true is not None:
            self._true_poses.append((poses.time, poses.true))

    def news(self) -> list[CameraNews]:
        """New conditions since the last call."""
        news = [*self._news, *self._common.news]
        self._news.clear()
        self._common.news.clear()
        return news

    def as_dict(self) -> list[dict[str, Any]]:
        """State of each camera; see `executor.remote.status`."""
        return [client.as_dict(self._now) for client in self._clients]

    def finish(self, stopped: Callable[[], bool]) -> CameraRecords:
        """Waits for the last images of all cameras; reports missing ones.

        Args:
            stopped: Whether a stop is requested, which shortens the wait.
        """
        self._wait_for_all(stopped)
        for client in self._clients:
            self._put(client, client.finish())
        self._process_complete(last=True)
        self._common.finish()
        self._report_trouble()
        several = len(self._clients) > 1
        return CameraRecords(
            tuple(sorted(self._together, key=lambda sample: sample.found.time)),
            {client.name: tuple(client.samples) for client in self._clients} if several else {},
            tuple(client.record() for client in self._clients),
            tuple(client.skipped for client in self._clients if client.skipped),
        )

    def _wait_for_all(self, stopped: Callable[[], bool]) -> None:
        """Waits in rounds with a common time-out for all cameras."""
        rounds = 0
        while waiting := [client for client in self._clients if client.busy]:
            if rounds * ROUND >= (HURRY if stopped() else PATIENCE):
                return
            for client in waiting:
                self._put(client, client.wait(ROUND / len(waiting)))
            rounds += 1

    def _put(self, client: CameraClient, sample: CameraSample | None) -> None:
        if sample is None:
            return
        for frame_set in self._open:
            if frame_set.trigger.frame == sample.frame:
                frame_set.samples[client.name] = sample
                return
        self._common.watch_alone(client.name, sample)

    def _process_complete(self, last: bool = False) -> None:
        """Fuses complete frames; in order, except that none waits for a late one without a pose."""
        gone = {client.name for client in self._clients if client.failed is not None}
        waiting: list[_FrameSet] = []
        for frame_set in self._open:
            answered = frame_set.asked - gone <= frame_set.samples.keys()
            late = frame_set.trigger.frame < self._frame - 1
            if answered or (late and frame_set.has_pose) or last:
                self._keep(self._fused(frame_set))
            else:
                waiting.append(frame_set)
        self._open = waiting

    def _keep(self, sample: CameraSample) -> None:
        self._together.append(sample)
        found = sample.found
        if not isinstance(found, PoseMeasurement):
            return
        if self.newest is None or self.newest[0].time < found.time:
            self.newest = found, sample.clearance

    def _fused(self, frame_set: _FrameSet) -> CameraSample:
        """The fused sample of a frame."""
        samples = {
            client.name: frame_set.samples[client.name]
            for client in self._clients
            if client.name in frame_set.samples
        }
        if samples:
            return self._common.of(samples)
        reason = next((e.failed.what for e in self._clients if e.failed), "no camera answered")
        return sample_without_pose(frame_set.trigger.frame, frame_set.trigger.poses.time, reason)

    def _report_trouble(self) -> None:
        troubles = {client.name: client.trouble(self._now) for client in self._clients}
        working = [name for name, trouble in troubles.items() if not trouble]
        then = (
            f"clearance is measured by {', '.join(working)}"
            if working
            else "clearance is not measured"
        )
        for client in self._clients:
            trouble = troubles[client.name]
            if trouble and self._reported.get(client.name) != trouble:
                text = f"camera {client.name} {trouble}; {then}"
                failed = client.failed is not None
                self._news.append(
                    CameraNews("camera", text)
                    if failed
                    else CameraNews("camera_sees_nothing", text)
                )
            self._reported[client.name] = trouble


#: Takes an event: code, text, and time on the loop's clock [s].
EventReport = Callable[[str, str, float], None]


class CameraWatch:
    """Requests images, and stops the run when the measured clearance is too small."""

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
        """Starts without requests.

        Args:
            status: Updated with their state.
            board: Takes the stop request.
            report: Called with each event.
            clearance_stop: Whether too small a clearance stops the run.
            listener: Receives the same.
        """
        self.rates = ""
        """Rate and visible tags of each camera, for the progress bar."""
        self._cameras, self._status, self._board = cameras, status, board
        self._report, self._clearance_stop, self._listener = report, clearance_stop, listener

    def trigger(self, poses: PlatformPoses, is_due: bool = True) -> None:
        """Takes poses, and requests an image if one is due."""
        if not is_due:
            self._cameras.drive(poses)
            return
        self._cameras.trigger(poses)
        self._report_news(poses.at)
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
            self._stop("clearance too small", near, "clearance_low", less)
        if all_failed:
            self._stop("stopping", all_failed, "camera", all_failed)

    def _must_hurry(self) -> bool:
        """Whether a stop shortens the wait for images; not that of a listener that raised."""
        now = self._board.read()
        return now.stop and (now.for_what is None or now.for_what.code != "recorder")

    def finish(self, at: float) -> CameraRecords:
        """Waits for the last images.

        Args:
            at: The end of the run, on the loop's clock, [s].
        """
        with self._listener.waiting("waiting for the last images"):
            seen = self._cameras.finish(self._must_hurry)
        self._report_news(at)
        for text in seen.skipped:
            self._report("pictures_dropped", text, at)
        return seen

    def _stop(self, label: str, detail: str, code: str, why: str) -> None:
        """Requests a stop, unless one was requested before."""
        if self._board.read().stop:
            return
        self._board.ask_stop(StopReason(code, why))
        self._listener.warning(f"{label}: {detail}")

    def _report_news(self, at: float) -> None:
        for news in self._cameras.news():
            self._report(news.code, news.text, at)
            self._listener.remark(news.text)
