"""The shipped solids of scenes/objects: sound surfaces, small files, and the same as their script makes."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import pyvista as pv

from synth.arrays import FloatArray

FOLDER = Path(__file__).parents[2] / "scenes" / "objects"
FILES = sorted(FOLDER.glob("*.stl"))
SIMPLIFICATION = 0.01
"""mm, TOLERANCE in make.py: another version of manifold3d may simplify elsewhere and move the surface by as much."""
SMALLEST_HEIGHT = 1e-4
"""mm, of a triangle: what make.py rounds coordinates to. A triangle that rounding collapsed has less."""
MOST_BYTES = 1_000_000
each_file = pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two folders with the objects made anew, by the script as its docstring says."""
    folders = tmp_path_factory.mktemp("made"), tmp_path_factory.mktemp("again")
    for folder in folders:
        subprocess.run([sys.executable, FOLDER / "make.py", folder], check=True)
    return folders


def corners_of(file: Path) -> FloatArray:
    """(f, 3, 3) corners of a binary STL's triangles, read apart from pyvista, which drops degenerate ones."""
    triangle = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    return np.asarray(np.fromfile(file, dtype=triangle, offset=84)["corners"], dtype=np.float64)


def volume(corners: FloatArray) -> float:
    """Signed volume by the divergence theorem, positive for an outward orientation."""
    return float(np.linalg.det(corners).sum() / 6)


def areas(corners: FloatArray) -> FloatArray:
    """(f,) areas of triangles."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(np.linalg.norm(normals, axis=1) / 2)


@each_file
def test_surface_is_closed_and_every_shell_is_oriented_outward(file: Path) -> None:
    """In a consistently oriented closed surface each directed edge occurs once, and its reverse once."""
    surface, corners = pv.read(file).clean(), corners_of(file)
    assert surface.is_manifold
    assert surface.n_open_edges == 0
    _, vertex = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    triangles = vertex.reshape(-1, 3)
    edges = np.vstack([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    assert len(np.unique(edges, axis=0)) == len(edges)
    assert {tuple(edge) for edge in edges} == {tuple(edge) for edge in edges[:, ::-1]}
    assert surface.split_bodies().n_blocks == 1, "with more shells, look at the volume of each"
    assert volume(corners) > 0


@each_file
def test_no_triangle_is_degenerate_and_the_size_is_5_to_30_mm(file: Path) -> None:
    corners = corners_of(file)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    assert (2 * areas(corners) / longest).min() > SMALLEST_HEIGHT
    assert 5 <= np.ptp(corners.reshape(-1, 3), axis=0).max() <= 30


def test_files_are_small_together_and_the_script_makes_them_and_no_others_by_the_byte(made: tuple[Path, Path]) -> None:
    assert sum(file.stat().st_size for file in FILES) <= MOST_BYTES
    assert len(FILES) >= 20
    first, again = ({file.name: file.read_bytes() for file in folder.iterdir()} for folder in made)
    assert first.keys() == {file.name for file in FILES}
    assert first == again


@each_file
def test_script_makes_the_shipped_shape(file: Path, made: tuple[Path, Path]) -> None:
    shipped, again = corners_of(file), corners_of(made[0] / file.name)
    for extreme in (np.min, np.max):
        np.testing.assert_allclose(extreme(again, axis=(0, 1)), extreme(shipped, axis=(0, 1)), atol=SIMPLIFICATION)
    # A surface that moves by a distance changes the volume by at most that distance times its area.
    assert volume(again) == pytest.approx(volume(shipped), abs=SIMPLIFICATION * areas(shipped).sum())
