"""Triangle surfaces of objects as files have them: read, cleaned, oriented and brought to size.

Files hold doubled faces, shells that are inside out, holes, and lengths in metres. Faces that stand twice are dropped;
every connected shell is oriented alike and outward. Holes are left: inside is where the generalised winding number is
above one half (`synth.simulate.object_grid`), which closes them.
"""

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from synth.arrays import FloatArray
from synth.errors import InputError
from synth.scene import MeshIndenter

SHORTEST_MM, LONGEST_MM = 0.5, 1000.0
"""Longest edges beyond which a file is taken to be in another unit."""


@dataclass(frozen=True, eq=False)
class Triangles:
    """A triangle surface: points (n, 3) in mm, faces (m, 3), and whether every edge has two faces."""

    points: FloatArray
    faces: np.ndarray
    closed: bool


def object_triangles(indenter: MeshIndenter, folder: Path) -> Triangles:
    """An object's surface in mm, not turned, its bounding box centred on the origin; its file is relative to `folder`.

    Files have right-handed axes; the scene's are left-handed, because y points down in the image. So y changes its
    sign: a letter can be read in the picture, a screw keeps its hand.

    Raises:
        InputError: a file that is missing or no surface, or of a size that speaks for another unit.
    """
    path = folder / indenter.file
    if not path.is_file():
        raise InputError(f"contact.indenter.file = {indenter.file!r}: there is no file {path}")
    try:
        surface = _read(path, path.stat().st_mtime_ns)
    except (ValueError, OSError, AttributeError) as error:
        raise InputError(
            f"contact.indenter.file = {indenter.file!r}: it cannot be read as a surface ({error})"
        ) from None
    longest = float(np.ptp(surface.points, axis=0).max())
    scale = indenter.size_mm / longest if indenter.size_mm is not None else indenter.scale
    if not SHORTEST_MM <= scale * longest <= LONGEST_MM:
        raise InputError(
            f"contact.indenter.scale = {scale:g}: {indenter.file} is then {scale * longest:.3g} mm long. Is it in "
            "metres (scale = 1000) or inches (scale = 25.4)? size_mm gives its longest edge instead"
        )
    centre = (surface.points.min(axis=0) + surface.points.max(axis=0)) / 2
    return Triangles(scale * (surface.points - centre) * [1, -1, 1], surface.faces[:, ::-1], surface.closed)


@lru_cache(maxsize=64)
def _read(path: Path, changed_ns: int) -> Triangles:
    """A file's surface, cleaned; kept for as long as the file does not change.

    Raises:
        ValueError: it has no triangles.
    """
    import pyvista as pv

    with _silence():
        surface = pv.read(path).extract_surface(algorithm=None).triangulate().clean()
        faces = surface.faces.reshape(-1, 4)[:, 1:]
        _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
        if len(first) == 0:
            raise ValueError("it has no triangles")
        surface = pv.PolyData.from_regular_faces(np.asarray(surface.points, dtype=np.float64), faces[np.sort(first)])
        surface = surface.compute_normals(consistent_normals=True, auto_orient_normals=False, split_vertices=False)
        shells = surface.connectivity("all").cell_data["RegionId"]
    points = np.asarray(surface.points, dtype=np.float64)
    faces = np.array(surface.faces.reshape(-1, 4)[:, 1:], dtype=np.int64)
    corners, sizes = points[faces], np.bincount(shells)
    centres = np.stack([np.bincount(shells, corners[:, :, k].mean(axis=1)) / sizes for k in range(3)], axis=-1)
    volumes = np.bincount(shells, np.linalg.det(corners - centres[shells][:, None]))
    inverted = volumes[shells] < 0
    faces[inverted] = faces[inverted][:, ::-1]
    return Triangles(points, faces, surface.n_open_edges == 0)


@contextmanager
def _silence() -> Iterator[None]:
    """Without VTK's log and warnings, which tell of addresses and reference counts."""
    disabled = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(disabled)
