"""Choice of the rig's cameras, and the image source of each."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import numpy as np

from model.errors import BadInput, require_not_empty, sequence_of
from model.files.reading import SECONDS_SINCE_1970, docs_page, is_folder
from model.progress import Listener
from model.rig import Camera, Rig

SYNTHETIC = "synthetic"

OneCamera = str | int | Path
"""Image source of a live camera: its index, device file or address; or ``NAME=SOURCE``."""
CameraChoice = OneCamera | Sequence[OneCamera] | Mapping[str, OneCamera] | None
"""``synthetic`` for all cameras of the rig file, one source, ``NAME=SOURCE`` for each of several, a
mapping from names to sources, an empty one for no camera; None for the default: all synthetic where
the drives are simulated in this process, an error on a bus."""


def choose_camera(rig: Rig, wanted: str | None, without: bool, in_process: bool) -> str | None:
    """The image source: ``synthetic``, a camera's index or address, or None.

    Raises:
        BadInput: The request cannot be met; nothing is ignored silently.
    """
    if without:
        if wanted is not None:
            raise BadInput(
                "--camera and --no-camera contradict each other", next_step="leave out one of them"
            )
        return None
    if not rig.is_tracked:
        raise BadInput(
            "the rig file has no camera or no tags",
            where=rig.name,
            next_step="add cameras and tags to the rig file, as in the example of"
            f" {docs_page('rig-file.md')}, or run without a camera: --no-camera, in Python"
            " cameras=[]",
        )
    if wanted is None:
        if not in_process:
            raise BadInput(
                "no camera was named",
                where="`cameras=`",
                why="the drives are not simulated in this process, so no image can be rendered",
                next_step="name a real camera: --camera INDEX, in Python cameras=INDEX; or run"
                " without one: --no-camera, cameras=[]",
            )
        return SYNTHETIC
    if wanted == SYNTHETIC and not in_process:
        raise BadInput(
            "the synthetic camera needs drives simulated in this process",
            where="`cameras=`",
            next_step="use the interface 'virtual', a real camera, or none: --no-camera, in Python"
            " cameras=[]",
        )
    if wanted != SYNTHETIC:
        _require_live(wanted)
    return wanted


def _require_live(source: str) -> None:
    """Refuses recordings, which do not show the moving platform."""
    if not is_camera(source):
        raise BadInput(
            f"{source!r} is not a live camera source",
            where="`cameras=`",
            why="images must be taken during the motion, not read from a file or folder",
            next_step="name an index such as 0, a device such as /dev/video0, or an address",
        )


def choose_cameras(
    rig: Rig, wanted: list[str], without: bool, in_process: bool
) -> dict[Camera, str]:
    """The cameras of a run, and the image source of each.

    Args:
        rig: The robot with its cameras.
        wanted: One source, or ``NAME=SOURCE`` for each of several cameras; ``synthetic`` or an
            empty list selects all cameras.
        in_process: The drives are simulated in this process.

    Raises:
        BadInput: The request cannot be met; nothing is ignored silently.
    """
    if not wanted:
        source = choose_camera(rig, None, without, in_process)
        return {} if source is None else dict.fromkeys(rig.cameras, source)
    if wanted == [SYNTHETIC]:
        choose_camera(rig, SYNTHETIC, without, in_process)
        return dict.fromkeys(rig.cameras, SYNTHETIC)
    if rig.cameras:
        chosen = parse_camera_sources(rig, wanted, None, "`cameras=`")
        for source in chosen.values():
            choose_camera(rig, source, without, in_process)
        return chosen
    choose_camera(rig, wanted[0], without, in_process)
    return {}


def resolve_cameras(rig: Rig, wanted: CameraChoice, in_process: bool) -> dict[Camera, str]:
    """The cameras of a run, from the argument of a library call.

    Args:
        wanted: See `CameraChoice`.
        in_process: The drives are simulated in this process.

    Raises:
        BadInput: As for `choose_cameras`.
    """
    if wanted is None:
        return choose_cameras(rig, [], False, in_process)
    if isinstance(wanted, Mapping):
        wanted = [f"{name}={source}" for name, source in wanted.items()]
    sources = source_texts("cameras", wanted)
    return choose_cameras(rig, sources, not sources, in_process)


def source_texts(name: str, wanted: OneCamera | Sequence[OneCamera]) -> list[str]:
    """One source or several, as texts.

    Args:
        name: Of the argument, for messages.
        wanted: As the caller gave it.

    Raises:
        BadInput: It is neither.
    """
    if isinstance(wanted, str | int | Path | np.integer):
        return [str(wanted)]
    return [str(source) for source in sequence_of(name, wanted)]


def choose_one_camera(rig: Rig, wanted: list[str], in_process: bool) -> tuple[Camera, str]:
    """The single camera that measures a platform at rest, and its image source.

    Args:
        wanted: One source, or ``NAME=SOURCE``.
        in_process: The drives are simulated in this process.

    Raises:
        BadInput: There are several, or the request cannot be met.
    """
    if len(wanted) != 1:
        raise BadInput(
            f"{len(wanted)} cameras are given; only one can be used",
            where="`camera=`",
            next_step="name the one that sees the most tags from the shortest distance",
        )
    ((camera, source),) = parse_camera_sources(rig, wanted, None, "`camera=`").items()
    choose_camera(rig, source, False, in_process)
    return camera, source


def parse_camera_sources(
    rig: Rig, sources: list[str], wanted: str | None, where: str = "track"
) -> dict[Camera, str]:
    """The image source of each camera.

    Args:
        rig: The robot with its cameras.
        sources: One source, or ``NAME=SOURCE`` for each of several cameras.
        wanted: The camera of a single source; None for the rig's first.
        where: Origin of the sources, for messages.

    Raises:
        BadInput: No or an empty source; a camera is unknown, named twice, or not named.
    """
    if not sources:
        raise BadInput("no image source is given", where=where, next_step="name one, such as 0")
    names = [camera.name for camera in rig.cameras]
    for source in sources:
        require_not_empty("the image source", source)
    if len(sources) == 1 and _is_unnamed(sources[0], names):
        return {rig.camera(wanted): sources[0]}
    if wanted is not None:
        raise BadInput(
            "`camera=` is for a single source without a name",
            where=where,
            next_step="leave it out, or name the camera in the source: NAME=SOURCE",
        )
    chosen: dict[Camera, str] = {}
    for source in sources:
        camera, address = parse_named_source(rig, source, where)
        if camera in chosen:
            raise BadInput(
                f"camera {camera.name!r} has two sources",
                where=where,
                next_step="name each camera once",
            )
        _require_own(address, chosen, camera.name, where)
        chosen[camera] = address
    return chosen


def parse_named_source(rig: Rig, source: str, where: str) -> tuple[Camera, str]:
    """The camera and the image source of ``NAME=SOURCE``.

    Args:
        rig: The robot with its cameras.
        where: Its origin, for messages.

    Raises:
        BadInput: A part is missing, or the camera is unknown.
    """
    names = [camera.name for camera in rig.cameras]
    name, sign, address = source.partition("=")
    if name in names and not address:
        raise BadInput(
            f"camera {name!r} has no source",
            where=where,
            next_step=f"write {name}=0, or its image source",
        )
    if not sign or "://" in name:
        raise BadInput(
            f"the source {source!r} does not name its camera",
            where=where,
            next_step=f"write NAME={source}, NAME one of: {', '.join(names)}",
        )
    return rig.camera(name), address


def _is_unnamed(source: str, names: list[str]) -> bool:
    """Whether a source names no camera: ``0``, an address or a path, and not ``WORD=0``."""
    word, sign, _ = source.partition("=")
    if not sign:
        return word not in names or Path(source).exists()
    return "://" in word or (word not in names and Path(source).exists())


def _require_own(address: str, chosen: Mapping[Camera, str], name: str, where: str) -> None:
    """Requires different sources for different cameras."""
    for camera, other in chosen.items():
        if address != SYNTHETIC and _device(address) == _device(other):
            raise BadInput(
                f"cameras {camera.name!r} and {name!r} have the same source {address!r}",
                where=where,
                next_step="give each camera its own source",
            )


def _device(source: str) -> str:
    """Canonical name of a source: ``00`` and ``/dev/video0`` are the same, and a path's links."""
    if "://" in source:
        kind, _, rest = source.partition("://")
        server, sign, path = rest.partition("/")
        user, at, host = server.rpartition("@")
        return f"{kind.lower()}://{user}{at}{host.lower()}{sign or '/'}{path}"
    with suppress(OSError, RuntimeError, ValueError):  # such as a loop of links, or a null byte
        if source.isdecimal() and not Path(source).exists():
            source = f"/dev/video{source.lstrip('0') or '0'}"
        return str(Path(source).resolve())
    return source


