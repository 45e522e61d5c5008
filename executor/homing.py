"""Homes a rig: pretensions all cables, then references the drives at a pose that is known.

The pose is stated, where a jig holds the platform, or measured by one camera.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from executor.cameras.client import static_pose
from executor.cameras.open import look_at_rest
from executor.cameras.sources import choose_one_camera, require_simulated_pictures
from executor.control.winch_laws import PretensionLaw, wind_in_speed
from executor.control.winch_motion import WinchesStand
from executor.drives import is_simulated, require_own_time
from executor.interlock.interlock import MotionInterlock
from executor.interlock.reference import HomingReference, reference_at
from executor.proposals import Facts, ForgetProposal, HomingProposal, require_confirmed
from executor.supervision import RequestBoard, Supervisor
from executor.winch_runs import WinchMotion, limit_of, move_by_law
from model.errors import BadInput, Refused, StoppedByOperator
from model.pose import Pose
from model.progress import SILENT, Listener
from model.rig import Camera, Rig

#: A cable is taken up no further than this, [m], and no faster than that, [m/s].
FURTHEST, FASTEST = 0.200, 0.010
#: Defaults: reach [m] and speed [m/s] as above, images, and how slack simulated cables hang, [m].
REACH, SPEED, PICTURES, SLACK = 0.050, 0.002, 20, 0.005
#: Fewest and most images that measure the pose.
FEWEST_PICTURES, MOST_PICTURES = 5, 1000


@dataclass(frozen=True, slots=True, eq=False)
class HomeResult:
    """What a homing made.

    Attributes:
        reference: Of the drives' counts.
        file: Where it is kept; None with simulated drives, which end with their process.
    """

    reference: HomingReference
    file: Path | None

    def facts(self) -> Facts:
        """Pose, its uncertainty, tensions and file, for people."""
        reference, tensions = self.reference, self.reference.tensions_n
        x, y, z = reference.pose.position_mm
        known = f"{reference.uncertainty_mm:.3f} mm (one standard deviation)"
        if reference.uncertainty_mm == 0.0:  # it is not measured how well a jig holds it
            known = "that of the jig (not measured)"
        kept = self.file or "not saved: simulated drives end with this process"
        return [
            ("platform", f"{x:z.2f}, {y:z.2f}, {z:z.2f} mm, {reference.how}"),
            ("uncertainty", known),
            ("tensions", f"{min(tensions):.1f} to {max(tensions):.1f} N"),
            ("reference", str(kept)),
        ]


def home(
    rig: Rig,
    *,
    at_home: bool = False,
    pose: Pose | None = None,
    camera: str | Sequence[str] | None = None,
    tension: float | None = None,
    limit: float | None = None,
    reach: float = REACH,
    speed: float = SPEED,
    pictures: int = PICTURES,
    simulated_slack: float = SLACK,
    realtime: bool = True,
    need_real_time_rights: bool = True,
    listener: Listener = SILENT,
    confirm: Callable[[HomingProposal], bool] | None = None,
    supervisor: Supervisor | None = None,
) -> HomeResult:
    """Winds slack cables in until all are taut, then references the drives at a known pose.

    All winches together, slowly, each until its cable carries the pretension; a cable that carries
    too much, or none after the whole reach, stops all. Exactly one of `at_home`, `pose` and
    `camera` says how the pose is known.

    Args:
        rig: The robot and its bus.
        at_home: A jig holds the platform at the rig's home pose.
        pose: A jig holds it there, ``world_from_platform``.
        camera: It hangs free, and this camera measures it: a source or ``NAME=SOURCE``.
        tension: Pretension, [N]; None for twice the rig's smallest tension.
        limit: No cable may carry more, [N]; None for 60 % of the rig's range.
        reach: Take up at most this length of a cable, [m].
        speed: No winch is faster, [m/s].
        pictures: To measure the pose in.
        simulated_slack: How slack simulated cables hang at most, [m].
        realtime: False for simulated time, as fast as the computer can.
        need_real_time_rights: Refuse to move drives on a bus without real-time scheduling.
        listener: Receives progress.
        confirm: Called once, before anything moves; False cancels it. Without it the call itself
            is the decision to move.
        supervisor: Turns interrupts into stops; None for `KeyboardInterrupt`.

    Raises:
        BadInput: An argument cannot be used.
        Refused: The bus is latched, a limit cannot be kept, or the pose is not known well enough.
        HardwareMissing: A drive or the camera does not answer.
        Fault: It ended with a fault, which is latched; all drives stopped together and hold.
        StoppedByOperator: It was cancelled, or stopped; the drives hold.
    """
    in_process = is_simulated(rig)
    require_own_time(rig, realtime)
    sources = [camera] if isinstance(camera, str) else list(camera or [])
    require_one_pose(at_home, pose, sources)
    _require_slow(reach, speed, pictures)
    eye = choose_one_camera(rig, sources, in_process) if sources else None
    if eye is not None:
        require_simulated_pictures(eye[1:], not realtime)
    known = None if eye is not None else _stated_pose(rig, pose)
    limit = limit_of(rig, limit)
    target = _target(rig, tension, limit)
    speed = min(speed, rig.motion.speed)
    interlock = MotionInterlock(rig)
    interlock.require_free()
    if eye is not None:  # it gives images, before anything is moved for it
        look_at_rest(rig, eye, 1, rig.home, lambda: None, listener)
    fastest = float(wind_in_speed(rig, target, limit, speed).max())
    require_confirmed(confirm, HomingProposal(rig, target, limit, reach, speed, fastest, eye))
    made: list[HomingReference] = []

    def at_rest(
        stand: WinchesStand, true_pose: Pose | None, board: RequestBoard
    ) -> HomingReference:
        made.append(_referenced(rig, stand, true_pose, board, known, eye, pictures))
        return made[0]

    lost_power = None
    if in_process:
        from simulation.ground_truth import PowerLoss  # a real bus loads no simulator

        lost_power = PowerLoss.drawn(rig, 0, simulated_slack, on_a_stand=eye is None)
    motion = WinchMotion(
        rig=rig,
        pose=known or rig.home,
        limit=limit,
        speed=speed,
        make_law=partial(PretensionLaw, target=target, limit=limit, reach=reach, speed=speed),
        lost_power=lost_power,
        realtime=realtime,
        need_real_time_rights=need_real_time_rights,
        rehome=True,
        name="home",
        listener=listener,
        supervisor=supervisor or Supervisor(),
    )
    move_by_law(motion, at_rest)
    (reference,) = made
    return HomeResult(reference, None if in_process else interlock.file.path)


def use_rig_file_counts(
    rig: Rig, *, confirm: Callable[[ForgetProposal], bool] | None = None
) -> None:
    """Drops the reference: absolute encoders count what the rig file says. Moves nothing.

    Raises:
        Refused: The bus is latched, or not all encoders are absolute.
        StoppedByOperator: It was cancelled.
    """
    interlock = MotionInterlock(rig)
    require_confirmed(confirm, ForgetProposal(interlock))
    interlock.go_by_the_rig_file()


def require_one_pose(at_home: bool, pose: Pose | None, cameras: Sequence[str]) -> None:
    """The pose must be known by exactly one source.

    Raises:
        BadInput: It is not.
    """
    if (at_home, pose is not None, bool(cameras)).count(True) != 1:
        raise BadInput(
            "state the platform pose by exactly one of --at-home, --pose-mm and --camera",
            where="cdpr home",
            why="homing needs a known pose",
            next_step="put the platform on a jig and pass --at-home or --pose-mm X Y Z, or let it"
            " hang in view of a calibrated camera and pass --camera INDEX",
        )


def _require_slow(reach: float, speed: float, pictures: int) -> None:
    """Keeps the bounds of the command line for every caller.

    Raises:
        BadInput: A bound is exceeded.
    """
    bounds = (("reach", reach, FURTHEST, "m"), ("speed", speed, FASTEST, "m/s"))
    for name, value, largest, unit in bounds:
        if not 0.0 < value <= largest:
            raise BadInput(
                f"the {name} of {value:g} {unit} must be above 0 and at most {largest:g} {unit}",
                where="home",
                next_step=f"give a smaller {name}",
            )
    if not FEWEST_PICTURES <= pictures <= MOST_PICTURES:
        raise BadInput(
            f"{pictures} images: must be from {FEWEST_PICTURES} to {MOST_PICTURES}",
            where="home",
            next_step="give another number of images",
        )


def _stated_pose(rig: Rig, pose: Pose | None) -> Pose:
    """The pose in which a jig holds the platform; the rig's home without one.

    Raises:
        BadInput: It is outside the workspace.
    """
    if pose is None:
        return rig.home
    inside = (rig.workspace_lower <= pose.position) & (pose.position <= rig.workspace_upper)
    if not inside.all():
        raise BadInput(
            "the pose is outside the workspace",
            where="--pose-mm",
            next_step="give the position of the platform's origin in the world frame, in mm",
        )
    return pose


def _target(rig: Rig, tension: float | None, limit: float) -> float:
    """The pretension, [N].

    Raises:
        Refused: It leaves no room below the limit.
    """
    target = 2.0 * rig.min_tension if tension is None else tension
    if not rig.min_tension <= target <= 0.8 * limit:
        raise Refused(
            f"a pretension of {target:g} N must be from {rig.min_tension:g} N to 80 % of the"
            f" limit of {limit:g} N",
            where="--tension-n",
            why="cables must be taut afterwards, with headroom below the limit while winding in",
            next_step="set another pretension or limit",
        )
    return target


def _referenced(
    rig: Rig,
    stand: WinchesStand,
    true_pose: Pose | None,
    board: RequestBoard,
    known: Pose | None,
    eye: tuple[Camera, str] | None,
    pictures: int,
) -> HomingReference:
    """The reference at the pose where the platform is held now.

    Args:
        rig: The robot.
        stand: Where its winches stand, and the tensions.
        true_pose: Where the simulated platform is.
        board: Where a stop is wished.
        known: The stated pose; None where a camera measures it.
        eye: That camera, from `choose_one_camera`.
        pictures: How many it takes.

    Raises:
        StoppedByOperator: The operator stopped it while the camera looked.
        Refused: The pose is not known well enough.
    """
    if known is not None:
        return reference_at(rig, known, stand.counts, stand.tensions, "stated pose", 0.0)
    assert eye is not None

    def unless_stopped() -> None:
        if board.read().stop:
            raise StoppedByOperator(
                "stopped before the pose was measured; the cables are taut and held",
                next_step="home again when ready",
            )

    looks = look_at_rest(rig, eye, pictures, true_pose, unless_stopped, SILENT)
    found = static_pose(rig, looks)
    how = f"tags in {found.pictures} of {pictures} images, camera {eye[0].name!r}"
    return reference_at(rig, found.pose, stand.counts, stand.tensions, how, found.uncertainty)
