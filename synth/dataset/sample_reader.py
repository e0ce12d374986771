"""Reading a sample's folder, of a pair or a clip, or a part of it; nothing is cached and nothing is written."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError, model_validator

from synth.arrays import FloatArray
from synth.dataset.exr import read_flow
from synth.dataset.images import Raster, read_png
from synth.dataset.jsontext import read_document
from synth.dataset.npz import read_npz
from synth.dataset.sample import CameraPair, Layout, further_cameras
from synth.dataset.tracks import MARKERS, MARKERS_FILE, STATES_FILE, read_table, states_columns
from synth.errors import InputError
from synth.flow.field import FlowArray, FlowField
from synth.scene import Scene
from synth.surface import ContactFaces, GelSurface
from synth.untrusted import inside

META_FILE = "meta.json"
Item = TypeVar("Item")
_FAR_MM = 1e6
_MOST_TRIANGLES = 5_000_000
"""Of a surface when its faces are subdivided."""
_FORMER_DEFAULTS = {
    **dict.fromkeys(("dome_radius_mm", "radius_mm", "thickness_mm", "outer", "window", "unit", "center_z_mm")),
    "length_mm": 0.0,
    "cut_end": "free",
    "rotation_deg": [0.0, 0.0, 0.0],
    "digest": "",
}
"""Of fields that once all shapes of gels and windows had."""
_Row = tuple[float, float, float]


class _Diagnostics(BaseModel):
    solver: list[dict[str, list[float] | float | bool | str | None]] = []


class _Meta(BaseModel):
    """What is relied on of meta.json, where more may stand."""

    index: int
    trajectory: int
    frames: tuple[int, ...]
    force_n: tuple[_Row, ...]
    torque_nmm: tuple[_Row, ...]
    diagnostics: _Diagnostics = _Diagnostics()
    scene: dict[str, Any]

    @model_validator(mode="after")
    def _of_one_length(self) -> "_Meta":
        of_frames = (self.frames, self.force_n, self.torque_nmm, self.diagnostics.solver or self.frames)
        if len({len(rows) for rows in of_frames}) > 1 or len(self.frames) < 2:
            raise ValueError("frames, force_n, torque_nmm and solver must be of one length, at least 2")
        return self


@dataclass(frozen=True)
class SampleData(CameraPair):
    """One image pair of a dataset with its exact flow.

    Attributes:
        image1, image2, flow: the main camera's, see `CameraPair`.
        surface: the undeformed contact surface of the gel, mm.
        displacement1: of its nodes in the state of image 1, (N, 3) float64, mm.
        displacement2: of its nodes in the state of image 2, (N, 3) float64, mm.
        meta: meta.json, with the drawn scene, forces in N and torques in N mm.
        further: images and flow of the scene's further cameras, by name.
    """

    surface: GelSurface
    displacement1: FloatArray
    displacement2: FloatArray
    meta: Mapping[str, Any]
    further: Mapping[str, CameraPair] = field(default_factory=dict)

    @property
    def images(self) -> tuple[Raster, ...]:
        """Image 1 and image 2; none where nothing was rendered."""
        return tuple(image for image in (self.image1, self.image2) if image is not None)

    @property
    def forward(self) -> FlowArray:
        """Flow from image 1 to image 2, (H, W, 2) float32 px, U right, V down; NaN where no gel is seen."""
        return self.flow.forward

    @property
    def backward(self) -> FlowArray | None:
        """The same with the images exchanged; None where the scene did not ask for it."""
        return self.flow.backward

    @property
    def visible(self) -> FlowArray:
        """(H, W) float32, 1 where the material point of a pixel of image 1 is seen in image 2, else 0."""
        return self.flow.forward_visible

    def seen_by(self, camera: str) -> "SampleData":
        """The sample with the images and flow of one camera, "" the main one; InputError for a name that it has not."""
        if not camera:
            return self
        if camera not in self.further:
            names = ", ".join(self.further) or "none"
            raise InputError(f"the sample has no camera {camera!r}; beside the main camera it has: {names}")
        return replace(self, **vars(self.further[camera]))


class _Read(Sequence[Item]):
    """Items of a number of files, each read when it is asked for."""

    def __init__(self, read: Callable[[int], Item], numbers: range) -> None:
        self._read, self._numbers = read, numbers

    def __len__(self) -> int:
        return len(self._numbers)

    def __getitem__(self, at: Any) -> Any:
        return _Read(self._read, self._numbers[at]) if isinstance(at, slice) else self._read(self._numbers[at])


@dataclass(frozen=True)
class ClipData:
    """All recorded states of one press, as one camera saw them; frame 0 is at rest.

    Attributes:
        folder: where its files are.
        camera: the camera's name, "" the main one.
        surface: the undeformed contact surface of the gel, mm.
        displacements: of its nodes, for each frame (N, 3) float64, mm.
        states: a structured array with a row for each frame, of the columns of `synth.dataset.tracks.states_columns`.
        meta: meta.json, with the drawn scene, forces in N and torques in N mm.
    """

    folder: Path
    camera: str
    surface: GelSurface
    displacements: tuple[FloatArray, ...]
    states: NDArray[Any]
    meta: Mapping[str, Any]

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.states)

    @cached_property
    def _layout(self) -> Layout:
        return Layout.of(self.meta["scene"])

    @property
    def images(self) -> Sequence[Raster]:
        """One of each frame, read when it is asked for; none where nothing was rendered."""
        count = len(self) if self._layout.has_images else 0
        return _Read(lambda frame: read_png(self.folder / self.camera / self._layout.image(frame)), range(count))

    @property
    def flows(self) -> Sequence[FlowField]:
        """Exact flow from frame 0 to frames 1, 2, ..., each read when it is asked for."""
        return _Read(lambda frame: read_flow(self.folder / self.camera / self._layout.flow(frame)), range(1, len(self)))

    @property
    def markers(self) -> NDArray[Any]:
        """Tracks of the dots, a structured array with the columns of `synth.dataset.tracks.MARKERS`, px."""
        return read_table(self.folder / self.camera / MARKERS_FILE, MARKERS)

    def pair(self, first: int, second: int) -> SampleData:
        """Any two frames as a pair; the flow from frame 0 is read, any other is traced anew.

        InputError for a frame that it has not, or a file that is missing or damaged.
        """
        if not (0 <= first < len(self) and 0 <= second < len(self) and first != second):
            raise InputError(f"{self.folder}: frames {first}, {second}: give two of 0 to {len(self) - 1}")
        frames = (first, second)
        rows = {name: [self.meta[name][frame] for frame in frames] for name in ("force_n", "torque_nmm")}
        told = self.meta.get("diagnostics", {})
        solver = [told["solver"][frame] for frame in frames] if told.get("solver") else []
        meta = {**self.meta, **rows, "frames": list(frames), "diagnostics": {**told, "solver": solver}}
        moved = [self.displacements[frame] for frame in frames]
        if first == 0:
            seen = read_pair(self.folder / self.camera, self._layout, second)
        else:
            image1, image2 = (self.images[frame] if self.images else None for frame in frames)
            seen = CameraPair(image1, image2, self._flow_between(*moved))
        return SampleData(**vars(seen), surface=self.surface, displacement1=moved[0], displacement2=moved[1], meta=meta)

    def _flow_between(self, first: FloatArray, second: FloatArray) -> FlowField:
        from synth.flow.exact import exact_flow  # `verify` shares nothing with it and reads clips
        from synth.flow.view import View
        from synth.optics import Optics

        view = View(self.surface, Optics.of(read_scene(self.folder).sensor.views[self.camera]))
        return exact_flow(view, self.surface.positions(first), self.surface.positions(second))


def read_sample(folder: Path) -> SampleData:
    """The files of a pair's folder; InputError where they are missing or damaged, or do not fit each other."""
    meta = read_meta(folder)
    layout = Layout.of(meta["scene"])
    surface, (displacement1, displacement2) = _read_surface(folder / "surface.npz", layout)
    further = {name: read_pair(folder / name, layout) for name in layout.cameras[1:]}
    return SampleData(**vars(read_pair(folder, layout)), surface=surface, displacement1=displacement1,
                      displacement2=displacement2, meta=meta, further=further)  # fmt: skip


