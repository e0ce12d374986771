"""One sample: two images of a gel, the exact flow between them, and all it was made from."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from synth.arrays import FloatArray
from synth.dataset.images import Raster
from synth.flow.field import FlowField
from synth.scene import Scene
from synth.surface import GelSurface

SAMPLES_FOLDER = "samples"
VIEW_FILES = ("image1.png", "image2.png", "flow.exr")
"""Files of each camera: the main one's in the sample's folder, another's in a folder of its name in that."""
SAMPLE_FILES = (*VIEW_FILES, "meta.json", "surface.npz")


def sample_name(index: int) -> str:
    """Name of a sample's folder: the index with at least six digits."""
    return f"{index:06d}"


def further_cameras(scene: Mapping[str, Any]) -> list[str]:
    """Names of the cameras beside the main one, from a scene as JSON holds it."""
    cameras = scene.get("sensor", {}).get("further_cameras", ())
    return [str(camera["name"]) for camera in cameras] if isinstance(cameras, list | tuple) else []


@dataclass(frozen=True)
class CameraPair:
    """What one camera contributes to a sample: its flow (H, W), in both directions, with the optional channels.

    Images are (H, W) grey or (H, W, 3) RGB, uint8 or uint16 (full scale 65535).
    """

    image1: Raster
    image2: Raster
    flow: FlowField


@dataclass(frozen=True)
class Sample(CameraPair):
    """A finished sample, before it is written, with what the main camera saw.

    Attributes:
        index: its number in the dataset.
        trajectory: number of the trajectory that its frames belong to.
        frames: (i, j), states of that trajectory shown in image 1 and image 2.
        seed: of the job.
        scene: the instance that was simulated and rendered.
        surface: what was rendered and traced.
        displacement1, displacement2: (n, 3) float64 mm of `surface.coarse.nodes`.
        diagnostics: JSON-able; "solver" is a list with a record for each of the two frames (depth_mm, shear_mm,
            twist_deg, converged, newton_iterations, residual, min_jacobian, max_penetration_mm).
        force_n, torque_nmm: (2, 3) of the indenter on the gel, per frame.
        further: what the other cameras saw, by their names.
    """

    index: int
    trajectory: int
    frames: tuple[int, int]
    seed: int
    scene: Scene
    surface: GelSurface
    displacement1: FloatArray
    displacement2: FloatArray
    diagnostics: Mapping[str, Any] = field(default_factory=dict)
    force_n: FloatArray = field(default_factory=lambda: np.zeros((2, 3)))
    torque_nmm: FloatArray = field(default_factory=lambda: np.zeros((2, 3)))
    further: Mapping[str, CameraPair] = field(default_factory=dict)


def largest_motion(flow: FlowField) -> float | None:
    """Length in px of the longest forward vector; None where no pixel sees the gel."""
    length = np.hypot(*np.moveaxis(flow.forward.astype(np.float64), -1, 0))
    finite = length[np.isfinite(length)]
    return float(finite.max()) if finite.size else None
