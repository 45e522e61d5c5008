"""One camera of a run: what was asked of it, what came back, how it does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from cdpr.errors import CdprError
from executor.camera_process import CameraProcess
from executor.camera_sight import CameraSight
from executor.observer import Look, Trigger, unseen
from tracking.measurement import PoseMeasurement
from tracking.pace import Pace


@dataclass(frozen=True, slots=True)
class CameraRecord:
    """What became of one camera's pictures in a run.

    Attributes:
        name: Of the camera in the rig file.
        source: Where its pictures came from.
        pictures: How many it was asked for.
        poses: How many of them gave a pose.
        dropped: How many were due while it was busy, and not asked for.
        measuring_ms: Median time that measuring one took; None where none was measured.
        failed: Why it gave no pictures any more, or nothing.
    """

    name: str
    source: str
    pictures: int
    poses: int
    dropped: int
    measuring_ms: float | None
    failed: str


class CameraEye:
    """Asks one camera for pictures and keeps its answers."""

    def __init__(self, process: CameraProcess, source: str) -> None:
        """Nothing was asked for yet.

        Args:
            process: Takes and measures the pictures.
            source: Where they come from, to be told.
        """
        self.name, self.source = process.name, source
        self.looks: list[Look] = []
        """Its answers, in order."""
        self.failed: CdprError | None = None
        """Why there will be no more of them."""
        self.dropped = 0
        """Pictures that were due while it was busy."""
        self._poses = 0
        self._process = process
        self._sight, self._pace = CameraSight(), Pace()

    def ask(self, trigger: Trigger) -> bool:
        """Asks for a picture unless it is busy or gone; returns whether it did."""
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

    def collect(self) -> Look | None:
        """Its newest answer, if it is there."""
        return self._taken(self._process.answer)

    @property
    def busy(self) -> bool:
        """It was asked, and may still answer."""
        return self.failed is None and self._process.unanswered is not None

    def wait(self, patience: float) -> Look | None:
        """Its answer, waited for so long, [s]."""
        return self._taken(lambda: self._process.answer_within(patience))

    def finish(self) -> Look | None:
        """What is said in place of an answer that never came; None when there is nothing to say."""
        unanswered = self._process.unanswered
        if unanswered is None:
            return None
        if self.failed is None:
            self.failed = CdprError(f"no answer any more from {unanswered.time:.2f} s on")
        look = unseen(unanswered.frame, unanswered.time, self.failed.what)
        self.looks.append(look)
        return look

    def trouble(self, now: float) -> str:
        """What keeps it from measuring, as what it does; nothing while all is well."""
        if self.failed is not None:
            return f"failed ({self.failed.what})"
        return self._sight.trouble(now)

    def record(self) -> CameraRecord:
        """What became of its pictures."""
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
        """How it does at the moment; see `executor.status`."""
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
        }

    def _taken(self, answer: Callable[[], Look | None]) -> Look | None:
        look: Look | None = None

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


def _median_ms(looks: list[Look]) -> float | None:
    seconds = [look.seconds for look in looks if np.isfinite(look.seconds)]
    return round(float(np.median(seconds)) * 1e3, 2) if seconds else None
