"""Graded meshes: what the solver relies on wherever the focus lies."""

import hashlib

import numpy as np
import pytest
from pads import area_vectors, contact_faces

from synth.arrays import FloatArray
from synth.mesh import Counts, Focus, PadMesh, graded_box
from synth.mesh.graded import FILM, FINEST, GRAIN_MM, STEEPEST, kuhn_tets, lateral_planes, spacing
from synth.mesh.pad import boundary_faces
from synth.mesh.tetrahedralise import WORST_SHAPE, shape_quality

SIZE = (20.0, 15.0, 4.0)
COUNTS = Counts(across=(8, 6), outer=(3, 2))
CENTRED = Focus((0.0, 0.0), (3.3, 2.8))
FOCI = {
    "centred": CENTRED,
    "off centre": Focus((4.0, -2.0), (3.0, 2.0)),
    "gap of a hair": Focus((6.999, 4.499), (3.0, 3.0)),
    "over the corner": Focus((9.5, -7.4), (3.3, 3.3)),
    "beyond the edge": Focus((30.0, 0.0), (1.0, 1.0)),
    "point": Focus((1.0, 2.0), (0.0, 0.0)),
    "line": Focus((1.0, 1.0), (50.0, 0.1)),
    "whole pad": Focus((0.0, 0.0), (10.0, 7.5)),
}
LAYERS = {"one": (), "film": (0.05,), "three": (0.1, 1.7), "thick": (3.9,)}


def random_spans(count: int, length: float) -> list[list[float]]:
    return np.sort(np.random.default_rng(5).uniform(-length / 2, length / 2, (count, 2))).tolist()


@pytest.mark.parametrize("layers", LAYERS.values(), ids=LAYERS)
@pytest.mark.parametrize("focus", FOCI.values(), ids=FOCI)
def test_fills_the_box_with_one_topology_and_bounded_shapes(focus: Focus, layers: tuple[float, ...]) -> None:
    mesh = graded_box(SIZE, focus, COUNTS, layers)
    assert mesh.volumes.min() > 0
    # Sums of 3000 volumes round to some 1e-15 relative.
    assert mesh.volumes.sum() == pytest.approx(np.prod(SIZE), rel=1e-12)
    assert mesh.tets is graded_box(SIZE, CENTRED, COUNTS, layers).tets
    assert (mesh.points.min(axis=0) == [-10.0, -7.5, 0.0]).all()
    assert (mesh.points.max(axis=0) == [10.0, 7.5, 4.0]).all()
    assert graded_box(SIZE, focus, COUNTS, layers).hash == mesh.hash
    if not layers:  # what fTetWild's meshes must meet, too
        assert shape_quality(mesh.points, mesh.tets).min() > WORST_SHAPE


def test_neighbours_share_faces_all_but_the_window_is_touchable_and_mirror_images_are_mirrored() -> None:
    centred = graded_box(SIZE, CENTRED, COUNTS)
    nx, ny, nz = COUNTS.cells(0), COUNTS.cells(1), COUNTS.through
    assert kuhn_tets(nx, ny, nz) is centred.tets  # made once
    assert not centred.tets.flags.writeable
    assert len(centred.points) == (nx + 1) * (ny + 1) * (nz + 1)
    assert len(boundary_faces(centred.tets)) == 4 * (nx * ny + ny * nz + nx * nz)
    assert len(contact_faces(centred).faces) == 2 * nx * ny
    mesh = graded_box(SIZE, FOCI["off centre"], COUNTS)
    area = area_vectors(mesh.points, mesh.touchable)
    assert np.linalg.norm(area, axis=1).sum() == pytest.approx(20 * 15 + 2 * (20 + 15) * 4, rel=1e-12)
    # Outward: the five faces' area vectors add up to minus the missing window face's, (0, 0, 20 * 15).
    np.testing.assert_allclose(area.sum(axis=0), [0, 0, -300.0], atol=1e-10)
    centre = mesh.points[mesh.touchable].mean(axis=1)
    assert (np.einsum("ij,ij->i", area, centre - [0, 0, 2.0]) > 0).all()
    assert mesh.touchable.dtype == np.int32
    assert not mesh.bonded[mesh.touchable].all(axis=1).any()
    place = {tuple(point): i for i, point in enumerate(centred.points)}
    for axis in (0, 1):
        image = centred.points.copy()
        image[:, axis] *= -1
        turned = np.array([place[tuple(point)] for point in image])[centred.tets]
        assert {frozenset(tet) for tet in turned.tolist()} == {frozenset(tet) for tet in centred.tets.tolist()}
    for low, high in random_spans(200, 20.0):
        planes = lateral_planes(20.0, (low, high), COUNTS, 0)
        assert (lateral_planes(20.0, (-high, -low), COUNTS, 0) == -planes[::-1]).all()
        assert (planes / GRAIN_MM % 1 == 0).all()


def test_centred_spacing_is_even_then_geometric_as_is_depth() -> None:
    planes = lateral_planes(20.0, (-3.3, 3.3), COUNTS, 0)
    step = np.diff(planes)
    np.testing.assert_allclose(step[3:11], 6.6 / 8, atol=2 * GRAIN_MM)  # Two coordinates rounded to GRAIN_MM
    np.testing.assert_allclose(planes[[3, 11]], [-3.3, 3.3], atol=2 * GRAIN_MM)
    ratio = max(root.real for root in np.roots([1, 1, 1, -6.7 / 0.825]) if abs(root.imag) < 1e-9)
    np.testing.assert_allclose(step[11:], 0.825 * ratio ** np.arange(1, 4), atol=4 * GRAIN_MM)
    steps = _depth_steps(Counts(through=4, growth=1.5))  # h (1 + 1.5 + 2.25 + 3.375) = 4 mm
    np.testing.assert_allclose(steps, 4 / 8.125 * 1.5 ** np.arange(4), atol=2 * GRAIN_MM)
    np.testing.assert_allclose(_depth_steps(Counts(through=4, growth=1.0)), 1.0, atol=2 * GRAIN_MM)


