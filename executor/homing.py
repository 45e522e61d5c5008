"""Homes a rig: pretensions all cables, then references the drives at a known pose.

The pose is stated, with the platform on a jig, or measured by one camera.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np

from executor.cameras.client import static_pose
from executor.cameras.open import measure_at_rest
from executor.cameras.sources import (
    OneCamera,
    choose_one_camera,
    require_synthetic_images,
    source_texts,
)
from executor.control.winch_laws import PretensionLaw, wind_in_speed
from executor.control.winch_loop import MakeLaw
from executor.control.winch_motion import WinchResult
from executor.drives import is_simulated, read_snapshot, require_drives
from executor.interlock.interlock import MotionInterlock
from executor.interlock.reference import HomingReference, counting_hash
from executor.proposals import Facts, Proposal, forget_proposal, homing_proposal, require_confirmed
from executor.realtime.scheduling import require_imported_script
from executor.remote.command_server import commands_from_start
from executor.supervision import RequestBoard, Supervisor
from executor.winch_runs import limit_of, move_by_law, record_folder
from model.errors import (
    BadInput,
    Refused,
    StoppedByOperator,
    positive_number,
    real_number,
    require_functions,
    require_types,
    truth_value,
)
from model.files.documents import PoseDocument
from model.kinematics import cable_lengths
from model.pages.page import FactsDisplay
from model.pose import Array, Pose
from model.progress import SILENT, Listener
from model.rig import Camera, Rig
from model.scene import empty_scene, require_unaltered
from model.statics.gravity import working_tensions
from model.winches import WinchMap, whole_lengths
from planner.settings import whole_number
from tracking.clearance import require_stated_errors

#: Largest reach, [m], and speed, [m/s], of winding in.
FURTHEST, FASTEST = 0.200, 0.010
#: Defaults: reach [m], speed [m/s], number of images, and slack of simulated cables, [m].
REACH, SPEED, PICTURES, SLACK = 0.050, 0.002, 20, 0.005
#: Longest duration of winding in, [s].
LONGEST = 3600.0
#: Largest pretension, as a share of the limit.
_SHARE_OF_LIMIT = 0.8
#: Smallest and largest number of images for the pose.
FEWEST_IMAGES, MOST_IMAGES = 5, 1000


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class HomeResult(FactsDisplay):
    """Result of homing.

    Attributes:
        reference: Homing reference of the drives.
        file: Its file; None with simulated drives, which end with their process.
        folder: Record of the motion, as an absolute path; None without one.
    """

    reference: HomingReference
    file: Path | None
    folder: Path | None = None

    def facts(self) -> Facts:
        """Human-readable pose, uncertainty, tensions, file and record."""
        reference, tensions = self.reference, self.reference.tensions_n
        x, y, z = reference.pose.position_mm
        known = f"{reference.uncertainty_mm:.3f} mm (one standard deviation)"
        if reference.uncertainty_mm == 0.0:  # the accuracy of a jig is not measured
            known = "that of the jig (not measured)"
        kept = self.file or "not saved: simulated drives end with this process"
        return [
            ("platform", f"{x:z.2f}, {y:z.2f}, {z:z.2f} mm, {reference.how}"),
            ("uncertainty", known),
            ("tensions", f"{min(tensions):.1f} to {max(tensions):.1f} N"),
            ("reference", str(kept)),
            *([("record", str(self.folder))] if self.folder else []),
        ]


def home(
    rig: Rig,
    *,
    at_home: bool = False,
    pose: Pose | None = None,
    camera: OneCamera | Sequence[OneCamera] | None = None,
    tension: float | None = None,
    limit: float | None = None,
    reach: float = REACH,
    speed: float = SPEED,
    pictures: int = PICTURES,
    simulated_slack: float = SLACK,
    folder: Path | str | None = None,
    realtime: bool = True,
    need_real_time_rights: bool = True,
    listener: Listener = SILENT,
    confirm: Callable[[Proposal], bool] | None = None,
    supervisor: Supervisor | None = None,
) -> HomeResult:
    """Pretensions all cables, then references the drives at a known pose.

    All winches wind in slowly and together, each until its cable carries the pretension. A tension
    above the limit, or a cable still slack after the full reach and its elastic stretch, stops all.
    Give exactly one of `at_home`, `pose` and `camera`.

    Args:
        rig: The robot and its bus.
        at_home: A jig holds the platform at the rig's home pose.
        pose: A jig holds the platform at this pose, ``world_from_platform``.
        camera: The platform hangs free and this camera measures it: index, device file or address,
            ``NAME=SOURCE`` of one of several, or ``synthetic`` with simulated drives.
        tension: Pretension, [N]; None for the tensions planned at a stated pose, at most 80 % of
            the limit, or with a camera for twice the rig's smallest tension.
        limit: Largest tension of any cable, [N]; None for 60 % of the rig's range.
        reach: Largest length of cable wound in besides its elastic stretch, [m].
        speed: Largest winch speed, [m/s].
        pictures: Number of images for the pose.
        simulated_slack: Largest slack of simulated cables, [m].
        folder: Record folder to create; None for ``runs/home``, ``runs/home-2`` …, and for none
            with simulated drives.
        realtime: False for simulated time, as fast as possible.
        need_real_time_rights: Refuse to move drives on a bus without real-time scheduling.
        listener: Receives progress.
        confirm: Called once, before anything moves; False cancels it. Without it the call itself
            confirms the motion.
        supervisor: Turns interrupts into stops; None for what signal handlers raise.

    Raises:
        BadInput: An argument cannot be used.
        Refused: The bus is latched, a limit cannot be kept, or the pose is too uncertain.
        HardwareMissing: A drive or the camera does not answer.
        Fault: It ended with a fault, which is latched; all drives stopped together and hold. Or a
            function of the listener raised an exception, which stops the motion without a latch.
        StoppedByOperator: Cancelled, or stopped; the drives hold.
    """
    require_types((rig, Rig), (listener, Listener), optional=[(pose, Pose)])
    require_unaltered(rig)
    require_functions(confirm=confirm)
    at_home, realtime = truth_value("at_home", at_home), truth_value("realtime", realtime)
    need_real_time_rights = truth_value("need_real_time_rights", need_real_time_rights)
    in_process = is_simulated(rig)
    require_drives(rig, realtime)
    sources = [] if camera is None else source_texts("camera", camera)
    require_one_pose(at_home, pose, sources)
    reach, speed = real_number("reach", reach, "m"), real_number("speed", speed, "m/s")
    pictures = whole_number("pictures", pictures, least=FEWEST_IMAGES, most=MOST_IMAGES)
    simulated_slack = positive_number("simulated_slack", simulated_slack, "m", or_zero=True)
    _require_slow(reach, speed)
    source = choose_one_camera(rig, sources, in_process) if sources else None
    if source is not None:
        require_stated_errors(rig, source[:1], "set a reference")
        require_synthetic_images(source[1:], not realtime)
    known = None if source is not None else _stated_pose(rig, pose)
    limit = limit_of(rig, limit)
    targets = _targets(rig, tension, known, limit)
    speed = min(speed, rig.motion.speed)
    law = _winding_in(rig, known or rig.home, targets, limit, reach, speed)
    make_folder = record_folder(rig, folder, "home")
    interlock = MotionInterlock(rig)
    made: list[HomingReference] = []

    lost_power = None
    if in_process:
        from simulation.ground_truth import PowerLoss  # a real bus loads no simulator

        lost_power = PowerLoss.drawn(rig, 0, simulated_slack, on_a_stand=source is None)
    with commands_from_start("home", rig, supervisor, realtime=realtime) as commands:
        interlock.require_free()
        if source is not None:  # check that it delivers images before anything moves
            measure_at_rest(rig, source, 1, rig.home, commands.require_no_stop, listener)
        fastest = float(wind_in_speed(rig, targets, limit, speed).max())
        proposal = homing_proposal(rig, targets, limit, reach, fastest, source)
        require_confirmed(confirm, proposal)

        def at_rest(result: WinchResult, true_pose: Pose | None) -> HomingReference:
            board = commands.board
            made.append(_referenced(rig, result, true_pose, board, known, source, pictures))
            return made[0]

        result = move_by_law(
            rig,
            commands,
            law,
            make_folder,
            pose=known or rig.home,
            limit=limit,
            speed=speed,
            realtime=realtime,
            need_real_time_rights=need_real_time_rights,
            listener=listener,
            lost_power=lost_power,
            rehome=True,
            at_rest=at_rest,
        )
    (reference,) = made
    return HomeResult(reference, None if in_process else interlock.file.path, result.folder)


def reference_at(
    rig: Rig, pose: Pose, counts: Array, tensions: Array, how: str, uncertainty: float
) -> HomingReference:
    """The reference from taut cables at a known pose.

    Args:
        rig: The robot as its file describes it.
        pose: ``world_from_platform``.
        counts: Positions of the drives there, shape (m,), [counts].
        tensions: Of the cables there, shape (m,), [N].
        how: How the pose is known.
        uncertainty: Of the pose, standard deviation of the position or of a cable's length, [m].
    """
    winches = WinchMap(rig)
    unstrained = winches.unstrained(cable_lengths(rig, pose), tensions)
    home = winches.home_counts + counts - winches.counts(unstrained)
    return HomingReference(
        schema_version=1,
        rig=rig.name,
        rig_hash=counting_hash(rig),
        made=datetime.now(UTC).isoformat(timespec="seconds"),
        how=how,
        pose=PoseDocument.of(pose),
        uncertainty_mm=round(uncertainty * 1000.0, 4),
        home_counts=[int(c) for c in np.rint(home)],
        tensions_n=[round(float(t), 3) for t in tensions],
        stands_at=[int(c) for c in np.rint(counts)],
    )


def use_rig_file_counts(rig: Rig, *, confirm: Callable[[Proposal], bool] | None = None) -> None:
    """Discards the reference: absolute encoders count as in the rig file. Moves nothing.

    Args:
        rig: The robot and its bus.
        confirm: Called once, before anything is discarded; False cancels it.

    Raises:
        Refused: The bus is latched, not all encoders are absolute, or encoders lost turns.
        StoppedByOperator: Cancelled.
        CdprError: Drives with brakes, whose last positions are known, cannot be read.
    """
    require_types((rig, Rig))
    require_functions(confirm=confirm)
    require_imported_script()
    interlock = MotionInterlock(rig)

    def read_positions() -> list[int]:
        seen = read_snapshot(rig, rig.home, empty_scene(rig).load)
        return [int(position) for position in seen.positions]

    interlock.require_rig_file_counts(read_positions)
    require_confirmed(confirm, forget_proposal(interlock))
    interlock.use_rig_file_counts()


def require_one_pose(at_home: bool, pose: Pose | None, cameras: Sequence[str]) -> None:
    """Requires exactly one source of the pose.

    Raises:
        BadInput: None or several are given.
    """
    if (at_home, pose is not None, bool(cameras)).count(True) != 1:
        raise BadInput(
            "state the platform pose by exactly one of `at_home=`, `pose=` and `camera=`",
            where="cdpr home",
            why="homing needs a known pose",
            next_step="put the platform on a jig and pass --at-home or --pose-mm X Y Z, or let it"
            " hang in view of a calibrated camera and pass --camera INDEX; in Python at_home=True,"
            " pose= or camera=",
        )


def _require_slow(reach: float, speed: float) -> None:
    """Requires the bounds of the command line for every caller."""
    bounds = (("reach", reach, FURTHEST, "m"), ("speed", speed, FASTEST, "m/s"))
    for name, value, largest, unit in bounds:
        if not 0.0 < value <= largest:
            raise BadInput(
                f"the {name} of {value:g} {unit} must be above 0 and at most {largest:g} {unit}",
                where="home",
                next_step=f"give a {name} in this range",
            )


def _winding_in(
    rig: Rig, pose: Pose, targets: Array, limit: float, reach: float, speed: float
) -> MakeLaw:
    """The law that winds in slack up to the reach, [m], and the cables' stretch at a pose."""
    slowest = float(wind_in_speed(rig, targets, limit, speed).min())
    if reach > LONGEST * slowest:
        raise Refused(
            f"winding in {reach * 1000:g} mm would take {reach / slowest / 3600.0:.2g} hours",
            where="home",
            why=f"a cable with E·A = {rig.cable_stiffness.max():.3g} N gains tension so fast that"
            f" it is wound in at {slowest * 1e6:.2g} µm/s",
            next_step="check cables.stiffness_n, which is E·A in N, not E in Pa; or give a higher"
            " limit or a shorter reach; nothing was moved",
        )
    lengths = whole_lengths(rig, cable_lengths(rig, pose))
    stretch = lengths * targets / (rig.cable_stiffness + targets)
    return partial(
        PretensionLaw, targets=targets, limit=limit, reach=reach, speed=speed, stretch=stretch
    )


