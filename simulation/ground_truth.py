"""Ground truth of the simulation, which may differ from the rig file.

Only this package reads the rig file's ``simulation`` section.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from model.errors import BadInput
from model.files.camera_file import require_coefficients
from model.files.documents import PoseDocument
from model.files.rig_file import RigDocument
from model.files.simulation_file import (
    SimulatedCameraDocument,
    SimulatedTagsDocument,
    SimulatedWinchesDocument,
    SimulationDocument,
)
from model.pose import Array, read_only
from model.rig import Camera, Rig, rig_from_document
from simulation.drives.power import Motor
from simulation.plant import Plant

# Effects of the synthetic camera's lens and sensor.


@dataclass(frozen=True, slots=True)
class Optics:
    """Effects of lens, sensor, lamp and cables on images.

    Attributes:
        noise: Standard deviation, [grey levels of 255].
        vignetting: Fraction of light lost in the corners of the image.
        blur: Standard deviation of the lens's and focus's blur, [px].
        exposure: Exposure time, which causes motion blur, [s]; 0 for sharp images.
        light: Fraction of full light; less reduces contrast, more overexposes.
        cables: Cables are visible and occlude.
        halo: Brightness of a lamp's halo at its centre, fraction of white.
        shadow: Fraction of light that a shadow across the image removes.
        sharpening: Strength of unsharp masking.
        enlarged: Ratio of image to sensor resolution, per axis.
        jpeg: Quality of the image's compression; 100 for none.
    """

    noise: float = 1.5
    vignetting: float = 0.25
    blur: float = 0.0
    exposure: float = 0.0
    light: float = 1.0
    cables: bool = True
    halo: float = 0.0
    shadow: float = 0.0
    sharpening: float = 0.0
    enlarged: int = 1
    jpeg: int = 100


def simulation_of(rig: Rig) -> SimulationDocument:
    """The imperfections of a rig, none by default."""
    return rig.document.simulation or SimulationDocument()


def rig_as_built(rig: Rig) -> Rig:
    """The rig with its true geometry: outlets, anchors, drums, pulleys, counts at home, and tags.

    Raises:
        BadInput: The true geometry is invalid.
    """
    truth, document = simulation_of(rig).as_built, _with_true_tags(rig.document)
    if truth is None:
        return rig if document is rig.document else rig_from_document(document)
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


def _with_true_tags(document: RigDocument) -> RigDocument:
    """The rig file's content with the true tags; itself if none are stated."""
    true = document.simulation.tags if document.simulation else SimulatedTagsDocument()
    if document.tags is None or not (true.platform or true.frame):
        return document
    changes = {}
    for part, tags in (("platform", true.platform), ("frame", true.frame)):
        placed = {tag.id: tag for tag in tags}
        changes[part] = [placed.get(tag.id, tag) for tag in getattr(document.tags, part)]
    return document.model_copy(update={"tags": document.tags.model_copy(update=changes)})


def stiffness_as_built(rig: Rig) -> Array | None:
    """Axial stiffness of each cable, shape (m,), [N]; None if as in the rig file."""
    truth = simulation_of(rig).as_built
    if truth is None or truth.stiffness_n is None:
        return None
    return read_only(truth.stiffness_n)


def winches_as_built(rig: Rig) -> SimulatedWinchesDocument:
    """Backlash, steps and noise of the simulated winches."""
    return simulation_of(rig).winches


def camera_as_built(rig: Rig, camera: Camera) -> tuple[Camera, Optics]:
    """The true camera, and the effects of its lens and sensor.

    Raises:
        BadInput: The true lens has an unsupported number of distortion coefficients.
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
        halo=truth.halo,
        shadow=truth.shadow,
        sharpening=truth.sharpening,
        enlarged=truth.enlarged,
        jpeg=truth.jpeg_quality,
    )
    moved = _moved(_with_lens(camera, truth), truth.world_from_camera)
    if truth.readout_ms is not None:
        moved = replace(moved, readout=truth.readout_ms / 1e3)
    if truth.latency_ms is not None:
        moved = replace(moved, latency=truth.latency_ms / 1e3)
    if truth.gamma is not None:
        moved = replace(moved, gamma=truth.gamma)
    return moved, optics


def _with_lens(camera: Camera, truth: SimulatedCameraDocument) -> Camera:
    lens = truth.lens
    if lens is None:
        return camera
    try:
        require_coefficients(lens.lens, len(lens.distortion))
    except ValueError as error:
        where = f"simulation.cameras: {truth.name}: lens.distortion"
        raise BadInput(str(error), where=where) from None
    matrix = [[lens.fx_px, 0.0, lens.cx_px], [0.0, lens.fy_px, lens.cy_px], [0.0, 0.0, 1.0]]
    distortion = read_only(np.array(lens.distortion))
    return replace(camera, matrix=read_only(matrix), distortion=distortion, lens=lens.lens)


def _moved(camera: Camera, pose: PoseDocument | None) -> Camera:
    return camera if pose is None else replace(camera, world_from_camera=pose.pose())


# State of a rig after a power loss: arbitrary encoder counts, slack cables.
#: Largest offset of the counters, [turns of the motor].
MOST_TURNS = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class PowerLoss:
    """Effect of a power loss on drums and counters.

    Attributes:
        miscounted: Offset of each drive's counts, shape (m,), [counts].
        slack: Length that each drum has paid out, shape (m,), [m]; on a stand beyond the stretch
            of its cable, which is slack by this length then.
        on_a_stand: The platform rests on a support; otherwise it hangs on the taut cables.
    """

    miscounted: Array
    slack: Array
    on_a_stand: bool

    @classmethod
    def drawn(cls, rig: Rig, seed: int, most_slack: float, *, on_a_stand: bool) -> PowerLoss:
        """A random power loss.

        Args:
            most_slack: Largest slack of a cable, [m].
            on_a_stand: Whether a support holds the platform.
        """
        random = np.random.default_rng(seed)
        per_turn = np.array([w.counts_per_rev for w in rig.document.winches], dtype=np.float64)
        turns = random.uniform(-MOST_TURNS, MOST_TURNS, rig.cable_count)
        slack = random.uniform(0.0, most_slack, rig.cable_count)
        return cls(read_only(np.rint(turns * per_turn)), read_only(slack), on_a_stand)

    def apply_to(self, rig: Rig, plant: Plant, motors: Iterable[Motor]) -> None:
        """Rotates the drums and offsets their counters; the platform settles accordingly.

        Raises:
            Fault: The platform has no equilibrium there.
        """
        paid_out = self.slack
        if self.on_a_stand:
            paid_out = paid_out + plant.stretch
            plant.support()
        plant.miscounted = self.miscounted
        for winch, motor, more, length in zip(
            rig.winches, motors, self.miscounted, paid_out, strict=True
        ):
            motor.position += float(more) + round(length * winch.counts_per_metre)
            motor.demand = motor.position