def require_camera_source(source: str) -> None:
    """Requires a source that can be a camera.

    Raises:
        BadInput: It is neither a number nor a device nor an address.
    """
    if not is_camera(source):
        raise BadInput(
            "not a folder of images, a video file or a camera",
            where=source,
            next_step="check the path; a camera is an index such as 0, /dev/video0 or an address",
        )


def is_camera(source: str) -> bool:
    """Whether it can be a camera: a number, a device or an address, not a file."""
    if source.startswith("/dev/"):
        return not (Path(source).is_file() or Path(source).is_dir())
    return source.isdecimal() or ("://" in source and not source.startswith("file:"))


def require_synthetic_images(sources: Iterable[str], fast: bool) -> None:
    """Requires synthetic cameras in simulated time, where real image times are meaningless.

    Raises:
        BadInput: A run is fast, and a source is a real camera.
    """
    real = [source for source in sources if source != SYNTHETIC]
    if fast and real:
        raise BadInput(
            "`realtime=False` needs synthetic cameras",
            where=f"`cameras={real[0]}`",
            why="a real camera takes images in real time; a fast run would end before the"
            " first one",
            next_step="leave out `realtime=False`, or pass `cameras='synthetic'`",
        )


# Which images are requested, which of several cameras are simultaneous, and which are missing.


