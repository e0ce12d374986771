"""Triangle meshes pressed, against an analytic body."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista as pv
from pads import scene

from synth.mesh import Counts, Focus, graded_box
from synth.scene import Scene
from synth.simulate import indenter, simulate
from synth.simulate.options import SolverOptions
from synth.simulate.probe import probe

SIZE = (12.0, 10.0, 3.0)
MESH = graded_box(SIZE, Focus((0.0, 0.0), (2.0, 2.0)), Counts((4, 4), (2, 2), 2))
EDGE, DEPTH = 3.5, 0.6
STRICT = SolverOptions(relaxed_tolerance=0.0)
PX_PER_MM = 17.0
"""Of the shipped scene gelsight_mini."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """With a cube in it whose edges are sharp."""
    pv.Cube(x_length=EDGE, y_length=EDGE, z_length=EDGE).triangulate().clean().save(tmp_path / "cube.stl")
    return tmp_path


def pressed(body: dict[str, Any]) -> Scene:
    moves = {"depth_mm": DEPTH, "shear_mm": [0.3, 0.2], "twist_deg": 5.0, "steps": 2, "position_mm": [0.1, 0.2]}
    return scene(SIZE, indenter=body, friction=0.5, motion=moves, numerics={"element": "auto"})


def cube(**fields: Any) -> dict[str, Any]:
    return {"shape": "mesh", "file": "cube.stl", **fields}


@pytest.mark.parametrize("turned", [(0.0, 0.0, 0.0), (20.0, 10.0, 30.0)])
def test_a_cube_is_the_block_of_its_fillet(folder: Path, monkeypatch, turned: tuple[float, float, float]) -> None:
    monkeypatch.setattr(indenter, "OBJECT_STIFFNESS", 1.0)  # as that of the block
    fillet = 0.7  # more than what the mesh asks for, so that both keep it
    block = {"shape": "box", "size_mm": [EDGE, EDGE, EDGE], "fillet_mm": fillet, "rotation_deg": turned}
    exact = simulate(pressed(block), MESH, options=STRICT)
    fine = cube(fillet_mm=fillet, cell_mm=fillet / 7, rotation_deg=turned)
    found = simulate(pressed(fine), MESH, folder, options=STRICT)
    axes = [np.linspace(-length / 2, length / 2, 31) for length in SIZE[:2]]
    face = probe(found.space, np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2))
    for one, other in zip(exact.states[1:], found.states[1:], strict=True):
        error = np.linalg.norm(np.subtract(one.force_n, other.force_n)) / np.linalg.norm(one.force_n)
        assert error < 0.01
        moved = (face @ (other.displacement - one.displacement))[:, :2]
        assert PX_PER_MM * np.sqrt((moved**2).sum(axis=1).mean()) < 0.02
