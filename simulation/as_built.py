"""The rig that is simulated, which need not be the one that its file describes.

Only this package looks into the rig file's ``simulation`` section.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cdpr.document_types import PoseDocument
from cdpr.errors import BadInput
from cdpr.poses import Array, read_only
from cdpr.rig import Camera, Rig, rig_from_document
from cdpr.simulation_file import (
    SimulatedCameraDocument,
    SimulatedWinchesDocument,
    SimulationDocument,
)
from simulation.optics import Optics


def simulation_of(rig: Rig) -> SimulationDocument:
    """The imperfections of a rig; a perfect one has none."""
    return rig.document.simulation or SimulationDocument()


def rig_as_built(rig: Rig) -> Rig:
    """The rig with its true geometry: outlets, anchors, drums, pulleys, counts at home.

    Raises:
        BadInput: There is no such rig.
    """
    truth = simulation_of(rig).as_built
    if truth is None:
        return rig
    document = rig.document
    winches = [
        winch.model_copy(update={"drum_mm_per_rev": drum, "home_counts": round(home)})
        for winch, drum, home in zip(
            document.winches, truth.drums_mm_per_rev, truth.home_counts, strict=True
        )
    ]
    changes = {
        "outlets_mm": truth.outlets_mm,
        "anchors_mm": truth.anchors_mm,
        "winches": winches,
    }
    if document.pulleys is not None:
        radius = {"radius_mm": truth.pulley_radius_mm}
        changes["pulleys"] = document.pulleys.model_copy(update=radius)
    return rig_from_document(document.model_copy(update=changes))


def stiffness_as_built(rig: Rig) -> Array | None:
    """Axial stiffness of each cable, shape (m,), [N]; None where the rig file tells it."""
    truth = simulation_of(rig).as_built
    if truth is None or truth.stiffness_n is None:
        return None
    return read_only(truth.stiffness_n)


def winches_as_built(rig: Rig) -> SimulatedWinchesDocument:
    """Backlash, steps and noise of the simulated winches."""
    return simulation_of(rig).winches


def camera_as_built(rig: Rig, camera: Camera) -> tuple[Camera, Optics]:
    """The camera that truly takes the pictures, and what its lens and sensor do to them.

    Raises:
        BadInput: The true lens has a number of distortion coefficients that OpenCV does not know.
    """
    found = [c for c in simulation_of(rig).cameras if c.name == camera.name]
    if not found:
        return camera, Optics()
    truth = found[0]
    optics = Optics(
        noise=truth.noise,
        vignetting=truth.vignetting,
        blur=truth.blur_px,
        exposure=truth.exposure_ms / 1e3,
        light=truth.light,
        cables=truth.cables,
    )
    return _moved(_with_lens(camera, truth), truth.world_from_camera), optics


def _with_lens(camera: Camera, truth: SimulatedCameraDocument) -> Camera:
    lens = truth.lens
    if lens is None:
        return camera
    if len(lens.distortion) not in (0, 4, 5, 8, 12, 14):
        raise BadInput(
            f"needs 0, 4, 5, 8, 12 or 14 coefficients, it has {len(lens.distortion)}",
            where=f"simulation.cameras: {truth.name}: lens.distortion",
        )
    matrix = [[lens.fx_px, 0.0, lens.cx_px], [0.0, lens.fy_px, lens.cy_px], [0.0, 0.0, 1.0]]
    distortion = read_only(np.array(lens.distortion))
    return replace(camera, matrix=read_only(matrix), distortion=distortion)


def _moved(camera: Camera, place: PoseDocument | None) -> Camera:
    return camera if place is None else replace(camera, world_from_camera=place.pose())
