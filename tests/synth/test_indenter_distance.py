"""Signed distance, normal and reach of every indenter, against points sampled on surfaces that are coded here anew."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import pyvista as pv
import warp as wp
from commands import refused
from scipy.spatial import ConvexHull, cKDTree

from synth.arrays import FloatArray
from synth.press.distance import normal_derivative, shape_vector, signed_distance
from synth.press.indenter import RigidBody, rigid_body, rotation_about
from synth.scene import Box, Cone, Cylinder, Indenter, MeshIndenter, Sphere, Torus

SPHERE = Sphere(shape="sphere", radius_mm=1.5)
CYLINDER = Cylinder(shape="cylinder", radius_mm=1.2, length_mm=2.0, fillet_mm=0.3)
BOX = Box(shape="box", size_mm=(2.0, 3.0, 1.6), fillet_mm=0.25)
CONE = Cone(shape="cone", half_angle_deg=40.0, height_mm=2.4, fillet_mm=0.3)
TORUS = Torus(shape="torus", radius_mm=1.6, tube_mm=0.5)
SHAPES: list[Indenter] = [SPHERE, CYLINDER, BOX, CONE, TORUS]
SPACING = 0.02  # Of the sampled surfaces, mm


@wp.kernel
def evaluate(
    kind: int,
    shape: wp.array(dtype=shape_vector),
    coefficients: wp.array4d(dtype=wp.float64),
    points: wp.array(dtype=wp.vec3d),
    sample: int,
    found: wp.array(dtype=wp.vec4d),
    bending: wp.array(dtype=wp.mat33d),
):
    i = wp.tid()
    found[i] = signed_distance(kind, shape[0], points[i], sample, coefficients)
    derivative, _steepness = normal_derivative(kind, shape[0], points[i], sample, coefficients)
    bending[i] = derivative


def measure(body: RigidBody, points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Distances (n,), normals (n, 3) and their derivatives (n, 3, 3) in the body's frame."""
    found, bending = wp.zeros(len(points), dtype=wp.vec4d), wp.zeros(len(points), dtype=wp.mat33d)
    shape = wp.array(body.shape[None], dtype=shape_vector)
    grid = wp.array(body.coefficients[None], dtype=wp.float64)
    inputs = [body.kind, shape, grid, wp.array(points, dtype=wp.vec3d), 0]
    wp.launch(evaluate, len(points), inputs=inputs, outputs=[found, bending], device="cpu")
    values = found.numpy()
    return values[:, 3], values[:, :3], bending.numpy()


def differences(body: RigidBody, points: FloatArray, h: float = 1e-5) -> tuple[FloatArray, FloatArray]:
    ends = [(measure(body, points + step), measure(body, points - step)) for step in h * np.eye(3)]
    slope, turning = (np.stack([ahead[k] - behind[k] for ahead, behind in ends], axis=-1) for k in (0, 1))
    return slope / (2 * h), turning / (2 * h)


def revolved(profile: FloatArray) -> FloatArray:
    """Surface points of a profile (k, 2) of (distance from the axis, z), turned about z."""
    rings = []
    for rho, z in profile:
        turn = np.linspace(0, 2 * np.pi, max(1, int(np.ceil(2 * np.pi * rho / SPACING))), endpoint=False)
        rings.append(np.column_stack([rho * np.cos(turn), rho * np.sin(turn), np.full(len(turn), z)]))
    return np.concatenate(rings)


def rounded(corners: list[tuple[float, float]], radius: float) -> FloatArray:
    """Convex profile: the corners, each replaced by an arc of that radius around it, and the segments between."""
    pieces = []
    for k in range(len(corners) - 1):
        a, b = np.array(corners[k]), np.array(corners[k + 1])
        along = (b - a) / np.linalg.norm(b - a)
        normal = np.array([along[1], -along[0]])
        share = np.linspace(0, 1, int(np.linalg.norm(b - a) / SPACING) + 2)[:, None]
        pieces.append(a + share * (b - a) + radius * normal)
    arcs = []
    for k, corner in enumerate(corners[1:-1], start=1):
        ends = [piece[j] - corner for piece, j in ((pieces[k - 1], -1), (pieces[k], 0))]
        angles = [np.arctan2(end[1], end[0]) for end in ends]
        turn = np.linspace(angles[0], angles[0] + (angles[1] - angles[0]) % (2 * np.pi), int(2 * radius / SPACING) + 9)
        arcs.append(corner + radius * np.column_stack([np.cos(turn), np.sin(turn)]))
    return np.concatenate(pieces + arcs)


