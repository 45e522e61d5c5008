"""Homing reference of the drives: a separate dated file, never the rig file.

It is stored beside the latch of the bus (`executor.interlock.locks`). `cdpr home` writes it; every
motion ends by updating the drive positions in it, or by marking it lost if cables were released.
It also states which drives were left without torque on purpose: any other one that no longer holds
its cable has released it meanwhile. For that purpose alone, absolute encoders that were never homed
have one too, with the counts of the rig file.
"""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, ValidationError

from drivers.can_bus import BusSettings
from drivers.plausibility import HOME
from executor.interlock.locks import WRITABLE, read_state_file, state_files
from model.errors import CdprError, Refused
from model.files.documents import Document, PoseDocument, content_hash, document_hash, write_atomic
from model.rig import Rig, rig_from_document

AGAIN = f"home the drives: {HOME}; nothing was moved"

#: Besides, for absolute encoders.
AS_IN_THE_FILE = (
    "if they count as in the rig file, `cdpr home RIG --as-rig-file` instead, in Python"
    " executor.use_rig_file_counts()"
)

#: Next step where encoders lost turns.
OVER_THE_TRAVEL = f"make the encoders absolute over the whole travel, then {AGAIN}"

#: Why a drive lost its configuration, and with it the reference of an incremental encoder.
RESTARTED = "power-cycled, or `bus.cycle_ms` was changed"

#: How a loss by whole turns ends.
TURNS_AWAY = "than at the last known position"

#: Loss by encoders that begin at 0 with their power.
SWITCHED_ON = (
    "all absolute encoders with a brake count from 0, as if from where they were switched on"
    " (ODrive: absolute_setpoints)"
)

#: A brake holds a drum within this part of a motor turn, if not within the start tolerance.
HELD_TURN = 0.1

#: Why drives at rest lost their reference, though they kept their power and position.
RELEASED = "left holding by the last motion, but without torque now, as after an emergency stop"


class HomingReference(Document):
    """Drive counts of a rig at home, and how they were determined."""

    schema_version: Literal[1]
    rig: str
    rig_hash: str = Field(description="of the rig data that the counts depend on")
    made: str = Field(
        description="time of homing, ISO 8601, UTC; empty for absolute encoders never homed"
    )
    how: str
    pose: PoseDocument = Field(description="of the platform at that time")
    uncertainty_mm: float = Field(description="of the pose, one standard deviation; 0 if stated")
    home_counts: Annotated[list[int], Field(min_length=1)]
    tensions_n: list[float]
    stands_at: list[int] = Field(description="drive positions at the end of the last motion")
    released: list[int] = Field(
        default=[], description="nodes left without torque on purpose, or since power-up"
    )
    lost: str = Field(default="", description="why it is no longer valid")

    @property
    def is_measured(self) -> bool:
        """Whether drives were at `stands_at`: absolute encoders never homed have not moved yet."""
        return bool(self.made) or self.stands_at != self.home_counts

    @property
    def has_lost_turns(self) -> bool:
        """Whether it is lost as in `why_turns_lost`: no motion since makes these counts right."""
        return self.lost.endswith((TURNS_AWAY, SWITCHED_ON))


def as_in_the_file(rig: Rig) -> HomingReference:
    """The reference of absolute encoders never homed, whose drives need not hold yet."""
    home = [winch.home_counts for winch in rig.winches]
    return HomingReference(
        schema_version=1,
        rig=rig.name,
        rig_hash=counting_hash(rig),
        made="",
        how="as in the rig file",
        pose=PoseDocument.of(rig.home),
        uncertainty_mm=0.0,
        home_counts=home,
        tensions_n=[],
        stands_at=home,
        released=[winch.node_id for winch in rig.winches],
    )


def counting_hash(rig: Rig) -> str:
    """Hash of all rig data that determine the drive counts at a pose."""
    winches = [document_hash(winch) for winch in rig.document.winches]
    return content_hash({"rig": rig.plan_hash, "winches": winches})


def referenced(rig: Rig, reference: HomingReference) -> Rig:
    """The rig with the home counts of a reference."""
    winches = [
        winch.model_copy(update={"home_counts": home})
        for winch, home in zip(rig.document.winches, reference.home_counts, strict=True)
    ]
    return rig_from_document(rig.document.model_copy(update={"winches": winches}))


def moved_since(rig: Rig, reference: HomingReference, positions: Sequence[int]) -> list[float]:
    """Cable travel of each drive since the last motion, [m].

    Zero for absolute encoders, which keep counting when moved.

    Args:
        positions: Of the drives now, [counts].
    """
    rows = zip(rig.winches, positions, reference.stands_at, strict=True)
    return [
        0.0 if winch.absolute else abs((at - left) / winch.counts_per_metre)
        for winch, at, left in rows
    ]


