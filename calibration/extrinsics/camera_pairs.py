"""A camera's pose from another one's: both see the platform's tags, or a board, at the same time.

Each pair of images gives the pose of what both see in either camera, with its covariance; the
camera's pose is that which fits all pairs best. What both see may be anywhere, and need not be
where the drives put it. Errors of the other camera's pose stay errors of this one's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from calibration.extrinsics.result import (
    ExtrinsicCalibration,
    extrinsics_page,
    extrinsics_result,
    judge_extrinsics,
    place_facts,
    widths_of,
    workspace_corners,
)
from calibration.intrinsics.calibrate import NOT_FOUND
from calibration.pictures import USUAL_PICTURES, PicturesFrom, opened_pictures
from calibration.procedures import ExtrinsicsOutcome
from calibration.results import Calibration, Destination, Issue, data_hash
from calibration.tag_map.bundle_adjustment import require_tags
from calibration.tag_map.observations import TagSights, platform_pose, sights_of
from calibration.targets.boards import Board, Charuco, Seen
from calibration.targets.grids import TagGrid
from executor.kernels import ready_to_measure
from model.cameras import Z_95
from model.errors import BadInput
from model.pose import Array, Pose, lever_arm_matrix, matrix_from_rotation_vector, read_only
from model.progress import SILENT, Listener
from model.rig import Camera, Rig
from tracking.camera_model import Image, ideal_from_pixels, project_undistorted
from tracking.pnp import moved, pose_slopes

LEAST_PAIRS = 4
GOOD_PAIRS = 12
_HUBER = 2.0
"""Errors beyond this many deviations count linearly."""
_LEAST_SCATTER = 0.02
"""Corners of a board are no better than this, RMS along an axis, [px]."""


@dataclass(frozen=True, slots=True, eq=False)
class BodyLook:
    """Something rigid in one image.

    Attributes:
        camera_from_body: Its pose.
        covariance: Of position and rotation vector along the camera's axes, shape (6, 6), [m, rad].
        error: RMS of its corners, [px].
    """

    camera_from_body: Pose
    covariance: Array
    error: float


def looks_at_tags(rig: Rig, camera: Camera, sights: TagSights) -> dict[str, BodyLook]:
    """The platform in every image in which its tags allow one pose."""
    bundles = {n: platform_pose(rig, camera, squares) for n, squares in sights.squares.items()}
    return {
        name: BodyLook(bundle.camera_from_body, bundle.covariance, bundle.reprojection)
        for name, bundle in bundles.items()
        if bundle is not None
    }


def require_oriented(board: Board) -> None:
    """Only boards whose print shows which corner is which can be seen by two cameras.

    Raises:
        BadInput: The board looks the same turned by 180°.
    """
    if not isinstance(board, (Charuco, TagGrid)):
        raise BadInput(
            f"two cameras can take {board} turned by 180° against each other",
            next_step="use --board charuco or tags, or the tags of the platform",
        )


def look_at_board(board: Board, camera: Camera, image: Image) -> BodyLook | None:
    """A board in an image; None where it is not found."""
    seen = board.find(image)
    return None if seen is None else _board_pose(seen, camera)


def _board_pose(seen: Seen, camera: Camera) -> BodyLook | None:
    ideal = ideal_from_pixels(camera, seen.corners)
    good, turn, place = cv2.solvePnP(seen.points, ideal, camera.matrix, np.zeros(4))
    if not good:
        return None
    turn, place = cv2.solvePnPRefineLM(seen.points, ideal, camera.matrix, np.zeros(4), turn, place)
    pose = Pose(np.ravel(place).astype(np.float64), matrix_from_rotation_vector(np.ravel(turn)))
    slopes = pose_slopes(camera, seen.points, pose).reshape(-1, 6)
    errors = ideal - project_undistorted(camera, pose.apply(seen.points))
    freedom = max(errors.size - 6, 1)
    scatter = max(float(np.sum(errors**2)) / freedom, _LEAST_SCATTER**2)
    error = float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))
    return BodyLook(pose, np.asarray(scatter * np.linalg.inv(slopes.T @ slopes)), error)


def locate_by_pairs(
    rig: Rig,
    camera: Camera,
    reference: Camera,
    pairs: Mapping[str, tuple[BodyLook, BodyLook]],
    unused: Mapping[str, str],
    hash_of_data: str,
) -> ExtrinsicCalibration:
    """Finds a camera's place from another one's.

    Args:
        rig: Says where measurements matter.
        camera: Its matrix and distortion hold; its place in the rig file does not matter.
        reference: Its place holds.
        pairs: What this camera and the other one saw at the same time, by name.
        unused: Why other images are not used.
        hash_of_data: Of what was seen.

    Raises:
        BadInput: Too few pairs.
    """
    if len(pairs) < LEAST_PAIRS:
        raise BadInput(
            f"{len(pairs)} pairs of images show the same thing; {LEAST_PAIRS} are required",
            where=f"cameras {camera.name} and {reference.name}",
            why="; ".join(f"{name} {why}" for name, why in list(unused.items())[:4])
            or "images of the same moment have the same name in both folders",
            next_step="take images at the same moments, of tags that both cameras see",
        )
    looks = list(pairs.values())
    between, information, scores = _fitted(looks)
    turn = np.kron(np.eye(2), reference.world_from_camera.rotation)
    relative = turn @ np.linalg.inv(information.sum(axis=0)) @ turn.T
    whole = information.sum(axis=0)
    without = [
        np.asarray(turn @ np.linalg.solve(whole - own, score), dtype=np.float64)
        for own, score in zip(information, scores, strict=True)
    ]
    world_from_camera = reference.world_from_camera.compose(between)
    shared = _by_place(reference, world_from_camera)
    own_widths = widths_of(relative, without)
    lacks = []
    if len(pairs) < GOOD_PAIRS:
        what = f"{len(pairs)} pairs of images were used; {GOOD_PAIRS} are required"
        lacks.append(Issue(what, "take more, all over what both cameras see"))
    if reference.pose_covariance is None:
        what = f"how far off the pose of camera {reference.name!r} is, is not stated"
        lacks.append(Issue(what, "calibrate its extrinsics, and pass that result's file too"))
    error = float(np.sqrt(np.mean([look.error**2 for look, _ in looks])))
    return ExtrinsicCalibration(
        camera=replace(camera, world_from_camera=world_from_camera),
        by="another camera",
        covariance=read_only(relative + shared),
        by_lens=None,
        half_widths=read_only(np.hypot(own_widths, Z_95 * np.sqrt(np.diag(shared)))),
        points=workspace_corners(rig),
        tag_errors={} if not rig.platform_tags else {rig.platform_tags[0].id: error},
        pictures=len(pairs),
        unused=unused,
        lacks=tuple(lacks),
        data_hash=hash_of_data,
    )


def _by_place(reference: Camera, world_from_camera: Pose) -> Array:
    """Covariance of a pose by the place of the camera that measured it, (6, 6); 0 if unstated."""
    if reference.pose_covariance is None:
        return np.zeros((6, 6))
    by_place = lever_arm_matrix(world_from_camera.position - reference.world_from_camera.position)
    return np.asarray(by_place @ reference.pose_covariance @ by_place.T)


def _fitted(looks: Sequence[tuple[BodyLook, BodyLook]]) -> tuple[Pose, Array, Array]:
    """``reference_from_camera``, and what each pair says of it.

    Returns:
        The pose; information, shape (n, 6, 6), and half the slope of each pair's squares, (n, 6).
    """
    guesses = [far.camera_from_body.compose(near.camera_from_body.inverse()) for near, far in looks]
    middle = np.median([guess.position for guess in guesses], axis=0)
    start = min(guesses, key=lambda guess: float(np.linalg.norm(guess.position - middle)))
    turn = np.kron(np.eye(2), start.rotation)
    whitening = [
        np.linalg.inv(np.linalg.cholesky(far.covariance + turn @ near.covariance @ turn.T))
        for near, far in looks
    ]

    def errors(x: Array) -> Array:
        camera = moved(start, x)
        gaps = [_gap(camera.compose(near.camera_from_body), far) for near, far in looks]
        return np.array([w @ gap for w, gap in zip(whitening, gaps, strict=True)])

    found = least_squares(
        lambda x: errors(x).ravel(), np.zeros(6), loss="huber", f_scale=_HUBER, x_scale=1e-3
    )
    steps = 1e-6 * np.eye(6)
    slopes = np.stack([(errors(found.x + d) - errors(found.x - d)) / 2e-6 for d in steps], axis=-1)
    left = errors(found.x)
    weight = np.minimum(1.0, _HUBER / np.maximum(np.abs(left), 1e-12))
    scale = max(float(np.sum(weight * left**2)) / max(left.size - 6, 1), 1.0)
    weighted = np.swapaxes(slopes * weight[..., None], 1, 2)
    information = weighted @ slopes / scale
    scores = np.einsum("nij,nj->ni", weighted, left) / scale
    return moved(start, found.x), information, scores


def _gap(here: Pose, there: BodyLook) -> Array:
    """From where the other camera sees a body to where this one does, (6,), [m, rad]."""
    pose = there.camera_from_body
    turn = Rotation.from_matrix(here.rotation @ pose.rotation.T).as_rotvec()
    return np.concatenate([here.position - pose.position, turn])


def locate_camera_by_another(
    rig: Rig,
    camera: Camera,
    reference: Camera,
    sources: tuple[PicturesFrom, PicturesFrom],
    *,
    board: Board | None = None,
    wanted: float = 1e-3,
    output: Destination | str | Path | None = None,
    listener: Listener = SILENT,
) -> ExtrinsicsOutcome:
    """Finds where a camera is, by what another camera sees at the same time.

    Args:
        rig: The robot.
        camera: Its matrix and distortion hold.
        reference: Another of its cameras, whose pose holds as well.
        sources: Images of this and of the other camera; those of a moment have the same name.
        board: What both see; the tags of the platform when left out.
        wanted: What is good enough in the work space, 95 %, [m].
        output: Folder for the result file and its report; nothing is written when left out.
        listener: Receives how far it is.

    Raises:
        BadInput: Both are one camera, the board looks the same turned, or too few pairs.
    """
    if camera.name == reference.name:
        raise BadInput(
            f"camera {camera.name!r} cannot be located by itself",
            next_step="name another camera of the rig whose pose is known",
        )
    if board is None:
        require_tags(rig, None)
    else:
        require_oriented(board)
    to = Destination.of(output)
    to.require_free("extrinsics", camera.name)
    ready_to_measure(listener)
    seen: list[dict[str, BodyLook]] = []
    unused: dict[str, str] = {}
    for eye, source in zip((camera, reference), sources, strict=True):
        looks, left_out = _looks(rig, eye, source, board, listener)
        seen.append(looks)
        unused |= {f"{eye.name}: {name}": why for name, why in left_out.items()}
    own, others = seen
    alone = [name for name in own if name not in others]
    unused |= {f"{camera.name}: {n}": f"camera {reference.name} saw nothing then" for n in alone}
    pairs = {name: (look, others[name]) for name, look in own.items() if name in others}
    numbers = (
        name.encode() + np.round(look.camera_from_body.matrix(), 9).tobytes()
        for name, both in pairs.items()
        for look in both
    )
    found = locate_by_pairs(rig, camera, reference, pairs, unused, data_hash(numbers))
    verdict = judge_extrinsics(found, wanted)
    result = extrinsics_result(found, verdict, rig.document, to.on)
    page = extrinsics_page(found, result, verdict, camera.world_from_camera)
    facts = place_facts(found, camera.world_from_camera)
    return Calibration(result, page, found, verdict, facts).saved_in(to.folder)


def _looks(
    rig: Rig, camera: Camera, source: PicturesFrom, board: Board | None, listener: Listener
) -> tuple[dict[str, BodyLook], dict[str, str]]:
    """What a camera saw by image, and why other images are not used."""
    pictures = opened_pictures(source, camera, USUAL_PICTURES)
    found: dict[str, BodyLook] = {}
    unused = dict(pictures.unused)
    with pictures.reported(f"camera {camera.name}", listener) as images:
        if board is None:
            numbers = [tag.id for tag in rig.platform_tags]
            sights = sights_of(images, rig, camera, numbers, unused)
            found, unused = looks_at_tags(rig, camera, sights), dict(sights.unused)
            unused |= {n: "allows no unique pose" for n in sights.squares if n not in found}
            return found, unused
        for name, image in images:
            look = look_at_board(board, camera, image)
            if look is None:
                unused[name] = NOT_FOUND
            else:
                found[name] = look
    return found, unused