def surface(indenter: Indenter) -> FloatArray:
    """Points on the surface, no two neighbours farther apart than about SPACING."""
    match indenter:
        case Sphere(radius_mm=r):
            angle = np.linspace(0, np.pi, int(np.pi * r / SPACING))
            return revolved(r * np.column_stack([np.sin(angle), np.cos(angle)]))
        case Cylinder(radius_mm=r, length_mm=length, fillet_mm=f):
            c, h = r - f, length / 2 - f
            return revolved(rounded([(0, -h), (c, -h), (c, h), (0, h)], f))
        case Cone(half_angle_deg=angle, height_mm=height, fillet_mm=f):
            low = -(height - 2 * f)
            base = -low * np.tan(np.radians(angle))
            flank = rounded([(0, low), (base, low), (0, 0)], f)
            top = np.linspace(np.radians(angle), np.pi / 2, int(2 * f / SPACING) + 9)  # the rounded tip
            tip = f * np.column_stack([np.cos(top), np.sin(top)])
            return revolved(np.concatenate([flank, tip]))
        case Torus(radius_mm=r, tube_mm=t):
            angle = np.linspace(0, 2 * np.pi, int(2 * np.pi * t / SPACING))
            return revolved(np.column_stack([r + t * np.cos(angle), t * np.sin(angle)]))
        case Box(size_mm=size, fillet_mm=f):
            half = np.array(size) / 2
            # A grid on the sharp box drawn in by the fillet, and out again along the core's normals.
            core, parts = half - f, []
            for axis in range(3):
                steps = [np.linspace(-h, h, int(2 * h / SPACING) + 2) for h in half]
                steps[axis] = np.array([-half[axis], half[axis]])
                grid = np.stack(np.meshgrid(*steps, indexing="ij"), -1).reshape(-1, 3)
                away = grid - np.clip(grid, -core, core)
                parts.append(np.clip(grid, -core, core) + f * away / np.linalg.norm(away, axis=1, keepdims=True))
            return np.concatenate(parts)
    raise TypeError(indenter)


def scattered(indenter: Indenter, rng: np.random.Generator, count: int = 400) -> FloatArray:
    found = surface(indenter)
    offset = rng.standard_normal((count, 3))
    offset *= 0.6 * rng.random((count, 1)) / np.linalg.norm(offset, axis=1, keepdims=True)
    return found[rng.integers(len(found), size=count)] + offset


def inside(indenter: Indenter, points: FloatArray) -> np.ndarray:
    """Within the hull of samples, or a ring's tube; only for points farther off than the sampling resolves."""
    if isinstance(indenter, Torus):
        return np.hypot(np.hypot(points[:, 0], points[:, 1]) - indenter.radius_mm, points[:, 2]) < indenter.tube_mm
    faces = ConvexHull(surface(indenter)[::7]).equations
    return (points @ faces[:, :3].T + faces[:, 3] < 0).all(axis=1)


@pytest.mark.parametrize("indenter", SHAPES, ids=lambda i: i.shape)
def test_distance_against_a_sampled_surface_and_normal_as_its_gradient(indenter: Indenter) -> None:
    body, points = rigid_body(indenter), scattered(indenter, np.random.default_rng(1))
    distance, normal, bending = measure(body, points)
    nearest, _ = cKDTree(surface(indenter)).query(points)
    # At distance d the nearest sample is at most sqrt(d^2 + s^2) away, s = SPACING (a diagonal of half cells, with
    # room), and never nearer than the surface; on edges samples lie on their arcs, so the surface itself is exact.
    assert (nearest >= np.abs(distance) - 1e-9).all()
    assert (nearest <= np.sqrt(distance**2 + SPACING**2) + 1e-9).all()
    sure = np.abs(distance) > SPACING
    assert ((distance < 0) == inside(indenter, points))[sure].all()
    assert 20 < (distance < 0).sum() < 380
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-12)
    slope, turning = differences(body, points)
    # Central difference: h^2 times the curvature's slope, 1e-10 * 1 / (0.05 mm)^2 where a fillet's centre is near. A
    # point within h of a medial axis has no gradient: none of these 400 random points should be, one is allowed.
    wrong = np.linalg.norm(slope - normal, axis=1) > 1e-6
    assert wrong.sum() <= 1
    # The derivative of a gradient is symmetric, and it does not turn along the normal.
    smooth = ~wrong & (np.abs(turning).max(axis=(1, 2)) < 1e3)
    assert smooth.mean() > 0.98
    np.testing.assert_allclose(bending[smooth], turning[smooth], atol=1e-5 * (1 + np.abs(turning[smooth]).max()))


