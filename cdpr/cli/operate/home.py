"""`cdpr home`: pretensions the cables and sets the encoder reference."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from shlex import join

from cdpr.cli.arguments import flag, given_options, option
from cdpr.cli.operate.run import MotionOptions
from cdpr.cli.options import (
    CALIBRATION,
    CHANNEL,
    INTERFACE,
    RIG,
    Triple,
    level_pose,
    require_unused,
    rig_on_bus,
    words_of,
)
from cdpr.cli.output import out, show_facts, show_json, show_line
from executor import homing


@dataclass(frozen=True, slots=True)
class WindingOptions:
    """Settings of pretension and pose measurement; every field is an option."""

    tension_n: float | None = option(
        "pretension of every cable (default: the tensions planned at a stated pose; with --camera"
        " twice the rig's smallest tension)"
    )
    limit_n: float | None = option("tension limit of any cable (default: 60 % of the range)")
    reach_mm: float = option(
        "largest length to wind in per cable",
        default=1000.0 * homing.REACH,
        min=0.1,
        max=1000.0 * homing.FURTHEST,
    )
    speed_mm_s: float = option(
        "largest winch speed", default=1000.0 * homing.SPEED, min=0.01, max=1000.0 * homing.FASTEST
    )
    pictures: int = option(
        "number of images for the pose",
        default=homing.PICTURES,
        min=homing.FEWEST_IMAGES,
        max=homing.MOST_IMAGES,
    )
    simulated_slack_mm: float = option(
        "largest slack of simulated cables", default=1000.0 * homing.SLACK, min=0.0, max=100.0
    )


def home(
    *,
    rig: Path = RIG,
    at_home: bool = flag("a jig holds the platform at the rig's home pose"),
    pose_mm: Triple | None = option("a jig holds the platform level at x y z"),
    camera: list[str] | None = option(
        "the platform hangs freely and a camera measures it: 'synthetic', an index, or"
        " NAME=SOURCE for a camera other than the rig file's first",
        metavar="SOURCE",
    ),
    calibration: list[Path] | None = CALIBRATION,
    output: Path | None = option(
        "record folder to create (default: runs/home, runs/home-2 …; none with simulated drives)",
        "-o",
        "--output",
    ),
    as_rig_file: bool = flag("move nothing: absolute encoders agree with the rig file"),
    winding: WindingOptions,
    interface: str | None = INTERFACE,
    channel: str | None = CHANNEL,
    motion: MotionOptions,
    as_json: bool = flag("print the reference as JSON", "--json"),
) -> None:
    """Pretension all cables, then set the encoder reference at a known pose.

    All winches wind in slowly together, each until its cable carries the pretension; a cable above
    the limit, or still slack after the full reach, stops all. The reference is stored in a file
    that `cdpr run` and `cdpr jog` use. With the interface 'virtual' it is a rehearsal.

    Examples:
      cdpr home rig.yaml --at-home
      cdpr home configs/gachon_8_6.yaml --camera synthetic --fast
    """
    the_rig = rig_on_bus(rig, interface, channel, calibration)
    if as_rig_file:
        if at_home or pose_mm or camera:
            homing.require_one_pose(False, None, [])
        unused = given_options(winding) | given_options(motion)
        unused |= {"--output": output, "--yes": None}
        require_unused("cdpr home", unused, "--as-rig-file neither moves nor measures")
        homing.use_rig_file_counts(the_rig, confirm=motion.confirmation(the_rig, as_json))
        if as_json:
            show_json({"file": None})
        else:
            out.print("no reference is stored; drives match the rig file at home")
        return
    result = homing.home(
        the_rig,
        at_home=at_home,
        pose=level_pose(pose_mm),
        camera=camera,
        tension=winding.tension_n,
        limit=winding.limit_n,
        reach=winding.reach_mm / 1000.0,
        speed=winding.speed_mm_s / 1000.0,
        pictures=winding.pictures,
        simulated_slack=winding.simulated_slack_mm / 1000.0,
        folder=output,
        **motion.arguments(the_rig, as_json),
    )
    if as_json:
        written = {"file": result.file, "record": result.folder}
        files = {name: path and str(path) for name, path in written.items()}
        show_json({**files, **result.reference.model_dump(mode="json")})
    else:
        show_facts("drives homed; they hold", result.facts())
        same = words_of(interface=interface, channel=channel, calibration=calibration)
        show_line(
            f"next: `cdpr jog {join([str(rig), *same])} --to-home --scene SCENE` (`--no-scene`"
            " without obstacles, `--by-mm X Y Z` by a distance), then `cdpr plan` and `cdpr run`"
        )
