"""Who may move what hangs on a bus: every motion there begins and ends here.

On a bus of this process alone (``virtual``) nothing is kept: its drives end with the process, and
begin where the rig file says.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from cdpr.errors import Refused
from cdpr.rig import Rig
from drivers.bus import IN_PROCESS, BusSettings
from executor.latch import Latch
from executor.machine import State
from executor.reference import (
    AGAIN,
    ReferenceDocument,
    ReferenceFile,
    as_in_the_file,
    counting_hash,
    referenced,
)


class Custody:
    """Of the bus of one rig."""

    def __init__(self, rig: Rig) -> None:
        """Looks at nothing yet."""
        self._rig = rig
        settings = BusSettings.of(rig)
        self._is_kept = settings.interface != IN_PROCESS
        self._latch, self.file = Latch(settings), ReferenceFile(settings)

    def require_free(self) -> None:
        """Nothing moves on a bus on which a fault is latched, or a run is under way.

        Raises:
            Refused: So it is; with the cause.
        """
        if self._is_kept:
            self._latch.require_released()

    def reference(self) -> ReferenceDocument | None:
        """The reference that counts for this rig file; None where it needs none and has none.

        Raises:
            Refused: There must be one and is none, it is lost, or it is another rig file's.
        """
        reference = self.kept_reference()
        if reference is None:
            self._require_absolute()
            return None
        if reference.lost:
            why = f"{reference.lost}; it was made {reference.made}"
            raise self._refusal("the drives are no more referenced", why)
        if reference.rig_hash != counting_hash(self._rig):
            why = f"it was made {reference.made} for {reference.rig}; geometry or winches differ"
            raise self._refusal("the drives were referenced for another rig file", why)
        return reference

    def kept_reference(self) -> ReferenceDocument | None:
        """What is on file for this bus, whatever it says; None where nothing is."""
        return self.file.read() if self._is_kept else None

    def referenced_rig(self) -> Rig:
        """The rig as its drives count; see `reference`."""
        reference = self.reference()
        return self._rig if reference is None else referenced(self._rig, reference)

    def require_ready(self) -> ReferenceDocument | None:
        """The bus is free, and the rig is the one that its drives were referenced for.

        Raises:
            Refused: They are not so.
        """
        self.require_free()
        reference = self.kept_reference()
        if reference is None:
            self._require_absolute()
        elif reference.lost:
            raise self._refusal("the drives are no more referenced", reference.lost)
        elif reference.home_counts != [winch.home_counts for winch in self._rig.winches]:
            what = "the run was prepared with another reference than that of its drives"
            raise self._refusal(what, f"the drives were referenced {reference.made}")
        return reference

    def begin(self, record: Path) -> None:
        """The drives are about to move; if that does not come to its end, the latch tells of it.

        Args:
            record: Where the motion is on record.

        Raises:
            Refused: The bus is latched, or cannot be.
        """
        if self._is_kept:
            self._latch.engage(self._rig.name, record)

    def prevented(self) -> None:
        """Nothing moved after all."""
        if self._is_kept:
            self._latch.release()

    def end(
        self,
        state: State,
        cause: str,
        record: Path,
        *,
        holding: bool,
        stands_at: Sequence[int] | None,
    ) -> None:
        """The motion is over: the bus is released when it ended well, else latched.

        Args:
            state: Where it ended.
            cause: Why it did not end well.
            record: Where it is on record.
            holding: Every cable was held to the end.
            stands_at: Where the drives stand, [counts]; None when nobody heard it.
        """
        if not self._is_kept:
            return
        self._latch.settle(self._rig.name, state, cause, record)
        reference = self.kept_reference()
        if not holding:
            reference = reference or as_in_the_file(self._rig)
            lost = f"drives let go of cables under tension ({cause})"
            self.file.write(reference.model_copy(update={"lost": reference.lost or lost}))
        elif reference is not None and stands_at is not None:
            self.file.write(reference.model_copy(update={"stands_at": list(stands_at)}))

    def go_by_the_rig_file(self) -> None:
        """From now on the drives count what the rig file says; no reference is kept.

        Raises:
            Refused: A drive without absolute encoder cannot do so; or a fault is latched.
        """
        self.require_free()
        self._require_absolute()
        self.file.remove()

    def _require_absolute(self) -> None:
        if not self._is_kept:
            return
        names = self._rig.drive_names
        relative = [names[w.node_id] for w in self._rig.winches if not w.absolute]
        if relative:
            raise self._refusal(
                f"never referenced: {', '.join(relative)}",
                "an encoder that is not absolute (winches[].encoder in the rig file) counts from"
                " anywhere once its power was gone",
            )

    def _refusal(self, what: str, why: str) -> Refused:
        return Refused(what, where=f"reference {self.file.path}", why=why, next_step=AGAIN)
