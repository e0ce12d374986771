"""Triangle surfaces as files have them: read, cleaned and oriented.

Files hold doubled faces and shells that are inside out. Faces that stand twice are dropped; every connected shell is
oriented alike and outward. Holes are left.
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

FORMATS = (".stl", ".obj", ".ply", ".off", ".vtp")


@dataclass(frozen=True, eq=False)
class Triangles:
    """A triangle surface: points (n, 3), faces (m, 3), whether every edge has two faces, and the number of shells."""

    points: FloatArray
    faces: np.ndarray
    closed: bool
    shells: int = 1


def read_surface(path: Path) -> Triangles:
    """A file's surface in its own unit, cleaned, cached while the file does not change; ValueError if there is none."""
    if not path.is_file():
        raise ValueError(f"there is no file {path}")
    if path.suffix.lower() not in FORMATS:
        raise ValueError(f"it is none of the surface files that are read: {', '.join(FORMATS)}")
    try:
        return _read(path, path.stat().st_mtime_ns)
    except (ValueError, OSError, AttributeError) as error:
        raise ValueError(f"it cannot be read as a surface ({error})") from None


@lru_cache(maxsize=64)
def _read(path: Path, changed_ns: int) -> Triangles:
    import pyvista as pv

    with _silence():
        surface = pv.read(path).extract_surface(algorithm=None).triangulate().clean()
        faces = surface.faces.reshape(-1, 4)[:, 1:]
        _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
        if len(first) == 0:
            raise ValueError("it has no triangles")
        if not np.isfinite(surface.points).all():
            raise ValueError("not all of its vertices are finite numbers")
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
    return Triangles(points, faces, surface.n_open_edges == 0, len(sizes))


@contextmanager
def _silence() -> Iterator[None]:
    """Silences VTK's log and warnings, which tell of addresses and reference counts."""
    disabled = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(disabled)
