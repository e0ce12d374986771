"""A pad's mesh: what the mesher's output is made into, what is refused and cached, and refinement by a sizing field."""

import contextlib
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from commands import refused
from pads import area_vectors, brick, contact_faces, crooked

import synth.mesh.cache as cache
from benchmarks.focused_mesh import around_focus
from synth.arrays import FloatArray
from synth.mesh import Focus, PadMesh, check_mesh, edge_length, mesh_key, pad_mesh
from synth.mesh.pad import boundary_faces, signed_volumes
from synth.mesh.tetrahedralise import (
    GRADING,
    WORST_SHAPE,
    _fault,
    _repair,
    box_sides,
    shape_quality,
    tetrahedralise_box,
)
from synth.scene import BoxGel, Layer, Numerics

SIZE = (7.0, 5.0, 2.5)
EDGE = 0.6
SOUND = brick((4.0, 3.0, 2.0), (2, 2, 2))
GEL = BoxGel(size_mm=(4.0, 4.0, 3.0), youngs_modulus_kpa=200.0)
NUMERICS = Numerics(edge_length_mm=1.5)
WIDE = (12.0, 9.0, 3.0)
FOCUS = Focus((1.5, -1.0), (2.0, 1.5))


@pytest.fixture(scope="module")
def pad(tmp_path_factory: pytest.TempPathFactory) -> PadMesh:
    """A real mesh, made in an empty working directory."""
    folder = tmp_path_factory.mktemp("cwd")
    with contextlib.chdir(folder):
        mesh = tetrahedralise_box(SIZE, EDGE)
        assert Path.cwd() == folder
    assert list(folder.iterdir()) == []  # fTetWild drops a __tracked_surface.stl where it runs
    return mesh


def test_fills_the_box_with_flat_closed_faces_and_edges_graded_toward_the_window(pad: PadMesh) -> None:
    assert pad.volumes.min() > 0
    # Sums of a few hundred volumes of about 0.1 mm^3 round to 1e-14 relative; 1e-12 leaves room.
    assert pad.volumes.sum() == pytest.approx(np.prod(SIZE), rel=1e-12)
    assert (np.unique(pad.tets) == np.arange(len(pad.points))).all()
    assert (pad.points.dtype, pad.tets.dtype) == (np.float64, np.int32)
    low, high = np.array(SIZE) * (-0.5, -0.5, 0), np.array(SIZE) * (0.5, 0.5, 1)
    corners = pad.points[boundary_faces(pad.tets)]
    assert ((corners == low).all(axis=1) | (corners == high).all(axis=1)).any(axis=1).all()
    assert ((pad.points >= low) & (pad.points <= high)).all()
    points = set(map(tuple, pad.points))
    assert points >= set(product(*zip(low, high, strict=True)))
    faces = boundary_faces(pad.tets)
    area = area_vectors(pad.points, faces)
    # Closed: the area vectors of some 500 faces sum to zero but for rounding, 500 * 1e-16 * 1 mm^2.
    np.testing.assert_allclose(area.sum(axis=0), 0.0, atol=1e-12)
    # Divergence theorem: positive only if the normals point out.
    enclosed = np.einsum("ij,ij->", pad.points[faces].mean(axis=1), area) / 3
    assert enclosed == pytest.approx(np.prod(SIZE), rel=1e-12)
    contact = contact_faces(pad)
    area = area_vectors(contact.nodes, contact.faces)
    assert (pad.on_face == (pad.points[:, 2] == 0)).all()
    assert (contact.nodes == pad.points[pad.on_face]).all()
    assert (area[:, :2] == 0).all()
    assert (area[:, 2] < 0).all()
    assert -area[:, 2].sum() == pytest.approx(SIZE[0] * SIZE[1], rel=1e-12)
    assert (np.unique(contact.faces) == np.arange(len(contact.nodes))).all()
    assert (pad.bonded == (pad.points[:, 2] == SIZE[2])).all()
    assert 4 <= pad.bonded.sum() < len(contact.nodes)  # coarser there than at the contact face

    def edge(level: float) -> float:
        faces = boundary_faces(pad.tets)
        count = (pad.points[faces][:, :, 2] == level).all(axis=1).sum()
        return float(np.sqrt(4 / np.sqrt(3) * SIZE[0] * SIZE[1] / count))

    # fTetWild splits edges longer than 4/3 of the target and collapses those shorter than 4/5.
    assert 4 / 5 * EDGE < edge(0.0) < 4 / 3 * EDGE
    assert 1.2 * edge(0.0) < edge(SIZE[2]) < 4 / 3 * GRADING * EDGE


def test_quality_and_volume_of_known_tetrahedra_and_the_hash_names_the_content(pad: PadMesh) -> None:
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
    assert signed_volumes(corner, np.array([[0, 1, 2, 3], [0, 2, 1, 3]])) == pytest.approx([1 / 6, -1 / 6])
    assert PadMesh(pad.points.copy(), pad.tets.copy(), SIZE).hash == pad.hash
    moved, turned = pad.points.copy(), pad.tets.copy()
    moved[0, 0] = np.nextafter(moved[0, 0], 9.0)
    turned[0] = turned[0][[1, 2, 0, 3]]
    assert len({pad.hash, replace(pad, points=moved).hash, replace(pad, tets=turned).hash}) == 3


