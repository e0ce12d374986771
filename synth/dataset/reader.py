"""Reading a dataset, a sample's folder, or a part of either; nothing is cached and nothing is written."""

import hashlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ValidationError

from synth.arrays import FloatArray
from synth.dataset.exr import read_flow
from synth.dataset.images import Raster, read_png
from synth.dataset.job import read_job_record
from synth.dataset.jsontext import read_document
from synth.dataset.manifest import (
    FAILURES_FILE,
    MANIFEST_FILE,
    LineTable,
    ManifestEntry,
    failure_key,
    manifest_key,
    read_line,
    scan_lines,
)
from synth.dataset.npz import read_npz
from synth.dataset.sample import SAMPLES_FOLDER, CameraPair, further_cameras, sample_name
from synth.errors import InputError
from synth.flow.field import FlowArray
from synth.scene import Scene
from synth.surface import ContactFaces, GelSurface
from synth.untrusted import inside, open_file

META_FILE = "meta.json"
_FAR_MM = 1e6
_MOST_TRIANGLES = 5_000_000
"""Of a surface when its faces are subdivided."""
_Rows = tuple[tuple[float, float, float], tuple[float, float, float]]


class _Diagnostics(BaseModel):
    solver: list[dict[str, list[float] | float | bool | str | None]] = []


class _Meta(BaseModel):
    """What is relied on of meta.json, where more may stand."""

    index: int
    trajectory: int
    frames: tuple[int, int]
    force_n: _Rows
    torque_nmm: _Rows
    diagnostics: _Diagnostics = _Diagnostics()
    scene: dict[str, Any]


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
    def images(self) -> tuple[Raster, Raster]:
        """Image 1 and image 2."""
        return self.image1, self.image2

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


@dataclass(frozen=True)
class Dataset:
    """A dataset directory as it was when it was opened; iterating reads its finished samples one by one.

    Methods raise InputError for a sample or camera that is not there, and for a file that is missing or damaged. `path`
    is the directory, `info` its dataset.json.
    """

    path: Path
    info: Mapping[str, Any]
    _table: LineTable[int]

    def __len__(self) -> int:
        """Number of finished samples."""
        return len(self._table.places)

    def __iter__(self) -> Iterator[SampleData]:
        """The finished samples, by index; see `read`."""
        return map(self.read, self.samples)

    @property
    def samples(self) -> list[int]:
        """Indices of the finished samples, ascending."""
        return sorted(self._table.places)

    @property
    def failures(self) -> list[dict[str, Any]]:
        """The records of failures.jsonl, by index and attempt."""
        path = self.path / FAILURES_FILE
        table = scan_lines(path, failure_key)
        return [read_line(path, table.places[key]) for key in sorted(table.places)]

    def folder(self, index: int) -> Path:
        """The sample's folder, DIR/samples/NNNNNN."""
        if index not in self._table.places:
            known = self.samples
            span = f"{known[0]} to {known[-1]} ({len(known)} of {self.info['n']})" if known else "none"
            raise InputError(f"{self.path}: has no finished sample {index}; it has {span}")
        return self.path / SAMPLES_FOLDER / sample_name(index)

    def entry(self, index: int) -> ManifestEntry:
        self.folder(index)
        return ManifestEntry.from_record(read_line(self.path / MANIFEST_FILE, self._table.places[index]))

    def scene_of(self, index: int) -> Scene:
        """The scene instance that the sample was made from."""
        return read_scene(self.folder(index))

    def read(self, index: int, camera: str = "") -> SampleData:
        """The sample's files; image1, image2 and flow are those of the camera of that name, by default the main one."""
        return read_sample(self.folder(index)).seen_by(camera)

    def check_hashes(self, index: int) -> list[str]:
        """One message for each file that is missing or whose content is not what the manifest says; empty: all well."""
        problems = []
        for name, expected in self.entry(index).sha256.items():
            path = self.folder(index) / name
            try:
                with open_file(self.folder(index) / inside(name)) as file:
                    found = hashlib.file_digest(file, "sha256").hexdigest()
                if found != expected:
                    problems.append(f"{path}: sha256 is {found[:16]}..., the manifest says {expected[:16]}...")
            except OSError as error:
                problems.append(f"{path}: cannot be read: {error.strerror or error}")
            except ValueError as error:
                problems.append(f"the manifest's {error}")
        return problems


def read_dataset(path: Path | str) -> Dataset:
    """Opens a dataset directory, finished or not, and writes nothing.

    Args:
        path: what was given to `generate` as `out`; a local directory.

    Returns:
        An iterable of `SampleData`, each read when its turn comes.

    Raises:
        InputError: Not a dataset, or its dataset.json or manifest is damaged.
    """
    directory = Path(path)
    if not directory.is_dir():
        raise InputError(f"{directory}: there is no such directory")
    info = read_job_record(directory)
    manifest = directory / MANIFEST_FILE
    if not manifest.is_file():
        raise InputError(f"{manifest}: missing; the dataset is damaged, or its first run was stopped at once")
    return Dataset(directory, info, scan_lines(manifest, manifest_key))


def read_sample(folder: Path) -> SampleData:
    """The files of one sample's folder; InputError where they are missing or damaged, or do not fit each other."""
    meta = read_meta(folder)
    surface, displacement1, displacement2 = _read_surface(folder / "surface.npz")
    further = {name: read_pair(folder / name) for name in further_cameras(meta["scene"])}
    return SampleData(**vars(read_pair(folder)), surface=surface, displacement1=displacement1,
                      displacement2=displacement2, meta=meta, further=further)  # fmt: skip


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


def _read_surface(path: Path) -> tuple[GelSurface, FloatArray, FloatArray]:
    """The surface and both displacements; InputError where the arrays are no surface."""
    arrays = read_npz(path, ("nodes", "faces", "subdivisions", "displacement1", "displacement2"))
    nodes, faces, parts, *moved = arrays.values()
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
    return GelSurface(ContactFaces(nodes, faces.astype(np.int32)), int(parts)), moved[0], moved[1]


def read_pair(folder: Path) -> CameraPair:
    """One camera's images and flow; InputError where they are missing or damaged, or do not fit each other."""
    image1, image2 = read_png(folder / "image1.png"), read_png(folder / "image2.png")
    flow = read_flow(folder / "flow.exr")
    size = flow.forward.shape[:2]
    if image1.shape[:2] != size or image2.shape != image1.shape:
        raise InputError(
            f"{folder}: image1.png is {image1.shape}, image2.png {image2.shape}, flow.exr {size}; they must agree"
        )
    return CameraPair(image1, image2, flow)


def read_scene(folder: Path) -> Scene:
    """The drawn scene in a sample's meta.json; InputError where that is damaged, or of another version's schema."""
    try:
        return Scene.model_validate(read_meta(folder)["scene"])
    except ValidationError as error:
        what = error.errors()[0]["msg"]
        raise InputError(f"{folder / META_FILE}: its scene does not fit this version of synth: {what}") from error
