"""Triangle surfaces as files have them: read, cleaned and oriented.

Files hold doubled faces, shells that are inside out, and bodies that share faces. Faces that stand twice are dropped;
the others are oriented outward, without the walls between bodies (`synth.scene.surface_shells`). Holes are left.
"""

import io
import os
import subprocess
import sys
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from synth.arrays import FloatArray
from synth.scene import surface_reader
from synth.scene.surface_reader import UNIT_FORMATS, VTK_FORMATS
from synth.scene.surface_shells import is_closed, outward, shells_of

FORMATS = VTK_FORMATS + UNIT_FORMATS
MOST_FACES, MOST_MM, MOST_SECONDS = 3_000_000, 1e9, 50.0


@dataclass(frozen=True, eq=False)
class Triangles:
    """A triangle surface: points (n, 3), faces (m, 3), whether they enclose volumes, and the number of shells."""

    points: FloatArray
    faces: np.ndarray
    closed: bool
    shells: int = 1


def read_surface(path: Path) -> Triangles:
    """A file's surface, cleaned, in mm if it states its unit; cached while it does not change; ValueError if none."""
    if not path.is_file():
        raise ValueError(f"there is no file {path}")
    if path.suffix.lower() not in FORMATS:
        raise ValueError(f"it is none of the surface files that are read: {', '.join(FORMATS)}")
    try:
        return _read(path, path.stat().st_mtime_ns)
    except (ValueError, OSError) as error:
        raise ValueError(f"it cannot be read as a surface ({error})") from None


@lru_cache(maxsize=64)
def _read(path: Path, changed_ns: int) -> Triangles:
    import pyvista as pv

    points, faces = _binary_stl(path) or _in_a_child(path)
    if len(faces) == 0:
        raise ValueError("it has no triangles")
    if len(faces) > MOST_FACES:
        raise ValueError(f"it has {len(faces)} triangles, more than {MOST_FACES}; simplify it")
    if not (np.abs(points) < MOST_MM).all():
        raise ValueError(f"not all of its vertices are finite numbers below {MOST_MM:g}")
    surface = pv.PolyData.from_regular_faces(points, faces).clean()
    faces = surface.faces.reshape(-1, 4)[:, 1:].astype(np.int64)
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    points, faces = np.asarray(surface.points, dtype=np.float64), faces[np.sort(first)]
    faces = outward(points, faces) if len(faces) else faces
    if len(faces) == 0:
        raise ValueError("its triangles enclose no volume")
    return Triangles(points, faces, is_closed(faces), int(shells_of(faces).max()) + 1)


def _binary_stl(path: Path) -> tuple[np.ndarray, np.ndarray] | None:
    """Points and faces of a binary STL whose size is that of its triangles."""
    with path.open("rb") as file:
        header = file.read(84)
    count = int.from_bytes(header[80:], "little")
    excess = path.stat().st_size - (84 + 50 * count)
    if path.suffix.lower() == ".stl" and excess < 0 and not header.startswith(b"solid"):
        raise ValueError(f"it promises {count} triangles, and is too short for them")
    if path.suffix.lower() != ".stl" or excess or count > MOST_FACES:
        return None
    triangle = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    return np.fromfile(path, triangle, offset=84)["corners"].reshape(-1, 3), np.arange(3 * count).reshape(-1, 3)


def _in_a_child(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Points and faces by a reader that a file may end; ValueError then."""
    command = [sys.executable, "-P", surface_reader.__file__, str(path)]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}  # each thread takes address space
    try:
        done = subprocess.run(command, capture_output=True, timeout=MOST_SECONDS, env=environment, check=False)
    except subprocess.TimeoutExpired:
        raise ValueError(f"its reader took more than {MOST_SECONDS:g} s: it is broken, or too fine") from None
    if done.returncode == 1:
        raise ValueError(done.stderr.decode(errors="replace").splitlines()[-1][:200])
    if done.returncode != 0:
        raise ValueError("its reader crashed: counts or indices in it are wrong, or it takes more than 4 GB")
    with np.load(io.BytesIO(done.stdout)) as answer:
        return answer["points"], answer["faces"]
