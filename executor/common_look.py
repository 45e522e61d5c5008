"""What several cameras say of a moment together, and whether something is too near then."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from cdpr.clearance import ClearanceModel
from executor.camera_sight import BLIND_PICTURES
from executor.near_watch import NearWatch
from executor.observer import Look
from tracking.cameras_together import CommonPose
from tracking.measured_clearance import MeasuredClearance, clearance_of
from tracking.measurement import PoseMeasurement


@dataclass(frozen=True, slots=True)
class CameraNews:
    """Something about a camera that the operator must know.

    Attributes:
        code: Of the event, such as ``camera`` or ``camera_sees_nothing``.
        text: One sentence.
    """

    code: str
    text: str


class CommonLook:
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
        """What began since whoever reads this cleared it."""
        self._model, self._several = model, len(names) > 1
        # Each camera has its own: where they disagree, nobody knows which one is right.
        self._watches = {name: NearWatch(limit) for name in names}
        self._within = 0.5 / rate
        self._common = CommonPose(self._within)
        self._moments = self._disagree = 0

    def of(self, looks: Mapping[str, Look]) -> Look:
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
            return Look(frame, found, picture, clearance=clearance)
        poses = {name: one for name, one in each.items() if isinstance(one, PoseMeasurement)}
        self._count_disagreement(found.reason if poses else "")
        for name, one in poses.items():
            self._watch(name, clearance_of(self._model, one), f", as camera {name} alone sees it")
        return Look(frame, found, picture)

    def finish(self) -> None:
        """Tells in how many moments a camera was left out as its picture was too far apart."""
        if self._common.apart:
            text = (
                f"in {self._common.apart} of {self._moments} moments not all cameras were taken"
                f" together: pictures were taken more than {self._within * 1e3:.0f} ms apart from"
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
                f"{reason}, {BLIND_PICTURES} times in a row; clearance is not measured together,"
                " only watched by each alone"
            )
            self.news.append(CameraNews("camera_sees_nothing", text))