def test_a_sphere_and_rotations_by_hand_and_unit_normals_on_axes() -> None:
    normals, radii = np.array([[0.0, 0, 1], [0, -1, 0]]), np.array([2.0, 1.0])
    found, direction, bending = measure(rigid_body(SPHERE), normals * radii[:, None])
    np.testing.assert_allclose(found, radii - 1.5, atol=1e-14)
    np.testing.assert_allclose(direction, normals, atol=1e-14)
    # The normal of a ball turns by (I - n n^T) / r; central differences of it are good to 1e-9.
    turning = (np.eye(3) - np.einsum("ni,nj->nij", normals, normals)) / radii[:, None, None]
    np.testing.assert_allclose(bending, turning, atol=1e-8)
    for indenter in SHAPES:
        points = np.array([[0, 0, z] for z in (-3.0, -0.5, 0.0, 0.5, 3.0)], dtype=float)
        distance, normal, _ = measure(rigid_body(indenter), points)
        assert np.isfinite(distance).all()
        np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-12)
    for axis in range(3):
        following, last = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
        np.testing.assert_allclose(rotation_about(axis, np.pi / 2) @ following, last, atol=1e-15)


@pytest.mark.parametrize("turn", [(0, 0, 0), (90, 0, 0), (0, 90, 30), (20, -35, 50), (180, 0, 0), (130, 10, 0)])
@pytest.mark.parametrize("indenter", SHAPES, ids=lambda i: i.shape)
def test_reach_is_the_highest_point(indenter: Indenter, turn: tuple[float, float, float]) -> None:
    turned = indenter.model_copy(update={"rotation_deg": turn})
    body = rigid_body(turned)
    x, y, z = (rotation_about(axis, np.radians(angle)) for axis, angle in enumerate(turn))
    world = surface(indenter) @ (z @ y @ x).T
    np.testing.assert_allclose(body.rotation, z @ y @ x, atol=1e-15)
    # Of samples SPACING apart on a surface of radius 0.25 mm or more the highest is SPACING^2 / (2 * 0.25) too low.
    assert -1e-9 <= body.reach_mm - world[:, 2].max() <= SPACING**2 / 0.5


def ball(folder: Path, cell_mm: float = 0.15, flip: bool = False, centre: tuple = (0.0, 0.0, 0.0)) -> RigidBody:
    mesh = pv.Icosphere(radius=1.5, nsub=4, center=centre)
    if flip:
        mesh = pv.PolyData(np.asarray(mesh.points), np.insert(mesh.regular_faces[:, ::-1], 0, 3, axis=1))
    mesh.save(folder / "ball.stl")
    return rigid_body(MeshIndenter(shape="mesh", file=str(folder / "ball.stl"), cell_mm=cell_mm))


@pytest.mark.parametrize("flip", [False, True])
def test_mesh_of_a_sphere_is_the_sphere(tmp_path: Path, flip: bool) -> None:
    body = ball(tmp_path, flip=flip, centre=(5.0, -2.0, 1.0))
    points = scattered(SPHERE, np.random.default_rng(3))
    distance, normal, _ = measure(body, points)
    exact, radial, _ = measure(rigid_body(SPHERE), points)
    near = np.abs(exact) < 0.25  # two cells from the grid's border, where the spline's end condition is forgotten
    # Facets of edge e = 1.5 * 1.1 / 16 = 0.1 mm lie e^2 / (6 r) = 1.2e-3 mm inside the ball at their middle; the
    # spline of the piecewise smooth distance adds less. Their normals are off by e / (2 r) = 0.035 at most.
    np.testing.assert_allclose(distance[near], exact[near], atol=2.5e-3)
    assert (np.linalg.norm(normal - radial, axis=1)[near] < 0.04).all()
    assert body.reach_mm == pytest.approx(1.5, abs=2.5e-3)
    # Beyond the grid, 0.4 mm off the ball's box, distances go by its border: right in sign, less than a quarter off.
    far = np.array([[4.0, 0.0, 0.0], [0.0, -3.0, 2.0], [2.5, 2.5, 2.5]])
    np.testing.assert_allclose(measure(body, far)[0], np.linalg.norm(far, axis=1) - 1.5, rtol=0.25)