def fault(points: FloatArray, tets: np.ndarray) -> str:
    return _fault(points, tets, box_sides(SIZE), float(np.prod(SIZE)), 1e-9)


def test_repair_snaps_turns_and_drops_and_faults_are_named() -> None:
    exact = brick(SIZE, (3, 2, 2))
    noise = 1e-3 * np.random.default_rng(1).uniform(-1, 1, exact.points.shape)
    points = np.concatenate([exact.points + noise, [[9.0, 9.0, 9.0]]])  # the last vertex belongs to no tetrahedron
    points, tets = _repair(points, exact.tets[:, [0, 2, 1, 3]], box_sides(SIZE), 0.02)
    assert len(points) == len(exact.points)
    assert (signed_volumes(points, tets) > 0).all()
    on_low, on_high = exact.points == exact.points.min(axis=0), exact.points == exact.points.max(axis=0)
    assert (points[on_low | on_high] == exact.points[on_low | on_high]).all()
    assert fault(points, tets) == ""
    assert fault(exact.points, exact.tets) == ""
    assert "off the gel's shape" in fault(exact.points + 1e-6, exact.tets)
    assert "fills" in fault(exact.points, exact.tets[1:])
    assert "volume" in fault(exact.points, exact.tets[:, [0, 2, 1, 3]])
    flat = exact.points.copy()
    (inside,) = np.flatnonzero((np.abs(flat - [-SIZE[0] / 6, 0.0, SIZE[2] / 2]) < 1e-9).all(axis=1))
    flat[inside, 2] = 1e-3 * SIZE[2]  # a node almost on the contact face: the volume stays right, the shapes do not
    assert "quality" in fault(flat, exact.tets)


def moved(corner: int, place: np.ndarray) -> PadMesh:
    points = SOUND.points.copy()
    points[SOUND.tets[0, corner]] = place
    return replace(SOUND, points=points)


def test_sound_meshes_and_slivers_pass_but_flat_inverted_and_broken_ones_are_refused() -> None:
    check_mesh(SOUND)
    others = SOUND.points[SOUND.tets[0, :3]]
    top = SOUND.points[SOUND.tets[0, 3]]
    sliver = moved(3, others.mean(axis=0) + 1e-3 * (top - others.mean(axis=0)))
    assert 0 < sliver.volumes[0] < 2e-3 * SOUND.volumes[0]
    check_mesh(PadMesh(sliver.points[sliver.tets[0]], np.array([[0, 1, 2, 3]]), SOUND.size_mm))  # others may turn over
    rng = np.random.default_rng(0)  # The volume of a flat one is 0 or some 1e-17 of either sign
    for corners in rng.normal(size=(12, 3, 3)):
        points = np.vstack([corners, rng.dirichlet(np.ones(3)) @ corners])
        refused("must be > 0", check_mesh, PadMesh(points, np.array([[0, 1, 2, 3]]), SOUND.size_mm))
    flipped = SOUND.tets.copy()
    flipped[5] = flipped[5][[1, 0, 2, 3]]
    one = SOUND.points.copy()
    one[SOUND.tets[0]] = one[SOUND.tets[0, 0]]
    lost = np.concatenate([SOUND.points, [[0.0, 0.0, 1.0]]])
    for mesh, message in (
        (replace(SOUND, tets=flipped), "tetrahedron 5 of the mesh has a volume of -"),
        (replace(SOUND, points=one), "volume of 0 mm"),
        (moved(0, np.array([np.nan, 0.0, 0.0])), "not finite"),
        (replace(SOUND, points=lost), f"node {len(SOUND.points)} of the mesh belongs to no tetrahedron"),
    ):
        refused(message, check_mesh, mesh)


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """A fast mesher that, like the real one, never makes the same mesh twice; its calls are counted."""
    calls: list[float] = []

    def counted(size: tuple[float, float, float], edge: float) -> PadMesh:
        calls.append(edge)
        return crooked(size, seed=len(calls))

    monkeypatch.setattr(cache, "tetrahedralise_box", counted)
    return calls


def test_made_once_and_read_bitwise_with_and_without_layers(tmp_path: Path, made: list[float]) -> None:
    first = pad_mesh(GEL, NUMERICS, [tmp_path])
    again = pad_mesh(GEL, NUMERICS, [tmp_path])
    assert made == [1.5]
    assert (again.points == first.points).all()
    assert (again.tets == first.tets).all()
    assert again.tets.dtype == np.int32
    assert again.hash == first.hash
    assert [path.name for path in tmp_path.iterdir()] == [f"{mesh_key(GEL, NUMERICS)}.npz"]  # nothing left aside
    film = GEL.model_copy(update={"layers": (Layer(thickness_mm=0.1, youngs_modulus_kpa=900.0),)})
    layered = pad_mesh(film, NUMERICS, [tmp_path])
    below = layered.points[layered.tets[layered.layer == 0]][:, :, 2]
    assert (below.min(), below.max()) == pytest.approx((0.0, 0.1), abs=1e-12)
    assert layered.volumes[layered.layer == 0].sum() == pytest.approx(0.1 * 4 * 4, rel=1e-12)
    assert layered.volumes.sum() == pytest.approx(4 * 4 * 3, rel=1e-12)
    assert made == [1.5]