def read_clip(folder: Path, camera: str = "") -> ClipData:
    """A clip's folder, as a camera saw it; errors as for `read_sample`, and for a camera that it has not."""
    meta = read_meta(folder)
    layout = Layout.of(meta["scene"])
    if camera not in layout.cameras:
        names = ", ".join(layout.cameras[1:]) or "none"
        raise InputError(f"{folder}: has no camera {camera!r}; beside the main camera it has: {names}")
    surface, displacements = _read_surface(folder / "surface.npz", layout)
    states = read_table(folder / STATES_FILE, states_columns(meta["scene"]))
    if not len(meta["frames"]) == len(states) == len(displacements):
        raise InputError(f"{folder}: meta.json, {STATES_FILE} and surface.npz differ in their numbers of frames")
    return ClipData(folder, camera, surface, displacements, states, meta)


def read_meta(folder: Path) -> dict[str, Any]:
    """A sample's meta.json; InputError where it is missing or damaged, or lacks something that is relied on."""
    meta = read_document(folder / META_FILE)
    try:
        _Meta.model_validate(meta)
        for name in further_cameras(meta["scene"]):
            inside(name)
    except ValueError as error:
        what = " ".join(str(error).splitlines()[-3:-1]) if isinstance(error, ValidationError) else error
        raise InputError(f"{folder / META_FILE}: {what}; the file is damaged") from error
    return meta


