"""Proposals of motions and resets: the question to the operator, and the facts."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

from drivers.can_bus import IN_PROCESS
from executor.interlock.fault_latch import LatchedFault
from executor.interlock.interlock import MotionInterlock, reference_status
from executor.interlock.reference import ReferenceStatus
from model.errors import (
    BadInput,
    StoppedByOperator,
    is_truth_value,
    require_functions,
    without_passwords,
)
from model.pose import Array, Pose
from model.rig import Camera, Rig
from model.scene import Scene

if TYPE_CHECKING:
    from executor.trajectory.setpoints import PreparedRun  # loads the planner's check

Facts = list[tuple[str, str]]
"""Human-readable names and values."""


class Proposal(Protocol):
    """An action that needs confirmation; a `confirm` callback shows it and answers.

    Attributes:
        question: To the operator.
        otherwise: Outcome after a no, such as ``nothing was moved``.
    """

    question: ClassVar[str]
    otherwise: ClassVar[str]

    @property
    def title(self) -> str:
        """The proposed action."""
        ...

    def facts(self) -> Facts:
        """Conditions and limits; empty if the title is enough."""
        ...


def require_confirmed(confirm: Callable[[Any], bool] | None, proposal: Proposal) -> None:
    """Asks for confirmation; without a callback, the call itself confirms.

    Raises:
        BadInput: It is not a function, or the answer is neither True nor False.
        StoppedByOperator: The answer was no.
    """
    require_functions(confirm=confirm)
    if confirm is None:
        return
    answer = confirm(proposal)
    if not is_truth_value(answer):
        raise BadInput(
            f"confirm must return True or False, it returned {answer!r:.60}",
            where=proposal.title,
            why=f"any other answer may be a no; {proposal.otherwise}",
            next_step="return True to go on, or False to cancel",
        )
    if not answer:
        raise StoppedByOperator(proposal.otherwise, next_step="run it again and confirm")


def _shown(camera: Camera, source: str) -> str:
    return f"{camera.name} ({without_passwords(source)})"


@dataclass(frozen=True, slots=True, eq=False)
class MotionProposal:
    """Proposal of a run; see `Proposal`.

    Attributes:
        prepared: The checked run.
        cameras: In use, with their sources.
        clearance_stop: Whether too small a measured clearance stops the run.
    """

    question: ClassVar[str] = "Move the platform now?"
    otherwise: ClassVar[str] = "nothing was moved"
    title: ClassVar[str] = "ready to run"

    prepared: PreparedRun
    cameras: Mapping[Camera, str]
    clearance_stop: bool

    def facts(self) -> Facts:
        """See `Proposal`."""
        prepared, scene = self.prepared, self.prepared.scene
        rig, table = prepared.rig, prepared.checked.table
        bus = rig.document.bus
        simulated = ", simulated drives" if bus.interface == IN_PROCESS else ""
        start, goal = scene.start.position * 1000, scene.goal.position * 1000
        return [
            ("rig, scene", f"{rig.name}, {scene.name}"),
            ("from", f"{start[0]:z.1f}, {start[1]:z.1f}, {start[2]:z.1f} mm"),
            ("to", f"{goal[0]:z.1f}, {goal[1]:z.1f}, {goal[2]:z.1f} mm"),
            *scene.stop_facts(),
            (
                "motion",
                f"{prepared.length * 1000:.1f} mm in {prepared.duration:.1f} s,"
                f" at most {rig.motion.speed * 1000:g} mm/s",
            ),
            ("set-points", f"{len(table)} cycles of {table.cycle * 1000:g} ms, all checked"),
            *self._reference(),
            ("cameras", self._cameras()),
            ("clearance stop", self._clearance()),
            ("bus", f"{bus.interface} {bus.channel}{simulated}"),
        ]

    def _clearance(self) -> str:
        """Threshold of the clearance stop, or why it is off."""
        scene = self.prepared.scene
        if not self.clearance_stop:
            return "off (--no-clearance-stop)"
        if not self.cameras:
            return "off (no camera)"
        if not scene.obstacles:
            return "off (no obstacles in the scene)"
        return f"below {scene.obstacle_clearance * 1000:g} mm, measured by the cameras"

    def _cameras(self) -> str:
        """Cameras in use, and those of the rig file that are not."""
        names = {camera.name for camera in self.cameras}
        unused = [one.name for one in self.prepared.rig.cameras if one.name not in names]
        used = ", ".join(_shown(*one) for one in self.cameras.items())
        parts = [used] if used else []
        parts += [f"not used: {', '.join(unused)}"] if unused else []
        return "; ".join(parts) or "none"

    def _reference(self) -> Facts:
        """The homing reference in use, if it is not the rig file's own."""
        interlock = MotionInterlock(self.prepared.rig)
        reference = interlock.kept_reference()
        if reference is None or not reference.made:
            return []
        return [("reference", f"{reference.made}, {reference.how}; {interlock.file.path}")]


