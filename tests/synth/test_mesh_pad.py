"""A pad's mesh: what the mesher's output is made into, and what the later stages rely on."""

import os
from dataclasses import replace

import numpy as np
import pytest
from pads import brick

from synth.mesh import PadMesh
from synth.mesh.pad import boundary_faces, signed_volumes
from synth.mesh.sizing import GRADING
from synth.mesh.tetrahedralise import WORST_SHAPE, _fault, _repair, shape_quality, tetrahedralise_box

SIZE = (7.0, 5.0, 2.5)
EDGE = 0.6


@pytest.fixture(scope="module")
def pad(tmp_path_factory: pytest.TempPathFactory) -> PadMesh:
    """A real mesh, made in an empty working directory."""
    folder, before = tmp_path_factory.mktemp("cwd"), os.getcwd()
    os.chdir(folder)
    try:
        mesh = tetrahedralise_box(SIZE, EDGE)
        # fTetWild drops a __tracked_surface.stl where it runs.
        assert list(folder.iterdir()) == []
        assert os.getcwd() == str(folder)
    finally:
        os.chdir(before)
    return mesh


def double_area(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (points[faces[:, i]] for i in range(3))
    return np.cross(b - a, c - a)


def test_fills_the_box(pad: PadMesh) -> None:
    assert pad.volumes.min() > 0
    # Sums of a few hundred volumes of about 0.1 mm^3 round to 1e-14 relative; 1e-12 leaves room.
    assert pad.volumes.sum() == pytest.approx(np.prod(SIZE), rel=1e-12)
    assert (np.unique(pad.tets) == np.arange(len(pad.points))).all()
    assert pad.points.dtype == np.float64
    assert pad.tets.dtype == np.int32


def test_faces_are_exactly_flat(pad: PadMesh) -> None:
    # Fails without the snapping in _repair: fTetWild leaves boundary vertices up to epsilon off.
    low, high = np.array([-SIZE[0] / 2, -SIZE[1] / 2, 0.0]), np.array([SIZE[0] / 2, SIZE[1] / 2, SIZE[2]])
    corners = pad.points[boundary_faces(pad.tets)]
    on_a_plane = (corners == low).all(axis=1) | (corners == high).all(axis=1)
    assert on_a_plane.any(axis=1).all()
    assert (pad.points >= low).all()
    assert (pad.points <= high).all()
    box = np.array([(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    assert all((pad.points == corner).all(axis=1).any() for corner in box)


def test_boundary_is_closed_and_points_outward(pad: PadMesh) -> None:
    # Fails when two nodes of any row of _FACES_OF_TET are exchanged.
    faces = boundary_faces(pad.tets)
    area = double_area(pad.points, faces) / 2
    # Closed: the area vectors of some 500 faces sum to zero but for rounding, 500 * 1e-16 * 1 mm^2.
    np.testing.assert_allclose(area.sum(axis=0), 0.0, atol=1e-12)
    # Divergence theorem: positive only if the normals point out.
    enclosed = np.einsum("ij,ij->", pad.points[faces].mean(axis=1), area) / 3
    assert enclosed == pytest.approx(np.prod(SIZE), rel=1e-12)


def test_contact_faces(pad: PadMesh) -> None:
    contact = pad.contact_faces
    area = double_area(contact.nodes, contact.faces) / 2
    assert (contact.nodes == pad.points[pad.contact_nodes]).all()
    assert (contact.nodes[:, 2] == 0).all()
    assert (area[:, :2] == 0).all()
    assert (area[:, 2] < 0).all()
    assert -area[:, 2].sum() == pytest.approx(SIZE[0] * SIZE[1], rel=1e-12)
    assert (np.unique(contact.faces) == np.arange(len(contact.nodes))).all()
    assert (pad.contact_nodes == np.flatnonzero(pad.points[:, 2] == 0)).all()


def test_bonded_nodes_are_the_window_face(pad: PadMesh) -> None:
    assert (pad.bonded == (pad.points[:, 2] == SIZE[2])).all()
    assert 4 <= pad.bonded.sum() < len(pad.contact_nodes)  # coarser there than at the contact face


def test_edge_lengths_are_graded(pad: PadMesh) -> None:
    """Edges are EDGE long at the contact face and longer toward the window."""

    def edge(level: float) -> float:
        """Of as many equilateral triangles on that face."""
        faces = boundary_faces(pad.tets)
        count = (pad.points[faces][:, :, 2] == level).all(axis=1).sum()
        return float(np.sqrt(4 / np.sqrt(3) * SIZE[0] * SIZE[1] / count))

    # fTetWild splits edges longer than 4/3 of the target and collapses those shorter than 4/5. Fails without bg_values.
    assert 4 / 5 * EDGE < edge(0.0) < 4 / 3 * EDGE
    assert 1.2 * edge(0.0) < edge(SIZE[2]) < 4 / 3 * GRADING * EDGE


def test_shape_quality_of_known_tetrahedra(pad: PadMesh) -> None:
    assert shape_quality(pad.points, pad.tets).min() >= WORST_SHAPE
    tets = np.array([[0, 1, 2, 3]], np.int32)
    regular = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], float)
    # Right corner: inscribed radius 1 / (3 + sqrt 3), circumscribed sqrt 3 / 2.
    corner = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    flat = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.3, 0.3, 1e-6]], float)
    # A dozen multiplications: a few 1e-16 each.
    assert shape_quality(regular, tets)[0] == pytest.approx(1.0, rel=1e-13)
    assert shape_quality(5 * corner, tets)[0] == pytest.approx(6 / (3 + 3**0.5) / 3**0.5, rel=1e-13)
    assert shape_quality(flat, tets)[0] < 1e-5


