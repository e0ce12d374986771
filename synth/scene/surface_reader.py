"""Readers of surface files, run in a process of their own: `python -P surface_reader.py FILE` writes to its output.

The readers of VTK, trimesh and Open CASCADE trust the counts and indices in a file. A file that lies about them ends
this process at most, within MEMORY_BYTES. It writes two arrays as an NPZ file: points (n, 3), of the file's unit or,
where the file states one, in mm, and faces (m, 3); or, with exit status 1, on its error stream what is wrong.
"""

import io
import os
import resource
import sys
from pathlib import Path

import numpy as np

VTK_FORMATS = (".stl", ".obj", ".ply", ".off", ".vtp")
STEP_FORMATS = (".step", ".stp")
UNIT_FORMATS = (".glb", ".dae", ".3mf", *STEP_FORMATS)
"""Formats that state their unit, read by trimesh."""
MEMORY_BYTES = 4 * 10**9
STEP_TOLERANCE = {"tol_linear": 0.01, "tol_angular": 0.1}  # mm to curved faces, rad between neighbours


def _by_vtk(path: Path) -> tuple[np.ndarray, np.ndarray]:
    import pyvista as pv

    data = pv.read(path)
    for cells in (data.GetPolys(), data.GetStrips()) if isinstance(data, pv.PolyData) else (data.GetCells(),):
        _check(pv.convert_array(cells.GetConnectivityArray()), data.n_points)
    surface = data.extract_surface(algorithm=None).triangulate()
    return np.asarray(surface.points), surface.faces.reshape(-1, 4)[:, 1:]


def _by_trimesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    is_step = path.suffix.lower() in STEP_FORMATS
    try:
        scene = trimesh.load_scene(path, process=False, skip_materials=True, **(STEP_TOLERANCE if is_step else {}))
    except (ImportError, FileNotFoundError) as error:
        missing = "Open CASCADE finds no shape in it, or is missing: pip install 'gelflow-synth[step]'"
        raise ValueError(missing) if is_step else error from None
    mesh = scene.to_mesh()
    if scene.units is None:
        raise ValueError("it has no parts that can be read, or they have different units")
    _check(mesh.faces, len(mesh.vertices))
    return mesh.vertices * trimesh.units.unit_conversion(scene.units, "millimeters"), mesh.faces


def _check(indices: np.ndarray, count: int) -> None:
    wrong = indices[(indices < 0) | (indices >= count)]
    if len(wrong):
        raise ValueError(f"a face refers to point {wrong[0]} of {count}")


if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    output, file, answer = os.fdopen(os.dup(1), "wb"), Path(sys.argv[1]), io.BytesIO()
    os.dup2(2, 1)  # what libraries print is no answer
    try:
        points, faces = (_by_trimesh if file.suffix.lower() in UNIT_FORMATS else _by_vtk)(file)
    except Exception as error:
        sys.exit(f"\n{str(error) or type(error).__name__}")
    np.savez(answer, points=points, faces=faces)
    output.write(answer.getbuffer())
    output.close()
