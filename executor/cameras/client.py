"""One camera of a run: what was asked of it, what came back, how it does."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from executor.cameras.process import CameraProcess, CameraSample, FrameRequest, unseen
from executor.recording.run_course import CameraRecord
from model.errors import CdprError, Fault
from tracking.measurement import PoseMeasurement
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