@dataclass(frozen=True, slots=True, eq=False)
class HomingProposal:
    """Proposal of a homing; see `Proposal`.

    Attributes:
        rig: The robot.
        targets: Pretension of each cable, shape (m,), [N].
        limit: Largest tension, [N].
        reach: Largest length of cable wound in, [m].
        speed: Fastest winch, [m/s].
        fastest: Largest winding-in speed, limited by the reaction time, [m/s].
        camera: Camera for the pose, and its source; None if the pose is stated.
    """

    question: ClassVar[str] = "Wind the cables in now?"
    otherwise: ClassVar[str] = "nothing was moved"
    title: ClassVar[str] = "ready to pretension"

    rig: Rig
    targets: Array
    limit: float
    reach: float
    speed: float
    fastest: float
    camera: tuple[Camera, str] | None

    def facts(self) -> Facts:
        """See `Proposal`."""
        source, bus = self.camera, self.rig.document.bus
        fastest, reach = self.fastest * 1000.0, self.reach * 1000.0
        low, high = self.targets.min(), self.targets.max()
        pull = f"{low:g}" if low == high else f"{low:.1f} to {high:.1f}"
        measured = f"measured, camera {_shown(*source)}" if source else "stated, held by a jig"
        return [
            ("rig", self.rig.name),
            ("pretension", f"{pull} N per cable, at most {self.limit:g} N"),
            (
                "winches",
                f"all together, at most {fastest:.2f} mm/s and {reach:g} mm each, plus stretch",
            ),
            ("pose", measured),
            ("bus", f"{bus.interface} {bus.channel}".strip()),
        ]


@dataclass(frozen=True, slots=True, eq=False)
class ForgetProposal:
    """Proposal to discard a homing reference; see `Proposal`.

    Attributes:
        interlock: Of its bus.
    """

    question: ClassVar[str] = "Do all drive positions match the rig file?"
    otherwise: ClassVar[str] = "the homing reference was not changed"

    interlock: MotionInterlock

    @property
    def title(self) -> str:
        """See `Proposal`."""
        status = reference_status(self.interlock)
        gone = "the present homing reference, which would be discarded"
        return f"{gone if status.file else 'homing reference'}: {status}"

    def facts(self) -> Facts:
        """See `Proposal`."""
        return []


def _tension_fact(limit: float) -> tuple[str, str]:
    return "tension", f"at most {limit:g} N in any cable; no taut cable may go slack"


def _held_fact(rig: Rig) -> tuple[str, str]:
    speed = rig.motion.speed * 1000.0
    return "motion", f"at most {speed:g} mm/s, as long as a control is held"


@dataclass(frozen=True, slots=True, eq=False)
class CableProposal:
    """Proposal to move one winch; see `Proposal`.

    Attributes:
        rig: The robot.
        cable: Its number, from 1.
        length: To pay out, [m]; negative winds in.
        limit: Largest tension of any cable, [N].
        speed: Of the winch, [m/s].
    """

    question: ClassVar[str] = "Move this cable now?"
    otherwise: ClassVar[str] = "nothing was moved"
    title: ClassVar[str] = "ready to move one cable"

    rig: Rig
    cable: int
    length: float
    limit: float
    speed: float

    def facts(self) -> Facts:
        """See `Proposal`."""
        rig, mm, speed = self.rig, self.length * 1000.0, self.speed * 1000.0
        return [
            ("rig", rig.name),
            ("cable", rig.drive_names[rig.winches[self.cable - 1].node_id]),
            ("motion", f"{abs(mm):g} mm {'out' if mm > 0 else 'in'}, at most {speed:g} mm/s"),
            _tension_fact(self.limit),
        ]


