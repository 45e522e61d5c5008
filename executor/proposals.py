"""Proposals of motions and resets: the question to the operator, and the facts."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

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

_NOT_MOVED, _NOT_ENABLED = "nothing was moved", "nothing was enabled"


@dataclass(frozen=True, slots=True, eq=False)
class Proposal:
    """An action that needs confirmation; a `confirm` callback shows it and answers.

    Attributes:
        title: The proposed action.
        question: To the operator.
        otherwise: Outcome after a no, such as ``nothing was moved``.
        facts: Returns conditions and limits; empty if the title is enough.
    """

    title: str
    question: str
    otherwise: str
    facts: Callable[[], Facts] = list


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
            why=f"any other answer could mean no; {proposal.otherwise}",
            next_step="return True to continue, or False to cancel",
        )
    if not answer:
        raise StoppedByOperator(proposal.otherwise, next_step="run it again and confirm")


# A run.


def motion_proposal(
    prepared: PreparedRun, cameras: Mapping[Camera, str], clearance_stop: bool
) -> Proposal:
    """Proposal of a run.

    Args:
        cameras: In use, with their sources.
        clearance_stop: Whether too small a measured clearance stops the run.
    """

    def facts() -> Facts:
        rig, scene, table = prepared.rig, prepared.scene, prepared.checked.table
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
            *_reference_facts(rig),
            ("cameras", _describe_cameras(rig, cameras)),
            ("clearance stop", _describe_clearance_stop(scene, cameras, clearance_stop)),
            ("bus", f"{bus.interface} {bus.channel}{simulated}"),
        ]

    return Proposal("ready to run", "Move the platform now?", _NOT_MOVED, facts)


def _reference_facts(rig: Rig) -> Facts:
    """The homing reference in use, if it is not the rig file's own."""
    interlock = MotionInterlock(rig)
    reference = interlock.kept_reference()
    if reference is None or not reference.made:
        return []
    return [("reference", f"{reference.made}, {reference.how}; {interlock.file.path}")]


def _describe_cameras(rig: Rig, cameras: Mapping[Camera, str]) -> str:
    """Cameras in use, and those of the rig file that are not."""
    names = {camera.name for camera in cameras}
    unused = [one.name for one in rig.cameras if one.name not in names]
    used = ", ".join(_shown(*one) for one in cameras.items())
    parts = [used] if used else []
    parts += [f"not used: {', '.join(unused)}"] if unused else []
    return "; ".join(parts) or "none"


def _describe_clearance_stop(
    scene: Scene, cameras: Mapping[Camera, str], clearance_stop: bool
) -> str:
    """Threshold of the clearance stop, or why it is off."""
    if not clearance_stop:
        return "off (--no-clearance-stop, in Python clearance_stop=False)"
    if not cameras:
        return "off (no camera)"
    if not scene.obstacles:
        return "off (no obstacles in the scene)"
    return f"below {scene.obstacle_clearance * 1000:g} mm, measured by the cameras"


def _shown(camera: Camera, source: str) -> str:
    return f"{camera.name} ({without_passwords(source)})"


# Homing, and its reference.


def homing_proposal(
    rig: Rig,
    targets: Array,
    limit: float,
    reach: float,
    fastest: float,
    camera: tuple[Camera, str] | None,
) -> Proposal:
    """Proposal of a homing.

    Args:
        targets: Pretension of each cable, shape (m,), [N].
        limit: Largest tension, [N].
        reach: Largest length of cable wound in, [m].
        fastest: Largest winding-in speed, limited by the reaction time, [m/s].
        camera: Camera for the pose, and its source; None if the pose is stated.
    """

    def facts() -> Facts:
        bus, low, high = rig.document.bus, targets.min(), targets.max()
        pull = f"{low:g}" if low == high else f"{low:.1f} to {high:.1f}"
        speed = f"at most {fastest * 1000:.2f} mm/s and {reach * 1000:g} mm each"
        measured = f"measured, camera {_shown(*camera)}" if camera else "stated, held by a jig"
        return [
            ("rig", rig.name),
            ("pretension", f"{pull} N per cable, at most {limit:g} N"),
            ("winches", f"all together, {speed}, plus stretch"),
            ("pose", measured),
            ("bus", f"{bus.interface} {bus.channel}".strip()),
        ]

    return Proposal("ready to pretension", "Wind the cables in now?", _NOT_MOVED, facts)


