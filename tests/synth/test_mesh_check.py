"""What `check_mesh` refuses, so that no solver is started on it."""

from dataclasses import replace

import numpy as np
import pytest
from pads import brick

from synth.errors import InputError
from synth.mesh import PadMesh, check_mesh

MESH = brick((4.0, 3.0, 2.0), (2, 2, 2))


def moved(corner: int, place: np.ndarray) -> PadMesh:
    """The mesh with one corner of its first tetrahedron somewhere else."""
    points = MESH.points.copy()
    points[MESH.tets[0, corner]] = place
    return replace(MESH, points=points)


def test_a_sound_mesh_passes_and_so_does_a_sliver() -> None:
    check_mesh(MESH)
    others = MESH.points[MESH.tets[0, :3]]
    top = MESH.points[MESH.tets[0, 3]]
    sliver = moved(3, others.mean(axis=0) + 1e-3 * (top - others.mean(axis=0)))
    assert 0 < sliver.volumes[0] < 2e-3 * MESH.volumes[0]
    check_mesh(PadMesh(sliver.points[sliver.tets[0]], np.array([[0, 1, 2, 3]]), MESH.size_mm))  # others may turn over


@pytest.mark.parametrize("seed", range(12))
def test_flat_is_refused_whatever_the_rounding(seed: int) -> None:
    """The volume then is 0 or some 1e-17 of either sign. Fails with 0 as the least share."""
    rng = np.random.default_rng(seed)
    corners = rng.normal(size=(3, 3))
    alone = PadMesh(np.vstack([corners, rng.dirichlet(np.ones(3)) @ corners]), np.array([[0, 1, 2, 3]]), MESH.size_mm)
    with pytest.raises(InputError, match="must be > 0"):
        check_mesh(alone)


def test_inside_out_one_point_not_finite_and_loose() -> None:
    """Fails with any of the checks left out."""
    flipped = MESH.tets.copy()
    flipped[5] = flipped[5][[1, 0, 2, 3]]
    one = MESH.points.copy()
    one[MESH.tets[0]] = one[MESH.tets[0, 0]]
    lost = np.concatenate([MESH.points, [[0.0, 0.0, 1.0]]])
    for mesh, message in (
        (replace(MESH, tets=flipped), "tetrahedron 5 of the mesh has a volume of -"),
        (replace(MESH, points=one), "volume of 0 mm"),
        (moved(0, np.array([np.nan, 0.0, 0.0])), "not finite"),
        (replace(MESH, points=lost), f"node {len(MESH.points)} of the mesh belongs to no tetrahedron"),
    ):
        with pytest.raises(InputError, match=message):
            check_mesh(mesh)