@dataclass(frozen=True, slots=True, eq=False)
class JogProposal:
    """Proposal of a jog session; see `Proposal`.

    Attributes:
        rig: The robot; its motion has the jog speed.
        scene: Obstacles and load.
        start: Present platform pose, ``world_from_platform``.
    """

    question: ClassVar[str] = "Enable the drives for jogging now?"
    otherwise: ClassVar[str] = "nothing was enabled"
    title: ClassVar[str] = "ready to enable the drives for jogging"

    rig: Rig
    scene: Scene
    start: Pose

    def facts(self) -> Facts:
        """See `Proposal`."""
        x, y, z = self.start.position * 1000.0
        return [
            ("rig", self.rig.name),
            ("platform", f"at {x:.1f}, {y:.1f}, {z:.1f} mm"),
            ("obstacles", ", ".join(one.name for one in self.scene.obstacles) or "none"),
            _held_fact(self.rig),
        ]


@dataclass(frozen=True, slots=True, eq=False)
class ResetProposal:
    """Proposal to reset a fault; see `Proposal`.

    Attributes:
        bus: Interface and channel.
        latched: The latched fault, if any.
    """

    question: ClassVar[str] = "Is the cause removed and the platform safe?"
    otherwise: ClassVar[str] = "nothing was reset"

    bus: str
    latched: LatchedFault | None

    @property
    def title(self) -> str:
        """See `Proposal`."""
        fault = self.latched
        cause = f"latched since {fault.since}: {fault.cause}" if fault else "no fault latched"
        return f"bus {self.bus}: {cause}"

    def facts(self) -> Facts:
        """See `Proposal`."""
        return []


@dataclass(frozen=True, slots=True, eq=False)
class ReleaseProposal:
    """Proposal to release the drives; see `Proposal`.

    Attributes:
        rig: The robot.
        bus: Interface and channel.
        braked: Whether brakes hold the drums afterwards.
        reference: Homing reference, which is discarded without brakes.
        in_fault: Names of drives that stay in fault, and cannot be reset before the release.
    """

    question: ClassVar[str] = "Is the platform supported, so that no cable carries it?"
    otherwise: ClassVar[str] = "the drives hold as before"
    title: ClassVar[str] = "ready to release the drives"

    rig: Rig
    bus: str
    braked: bool
    reference: ReferenceStatus
    in_fault: tuple[str, ...] = ()

    def facts(self) -> Facts:
        """See `Proposal`."""
        held = "the brakes hold the drums" if self.braked else "nothing holds the cables"
        gone = "discarded: run `cdpr home` before the next motion"
        stays = f"{', '.join(self.in_fault)}: not enabled, stays so until `cdpr reset RIG`"
        return [
            ("rig", self.rig.name),
            ("bus", self.bus),
            *([("in fault", stays)] if self.in_fault else []),
            ("afterwards", held),
            ("reference", str(self.reference) if self.braked else gone),
        ]


@dataclass(frozen=True, slots=True, eq=False)
class CablesProposal:
    """Proposal of a session of single-cable jogs; see `Proposal`.

    Attributes:
        rig: The robot; its motion has the jog speed.
        limit: Largest tension of any cable, [N].
    """

    question: ClassVar[str] = "Enable the drives to jog one cable at a time now?"
    otherwise: ClassVar[str] = "nothing was enabled"
    title: ClassVar[str] = "ready to enable the drives for jogs of single cables"

    rig: Rig
    limit: float

    def facts(self) -> Facts:
        """See `Proposal`."""
        rig = self.rig
        return [
            ("rig", rig.name),
            ("cables", f"{rig.cable_count}, one at a time"),
            _held_fact(rig),
            _tension_fact(self.limit),
            ("not checked", "obstacles, workspace and the platform's pose"),
            ("reference", "stays as it is; a run begins only where drive positions fit a pose"),
        ]
