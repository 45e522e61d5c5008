"""One camera of a run: what was asked of it, what came back, how it does."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from executor.cameras.process import CameraProcess, CameraSample, FrameRequest, unseen
from executor.recording.record_files import CameraRecord
from model.errors import CdprError, Fault, Refused
from model.kinematics import structure_matrix
from model.pose import Pose, matrix_from_rotation_vector, rotation_vector_from_matrix
from model.rig import Rig
from tracking.measurement import Observation, PoseMeasurement
from tracking.track import FrameRate

# Whether a camera measures the platform now, or has lost it.


#: This many images in a row without a pose mean that the camera looks elsewhere or the light is
#: gone.
BLIND_PICTURES = 10
#: A camera that answers nothing for so long hangs, [s].
SILENCE = 2.0


class CameraHealth:
    """Knows what was asked of a camera, and what came back."""

    def __init__(self) -> None:
        """Nothing was asked for yet."""
        self._asked: float | None = None
        self._blind = 0

    def ask(self, at: float) -> None:
        """An image was asked for, at this time, [s]."""
        self._asked = at

    def answer(self, seen: bool) -> None:
        """That image is measured.

        Args:
            seen: It gave a pose.
        """
        self._asked, self._blind = None, 0 if seen else self._blind + 1

    def trouble(self, now: float) -> str:
        """Why no pose is measured any more, as what the camera does; nothing while all is well.

        Args:
            now: On the clock of `ask`, [s].
        """
        if self._asked is not None and now - self._asked > SILENCE:
            return f"did not answer for {SILENCE:g} s"
        if self._blind >= BLIND_PICTURES:
            return (
                f"gave no pose in {BLIND_PICTURES} images in a row (is it where the rig file"
                " says, are tags in view and lit?)"
            )
        return ""


class CameraClient:
    """Asks one camera for images and keeps its answers."""

    def __init__(self, process: CameraProcess, source: str, live_image: int | None = None) -> None:
        """Nothing was asked for yet.

        Args:
            process: Takes and measures the images.
            source: Where they come from, for messages.
            live_image: Descriptor of the memory of `executor.cameras.live_image`; None for none.
        """
        self._live_image = live_image
        self.name, self.source = process.name, source
        self.looks: list[CameraSample] = []
        """Its answers, in order."""
        self.failed: CdprError | None = None
        """Why there will be no more of them."""
        self.dropped = 0
        """Images that were due while it was busy."""
        self._poses = 0
        self._process = process
        self._sight, self._pace = CameraHealth(), FrameRate()

    def ask(self, trigger: FrameRequest) -> bool:
        """Asks for an image unless it is busy or gone; returns whether it did."""
        if self.failed is not None:
            return False
        if self._process.unanswered is not None:
            self.dropped += 1
            return False
        self._try(lambda: self._process.ask(trigger))
        if self.failed is not None:
            return False
        self._sight.ask(trigger.asked)
        return True

    def collect(self) -> CameraSample | None:
        """Its newest answer, if it is there."""
        return self._taken(self._process.answer)

    @property
    def busy(self) -> bool:
        """It was asked, and may still answer."""
        return self.failed is None and self._process.unanswered is not None

    def wait(self, patience: float) -> CameraSample | None:
        """Its answer, waited for so long, [s]."""
        return self._taken(lambda: self._process.answer_within(patience))

    def finish(self) -> CameraSample | None:
        """What is said in place of an answer that never came; None when there is nothing to say."""
        unanswered = self._process.unanswered
        if unanswered is None:
            return None
        if self.failed is None:
            self.failed = CdprError(f"no answer since {unanswered.time:.2f} s")
        look = unseen(unanswered.frame, unanswered.time, self.failed.what)
        self.looks.append(look)
        return look

    def trouble(self, now: float) -> str:
        """What keeps it from measuring, as what it does; nothing while all is well."""
        if self.failed is not None:
            return f"failed ({self.failed.what})"
        return self._sight.trouble(now)

    def record(self) -> CameraRecord:
        """What became of its images."""
        return CameraRecord(
            self.name,
            self.source,
            len(self.looks),
            self._poses,
            self.dropped,
            _median_ms(self.looks),
            self.failed.what if self.failed is not None else "",
        )

    def as_dict(self, now: float) -> dict[str, Any]:
        """How it does at the moment; see `executor.remote.status`."""
        found = self.looks[-1].found if self.looks else None
        return {
            "name": self.name,
            "source": self.source,
            "pictures": len(self.looks),
            "poses": self._poses,
            "dropped": self.dropped,
            "pictures_per_second": self._pace.pictures_per_second,
            "measuring_ms": self._pace.measuring_ms,
            "tags": list(found.tags) if isinstance(found, PoseMeasurement) else [],
            "trouble": self.trouble(now),
            "live_image": self._live_image,
        }

    def _taken(self, answer: Callable[[], CameraSample | None]) -> CameraSample | None:
        look: CameraSample | None = None

        def take() -> None:
            nonlocal look
            look = answer()

        if self.failed is None:
            self._try(take)
        if look is not None:
            seen = isinstance(look.found, PoseMeasurement)
            self.looks.append(look)
            self._pace.take(look.found.time, look.seconds)
            self._sight.answer(seen)
            self._poses += seen
        return look

    def _try(self, act: Callable[[], None]) -> None:
        try:
            act()
        except CdprError as error:
            self.failed = error


def _median_ms(looks: list[CameraSample]) -> float | None:
    seconds = [look.seconds for look in looks if np.isfinite(look.seconds)]
    return round(float(np.median(seconds)) * 1e3, 2) if seconds else None


# Waiting until cameras are open, which takes a while, and may be stopped meanwhile.


#: How long processes may take to import their libraries, to compile what finds tags' edges (once on
#: a machine) and to open their cameras, all together, [s].
START_TIMEOUT = 180.0
#: How long a wish to stop may wait to be heard, [s].
HEARING = 0.1


def wait_until_ready(
    processes: Sequence[CameraProcess], unless_stopped: Callable[[], None]
) -> None:
    """Waits until all cameras are open; the first one that fails ends it.

    Args:
        processes: They open their cameras at the same time.
        unless_stopped: Asked again and again; what it raises ends the waiting.

    Raises:
        CdprError: A camera cannot be used, for the reason given.
    """
    waiting, latest = list(processes), time.monotonic() + START_TIMEOUT
    while waiting:
        unless_stopped()
        step = HEARING / len(waiting)
        waiting = [process for process in waiting if not process.is_ready(step)]
        if waiting and time.monotonic() > latest:
            names = ", ".join(process.name for process in waiting)
            raise Fault(
                f"camera {names} did not open within {START_TIMEOUT:.0f} s",
                where="cameras",
                why="the device or its network does not answer",
                next_step="check the camera with `cdpr doctor RIG --camera SOURCE`",
            )


# Where a platform at rest is, from several images of it.


#: At least this share of the images must give a pose.
SEEN_SHARE = 0.8
#: The platform moves, or the light flickers, when poses scatter by more, [m].
MOST_SCATTER = 0.5e-3


@dataclass(frozen=True, slots=True, eq=False)
class RestPose:
    """The mean of several measurements.

    Attributes:
        pose: ``world_from_platform``.
        uncertainty: Of the position along its worst direction, standard deviation, [m].
        length_uncertainty: Of the cable length known worst, [m].
        pictures: How many gave a pose.
    """

    pose: Pose
    uncertainty: float
    length_uncertainty: float
    pictures: int


def static_pose(rig: Rig, looks: Sequence[Observation]) -> RestPose:
    """The pose in which the platform stood still in all images.

    What is wrong with one image is wrong with all, so the mean is not more certain than each.

    Raises:
        Refused: Too few images show it, it did not stand still, or it is not known well enough
            for a run to start: to half the rig's start tolerance, in cable length.
    """
    found = [look for look in looks if isinstance(look, PoseMeasurement)]
    if not found or len(found) < SEEN_SHARE * len(looks):
        reasons = {getattr(look, "reason", "") for look in looks} - {""}
        raise _refusal(
            f"{len(found)} of {len(looks)} images give a platform pose",
            "; ".join(sorted(reasons)),
        )
    first = found[0].pose
    positions = np.array([look.pose.position for look in found])
    turns = np.array(
        [rotation_vector_from_matrix(look.pose.rotation @ first.rotation.T) for look in found]
    )
    scatter = float(np.max(np.std(positions, axis=0)))
    if not scatter <= MOST_SCATTER:
        raise _refusal(
            f"the platform is not at rest: its poses scatter by {scatter * 1000:.2f} mm,"
            f" limit {MOST_SCATTER * 1000:g} mm",
            "it swings, or the light flickers",
        )
    turned = matrix_from_rotation_vector(turns.mean(axis=0))
    pose = Pose(positions.mean(axis=0), turned @ first.rotation)
    covariance = np.mean([look.covariance for look in found], axis=0)
    columns = structure_matrix(rig, pose)
    lengths = float(np.sqrt(np.max(np.einsum("im,ij,jm->m", columns, covariance, columns))))
    allowed = rig.motion.start_tolerance / 2.0
    if not lengths <= allowed:
        raise _refusal(
            f"the uncertainty of a cable's length is {lengths * 1000:.2f} mm, limit"
            f" {allowed * 1000:.2f} mm",
            "few tags are visible, from far away or at a steep angle",
        )
    worst = float(np.sqrt(np.max(np.linalg.eigvalsh(covariance[:3, :3]))))
    return RestPose(pose, worst, lengths, len(found))


def _refusal(what: str, why: str) -> Refused:
    return Refused(
        what,
        where="tracked pose",
        why=why,
        next_step="check camera, light and tags (`cdpr track RIG SOURCE`), then home again; the"
        " cables are taut and held",
    )


# Images of a platform that stands still, and an operator who may end the looking at any time.


#: An image that has not come after so long will not come, [s].
PATIENCE = 20.0


def looks_at_rest(
    process: CameraProcess,
    pictures: int,
    period: float | None,
    true_pose: Pose | None,
    unless_stopped: Callable[[], None],
) -> list[Observation]:
    """What a camera measures in some images, one after another.

    Args:
        process: Of the camera, which is open.
        pictures: How many.
        period: Between images in simulated time, [s]; None where a real camera takes them.
        true_pose: Where the simulated platform is.
        unless_stopped: Called before each image and while one is waited for; what it raises ends
            the looking.

    Raises:
        CdprError: The camera failed, for the reason given.
    """
    began, looks = time.monotonic(), []
    for frame in range(pictures):
        unless_stopped()
        asked = time.monotonic()
        since = asked - began if period is None else frame * period
        process.ask(FrameRequest(frame, since, asked, true_pose))
        looks.append(_answer(process, asked + PATIENCE, unless_stopped))
    return looks


def _answer(
    process: CameraProcess, latest: float, unless_stopped: Callable[[], None]
) -> Observation:
    while True:
        look = process.answer_within(HEARING)
        if look is not None:
            return look.found
        unless_stopped()
        if time.monotonic() > latest:
            raise Fault(
                f"the camera delivered no image for {PATIENCE:g} s",
                where=f"camera {process.name}",
                why="the camera or its connection hangs",
                next_step="check its cable, then start again",
            )