def largest_ratio(q: float) -> float:
    """Bound on the ratio of neighbouring spacings, q for whole elements and a little more between."""
    # An element across the zone's end, a share t inside, is t f + f q (q^(1-t) - 1) / (q - 1) long, the next f q^(2-t).
    t = np.linspace(0, 1, 2001)
    return float((q ** (2 - t) / (t + q * (q ** (1 - t) - 1) / (q - 1))).max()) if q > 1 else 1.0


@pytest.mark.parametrize("counts", [COUNTS, Counts(across=(12, 4), outer=(5, 3))], ids=["usual", "other"])
def test_spacing_is_even_in_the_focus_and_grows_by_a_bounded_ratio(counts: Counts) -> None:
    assert largest_ratio(STEEPEST) < 1.1 * STEEPEST  # as the constant's docstring says
    wide = 0
    for low, high in random_spans(300, 15.0):
        fine, rate = spacing(15.0, (low, high), counts, 1)
        planes = lateral_planes(15.0, (low, high), counts, 1)
        step, even = np.diff(planes), 15.0 / counts.cells(1)
        ratio = step[1:] / step[:-1]
        # Rounding to GRAIN_MM changes a spacing of at least FINEST * even = 0.04 mm by 2 GRAIN_MM at most.
        limit = largest_ratio(float(np.exp(rate))) * (1 + 4 * GRAIN_MM / (FINEST * even))
        assert np.exp(rate) <= STEEPEST * (1 + 1e-12)
        assert np.maximum(ratio, 1 / ratio).max() <= limit
        inside = (planes[:-1] >= low) & (planes[1:] <= high)
        np.testing.assert_allclose(step[inside], fine, atol=2 * GRAIN_MM)
        assert FINEST * even <= fine <= min(even, step.min() + 2 * GRAIN_MM)
        wanted = max((high - low) / counts.across[1], FINEST * even)
        if rate < np.log(STEEPEST) and wanted < even:
            wide += 1
            assert fine == wanted
    assert wide > 100  # the limits are the exception


def test_small_focus_outgrows_its_elements_and_planes_move_continuously_with_it() -> None:
    """Where STEEPEST does not fill the pad, the spacing in the focus is coarser than asked, and fills it exactly."""
    fine, rate = spacing(20.0, (-0.1, 0.1), Counts(across=(8, 8), outer=(2, 2)), 0)
    assert np.exp(rate) == pytest.approx(STEEPEST)
    assert fine > 0.2 / 8
    # 12 elements: inside the zone 0.2 / f, beside it n each with f (q + ... + q^n) = 9.9 as a continuous sum.
    beside = (12 - 0.2 / fine) / 2
    reach = fine * STEEPEST * (STEEPEST**beside - 1) / (STEEPEST - 1)
    assert reach == pytest.approx(9.9, rel=1e-9)  # a root by halving, to the last bits
    walk = np.linspace(0.0, 12.0, 1201)
    planes = np.array([lateral_planes(20.0, Focus((x, 0), (3, 3)).span(0, 20.0), COUNTS, 0) for x in walk])
    # Planes move a few times as fast as the focus at most (0.05 mm a step was seen); a jump would be 0.75 mm or more.
    assert np.abs(np.diff(planes, axis=0)).max() < 0.2


@pytest.mark.parametrize("layers", LAYERS.values(), ids=LAYERS)
def test_layers_are_bounded_by_planes(layers: tuple[float, ...]) -> None:
    counts = Counts(through=3)
    mesh = graded_box(SIZE, CENTRED, counts, layers)
    faces = np.concatenate([[0.0], np.cumsum(layers), [SIZE[2]]])
    z = mesh.points[mesh.tets][:, :, 2]
    planes = np.unique(mesh.points[:, 2])
    assert set(faces) <= set(planes)
    assert mesh.layer.dtype == np.int32
    assert set(mesh.layer) == set(range(len(layers) + 1))
    assert (z >= faces[mesh.layer][:, None]).all()
    assert (z <= faces[mesh.layer + 1][:, None]).all()
    for k in range(len(layers) + 1):
        between = ((planes > faces[k]) & (planes <= faces[k + 1])).sum()
        assert between >= (FILM if layers else counts.through)
        volume = SIZE[0] * SIZE[1] * (faces[k + 1] - faces[k])
        assert mesh.volumes[mesh.layer == k].sum() == pytest.approx(volume, rel=1e-12)
    assert np.diff(planes).max() <= _depth_steps(counts).max() + 1e-9


def _depth_steps(counts: Counts) -> FloatArray:
    return np.diff(np.unique(graded_box(SIZE, CENTRED, counts).points[:, 2]))


def test_hash_knows_layers_and_layers_that_give_no_mesh_are_refused() -> None:
    mesh = graded_box(SIZE, CENTRED, COUNTS)
    # As it was before there were layers: trajectories and datasets name meshes by it.
    content = mesh.points.astype("<f8").tobytes() + mesh.tets.astype("<i4").tobytes()
    assert mesh.hash == hashlib.sha256(content).hexdigest()
    layered = PadMesh(mesh.points, mesh.tets, SIZE, (np.arange(len(mesh.tets)) % 2).astype(np.int32))
    assert layered.hash != mesh.hash
    for layers in ((0.0,), (-1.0, 2.0), (4.0,), (3.0, 2.0)):
        with pytest.raises(ValueError, match="must be positive and thinner"):
            graded_box(SIZE, CENTRED, COUNTS, layers)
