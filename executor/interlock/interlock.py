"""Who may move what hangs on a bus: every motion there begins and ends here.

On a bus of this process alone (``virtual``) nothing is kept: its drives end with the process, and
begin where the rig file says.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from drivers.can_bus import IN_PROCESS, BusSettings
from executor.interlock.fault_latch import FaultLatch
from executor.interlock.reference import (
    AGAIN,
    HomingReference,
    ReferenceFile,
    as_in_the_file,
    counting_hash,
    moved_since,
    referenced,
)
from executor.state_machine import State
from model.errors import Refused
from model.rig import Rig


class MotionInterlock:
    """Of the bus of one rig."""

    def __init__(self, rig: Rig) -> None:
        """Looks at nothing yet."""
        self._rig = rig
        settings = BusSettings.of(rig)
        self._is_kept = settings.interface != IN_PROCESS
        self._latch, self.file = FaultLatch(settings), ReferenceFile(settings)
        self._counted_from: HomingReference | None = None

    def require_free(self) -> None:
        """Nothing moves on a bus on which a fault is latched, or a run is under way.

        Raises:
            Refused: So it is; with the cause.
        """
        if self._is_kept:
            self._latch.require_disengaged()

    def reference(self) -> HomingReference | None:
        """The reference that counts for this rig file; None where it needs none and has none.

        Raises:
            Refused: There must be one and is none, it is lost, or it is another rig file's.
        """
        reference = self.kept_reference()
        if reference is None:
            self._require_absolute()
            return None
        if reference.lost:
            why = f"{reference.lost}; homed {reference.made}"
            raise self._refusal("the homing reference is lost", why)
        if reference.rig_hash != counting_hash(self._rig):
            why = f"homed {reference.made} for {reference.rig}; geometry or winches differ"
            raise self._refusal("the drives were homed for another rig file", why)
        return reference

    def why_unreferenced(self, stands: Sequence[int] | None = None) -> str:
        """Why the drives do not count from their reference; nothing where they do.

        Args:
            stands: Where they stand, [counts]; where it is left out, only the file is looked at.
        """
        try:
            reference = self.reference()
        except Refused as error:
            return f"{error.what}: {error.why}"
        if reference is None or stands is None:
            return ""
        moved = moved_since(self._rig, reference, stands)
        worst = max(range(len(moved)), key=moved.__getitem__)
        if moved[worst] <= self._rig.motion.start_tolerance:
            return ""
        name = list(self._rig.drive_names.values())[worst]
        return f"{name} is {moved[worst] * 1000:.1f} mm of cable from its last known position"

    def kept_reference(self) -> HomingReference | None:
        """What is on file for this bus, whatever it says; None where nothing is."""
        return self.file.read() if self._is_kept else None

    def referenced_rig(self) -> Rig:
        """The rig as its drives count; see `reference`."""
        reference = self.reference()
        return self._rig if reference is None else referenced(self._rig, reference)

    def require_ready(self) -> HomingReference | None:
        """The bus is free, and the rig is the one that its drives were referenced for.

        Raises:
            Refused: They are not so.
        """
        self.require_free()
        reference = self.kept_reference()
        if reference is None:
            self._require_absolute()
        elif reference.lost:
            raise self._refusal("the homing reference is lost", reference.lost)
        elif reference.home_counts != [winch.home_counts for winch in self._rig.winches]:
            what = "the run was prepared with a different homing reference"
            raise self._refusal(what, f"the drives were homed {reference.made}")
        return reference

    def still_counts(self, stands: Sequence[int]) -> HomingReference | None:
        """The reference, if drives that stand there [counts] still count from it; else None."""
        reference = self._readable()
        if reference is None or reference.lost or len(reference.stands_at) != len(stands):
            return None
        moved = max(moved_since(self._rig, reference, stands))
        return reference if moved <= self._rig.motion.start_tolerance else None

    def found_restarted(self, nodes: Iterable[int]) -> None:
        """Drives were switched on since they were set up: their reference is lost for good.

        It is kept at once, whatever happens next: nothing else records it
        once they are set up again.

        Raises:
            Refused: It cannot be kept.
        """
        forgot = {winch.node_id for winch in self._rig.winches if not winch.absolute} & {*nodes}
        if forgot:
            names = [name for node, name in self._rig.drive_names.items() if node in forgot]
            self._lose(f"{', '.join(names)}: power-cycled after homing")

    def confirm_held(self, stands: Sequence[int]) -> None:
        """All drives held since they were last heard: they still count, and stand there [counts].

        Raises:
            Refused: It cannot be kept.
        """
        reference = self._readable()
        if reference is not None and not reference.lost and len(reference.stands_at) == len(stands):
            self.file.write(reference.model_copy(update={"stands_at": list(stands)}))

    def begin(
        self, record: Path, reference: HomingReference | None, *, rehome: bool = False
    ) -> None:
        """The drives are about to move; if that does not finish, the latch records it.

        Args:
            record: Where the motion is on record.
            reference: From which the drives count, found to do so; None where it is not known.
            rehome: They are to be homed again; the present reference is given up.

        Raises:
            Refused: The bus is latched, or cannot be.
        """
        if not self._is_kept:
            return
        self._latch.engage(self._rig.name, record)
        self._counted_from = None if rehome else reference
        try:
            if rehome:
                self._lose("homing did not finish")
        except BaseException:
            self._latch.disengage()
            raise

    def take(self, reference: HomingReference) -> None:
        """A new reference, made between `begin` and `end`.

        Raises:
            Refused: It cannot be kept.
        """
        if self._is_kept:
            self.file.write(reference)

    def cancel(self) -> None:
        """Nothing moved after all."""
        if self._is_kept:
            self._latch.disengage()

    def end(
        self,
        state: State,
        cause: str,
        record: Path,
        *,
        holding: bool,
        stands_at: Sequence[int] | None,
        let_go: str = "",
    ) -> None:
        """The motion is over: the bus is free when it ended well, else latched.

        Args:
            state: Where it ended.
            cause: Why it did not end well.
            record: Where it is on record.
            holding: Every cable was held to the end.
            stands_at: Positions of the drives, [counts]; None when unknown.
            let_go: Why cables are not held any more where that was wished; what the reference was
                lost by.

        Raises:
            Refused: The reference cannot be kept, then the bus stays latched; or the latch cannot.
        """
        if not self._is_kept:
            return
        try:
            lost = let_go or f"drives released cables under tension ({cause})"
            self._note_end(lost, holding, stands_at)
        except Refused as error:
            self._latch.settle(self._rig.name, State.LATCHED, cause or error.what, record)
            raise
        self._latch.settle(self._rig.name, state, cause, record)

    def _note_end(self, lost: str, holding: bool, stands_at: Sequence[int] | None) -> None:
        """What the end of a motion means for the reference."""
        if not holding:
            reference = self._readable() or as_in_the_file(self._rig)
            self.file.write(reference.model_copy(update={"lost": reference.lost or lost}))
        elif self._counted_from is not None and stands_at is not None:
            stand = {"stands_at": list(stands_at)}
            self.file.write(self._counted_from.model_copy(update=stand))

    def _lose(self, why: str) -> None:
        """The reference on file, if any, counts no more; the first reason is kept."""
        reference = self._readable()
        if reference is not None and not reference.lost:
            self.file.write(reference.model_copy(update={"lost": why}))

    def _readable(self) -> HomingReference | None:
        """What is on file, where it can be read; what cannot is no reference that counts."""
        try:
            return self.kept_reference()
        except Refused:
            return None

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
                f"never homed: {', '.join(relative)}",
                "the position of an encoder that is not absolute (winches[].encoder in the"
                " rig file) is arbitrary after power-up",
            )

    def _refusal(self, what: str, why: str) -> Refused:
        return Refused(what, where=f"reference {self.file.path}", why=why, next_step=AGAIN)


# The reference of a bus, for people and programs.


@dataclass(frozen=True, slots=True)
class ReferenceStatus:
    """The homing reference of a bus.

    Attributes:
        counts: Whether the drives still count from it.
        why_not: Why they do not.
        made: When it was made; None where none is kept.
        how: The pose was known.
        file: Where it is kept.
    """

    counts: bool
    why_not: str | None
    made: str | None
    how: str | None
    file: str | None

    def __str__(self) -> str:
        """Whether it is valid and how it was made, or why not."""
        if not self.counts:
            return f"not valid: {self.why_not}"
        if not self.made:
            return "none: absolute encoders match the rig file"
        return f"valid, made {self.made} ({self.how})"


def reference_status(
    interlock: MotionInterlock, positions: Sequence[int] | None = None
) -> ReferenceStatus:
    """The reference of a bus.

    Args:
        interlock: Of the bus.
        positions: Of its drives, [counts]; None where they were not asked.
    """
    why = interlock.why_unreferenced(positions)
    try:
        kept = interlock.kept_reference()
    except Refused:  # the reason says so
        kept = None
    path = interlock.file.path
    return ReferenceStatus(
        counts=not why,
        why_not=why or None,
        made=kept.made if kept else None,
        how=kept.how if kept else None,
        file=str(path) if path.exists() else None,
    )