def why_moved(rig: Rig, reference: HomingReference, positions: Sequence[int]) -> str:
    """Which drive moved farthest since the last motion, and by how much; empty within tolerance.

    Args:
        positions: Of the drives now, [counts].
    """
    moved = moved_since(rig, reference, positions)
    worst = max(range(len(moved)), key=moved.__getitem__)
    if moved[worst] <= rig.motion.start_tolerance:
        return ""
    name = list(rig.drive_names.values())[worst]
    return f"{name} is {moved[worst] * 1000:.1f} mm of cable from its last known position"


def is_braked_at(rig: Rig, reference: HomingReference) -> bool:
    """Whether brakes should hold absolute encoders of this rig at the last positions on file.

    Not once it is lost: released cables, or a motion since, may have rotated the drums.
    """
    is_of_rig = reference.is_measured and reference.rig_hash == counting_hash(rig)
    braked = any(winch.absolute and winch.brake for winch in rig.winches)
    return is_of_rig and braked and not reference.lost


def why_turns_lost(rig: Rig, reference: HomingReference, positions: Sequence[int]) -> str:
    """Why absolute encoders of braked drums seem to have lost turns; empty if they do not.

    Either all count near 0, and did not before; or all are whole turns, 0 included, from their last
    positions. Another distance of any one means that drums were moved, which they counted. Without
    a brake a drum may be at any angle.

    Args:
        reference: Of its drives; they were not moved by a program since `stands_at`.
        positions: Of the drives now, [counts].
    """
    if not reference.is_measured or len(positions) != len(reference.stands_at):
        return ""
    braked = [drive for drive, winch in enumerate(rig.winches) if winch.absolute and winch.brake]
    per_turn = np.array([rig.winches[drive].counts_per_turn for drive in braked])
    per_metre = np.array([abs(rig.winches[drive].counts_per_metre) for drive in braked])
    tolerance = np.minimum(rig.motion.start_tolerance * per_metre, HELD_TURN * per_turn)
    now, left = np.array(positions)[braked], np.array(reference.stands_at)[braked]
    moved = now - left
    if (abs(now) <= tolerance).all() and (np.minimum(abs(left), abs(moved)) > tolerance).any():
        return SWITCHED_ON
    turns = np.rint(moved / per_turn)
    if (abs(moved - turns * per_turn) > tolerance).any():
        return ""
    named: dict[int, list[str]] = {}
    names = list(rig.drive_names.values())
    for drive, count in zip(braked, turns.astype(int).tolist(), strict=True):
        named.setdefault(count, []).append(names[drive])
    return "; ".join(
        f"{', '.join(names)} {'count' if names[1:] else 'counts'} {abs(count)} whole"
        f" turn{'s' if abs(count) > 1 else ''} {'more' if count > 0 else 'less'} {TURNS_AWAY}"
        for count, names in named.items()
        if count
    )


def released_since(
    rig: Rig, reference: HomingReference, restarted: Collection[int], released: Collection[int]
) -> str:
    """Why the reference is lost, if drives that were left holding no longer hold; else empty.

    Absolute encoders may be power-cycled.

    Args:
        restarted: Nodes found without this program's configuration.
        released: Nodes found without torque.
    """
    names = [
        rig.drive_names[winch.node_id]
        for winch in rig.winches
        if winch.node_id in released
        and winch.node_id not in reference.released
        and not (winch.absolute and winch.node_id in restarted)
    ]
    return f"{', '.join(names)}: {RELEASED}" if names else ""


class ReferenceFile:
    """The reference file of one bus, also where it was before a folder for all users existed."""

    def __init__(self, settings: BusSettings) -> None:
        self._paths = state_files("reference", settings)

    @property
    def path(self) -> Path:
        """The file; where there is none, the one that would be written."""
        return next(filter(os.path.lexists, self._paths), self._paths[0])

    @property
    def where(self) -> str:
        """The file, in a refusal."""
        return f"reference {self.path}"

    def read(self) -> HomingReference | None:
        """The reference; None where there is none.

        If there are two, a loss noted in either counts; two different ones are a loss.

        Raises:
            Refused: A file cannot be read, so that its content is unknown.
        """
        found = [one for one in map(self._read, self._paths) if one is not None]
        if not found:
            return None
        first = next((one for one in found if one.lost), found[0])
        if not any(one.made or one.lost for one in found):  # none was homed: the rig file counts
            return first
        if not first.lost and any(_origin(one) != _origin(first) for one in found):
            differ = f"it differs between {' and '.join(map(str, self._paths))}"
            return first.model_copy(update={"lost": differ})
        return first

    def _read(self, path: Path) -> HomingReference | None:
        try:
            return HomingReference.model_validate_json(read_state_file(path))
        except FileNotFoundError:
            return None
        except (OSError, ValidationError, ValueError) as error:
            raise Refused(
                "the homing reference cannot be read",
                where=str(path),
                why=str(error).splitlines()[0],
                next_step=AGAIN,
            ) from None

    def remove(self) -> None:
        """Removes the file, wherever it is.

        Raises:
            Refused: It cannot be removed.
        """
        try:
            for path in reversed(self._paths):  # an interruption leaves the one that counts
                path.unlink(missing_ok=True)
        except OSError as error:
            raise Refused(
                "the homing reference cannot be removed",
                where=str(self.path),
                why=error.strerror or str(error),
                next_step=WRITABLE,
            ) from None

    def write(self, reference: HomingReference) -> None:
        """Writes the reference, and removes the one where it was before.

        Raises:
            Refused: It cannot be written, or the other one not be removed.
        """
        path, *earlier = self._paths
        try:
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            text = json.dumps(reference.model_dump(mode="json"), indent=1) + "\n"
            write_atomic(path, text, durable=True)
            for other in earlier:
                other.unlink(missing_ok=True)
        except (OSError, CdprError) as error:
            raise Refused(
                "the homing reference cannot be written",
                where=str(path),
                why=error.why if isinstance(error, CdprError) else error.strerror or str(error),
                next_step=f"{WRITABLE}, then run `cdpr home`",
            ) from None


