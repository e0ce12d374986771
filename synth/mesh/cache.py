"""Meshes are cached by content: made once per pad and edge length, then read. A dome's is its box's, bulged when read.

fTetWild is not deterministic, so the cache is also what makes a dataset reproducible: a dataset directory keeps the
meshes it used and a later run on it reads those first.
"""

import contextlib
import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from synth.dataset.atomic_files import replacing
from synth.errors import InputError
from synth.mesh.dome import domed
from synth.mesh.face import FLAT_FACE, Face, PadFace, face_of
from synth.mesh.layered import layered
from synth.mesh.pad import PadMesh
from synth.mesh.tetrahedralise import ENVELOPE, GRADING, background_of, box_sides, tetrahedralise, tetrahedralise_box
from synth.scene import FileGel, Gel, Numerics, PadGel
from synth.untrusted import open_file

SURFACE, ROOM = 0.5, 1.5
"""Edge length of the surface that fTetWild is given, over that of the mesh; and fTetWild's envelope, over the distance
of the mesh's chords from a curved face."""
CHORDS = 0.03
"""Share of a round gel's volume that flat faces may add or take away."""


def edge_length(gel: Gel, numerics: Numerics) -> float:
    """Edge length (mm) of fTetWild's mesh at the contact face: as given, or by default a fifth of the gel's thickness,
    at most 1 mm; of a round gel, whose one mesh serves all trajectories, four fifths and at most a sixth of the radius.
    """
    default_mm = min(gel.depth_mm / 5, 1.0) if isinstance(gel, PadGel) else min(0.8 * gel.depth_mm, gel.size_mm[0] / 12)
    return numerics.edge_length_mm or default_mm


def mesh_key(gel: Gel, numerics: Numerics) -> str:
    """Name of the mesh of a pad: everything that its making depends on."""
    recipe: dict[str, object] = {
        "shape": gel.shape,
        "size_mm": gel.size_mm,
        "edge_length_mm": edge_length(gel, numerics),
        "grading": GRADING,
        "envelope": ENVELOPE,
        **gel.model_dump(include={"thickness_mm"}),
    }
    if isinstance(gel, FileGel):
        recipe["files"] = gel.digest
    return hashlib.sha256(json.dumps(recipe, sort_keys=True).encode()).hexdigest()[:16]


def user_cache() -> Path:
    """Where meshes are cached between runs: $XDG_CACHE_HOME or ~/.cache."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "gelflow-synth" / "meshes"


def pad_mesh(
    gel: Gel, numerics: Numerics, folders: Sequence[Path] | None = None, scene_folder: Path | None = None
) -> PadMesh:
    """The mesh of a pad, from the first folder that holds it, else made; afterwards every folder holds it.

    Of the numerics the edge length counts. The folders are searched in order, by default the user's cache; the gel's
    own files are relative to `scene_folder`. InputError where layers or a dome turn a tetrahedron over.
    """
    key, face = mesh_key(gel, numerics), FLAT_FACE if gel.dome_radius_mm else face_of(gel, scene_folder or Path())
    paths = [folder / f"{key}.npz" for folder in (folders if folders is not None else [user_cache()])]
    mesh = next((found for path in paths if (found := _read(path, gel, face)) is not None), None)
    if mesh is None:
        mesh = _made(gel, face, edge_length(gel, numerics))
    for path in paths:
        if _read(path, gel, face) is None:
            _write(path, mesh)
    sides = box_sides(gel.size_mm) if isinstance(face, PadFace) else face.sides
    return domed(layered(mesh, sides, gel.layers_mm), gel.dome_radius_mm)


def _made(gel: Gel, face: Face, edge_mm: float) -> PadMesh:
    """A new mesh; of a dome that of its box."""
    if isinstance(face, PadFace):
        return tetrahedralise_box(gel.size_mm, edge_mm)
    # Edges of that length on the face, whose chords are off it by h² / 8 R, must fit the envelope.
    off = ROOM * edge_mm**2 / (4 * min(gel.size_mm[:2]))
    surface, triangles = face.triangles(SURFACE * edge_mm)
    envelope = max(ENVELOPE, off / float(np.linalg.norm(np.ptp(surface, axis=0))))
    x, y = 2 * np.abs(surface[:, :2]).max(axis=0)
    background = background_of((x, y, surface[:, 2].max()), edge_mm)
    points, tets = tetrahedralise(
        surface, triangles, face.sides, background, face.volume_mm3, CHORDS, envelope=envelope
    )
    return PadMesh(points, tets, gel.size_mm, face=face)


def _read(path: Path, gel: Gel, face: Face) -> PadMesh | None:
    """A cached mesh, or None where there is none or the file is damaged (it is then made again)."""
    try:
        with open_file(path) as file, np.load(file, allow_pickle=False) as data:
            return PadMesh(data["points"], data["tets"], gel.size_mm, face=face)
    except (OSError, EOFError, ValueError, KeyError, MemoryError, BadZipFile):
        return None


def _write(path: Path, mesh: PadMesh) -> None:
    """Store a mesh, whole or not at all. A folder that cannot be written gets none: the mesh itself is not at stake."""
    with contextlib.suppress(OSError, InputError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as file:
            np.savez(file, points=mesh.points, tets=mesh.tets)
