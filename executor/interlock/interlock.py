"""Motion interlock of a bus: every motion begins and ends here.

On the interface ``virtual`` nothing is stored: its drives end with the process, and start as in
the rig file.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path

from drivers.can_bus import IN_PROCESS, BusSettings
from executor.interlock.fault_latch import FaultLatch, LatchedFault
from executor.interlock.reference import (
    AGAIN,
    RESTARTED,
    HomingReference,
    ReferenceFile,
    ReferenceStatus,
    as_in_the_file,
    changed_reference,
    counting_hash,
    is_braked_at,
    lost_reference,
    referenced,
    released_since,
    require_absolute,
    turns_lost,
    why_moved,
    why_turns_lost,
)
from executor.state_machine import State
from model.errors import Refused
from model.rig import Rig


class MotionInterlock:
    """Motion interlock of the bus of one rig."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        settings = BusSettings.of(rig)
        self._is_kept = settings.interface != IN_PROCESS
        self._latch = FaultLatch(settings, rig.drive_names)
        self.file = ReferenceFile(settings)
        self._counted_from: HomingReference | None = None
        self._under: LatchedFault | None = None  # the fault of an earlier motion, which stays

    def require_free(self) -> None:
        """Requires a bus without a latched fault or an active run.

        Raises:
            Refused: The bus is not free; with the cause.
        """
        if self._is_kept:
            self._latch.require_disengaged()

    def reference(self) -> HomingReference | None:
        """The valid reference for this rig file; None if it needs none and has none.

        Raises:
            Refused: It is required but missing, lost, or made for another rig file.
        """
        reference = self.kept_reference()
        if reference is not None and reference.lost:
            raise lost_reference(self._rig, reference, self.file.where)
        if reference is None or not reference.made:
            self._require_absolute()
            return None
        if reference.rig_hash != counting_hash(self._rig):
            why = f"homed {reference.made} for {reference.rig}; geometry or winches differ"
            raise self._refusal("the drives were homed for another rig file", why)
        return reference

    def why_unreferenced(self, positions: Sequence[int] | None = None) -> str:
        """Why the homing reference is not valid; empty if it is.

        Args:
            positions: Of the drives, [counts]; None to check only the file.
        """
        try:
            reference = self.reference()
        except Refused as error:
            return f"{error.what}: {error.why}"
        if positions is None:
            return ""
        moved = "" if reference is None else why_moved(self._rig, reference, positions)
        return self.why_turns_lost(positions) or moved

    def why_turns_lost(self, positions: Sequence[int]) -> str:
        """Why the reference is lost, where encoders now at positions [counts] lost turns."""
        reference = self._braked_at()
        return "" if reference is None else why_turns_lost(self._rig, reference, positions)

    def _braked_at(self) -> HomingReference | None:
        """The reference, if brakes should hold the drives at its last positions; else None."""
        try:
            reference = self._in_force()
        except Refused:  # refused anyway
            return None
        if reference is None or self._latch.is_of_unfinished_motion():
            return None  # until a reset stores where it ended, the last positions are older
        return reference if is_braked_at(self._rig, reference) else None

    def kept_reference(self) -> HomingReference | None:
        """The reference on file for this bus, valid or not; None without a file."""
        return self.file.read() if self._is_kept else None

    def referenced_rig(self) -> Rig:
        """The rig as its drives count; see `reference`."""
        reference = self.reference()
        return self._rig if reference is None else referenced(self._rig, reference)

    def require_ready(self) -> HomingReference | None:
        """Requires a free bus, and drives referenced for this rig; returns their reference.

        Raises:
            Refused: One of both does not hold.
        """
        self.require_free()
        reference = self._in_force()
        if reference is None:
            return None
        if reference.lost:
            raise lost_reference(self._rig, reference, self.file.where)
        if reference.home_counts != [winch.home_counts for winch in self._rig.winches]:
            what = "the run was prepared with a different homing reference"
            raise self._refusal(what, f"the drives were homed {reference.made}")
        return reference

    def still_counts(self, positions: Sequence[int]) -> HomingReference | None:
        """The reference, if it is valid for drives at these positions [counts]; else None."""
        try:
            reference = self._in_force()
        except Refused:
            return None
        if reference is None or reference.lost or len(reference.stands_at) != len(positions):
            return None
        moved = self.why_turns_lost(positions) or why_moved(self._rig, reference, positions)
        return None if moved else reference

    def found_restarted(self, nodes: Iterable[int]) -> None:
        """Marks the reference of power-cycled drives as lost; absolute encoders need not hold.

        This is written at once, as nothing else records it after the next configuration.

        Raises:
            Refused: It cannot be written.
        """
        found = {*nodes}
        restarted = {winch.node_id for winch in self._rig.winches if not winch.absolute} & found
        if restarted:
            names = [name for node, name in self._rig.drive_names.items() if node in restarted]
            self._lose(f"{', '.join(names)}: {RESTARTED}")
        reference = self._readable()
        if reference is not None and not found <= {*reference.released}:
            released = sorted(found.union(reference.released))
            self.file.write(reference.model_copy(update={"released": released}))

    def found_at_rest(
        self, positions: Sequence[int], restarted: Collection[int], released: Collection[int]
    ) -> None:
        """Marks the reference as lost if encoders lost turns, or drives left holding their torque.

        This is written at once, as the motion that follows hides the lost turns.

        Args:
            positions: Of the drives, [counts].
            restarted: Nodes found without this program's configuration.
            released: Nodes found without torque.

        Raises:
            Refused: It cannot be written.
        """
        if why := self.why_turns_lost(positions) or self.why_released(restarted, released):
            self._lose(why)

    def why_released(self, restarted: Collection[int], released: Collection[int]) -> str:
        """Why the reference is lost, where drives left holding are without torque; else empty.

        Args:
            restarted: Nodes found without this program's configuration.
            released: Nodes found without torque.
        """
        reference = self._readable()
        if reference is None:
            return ""
        return released_since(self._rig, reference, restarted, released)

    def lost_torque(self, why: str) -> None:
        """Marks the reference as lost, as a drive released a cable under tension.

        Raises:
            Refused: It cannot be written.
        """
        if self._is_kept:
            self._note_end(why, holding=False, positions=None, released=())

    def confirm_at_rest(self, positions: Sequence[int], *, held: bool) -> None:
        """Stores the positions of drives after a reset: the reference stays valid.

        Args:
            positions: Of the drives, [counts].
            held: All held throughout; otherwise only absolute encoders, which count all motion.

        Raises:
            Refused: It cannot be written.
        """
        reference = self._readable()
        if reference is None or reference.lost or len(reference.stands_at) != len(positions):
            return
        rows = zip(self._rig.winches, positions, reference.stands_at, strict=True)
        at = [now if held or winch.absolute else then for winch, now, then in rows]
        released = [] if held else reference.released
        self.file.write(reference.model_copy(update={"stands_at": at, "released": released}))

    def begin(
        self,
        record: Path,
        reference: HomingReference | None,
        *,
        rehome: bool = False,
        under: LatchedFault | None = None,
    ) -> None:
        """Engages the latch before a motion; it stays if the motion does not finish.

        From here on the drives are expected to hold, even if this program is killed.

        Args:
            record: Path of the motion's record.
            reference: The drives' valid reference; None if unknown.
            rehome: The drives will be homed again; the present reference is discarded.
            under: Latched fault that a release does not need cleared: it stays, however it ends.

        Raises:
            Refused: The bus is latched, but not by `under`; the reference changed since it was
                read; or latch or reference cannot be written.
        """
        if not self._is_kept:
            return
        if under is None:
            self._latch.engage(self._rig.name, record)
        else:
            self._latch.hold_engaged(under)
        self._under = under
        try:
            self._counted_from = self._expect_to_hold(reference, rehome=rehome)
        except BaseException:
            self._settle(State.STOPPED, "", record)  # nothing was enabled
            raise

    def _expect_to_hold(
        self, reference: HomingReference | None, *, rehome: bool
    ) -> HomingReference | None:
        """Notes that no drive is released; returns the reference that this motion counts from.

        The file is read again, as only from now on no other program writes to it: the set-up of
        the drives may have found some restarted, and another program may have homed them.
        """
        if rehome and (reference is None or reference.made):
            self._lose("homing did not finish")
            return None
        now = self._readable() if reference is None else self._in_force()
        if reference is not None and now is not None:
            if now.lost:
                raise lost_reference(self._rig, now, self.file.where)
            if (now.made, now.home_counts) != (reference.made, reference.home_counts):
                raise changed_reference(now, self.file.where)
        if now is not None and now.released and not now.lost:
            self.file.write(now.model_copy(update={"released": []}))
        return None if reference is None else now

    def take(self, reference: HomingReference) -> None:
        """Stores a new reference, made between `begin` and `end`.

        Raises:
            Refused: It cannot be written.
        """
        if self._is_kept:
            self.file.write(reference)
            self._counted_from = None  # whose end would replace it

    def cancel(self) -> None:
        """Disengages the latch when nothing was enabled after all."""
        if self._is_kept:
            if self._counted_from is not None:
                self.file.write(self._counted_from)
            self._latch.disengage()

    def end(
        self,
        state: State,
        cause: str,
        record: Path,
        *,
        holding: bool,
        positions: Sequence[int] | None,
        released: Sequence[int] = (),
        release_reason: str = "",
    ) -> None:
        """Ends a motion: frees the bus if it ended well, else latches the fault.

        Args:
            cause: Why it did not end well.
            record: Path of its record.
            holding: Every cable was held to the end.
            positions: Positions of the drives, [counts]; None when unknown.
            released: Nodes left without torque: by their brakes, or never enabled.
            release_reason: Why cables were released on purpose; recorded as loss of the reference.

        Raises:
            Refused: The reference cannot be written, so that the bus stays latched; or the latch
                cannot.
        """
        if not self._is_kept:
            return
        try:
            lost = (
                release_reason or f"cables under tension were released, or may have been ({cause})"
            )
            self._note_end(lost, holding, positions, released)
        except Refused as error:
            self._settle(State.LATCHED, cause or error.what, record)
            raise
        self._counted_from = None
        self._settle(state, cause, record)

    def _settle(self, state: State, cause: str, record: Path) -> None:
        if self._under is None:
            self._latch.settle(self._rig.name, state, cause, record)
        else:
            self._latch.let_go()

    def _note_end(
        self,
        lost: str,
        holding: bool,
        positions: Sequence[int] | None,
        released: Sequence[int],
    ) -> None:
        """Updates the reference after a motion."""
        if not holding:
            reference = self._readable() or as_in_the_file(self._rig)
            self.file.write(reference.model_copy(update={"lost": reference.lost or lost}))
        elif self._counted_from is not None and positions is not None:
            update = {"stands_at": list(positions), "released": list(released)}
            self.file.write(self._counted_from.model_copy(update=update))

    def _in_force(self) -> HomingReference | None:
        """The reference on file, valid or lost; None on a virtual bus.

        Absolute encoders never homed have the one of their rig file.

        Raises:
            Refused: It cannot be read, or drives without absolute encoders were never homed.
        """
        kept = self.kept_reference()
        if kept is not None and (kept.made or kept.lost):
            return kept
        self._require_absolute()
        if not self._is_kept:
            return None
        reference = as_in_the_file(self._rig)
        if kept is None:
            return reference
        at = {"stands_at": kept.stands_at} if kept.rig_hash == reference.rig_hash else {}
        return reference.model_copy(update={"released": kept.released} | at)

    def _lose(self, why: str) -> None:
        """Marks the reference as lost, also one only another user has; keeps the first reason."""
        try:
            reference = self.kept_reference() or as_in_the_file(self._rig)
        except Refused:  # it is refused anyway, and says why
            return
        if self._is_kept and not reference.lost:
            self.file.write(reference.model_copy(update={"lost": why}))

    def _readable(self) -> HomingReference | None:
        """The reference on file; None if it cannot be read."""
        try:
            return self.kept_reference()
        except Refused:
            return None

    def use_rig_file_counts(self) -> None:
        """Removes the reference: the drives count as in the rig file.

        Raises:
            Refused: A drive without absolute encoder cannot do so; or a fault is latched.
        """
        self.require_free()
        self._require_absolute()
        self.file.remove()

    def require_rig_file_counts(self, read_positions: Callable[[], Sequence[int]]) -> None:
        """Requires a free bus and absolute encoders, which can count as in the rig file.

        Args:
            read_positions: Positions of the drives, [counts]; called only where their brakes should
                have held them at known ones.

        Raises:
            Refused: As `use_rig_file_counts`; or encoders lost turns, now or since homing.
            CdprError: The drives cannot be read.
        """
        self.require_free()
        self._require_absolute()
        kept = self._readable()
        if kept is not None and kept.has_lost_turns:
            raise lost_reference(self._rig, kept, self.file.where)
        if self._braked_at() is not None and (lost := self.why_turns_lost(read_positions())):
            raise turns_lost(lost, self.file.where)

    def _require_absolute(self) -> None:
        if self._is_kept:
            require_absolute(self._rig, self.file.where)

    def _refusal(self, what: str, why: str) -> Refused:
        return Refused(what, where=self.file.where, why=why, next_step=AGAIN)


# Status of a bus's reference.


def reference_status(
    interlock: MotionInterlock, positions: Sequence[int] | None = None, *, held: bool = False
) -> ReferenceStatus:
    """The reference of a bus.

    Args:
        positions: Of its drives, [counts]; None if not read.
        held: All drives hold on their own, none without its configuration, so that a reset stores
            their positions.
    """
    why = interlock.why_unreferenced(positions)
    turns = positions is not None and bool(interlock.why_turns_lost(positions))
    unrecorded = held and not turns and bool(why) and not interlock.why_unreferenced()
    if unrecorded:
        why = (
            f"the end of the last motion was not recorded ({why}), but all drives held:"
            " `cdpr reset RIG` stores their positions, and no homing is needed"
        )
    try:
        kept = interlock.kept_reference()
    except Refused:  # reported in `why`
        kept = None
    return ReferenceStatus.of(kept, interlock.file.path, why, valid_after_reset=unrecorded)
