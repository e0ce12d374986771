"""One sample, a pair or a clip: images of a gel, the exact flow between them, and all it was made from.

A pair is two frames and the flow between them, a clip all frames of a press and the flow from the first to each other.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from synth.arrays import FloatArray
from synth.dataset.images import Raster
from synth.flow.field import FlowField
from synth.scene import Scene
from synth.surface import GelSurface


def sample_name(index: int) -> str:
    """Name of a sample's folder, and of a clip's frame: the number with at least six digits."""
    return f"{index:06d}"


def further_cameras(scene: Mapping[str, Any]) -> list[str]:
    """Names of the cameras beside the main one, from a scene as JSON holds it."""
    cameras = scene.get("sensor", {}).get("further_cameras", ())
    return [str(camera["name"]) for camera in cameras] if isinstance(cameras, list | tuple) else []


@dataclass(frozen=True)
class Layout:
    """Where the files of a scene's samples lie in their folders: those of pairs, or those of clips.

    The cameras are by name, "" the main one, whose files lie in the sample's folder; another's lie in a folder of its
    name in that.
    """

    is_of_clips: bool
    has_images: bool
    cameras: tuple[str, ...]

    @classmethod
    def of(cls, scene: Mapping[str, Any]) -> "Layout":
        """That of a scene as JSON holds it, drawn or not."""
        parts = (scene.get(part) for part in ("sampling", "outputs"))
        sampling, outputs = (part if isinstance(part, Mapping) else {} for part in parts)
        images = outputs.get("images", True) is True
        return cls(sampling.get("kind") == "clips", images, ("", *further_cameras(scene)))

    @property
    def folder(self) -> str:
        """The folder of all samples in a dataset."""
        return "clips" if self.is_of_clips else "samples"

    def image(self, frame: int) -> str:
        """File of an image, from 0 on, in a camera's folder."""
        return f"frames/{sample_name(frame)}.png" if self.is_of_clips else f"image{frame + 1}.png"

    def flow(self, frame: int) -> str:
        """File of the flow from frame 0 to a later one in a camera's folder."""
        return f"flow/{sample_name(frame)}.exr" if self.is_of_clips else "flow.exr"

    def files(self, frames: int) -> list[str]:
        """All files of a sample with that many frames, in its folder."""
        own = ["states.csv"] if self.is_of_clips else []
        views = [self.flow(frame) for frame in range(1, frames)] + (["markers.csv"] if self.is_of_clips else [])
        views += [self.image(frame) for frame in range(frames if self.has_images else 0)]
        seen = [f"{camera}/{name}" if camera else name for camera in self.cameras for name in views]
        return ["meta.json", "surface.npz", *own, *seen]


@dataclass(frozen=True)
class CameraPair:
    """Two images of one camera and the flow between them (H, W), in both directions, with the optional channels.

    Images are (H, W) grey or (H, W, 3) RGB, uint8 or uint16 (full scale 65535); None where nothing was rendered.
    """

    image1: Raster | None
    image2: Raster | None
    flow: FlowField


@dataclass(frozen=True)
class CameraFrames:
    """What one camera contributes to a sample.

    Attributes:
        size: (height, width) px.
        images: one of each frame, (H, W) grey or (H, W, 3) RGB, uint8 or uint16 (full scale 65535); none where nothing
            was rendered.
        flows: from frame 0 to each later one, gone through once, so that they may be made one after the other.
        markers: rows of a clip's markers.csv, see `synth.dataset.tracks`.
    """

    size: tuple[int, int]
    images: tuple[Raster, ...]
    flows: Iterable[FlowField]
    markers: FloatArray = field(default_factory=lambda: np.zeros((0, 7)))


@dataclass(frozen=True)
class Sample:
    """A finished sample, before it is written.

    Attributes:
        index: its number in the dataset.
        trajectory: number of the trajectory that its frames belong to.
        frames: states of that trajectory that are shown, (i, j) of a pair.
        seed: of the job.
        scene: the instance that was simulated and rendered.
        surface: what was rendered and traced.
        displacements: for each frame (n, 3) float64 mm of `surface.coarse.nodes`.
        cameras: what each camera saw, by name; "" is the main one.
        diagnostics: JSON-able; "solver" is a list with a record for each frame (depth_mm, shear_mm, twist_deg,
            converged, newton_iterations, residual, min_jacobian, max_penetration_mm).
        force_n, torque_nmm: (frames, 3) of the indenter on the gel.
    """

    index: int
    trajectory: int
    frames: tuple[int, ...]
    seed: int
    scene: Scene
    surface: GelSurface
    displacements: tuple[FloatArray, ...]
    cameras: Mapping[str, CameraFrames]
    diagnostics: Mapping[str, Any] = field(default_factory=dict)
    force_n: FloatArray = field(default_factory=lambda: np.zeros((2, 3)))
    torque_nmm: FloatArray = field(default_factory=lambda: np.zeros((2, 3)))


def largest_motion(flow: FlowField) -> float | None:
    """Length in px of the longest forward vector; None where no pixel sees the gel."""
    length = np.hypot(*np.moveaxis(flow.forward.astype(np.float64), -1, 0))
    finite = length[np.isfinite(length)]
    return float(finite.max()) if finite.size else None
