"""The tags of a rig in many pictures of one camera, and why others are of no use."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from calibration.data_hash import data_hash
from calibration.same_view import as_in, nothing_moved
from cdpr.errors import BadInput
from cdpr.rig import Camera, Rig
from tracking.detector import Detection
from tracking.detectors import make_detector
from tracking.edges import RefinedTag, refine
from tracking.marks import modules_across
from tracking.other_tags import what_else_is_seen
from tracking.picture import Image


@dataclass(frozen=True, slots=True, eq=False)
class TagSights:
    """Whole tags that were seen.

    Attributes:
        squares: Of every picture that shows some, by its name: the tags' squares by number.
        unused: Why a picture, or a tag in it, is not used, by name.
    """

    squares: Mapping[str, Mapping[int, RefinedTag]]
    unused: Mapping[str, str]

    @property
    def numbers(self) -> tuple[int, ...]:
        """Numbers of the tags that were seen."""
        return tuple(sorted({number for squares in self.squares.values() for number in squares}))

    def without(self, unused: Mapping[str, str]) -> TagSights:
        """The sights without some more pictures, and why."""
        left = {name: squares for name, squares in self.squares.items() if name not in unused}
        return TagSights(left, {**self.unused, **unused})

    def each_view_once(self) -> TagSights:
        """Without pictures in which all tags are where another, which shows no fewer, has them."""
        kept: dict[str, Mapping[int, RefinedTag]] = {}
        unused = {}
        for name, squares in sorted(self.squares.items(), key=lambda sight: -len(sight[1])):
            first = next((n for n, before in kept.items() if _alike(squares, before)), None)
            if first is None:
                kept[name] = squares
            else:
                unused[name] = as_in(first)
        return self.without(unused)

    def data_hash(self) -> str:
        """Hash of what was seen."""
        return data_hash(
            f"{name} {number}".encode() + np.round(square.corners, 6).tobytes()
            for name, squares in self.squares.items()
            for number, square in sorted(squares.items())
        )


def sights_of(
    pictures: Iterable[tuple[str, Image]],
    rig: Rig,
    camera: Camera,
    wanted: Collection[int],
    unused: Mapping[str, str] | None = None,
) -> TagSights:
    """Looks for tags.

    A number that is seen twice in a picture is left out there: nobody knows which is the rig's.
    A copy of a picture is left out: it tells nothing more. Pictures of a camera that stands still
    differ by their noise at least.

    Args:
        pictures: Names and grey pictures of the camera's size.
        rig: Its family of tags, and what finds them.
        camera: Its matrix and distortion hold.
        wanted: Their numbers.
        unused: Pictures that were left out before, with the reasons.

    Raises:
        BadInput: No picture shows any of them whole.
    """
    family = rig.tag_family
    detector, modules = make_detector(rig.tag_detector, family), modules_across(family)
    found: dict[str, Mapping[int, RefinedTag]] = {}
    left_out = dict(unused or {})
    example: tuple[str, Image] | None = None
    names: dict[bytes, str] = {}
    for name, image in pictures:
        first = names.setdefault(hashlib.sha256(image.tobytes()).digest(), name)
        if first != name:
            left_out[name] = f"is the same picture as {first}"
            continue
        mine = [d for d in detector.detect_all(image) if d.id in wanted]
        twice = [number for number, count in Counter(d.id for d in mine).items() if count > 1]
        left_out |= {f"{name}, tag {number}": "is seen more than once" for number in twice}
        squares = _whole(image, camera, [d for d in mine if d.id not in twice], modules)
        if squares:
            found[name] = squares
        elif not twice:
            left_out[name] = "shows none of the tags whole"
            example = example or (name, image)
    if not found:
        raise _nothing_seen(camera, family, wanted, left_out, example)
    return TagSights(found, left_out)


def _alike(squares: Mapping[int, RefinedTag], before: Mapping[int, RefinedTag]) -> bool:
    both = squares.keys() & before.keys()
    if not both:
        return False
    corners, earlier = (np.array([one[k].corners for k in both]) for one in (squares, before))
    return nothing_moved(corners, earlier)


def _whole(
    image: Image, camera: Camera, detections: list[Detection], modules: int
) -> dict[int, RefinedTag]:
    corners = np.array([d.corners for d in detections]).reshape(-1, 4, 2)
    squares = refine(image, camera, corners, modules)
    pairs = zip(detections, squares, strict=True)
    return {d.id: square for d, square in pairs if square is not None and square.whole}


def _nothing_seen(
    camera: Camera,
    family: str,
    wanted: Collection[int],
    unused: Mapping[str, str],
    example: tuple[str, Image] | None,
) -> BadInput:
    why = "; ".join(f"{name} {reason}" for name, reason in list(unused.items())[:4])
    if example is not None:
        name, image = example
        why += f"; {name} shows {what_else_is_seen(image, family, list(wanted))}"
    return BadInput(
        f"none of the {family} tags {', '.join(map(str, wanted))} is to be seen whole",
        where=f"camera {camera.name}",
        why=why,
        next_step="check that the camera sees them, that the light suffices, and that the rig file"
        " names the family and numbers of the printed tags",
    )
