"""Client of one camera of a run: requests, samples, health."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from executor.cameras.process import CameraProcess, CameraSample, FrameRequest, sample_without_pose
from executor.recording.record_files import CameraRecord
from executor.state_machine import PlatformPoses
from model.errors import CdprError, Fault, Refused, without_passwords
from model.kinematics import cable_lengths, structure_matrix
from model.pose import Pose, moved, step_between
from model.rig import Rig
from tracking.measurement import FrameRate, Observation, PoseMeasurement, largest_deviations

# Health of a camera: whether it still measures the platform.


#: Consecutive images without a pose after which the camera is misaligned or the light is off.
BLIND_IMAGES = 10
#: A camera without an answer for this long counts as hung, [s].
SILENCE = 2.0


class CameraHealth:
    """Judges a camera by its requests and answers."""

    def __init__(self) -> None:
        self._asked: float | None = None
        self._blind = 0

    def ask(self, at: float) -> None:
        """Takes the time of a request, [s]."""
        self._asked = at

    def answer(self, seen: bool) -> None:
        """Takes an answer.

        Args:
            seen: Whether the image gave a pose.
        """
        self._asked, self._blind = None, 0 if seen else self._blind + 1

    def trouble(self, now: float) -> str:
        """Why no pose is measured, as a predicate of the camera; empty if healthy.

        Args:
            now: On the clock of `ask`, [s].
        """
        if self._asked is not None and now - self._asked > SILENCE:
            return f"did not answer for {SILENCE:g} s"
        if self._blind >= BLIND_IMAGES:
            return (
                f"gave no pose in {BLIND_IMAGES} images in a row (is it where the rig file"
                " says, are tags in view and lit?)"
            )
        return ""


@dataclass(frozen=True, slots=True)
class CameraNews:
    """A condition of a camera for the operator.

    Attributes:
        code: Of the event, such as ``camera`` or ``camera_sees_nothing``.
        text: One sentence.
    """

    code: str
    text: str


class CameraClient:
    """Requests images from one camera and stores its samples."""

    def __init__(self, process: CameraProcess, source: str, live_image: int | None = None) -> None:
        """Starts without requests.

        Args:
            process: Takes and measures the images.
            source: Of the images, for messages and records; its password is left out.
            live_image: Descriptor of the memory of `executor.cameras.live_image`; None for none.
        """
        self._live_image = live_image
        self.name, self.source = process.name, without_passwords(source)
        self.samples: list[CameraSample] = []
        """Its samples, in order."""
        self.failed: CdprError | None = None
        """Why there will be no more samples; None while there may be."""
        self.dropped = 0
        """Number of images due while it was busy."""
        self._poses = self._late = self._truncated = 0
        self._process = process
        self._health, self._pace = CameraHealth(), FrameRate()

    def ask(self, trigger: FrameRequest) -> bool:
        """Requests an image unless the camera is busy or failed; returns whether it did."""
        if self.failed is not None:
            return False
        if self._process.unanswered is not None:
            self.dropped += 1
            return False
        self._try(lambda: self._process.ask(trigger))
        if self.failed is not None:
            return False
        self._health.ask(trigger.poses.at)
        return True

    def collect(self) -> CameraSample | None:
        """Its next sample, if it has arrived."""
        return self._taken(self._process.answer)

    @property
    def busy(self) -> bool:
        """Whether an answer may still arrive."""
        return self.failed is None and self._process.unanswered is not None

    def wait(self, patience: float) -> CameraSample | None:
        """Its next sample, waited for up to ``patience`` [s]."""
        return self._taken(lambda: self._process.answer_within(patience))

    def finish(self) -> CameraSample | None:
        """A sample without a pose for an unanswered request; None without one."""
        unanswered = self._process.unanswered
        if unanswered is None:
            return None
        if self.failed is None:
            self.failed = CdprError(f"no answer since {unanswered.poses.time:.2f} s")
        sample = sample_without_pose(unanswered.frame, unanswered.poses.time, self.failed.what)
        self.samples.append(sample)
        return sample

    def trouble(self, now: float) -> str:
        """Why it does not measure, as a predicate; empty if healthy."""
        if self.failed is not None:
            return f"failed ({self.failed.what})"
        return self._health.trouble(now)

    @property
    def skipped(self) -> str:
        """How many images were skipped, and why, as a sentence; empty if none was."""
        if not self.dropped:
            return ""
        text = (
            f"camera {self.name}: {self.dropped} of {self.dropped + len(self.samples)} images"
            " skipped; the previous one had not arrived yet, or was still being measured"
        )
        unused = {"truncated": self._truncated, "late": self._late}
        numbers = ", ".join(f"{count} {what}" for what, count in unused.items() if count)
        return text + (f"; images delivered but not used: {numbers}" if numbers else "")

    def record(self) -> CameraRecord:
        """Statistics of its images."""
        return CameraRecord(
            self.name,
            self.source,
            len(self.samples),
            self._poses,
            self.dropped,
            _median_ms(self.samples),
            self.failed.what if self.failed is not None else "",
        )

    def as_dict(self, now: float) -> dict[str, Any]:
        """Its present state; see `executor.remote.status`."""
        found = self.samples[-1].found if self.samples else None
        return {
            "name": self.name,
            "source": self.source,
            "pictures": len(self.samples),
            "poses": self._poses,
            "dropped": self.dropped,
            "pictures_per_second": self._pace.pictures_per_second,
            "measuring_ms": self._pace.measuring_ms,
            "tags": list(found.tags) if isinstance(found, PoseMeasurement) else [],
            "trouble": self.trouble(now),
            "live_image": self._live_image,
        }

    def _taken(self, answer: Callable[[], CameraSample | None]) -> CameraSample | None:
        sample: CameraSample | None = None

        def take() -> None:
            nonlocal sample
            sample = answer()

        if self.failed is None:
            self._try(take)
        if sample is not None:
            seen = isinstance(sample.found, PoseMeasurement)
            self.samples.append(sample)
            self._pace.take(sample.found.time, sample.seconds)
            self._health.answer(seen)
            self._poses += seen
            self._late, self._truncated = sample.late, sample.truncated
        return sample

    def _try(self, act: Callable[[], None]) -> None:
        try:
            act()
        except CdprError as error:
            self.failed = error


def _median_ms(samples: list[CameraSample]) -> float | None:
    seconds = [sample.seconds for sample in samples if np.isfinite(sample.seconds)]
    return round(float(np.median(seconds)) * 1e3, 2) if seconds else None


# Opening of cameras, which takes a while and may be stopped.


#: Time for all processes to import their libraries, compile the tag edge detector (once on a
#: machine) and open their cameras, [s].
START_TIMEOUT = 180.0
#: Largest delay of a stop request, [s].
HEARING = 0.1


def wait_until_ready(processes: Sequence[CameraProcess], check_stop: Callable[[], None]) -> None:
    """Waits until all cameras are open; the first failure ends it.

    Args:
        processes: Open their cameras at the same time.
        check_stop: Called repeatedly; an exception ends the wait.

    Raises:
        CdprError: A camera cannot be used.
    """
    waiting, latest = list(processes), time.monotonic() + START_TIMEOUT
    while waiting:
        check_stop()
        step = HEARING / len(waiting)
        waiting = [process for process in waiting if not process.is_ready(step)]
        if waiting and time.monotonic() > latest:
            names = ", ".join(process.name for process in waiting)
            raise Fault(
                f"camera {names} did not open within {START_TIMEOUT:.0f} s",
                where="cameras",
                why="the device or its network does not answer",
                next_step="check the camera with `cdpr doctor RIG --camera NAME=SOURCE`",
            )


# Pose of a platform at rest, from several images.


#: At least this share of the images must give a pose.
SEEN_SHARE = 0.8
#: Largest standard deviation of a cable's length over the images, and half of its largest drift
#: over all of them, as a share of the start tolerance and in [m]; the smaller one counts. More
#: means a moving platform or flickering light.
SCATTER_SHARE, MOST_SCATTER = 0.25, 0.5e-3


@dataclass(frozen=True, slots=True, eq=False)
class RestPose:
    """The mean of several measurements.

    Attributes:
        pose: ``world_from_platform``.
        uncertainty: Of the position along its worst direction, or of a cable's length if that is
            more, as by the rotation; standard deviation, [m].
        pictures: Number of images with a pose.
    """

    pose: Pose
    uncertainty: float
    pictures: int


def static_pose(rig: Rig, samples: Sequence[Observation]) -> RestPose:
    """The pose of a platform at rest, as the mean over its images.

    Systematic errors are the same in all images, so the mean is not more certain than each. What
    the poses scatter is added, as it may be a motion.

    Raises:
        Refused: Too few images give a pose, the platform was not at rest, or the uncertainty of a
            cable length exceeds half the rig's start tolerance.
    """
    found = [sample for sample in samples if isinstance(sample, PoseMeasurement)]
    if not found or len(found) < SEEN_SHARE * len(samples):
        reasons = {getattr(sample, "reason", "") for sample in samples} - {""}
        raise _refusal(
            f"{len(found)} of {len(samples)} images give a platform pose",
            "; ".join(sorted(reasons)),
        )
    _require_rest(rig, found)
    first = found[0].pose
    steps = np.array([step_between(first, sample.pose) for sample in found])
    pose = moved(first, steps.mean(axis=0))
    stated = [sample.covariance + sample.shared for sample in found]
    covariance = np.mean(stated, axis=0) + np.cov(steps.T, bias=True)
    columns = structure_matrix(rig, pose)
    lengths = float(np.sqrt(np.max(np.einsum("im,ij,jm->m", columns, covariance, columns))))
    allowed = rig.motion.start_tolerance / 2.0
    if not lengths <= allowed:
        raise _refusal(
            f"the uncertainty of a cable's length is {lengths * 1000:.2f} mm, limit"
            f" {allowed * 1000:.2f} mm",
            "few tags are visible, from far away or at a steep angle, or the camera's calibrations,"
            " or `error_mm`, state an error that large",
        )
    worst, _ = largest_deviations(covariance)
    return RestPose(pose, max(worst, lengths), len(found))


def _require_rest(rig: Rig, found: Sequence[PoseMeasurement]) -> None:
    """Refuses poses between which a cable's length changes.

    A rotation changes lengths, but no position; a slow motion changes them more from the first to
    the last image than they scatter.
    """
    limit = min(SCATTER_SHARE * rig.motion.start_tolerance, MOST_SCATTER)
    lengths = np.array([cable_lengths(rig, one.pose) for one in found])
    changes = lengths - lengths.mean(axis=0)
    along = np.linspace(-0.5, 0.5, len(found))
    drifts = np.abs(along @ changes) / (along @ along)
    for how, values, most in (
        ("has a standard deviation of", changes.std(axis=0), limit),
        ("drifts by", drifts, 2.0 * limit),
    ):
        worst = int(np.argmax(values))
        if not values[worst] <= most:
            raise _refusal(
                f"the platform is not at rest: the length of cable {worst + 1} {how}"
                f" {values[worst] * 1000:.2f} mm in {len(found)} images, limit"
                f" {most * 1000:.2f} mm",
                "it swings or still sinks, the light flickers, or the image is poor",
            )


def _refusal(what: str, why: str) -> Refused:
    return Refused(
        what,
        where="tracked pose",
        why=why,
        next_step="check camera, light and tags (`cdpr track RIG SOURCE`), then home again; the"
        " cables are taut and held",
    )


# Images of a platform at rest; the operator may stop at any time.


#: Time-out of an image, [s].
PATIENCE = 20.0


def samples_at_rest(
    process: CameraProcess,
    pictures: int,
    period: float | None,
    true_pose: Pose | None,
    check_stop: Callable[[], None],
) -> list[Observation]:
    """Measurements of consecutive images.

    Args:
        process: Of the camera, which is open.
        period: Of images in simulated time, [s]; None for a real camera.
        true_pose: Of the simulated platform.
        check_stop: Called before each image and while waiting; an exception ends it.

    Raises:
        CdprError: The camera failed.
    """
    began, samples = time.monotonic(), []
    for frame in range(pictures):
        check_stop()
        asked = time.monotonic()
        since = asked - began if period is None else frame * period
        process.ask(FrameRequest(frame, PlatformPoses(since, asked, true_pose)))
        samples.append(_answer(process, asked + PATIENCE, check_stop))
    return samples


def _answer(process: CameraProcess, latest: float, check_stop: Callable[[], None]) -> Observation:
    while True:
        sample = process.answer_within(HEARING)
        if sample is not None:
            return sample.found
        check_stop()
        if time.monotonic() > latest:
            raise Fault(
                f"the camera delivered no image for {PATIENCE:g} s",
                where=f"camera {process.name}",
                why="the camera or its connection hangs",
                next_step="check its cable, then start again",
            )