def _origin(reference: HomingReference) -> tuple[str, str, list[int]]:
    """What a reference is of: the same after each motion."""
    return reference.rig_hash, reference.made, reference.home_counts


# Refusals, of the rig's drives and of the file.


def require_absolute(rig: Rig, where: str) -> None:
    """Requires absolute encoders of drives that were never homed.

    Raises:
        Refused: One is not absolute.
    """
    relative = [rig.drive_names[winch.node_id] for winch in rig.winches if not winch.absolute]
    if relative:
        raise Refused(
            f"never homed: {', '.join(relative)}",
            where=where,
            why="the position of an encoder that is not absolute (winches[].encoder in the rig"
            " file) is arbitrary after power-up",
            next_step=AGAIN,
        )


def lost_reference(rig: Rig, reference: HomingReference, where: str) -> Refused:
    """Refusal of a reference that its file states as lost."""
    homed = f"homed {reference.made}" if reference.made else "the drives were never homed"
    absolute = all(winch.absolute for winch in rig.winches)
    next_step = f"{AGAIN}; {AS_IN_THE_FILE}" if absolute else AGAIN
    return Refused(
        "the homing reference is lost",
        where=where,
        why=f"{reference.lost}; {homed}",
        next_step=OVER_THE_TRAVEL if reference.has_lost_turns else next_step,
    )


def changed_reference(now: HomingReference, where: str) -> Refused:
    """Refusal of a motion prepared with another reference than the present one."""
    return Refused(
        "the homing reference changed while this motion was prepared",
        where=where,
        why=f"another program homed the drives or discarded their reference: {now.how}",
        next_step="prepare the motion again: repeat the command; nothing was moved",
    )


def turns_lost(lost: str, where: str) -> Refused:
    """Refusal of absolute encoders that lost turns; ``lost`` from `why_turns_lost`."""
    return Refused(
        f"the homing reference is lost: {lost}",
        where=where,
        why="encoders that are not absolute over the whole travel, or not set up so (ODrive:"
        " absolute_setpoints), lose turns with their power; or other means moved every drum so",
        next_step=OVER_THE_TRAVEL,
    )


# Status of a reference, for operators and scripts.


@dataclass(frozen=True, slots=True)
class ReferenceStatus:
    """The homing reference of a bus.

    Attributes:
        counts: Whether it is valid.
        why_not: Why it is not.
        made: Time of homing; None if there is none.
        how: How the pose was known.
        file: Its path.
        known: False where drives that decide about it could not be read.
        valid_after_reset: `cdpr reset` makes it valid, as all drives held: it stores their
            positions.
    """

    counts: bool
    why_not: str | None
    made: str | None
    how: str | None
    file: str | None
    known: bool = True
    valid_after_reset: bool = False

    @classmethod
    def of(
        cls, kept: HomingReference | None, path: Path, why: str, *, valid_after_reset: bool
    ) -> ReferenceStatus:
        """That of a reference on file, which is not valid because of ``why``, if not empty."""
        return cls(
            counts=not why,
            why_not=why or None,
            made=kept.made if kept and kept.made else None,
            how=kept.how if kept and kept.made else None,
            file=str(path) if path.exists() else None,
            valid_after_reset=valid_after_reset,
        )

    @property
    def why_lost(self) -> str | None:
        """Why drives must be homed; None if they need not be, or if that is unknown."""
        return self.why_not if self.known and not self.valid_after_reset else None

    def if_unread(self, why: str) -> ReferenceStatus:
        """The same, where not all drives could be read: unknown, unless lost by its file."""
        return replace(self, counts=False, why_not=why, known=False) if self.counts else self

    def __str__(self) -> str:
        """Whether it is valid and how it was made, or why not."""
        if not self.known:
            return f"unknown: {self.why_not}"
        if self.valid_after_reset:
            return f"not valid before a reset: {self.why_not}"
        if not self.counts:
            return f"not valid: {self.why_not}"
        if not self.made:
            return "none: the drives count as in the rig file"
        return f"valid, made {self.made} ({self.how})"