def _read_surface(path: Path, layout: Layout) -> tuple[GelSurface, tuple[FloatArray, ...]]:
    """The surface and the displacements of all frames; InputError where the arrays are no surface."""
    names = ("displacements",) if layout.is_of_clips else ("displacement1", "displacement2")
    nodes, faces, parts, *moved = read_npz(path, ("nodes", "faces", "subdivisions", *names)).values()
    moved = list(moved[0]) if layout.is_of_clips and moved[0].ndim == 3 else moved
    shaped = all(
        each.ndim == 2 and each.shape == (len(nodes), 3) and each.dtype.kind == "f" for each in (nodes, *moved)
    )
    near = shaped and all((np.abs(each) < _FAR_MM).all() for each in (nodes, *moved))
    indices = near and faces.ndim == 2 and faces.shape[1] in (3, 6) and faces.dtype.kind in "iu" and len(faces) > 0
    split = indices and 0 <= faces.min() <= faces.max() < len(nodes) and parts.shape == () and parts.dtype.kind in "iu"
    if not (split and 1 <= parts <= math.sqrt(_MOST_TRIANGLES / len(faces))):
        raise InputError(
            f"{path}: its arrays are no surface; nodes and displacements are (n, 3) mm, faces (k, 3) or (k, 6) numbers "
            f"of nodes, subdivisions from 1 on give at most {_MOST_TRIANGLES} triangles; the file is damaged"
        )
    return GelSurface(ContactFaces(nodes, faces.astype(np.int32)), int(parts)), tuple(moved)


def read_pair(folder: Path, layout: Layout, frame: int = 1) -> CameraPair:
    """One camera's images of frame 0 and another, and the flow between them.

    InputError where files are missing or damaged, or do not fit each other.
    """
    flow = read_flow(folder / layout.flow(frame))
    if not layout.has_images:
        return CameraPair(None, None, flow)
    (first, image1), (second, image2) = ((name, read_png(folder / name)) for name in map(layout.image, (0, frame)))
    size, third = flow.forward.shape[:2], layout.flow(frame)
    if image1.shape[:2] != size or image2.shape != image1.shape:
        raise InputError(
            f"{folder}: {first} is {image1.shape}, {second} {image2.shape}, {third} {size}; they must agree"
        )
    return CameraPair(image1, image2, flow)


def read_scene(folder: Path) -> Scene:
    """The drawn scene in a sample's meta.json; InputError where that is damaged, or of another version's schema."""
    try:
        return Scene.model_validate(_in_schema(read_meta(folder)["scene"]))
    except ValidationError as error:
        what = error.errors()[0]["msg"]
        raise InputError(f"{folder / META_FILE}: its scene does not fit this version of synth: {what}") from error


def _in_schema(scene: dict[str, Any]) -> dict[str, Any]:
    """A recorded scene without fields of other shapes, which earlier versions wrote at their defaults."""
    sensor = dict(scene.get("sensor", {}))
    for name in ("gel", "window"):
        match sensor.get(name):
            case {"shape": shape, **fields}:
                unused = _FORMER_DEFAULTS | ({"size_mm": fields.get("size_mm")} if shape == "capsule" else {})
                own = {key: value for key, value in fields.items() if key not in unused or value != unused[key]}
                sensor[name] = {"shape": shape, **own}
    return {**scene, "sensor": sensor}