def test_mesh_normal_is_the_gradient_and_a_grid_in_a_larger_batch_read_to_its_own_end(tmp_path: Path) -> None:
    body = ball(tmp_path)
    points = scattered(SPHERE, np.random.default_rng(4), 100)
    points = points[np.abs(measure(body, points)[0]) < 0.3]
    _, normal, bending = measure(body, points)
    slope, turning = differences(body, points)
    # Within a cell of 0.15 mm the spline's third derivative is up to 10 / mm^2, its difference quotient h^2 times that.
    np.testing.assert_allclose(bending, turning, atol=1e-5)
    # The normal is the spline's unit gradient; the gradient's own length is 1 to within the facets' angle, 0.035.
    length = np.linalg.norm(slope, axis=1, keepdims=True)
    np.testing.assert_allclose(slope / length, normal, atol=1e-6)
    np.testing.assert_allclose(length, 1.0, atol=0.04)
    body = ball(tmp_path, cell_mm=0.3)
    padded = replace(body, coefficients=np.pad(body.coefficients, ((0, 9), (0, 20), (0, 3))))
    points = np.random.default_rng(5).uniform(-4.0, 4.0, (200, 3))
    for alone, together in zip(measure(body, points), measure(padded, points), strict=True):
        assert (alone == together).all()


def test_meshes_are_scaled_and_turned_and_edges_rounded_to_what_the_pads_mesh_resolves(tmp_path: Path) -> None:
    pv.Cube(x_length=1.0, y_length=2.0, z_length=3.0).triangulate().save(tmp_path / "block.stl")
    lying = MeshIndenter(shape="mesh", file="block.stl", scale=2.0, cell_mm=0.1, rotation_deg=(90.0, 0.0, 0.0))
    body = rigid_body(lying, tmp_path)
    assert body.reach_mm == pytest.approx(2.0)  # y is up: half of twice 2 mm
    distance, _, _ = measure(body, np.array([[1.1, 0.0, 0.0], [0.0, 3.1, 0.0], [0.0, 0.0, 2.1], [0.7, 0.0, 0.0]]))
    # Away from edges the distance is linear and the spline exact, but for the filter's tail from the edges.
    np.testing.assert_allclose(distance, [0.1, 0.1, 0.1, -0.3], atol=1e-3)
    assert rigid_body(CYLINDER, resolution_mm=0.6).shape[0] == 0.3  # stated: kept
    unstated = CYLINDER.model_copy(update={"fillet_mm": None})
    sharp, blunt = rigid_body(unstated), rigid_body(unstated, resolution_mm=0.6)
    assert (sharp.fillet_mm, blunt.fillet_mm) == (sharp.shape[0], blunt.shape[0]) == (0.2, 0.6)
    assert blunt.reach_mm == pytest.approx(sharp.reach_mm)
    axis = np.array([[0.0, 0.0, 1.3], [1.4, 0.0, 0.0]])
    np.testing.assert_allclose(measure(blunt, axis)[0], measure(sharp, axis)[0], atol=1e-12)
    assert rigid_body(unstated, resolution_mm=5.0).shape[0] == pytest.approx(0.9)  # 90 % of half the length


UNUSABLE: dict[str, tuple[pv.PolyData | bytes | None, str]] = {
    "missing": (None, "no file"),
    "sheet": (pv.Plane(i_size=2.0, j_size=2.0).triangulate(), "single sheet"),
    "metres": (pv.Icosphere(radius=0.01), "metres"),
    "garbage": (b"solid nothing\n" + bytes(range(256)), "cannot be read as a surface"),
    "empty": (b"", "cannot be read as a surface"),
    "fine": (pv.Icosphere(radius=40.0), "cell_mm"),
}


@pytest.mark.parametrize("kind", UNUSABLE)
def test_unusable_mesh_is_named(tmp_path: Path, kind: str, caplog, recwarn: pytest.WarningsRecorder) -> None:
    content, words = UNUSABLE[kind]
    path = tmp_path / f"{kind}.stl"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        content.save(path)
    said = refused(words, rigid_body, MeshIndenter(shape="mesh", file=path.name, cell_mm=0.1), tmp_path)
    assert not caplog.records
    assert not recwarn.list
    assert path.name in said or kind == "fine"


@pytest.mark.parametrize(
    ("indenter", "field", "value"),
    [(CYLINDER, "fillet_mm", 1.0), (BOX, "fillet_mm", 0.8), (CONE, "fillet_mm", 1.2), (TORUS, "tube_mm", 1.6)],
)
def test_too_large_rounding_is_named(indenter: Indenter, field: str, value: float) -> None:
    refused(f"{field} = {value}", rigid_body, indenter.model_copy(update={field: value}))