def cycles_per_image(rate: float, cycle: float) -> int:
    """Cycles between requested images: the fewest in which a camera always takes another one.

    Args:
        rate: Of the camera's images, [Hz].
        cycle: [s].
    """
    return max(1, math.ceil(1.0 / (rate * cycle) - 1e-9))


def require_plan_used(sources: Iterable[str], plan: object | None) -> None:
    """Refuses a plan if no source renders images of it.

    Raises:
        BadInput: No source is ``synthetic``.
    """
    named = list(sources)
    if plan is not None and SYNTHETIC not in named:
        raise BadInput(
            "`plan=` is for the synthetic camera",
            where="track",
            why=f"images come from {', '.join(named)}",
            next_step="name the obstacles with `scene=`, or the source 'synthetic'",
        )


def require_one_kind(sources: Mapping[str, str]) -> None:
    """Refuses to pair images of folders, videos, live and synthetic cameras with each other.

    Args:
        sources: Of each camera, by its name.

    Raises:
        BadInput: They are of different kinds.
    """
    kinds = {name: _kind(source) for name, source in sources.items()}
    if len(set(kinds.values())) > 1:
        raise BadInput(
            "the cameras' sources are of different kinds, so their images cannot be paired",
            where=", ".join(f"{name}={source} ({kinds[name]})" for name, source in sources.items()),
            why="simultaneous images have the same name in folders, and the same time in videos",
            next_step="pass only folders, only videos, only live or only synthetic cameras",
        )


def _kind(source: str) -> str:
    if is_folder(Path(source)):
        return "a folder"
    if Path(source).is_file():
        return "a video"
    return "synthetic" if source == SYNTHETIC else "live"


def report_different_videos(videos: Mapping[str, tuple[int, float]], listener: Listener) -> None:
    """Remarks on videos of different length or rate: they may not have begun together.

    Args:
        videos: Number of images, and rate [Hz], of that of each camera.
    """
    if len({(count, round(rate, 3)) for count, rate in videos.values()}) > 1:
        facts = ", ".join(f"{n} {count} at {rate:.6g}/s" for n, (count, rate) in videos.items())
        listener.remark(
            f"the videos have different numbers of images or rates ({facts}); images are paired by"
            " their times from the beginning of each, which must be simultaneous"
        )