def forget_proposal(interlock: MotionInterlock) -> Proposal:
    """Proposal to discard the homing reference of a bus."""
    status = reference_status(interlock)
    gone = "the present homing reference, which would be discarded"
    return Proposal(
        f"{gone if status.file else 'homing reference'}: {status}",
        "Do all drive positions match the rig file?",
        "the homing reference was not changed",
    )


# Jogs.


def _tension_fact(limit: float) -> tuple[str, str]:
    return "tension", f"at most {limit:g} N in any cable; no taut cable may go slack"


def _held_fact(rig: Rig) -> tuple[str, str]:
    speed = rig.motion.speed * 1000.0
    return "motion", f"at most {speed:g} mm/s, as long as a control is held"


def cable_proposal(rig: Rig, cable: int, length: float, limit: float, speed: float) -> Proposal:
    """Proposal to move one winch.

    Args:
        cable: Its number, from 1.
        length: To pay out, [m]; negative winds in.
        limit: Largest tension of any cable, [N].
        speed: Of the winch, [m/s].
    """

    def facts() -> Facts:
        mm, direction = abs(length * 1000.0), "out" if length > 0 else "in"
        return [
            ("rig", rig.name),
            ("cable", rig.drive_names[rig.winches[cable - 1].node_id]),
            ("motion", f"{mm:g} mm {direction}, at most {speed * 1000.0:g} mm/s"),
            _tension_fact(limit),
        ]

    return Proposal("ready to move one cable", "Move this cable now?", _NOT_MOVED, facts)


def jog_proposal(rig: Rig, scene: Scene, start: Pose) -> Proposal:
    """Proposal of a jog session.

    Args:
        rig: The robot; its motion has the jog speed.
        start: Present platform pose, ``world_from_platform``.
    """

    def facts() -> Facts:
        x, y, z = start.position * 1000.0
        return [
            ("rig", rig.name),
            ("platform", f"at {x:.1f}, {y:.1f}, {z:.1f} mm"),
            ("obstacles", ", ".join(one.name for one in scene.obstacles) or "none"),
            _held_fact(rig),
        ]

    title = "ready to enable the drives for jogging"
    return Proposal(title, "Enable the drives for jogging now?", _NOT_ENABLED, facts)


def cables_proposal(rig: Rig, limit: float) -> Proposal:
    """Proposal of a session of single-cable jogs.

    Args:
        rig: The robot; its motion has the jog speed.
        limit: Largest tension of any cable, [N].
    """

    def facts() -> Facts:
        return [
            ("rig", rig.name),
            ("cables", f"{rig.cable_count}, one at a time"),
            _held_fact(rig),
            _tension_fact(limit),
            ("not checked", "obstacles, workspace and the platform's pose"),
            ("reference", "stays as it is; a run begins only where drive positions fit a pose"),
        ]

    title = "ready to enable the drives for jogs of single cables"
    question = "Enable the drives to jog one cable at a time now?"
    return Proposal(title, question, _NOT_ENABLED, facts)


# Resets and releases.


def reset_proposal(bus: str, latched: LatchedFault | None) -> Proposal:
    """Proposal to reset a fault.

    Args:
        latched: The latched fault, if any.
    """
    cause = f"latched since {latched.since}: {latched.cause}" if latched else "no fault latched"
    question = "Is the cause removed and the platform safe?"
    return Proposal(f"bus {bus}: {cause}", question, "nothing was reset")


def release_proposal(
    rig: Rig, bus: str, braked: bool, reference: ReferenceStatus, in_fault: tuple[str, ...]
) -> Proposal:
    """Proposal to release the drives.

    Args:
        braked: Whether brakes hold the drums afterwards.
        reference: Homing reference, which is discarded without brakes.
        in_fault: Names of drives that stay in fault, and cannot be reset before the release.
    """

    def facts() -> Facts:
        held = "the brakes hold the drums" if braked else "nothing holds the cables"
        gone = "discarded: run `cdpr home` before the next motion"
        stays = f"{', '.join(in_fault)}: not enabled, stays so until `cdpr reset RIG`"
        return [
            ("rig", rig.name),
            ("bus", bus),
            *([("in fault", stays)] if in_fault else []),
            ("afterwards", held),
            ("reference", str(reference) if braked else gone),
        ]

    question = "Is the platform supported, so that no cable carries it?"
    return Proposal("ready to release the drives", question, "the drives hold as before", facts)