@pytest.mark.parametrize("damage", ["empty", "cut", "flipped", "text", "no tets"])
def test_damaged_file_is_made_again(tmp_path: Path, made: list[float], damage: str) -> None:
    pad_mesh(GEL, NUMERICS, [tmp_path])
    path = tmp_path / f"{mesh_key(GEL, NUMERICS)}.npz"
    content = path.read_bytes()
    middle = len(content) // 2
    flipped = content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]
    if damage == "no tets":
        np.savez(path, points=np.zeros((4, 3)))
    else:
        path.write_bytes({"empty": b"", "cut": content[:middle], "flipped": flipped, "text": b"no mesh"}[damage])
    again = [pad_mesh(GEL, NUMERICS, [tmp_path]).hash for _ in range(2)]
    assert again[0] == again[1]
    assert len(made) == 2


def test_every_folder_gets_the_mesh_of_the_first_that_has_it(tmp_path: Path, made: list[float]) -> None:
    dataset, user, other = tmp_path / "dataset", tmp_path / "user", tmp_path / "other"
    kept = pad_mesh(GEL, NUMERICS, [dataset])
    pad_mesh(GEL, NUMERICS, [user])
    assert pad_mesh(GEL, NUMERICS, [dataset, user, other]).hash == kept.hash
    assert pad_mesh(GEL, NUMERICS, [other]).hash == kept.hash
    assert len(made) == 2


def test_user_cache_follows_xdg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, made: list[float]) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache.user_cache() == tmp_path / "gelflow-synth" / "meshes"
    mesh = pad_mesh(GEL, NUMERICS)
    assert (cache.user_cache() / f"{mesh_key(GEL, NUMERICS)}.npz").is_file()
    assert pad_mesh(GEL, NUMERICS).hash == mesh.hash
    assert len(made) == 1


def test_key_depends_on_what_the_mesh_depends_on_only_and_on_the_default_edge() -> None:
    key = mesh_key(GEL, NUMERICS)
    assert mesh_key(GEL.model_copy(update={"size_mm": (4.0, 4.0, 3.1)}), NUMERICS) != key
    assert mesh_key(GEL, Numerics(edge_length_mm=1.4)) != key
    assert mesh_key(GEL.model_copy(update={"youngs_modulus_kpa": 7.0, "poisson_ratio": 0.3}), NUMERICS) == key
    assert mesh_key(GEL, Numerics(edge_length_mm=1.5, tolerance=1e-4)) == key
    assert mesh_key(GEL, Numerics()) == mesh_key(GEL, Numerics(edge_length_mm=edge_length(GEL, Numerics())))
    for thickness, edge in ((2.0, 0.4), (4.0, 0.8), (8.0, 1.0)):
        gel = GEL.model_copy(update={"size_mm": (20.0, 20.0, thickness)})
        assert edge_length(gel, Numerics()) == pytest.approx(edge)


def test_edges_are_small_in_the_focus_only() -> None:
    pad = tetrahedralise_box(WIDE, EDGE, around_focus(WIDE, EDGE, FOCUS, 2.0))
    contact = contact_faces(pad)
    corners = contact.nodes[contact.faces]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean(axis=1)
    beyond = np.abs(corners.mean(axis=1)[:, :2] - FOCUS.centre_mm) - FOCUS.half_mm
    away = np.linalg.norm(np.maximum(beyond, 0), axis=1)  # from the zone
    # fTetWild aims at edges of 4/5 to 4/3 of the target and is random: the limits lie 6 deviations of 20 meshes away.
    assert 0.8 * EDGE < edges[away == 0].mean() < 1.5 * EDGE
    assert edges[away > 2.5].mean() > 1.25 * edges[away == 0].mean()
    assert len(corners) < 0.5 * WIDE[0] * WIDE[1] / (np.sqrt(3) / 4 * EDGE**2)


def test_focus_is_clipped_to_the_pad_and_what_is_none_is_refused() -> None:
    assert FOCUS.clipped(WIDE) == FOCUS
    assert Focus((5.0, 0.0), (3.0, 1.0)).clipped(WIDE) == Focus((4.0, 0.0), (2.0, 1.0))  # over the edge
    assert Focus((20.0, -9.0), (3.0, 1.0)).clipped(WIDE) == Focus((6.0, -4.5), (0.0, 0.0))  # beside the pad
    assert Focus((0.0, 0.0), (99.0, 99.0)).clipped(WIDE) == Focus((0.0, 0.0), (6.0, 4.5))