#: HHMMSS, HHMMSSmmm or HH-MM-SS at the end, perhaps after a date.
_TIME_OF_DAY = re.compile(r"(?<!\d)(?:\d{8})?([01]\d|2[0-3])(\D?)([0-5]\d)\2([0-5]\d)(\d{3})?$")
#: Two numbers at the end: perhaps seconds and a fraction of them.
_TWO_NUMBERS = re.compile(r"(.*?(\d+))(\D)(\d+)")
#: A fraction of seconds has at least so many digits; with fewer than `_FINE` it may be a number of
#: images, which rarely exceeds half of those that its digits can count.
_COARSE, _FINE = 3, 6


def report_gap(names: Sequence[str], listener: Listener) -> None:
    """Remarks on images that seem to be missing, by the names of the others in natural order."""
    if gap := first_gap(names):
        listener.remark(
            f"images seem to be missing between {' and '.join(gap)}: times are those of consecutive"
            " images, so later ones are too early, and the next poses of a camera with readout_ms"
            " are wrong"
        )


def first_gap(names: Sequence[str]) -> tuple[str, str] | None:
    """The first names between which images seem to be missing, by the last number of each.

    The numbers increase, and most by about the same step, which is 1, 10 or that of time stamps.
    Those that can all be times of day are taken as such; those that do not increase, as fractions
    of the seconds before them.

    Args:
        names: In natural order.
    """
    stems = [Path(name).stem for name in names]
    last = [number for stem in stems for number in re.findall(r"\d+", stem)[-1:]]
    if len(last) < 3 or len(last) < len(stems):
        return None
    times = _times_of_day(stems)
    for counts in [times] if times else [list(map(int, last)), _times_with_fraction(stems)]:
        steps = [after - before for before, after in pairwise(counts)]
        if min(steps, default=0) > 0:
            usual = sorted(steps)[(len(steps) - 1) // 2]
            gaps = (k for k, step in enumerate(steps) if step > 1.5 * usual)
            return next(((names[k], names[k + 1]) for k in gaps), None)
    return None


def _times_of_day(stems: Iterable[str]) -> list[int]:
    """Those at the ends of all names, [ms]; empty if a name has none."""
    found = [_TIME_OF_DAY.search(stem) for stem in stems]
    parts = [time.group(1, 3, 4, 5) for time in found if time is not None]
    numbers = [[int(part or 0) for part in time] for time in parts]
    times = [((h * 60 + m) * 60 + s) * 1000 + ms for h, m, s, ms in numbers]
    return times if len(times) == len(found) else []


def _times_with_fraction(stems: Iterable[str]) -> list[int]:
    """Times of names that end in seconds and a fraction of them, in units of its last digit.

    The seconds are those of a time of day, or since 1970, or any number before a decimal point.
    Empty for other names.
    """
    found = [_TWO_NUMBERS.fullmatch(stem) for stem in stems]
    named = [two.groups() for two in found if two is not None]
    fractions = [fraction for *_, fraction in named]
    digits = max(map(len, fractions), default=0)
    are_decimals = all(sign == "." for _, _, sign, _ in named)
    are_even = are_decimals or min(map(len, fractions), default=0) == digits
    are_fractions = digits >= _FINE or (digits >= _COARSE and max(fractions) >= "5")
    if len(named) < len(found) or not (are_even and are_fractions):
        return []
    seconds = [time // 1000 for time in _times_of_day(whole for whole, *_ in named)]
    if not seconds and (are_decimals or all(len(n) >= SECONDS_SINCE_1970 for _, n, *_ in named)):
        seconds = [int(number) for _, number, *_ in named]
    fine = [int(fraction.ljust(digits, "0")) for fraction in fractions]
    return [s * 10**digits + part for s, part in zip(seconds, fine, strict=False)]
