"""Objects: the shipped solids of scenes/objects, triangle meshes as files have them, and their edges after rounding."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import pyvista as pv
from commands import refused
from pads import areas

from synth.arrays import FloatArray
from synth.press.indenter import EVERYTHING, OBJECT_RADIUS, RigidBody, Touchable, object_radius, rigid_body
from synth.press.measure import Distance
from synth.scene import Box, MeshIndenter

FOLDER = Path(__file__).parents[2] / "scenes" / "objects"
FILES = sorted(FOLDER.glob("*.stl"))
SIMPLIFICATION = 0.01
"""mm, TOLERANCE in make.py: another version of manifold3d may simplify elsewhere and move the surface by as much."""
each_file = pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
CUBE = pv.Cube(x_length=4.0, y_length=3.0, z_length=2.0).triangulate().clean()
CELL = 0.1


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


def triangle_areas(corners: FloatArray) -> FloatArray:
    return areas(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))


@each_file
def test_surface_is_closed_oriented_outward_without_slivers_and_5_to_30_mm_long(file: Path) -> None:
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
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    # mm, what make.py rounds coordinates to: a triangle that rounding collapsed has less.
    assert (2 * triangle_areas(corners) / longest).min() > 1e-4
    assert 5 <= np.ptp(corners.reshape(-1, 3), axis=0).max() <= 30


def test_files_are_small_together_and_the_script_makes_them_and_no_others_by_the_byte(made: tuple[Path, Path]) -> None:
    assert sum(file.stat().st_size for file in FILES) <= 1_000_000
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
    assert volume(again) == pytest.approx(volume(shipped), abs=SIMPLIFICATION * triangle_areas(shipped).sum())


def saved(folder: Path, points: FloatArray, faces: np.ndarray, name: str = "object.stl") -> Path:
    pv.PolyData.from_regular_faces(np.asarray(points, dtype=float), faces).save(folder / name)
    return folder / name


def body_of(path: Path, fillet_mm: float | None = None, touchable: Touchable = EVERYTHING) -> RigidBody:
    indenter = MeshIndenter(shape="mesh", file=path.name, cell_mm=CELL, fillet_mm=fillet_mm)
    return rigid_body(indenter, path.parent, touchable=touchable)


def distances(body: RigidBody, points: FloatArray) -> FloatArray:
    return Distance(body, np.zeros((1, 3)), np.eye(3)[None])(points, np.zeros(len(points), dtype=np.int32))[1]


def around(half: tuple[float, float, float]) -> FloatArray:
    return np.random.default_rng(7).uniform(-1, 1, (4000, 3)) * (np.array(half) + 2 * CELL)


def assert_equal_near(found: FloatArray, exact: FloatArray, near: float, error: float) -> None:
    close = np.abs(exact) < near
    np.testing.assert_allclose(found[close], exact[close], atol=error)


def parts(kind: str) -> tuple[FloatArray, np.ndarray]:
    points, faces = np.asarray(CUBE.points, dtype=float), np.asarray(CUBE.regular_faces)
    match kind:
        case "inverted":
            faces = faces[:, ::-1]
        case "one face inverted":
            faces = np.concatenate([faces[:1, ::-1], faces[1:]])
        case "doubled":
            faces = np.concatenate([faces, faces[:6], faces[6:, ::-1]])
        case "two shells":  # the left and the right part, 1 mm of them in common
            sides = np.where(points[:, :1] > 0, [0.5, 2.0], [-2.0, -0.5])
            left, right = (np.column_stack([side, points[:, 1:]]) for side in sides.T)
            points, faces = np.concatenate([left, right]), np.concatenate([faces, faces[:, ::-1] + len(points)])
        case "unjoined":
            points, faces = points[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)
    return points, faces


@pytest.mark.parametrize("kind", ["inverted", "one face inverted", "doubled", "two shells", "unjoined"])
def test_meshes_with_faults_are_the_same_body(tmp_path: Path, kind: str) -> None:
    body, whole = (body_of(saved(tmp_path, *parts(one)), fillet_mm=0.3) for one in (kind, ""))
    places = around((2.0, 1.5, 1.0))
    assert_equal_near(distances(body, places), distances(whole, places), 0.25, 0.01)


def test_a_hole_is_closed_but_more_hole_than_surface_is_refused(tmp_path: Path) -> None:
    ball = pv.Icosphere(radius=2.0, nsub=3)
    centres = np.asarray(ball.cell_centers().points)
    hole = np.linalg.norm(centres - [0.0, 0.0, 2.0], axis=1) < 0.5
    file = saved(tmp_path, ball.points, ball.regular_faces[~hole])
    missing = centres[hole] * [1, -1, 1]
    with np.errstate(invalid="raise"):
        bodies = [body_of(file, fillet_mm) for fillet_mm in (None, CELL)]
    for body in bodies:
        assert (np.abs(distances(body, missing)) < 2 * CELL).all()
        assert distances(body, np.array([[0.0, 0.0, 0.0]]))[0] < 0
    rest = pv.Sphere(radius=4.0).clip("z", origin=(0, 0, 3.0), invert=False)
    cap = rest.extract_surface(algorithm=None).triangulate()
    refused("open sheet", body_of, saved(tmp_path, cap.points, cap.regular_faces))


@pytest.mark.parametrize("ending", ["stl", "obj", "ply", "off"])
def test_formats(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"block.{ending}"
    points, faces = parts("")
    if ending == "off":
        rows = [" ".join(map(str, point)) for point in points] + [f"3 {a} {b} {c}" for a, b, c in faces]
        path.write_text("\n".join(["OFF", f"{len(points)} {len(faces)} 0", *rows]) + "\n")
    else:
        saved(tmp_path, points, faces, path.name)
    assert body_of(path).reach_mm == pytest.approx(1.0)


def test_hundred_thousands_of_triangles_give_the_ball_that_they_lie_on(tmp_path: Path) -> None:
    ball = pv.Sphere(radius=2.0, theta_resolution=400, phi_resolution=300)
    assert ball.n_cells > 200_000
    body = body_of(saved(tmp_path, ball.points, ball.regular_faces))
    places = around((1.5, 1.5, 1.5))
    assert_equal_near(distances(body, places), np.linalg.norm(places, axis=1) - 2.0, 0.25, 1e-3)


def test_edges_are_rounded_as_those_of_a_block(tmp_path: Path) -> None:
    fillet = 0.4
    body = body_of(saved(tmp_path, *parts("")), fillet_mm=fillet)
    block = rigid_body(Box(shape="box", size_mm=(4.0, 3.0, 2.0), fillet_mm=fillet))
    places = around((2.0, 1.5, 1.0))
    found, exact = distances(body, places), distances(block, places)
    # A B-spline of a distance whose second derivative jumps errs by some 1 % of the spacing there.
    assert_equal_near(found, exact, 0.2, 0.01)
    assert np.sqrt(np.mean((found - exact)[np.abs(exact) < 0.2] ** 2)) < 2e-3


def test_a_tip_that_is_rounded_on_request_counts_from_its_own_end(tmp_path: Path) -> None:
    """A ball of radius r in a cone of half-angle α ends r (1 / sin α - 1) before the tip."""
    cone, fillet = pv.Cone(direction=(0, 0, 1), height=4.0, radius=2.0, resolution=80).triangulate().clean(), 0.5
    body = body_of(saved(tmp_path, cone.points, cone.regular_faces), fillet_mm=fillet)
    # The tip is 2 mm from the middle; the ball's end lies between points of a grid of 0.1 mm.
    assert body.reach_mm == pytest.approx(2.0 - fillet * (np.sqrt(5) - 1), abs=CELL / 2)


def joined(*pieces: pv.PolyData) -> tuple[FloatArray, np.ndarray]:
    starts = np.cumsum([0, *(len(piece.points) for piece in pieces)])
    faces = [piece.regular_faces + start for piece, start in zip(pieces, starts, strict=False)]
    return np.concatenate([piece.points for piece in pieces]), np.concatenate(faces)


def test_a_thin_part_is_kept(tmp_path: Path) -> None:
    """A plate thinner than two radii keeps its thickness, a blade on it its height."""
    plate = pv.Cube(x_length=6.0, y_length=6.0, z_length=0.5).triangulate()
    blade = pv.Cube(x_length=4.0, y_length=0.3, z_length=2.0, center=(0.0, 0.0, 1.0)).triangulate()
    body = body_of(saved(tmp_path, *joined(plate, blade)), fillet_mm=0.6)
    height = 2.25 / 2
    assert body.reach_mm == pytest.approx(height, abs=0.1)
    inside = np.array([[2.0, 2.0, -height + 0.25], [0.0, 0.0, height - 0.3], [1.5, 0.0, height - 0.5]])
    assert (distances(body, inside) < 0).all()
    beside = np.array([[2.0, 2.0, -height + 0.7], [0.0, 0.4, height - 0.3]])
    assert (distances(body, beside) > 0).all()


def test_a_notch_narrower_than_the_edges_is_filled(tmp_path: Path) -> None:
    boxes = [pv.Cube(x_length=2.0, y_length=3.0, z_length=2.0, center=(x, 0.0, 0.0)).triangulate() for x in (-1.1, 1.1)]
    base = pv.Cube(x_length=4.2, y_length=3.0, z_length=1.0, center=(0.0, 0.0, -0.9)).triangulate()
    path, within = saved(tmp_path, *joined(*boxes, base)), np.array([[0.0, 0.0, 0.5]])
    assert distances(body_of(path), within)[0] > 0
    assert distances(body_of(path, fillet_mm=0.6), within)[0] < 0


def test_the_lowest_point_of_an_object_comes_down_on_the_axis_of_a_round_gel(tmp_path: Path) -> None:
    peg = pv.Cube(x_length=0.8, y_length=0.8, z_length=1.0, center=(1.5, 0.0, 1.0)).triangulate()
    base = pv.Cube(x_length=4.2, y_length=3.0, z_length=1.0).triangulate()
    path, within = saved(tmp_path, *joined(peg, base)), np.array([[0.0, 0.0, 0.5]])
    assert distances(body_of(path), within)[0] > 0
    assert distances(body_of(path, touchable=Touchable(at_tip=True)), within)[0] < 0


def test_what_cannot_touch_has_no_grid_and_the_radius_is_what_the_gel_can_follow(tmp_path: Path) -> None:
    path = saved(tmp_path, *parts(""))
    whole, part = body_of(path), body_of(path, touchable=Touchable(height_mm=0.5))
    assert part.coefficients.shape[2] < whole.coefficients.shape[2] - 10
    assert part.reach_mm == pytest.approx(whole.reach_mm, abs=1e-6)
    top = around((2.0, 1.5, 0.1)) + np.array([0.0, 0.0, 0.9])
    assert_equal_near(distances(part, top), distances(whole, top), 0.2, 0.01)
    stated = MeshIndenter(shape="mesh", file="object.stl", fillet_mm=0.5)
    assert [object_radius(stated, spacing) for spacing in (0.1, 0.4)] == [0.5, 0.5]
    unstated = MeshIndenter(shape="mesh", file="object.stl")
    assert object_radius(unstated, 0.4) == OBJECT_RADIUS * 0.4