def _stated_pose(rig: Rig, pose: Pose | None) -> Pose:
    """The pose at which a jig holds the platform; the rig's home by default."""
    if pose is None:
        return rig.home
    inside = (rig.workspace_lower <= pose.position) & (pose.position <= rig.workspace_upper)
    if not inside.all():
        raise BadInput(
            "the pose is outside the workspace",
            where="`pose=`",
            next_step="give the position of the platform's origin in the world frame, inside the"
            " workspace box of the rig file",
        )
    return pose


def _targets(rig: Rig, tension: float | None, known: Pose | None, limit: float) -> Array:
    """The pretension of each cable, shape (m,), [N].

    By default the tensions planned at the stated pose: the platform stays there when its jig is
    removed, and the next motion begins with the tensions it expects. A platform that hangs free
    moves while cables are wound in, so that their tensions exceed a common, smaller one.
    """
    most = _SHARE_OF_LIMIT * limit
    if tension is None and known is not None:
        targets = np.minimum(working_tensions(rig, known).tensions, most)
    else:
        common = 2.0 * rig.min_tension if tension is None else real_number("tension", tension, "N")
        targets = np.full(rig.cable_count, common)
    wrong = targets[~((rig.min_tension <= targets) & (targets <= most))]
    if wrong.size:
        raise Refused(
            f"a pretension of {wrong[0]:g} N must be from {rig.min_tension:g} N to"
            f" {_SHARE_OF_LIMIT:.0%} of the limit of {limit:g} N",
            where="`tension=`",
            why="cables must be taut afterwards, with headroom below the limit while winding in",
            next_step="set another pretension or limit",
        )
    return targets


def _referenced(
    rig: Rig,
    result: WinchResult,
    true_pose: Pose | None,
    board: RequestBoard,
    known: Pose | None,
    source: tuple[Camera, str] | None,
    pictures: int,
) -> HomingReference:
    """The reference at the current pose of the platform.

    Args:
        result: Of the winch motion.
        true_pose: Of the simulated platform.
        known: The stated pose; None if a camera measures it.
        source: That camera, from `choose_one_camera`.
    """
    if known is not None:
        return reference_at(rig, known, result.counts, result.tensions, "stated pose", 0.0)
    assert source is not None

    def require_no_stop() -> None:
        if board.read().stop:
            raise StoppedByOperator(
                "stopped before the pose was measured; the cables are taut and held",
                next_step="home again when ready",
            )

    samples = measure_at_rest(rig, source, pictures, true_pose, require_no_stop, SILENT)
    found = static_pose(rig, samples)
    how = f"tags in {found.pictures} of {pictures} images, camera {source[0].name!r}"
    return reference_at(rig, found.pose, result.counts, result.tensions, how, found.uncertainty)