def test_signed_volume_changes_sign_with_orientation() -> None:
    corner = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    assert signed_volumes(corner, np.array([[0, 1, 2, 3]], np.int32))[0] == pytest.approx(1 / 6)
    assert signed_volumes(corner, np.array([[0, 2, 1, 3]], np.int32))[0] == pytest.approx(-1 / 6)


def test_repair_snaps_turns_and_drops() -> None:
    exact = brick(SIZE, (3, 2, 2))
    noise = 1e-3 * np.random.default_rng(1).uniform(-1, 1, exact.points.shape)
    points = np.concatenate([exact.points + noise, [[9.0, 9.0, 9.0]]])  # the last vertex belongs to no tetrahedron
    points, tets = _repair(points, exact.tets[:, [0, 2, 1, 3]], SIZE)
    assert len(points) == len(exact.points)
    assert (signed_volumes(points, tets) > 0).all()
    on_low, on_high = exact.points == exact.points.min(axis=0), exact.points == exact.points.max(axis=0)
    assert (points[on_low | on_high] == exact.points[on_low | on_high]).all()
    assert _fault(points, tets, SIZE) == ""


def test_faults_are_named() -> None:
    exact = brick(SIZE, (3, 2, 2))
    assert _fault(exact.points, exact.tets, SIZE) == ""
    assert "fills" in _fault(exact.points, exact.tets[1:], SIZE)
    assert "volume" in _fault(exact.points, exact.tets[:, [0, 2, 1, 3]], SIZE)
    flat = exact.points.copy()
    inside = np.flatnonzero((np.abs(flat - [-SIZE[0] / 6, 0.0, SIZE[2] / 2]) < 1e-9).all(axis=1))
    assert len(inside) == 1
    flat[inside, 2] = 1e-3 * SIZE[2]  # a node almost on the contact face: the volume stays right, the shapes do not
    assert "quality" in _fault(flat, exact.tets, SIZE)


def test_hash_names_the_content(pad: PadMesh) -> None:
    assert PadMesh(pad.points.copy(), pad.tets.copy(), SIZE).hash == pad.hash
    moved, turned = pad.points.copy(), pad.tets.copy()
    moved[0, 0] = np.nextafter(moved[0, 0], 9.0)
    turned[0] = turned[0][[1, 2, 0, 3]]
    assert len({pad.hash, replace(pad, points=moved).hash, replace(pad, tets=turned).hash}) == 3
