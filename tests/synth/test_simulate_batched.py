"""Many trajectories at once against one by one."""

from collections import deque
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp
from commands import refused
from pads import ELEMENT, MIXED, PUNCH, SPHERE, brick, dense, indenters, same, scene, simulate_scenes

from synth.mesh import PadMesh
from synth.press.press import Press
from synth.scene import Scene
from synth.simulate import Trajectory, simulate
from synth.simulate.batched import simulate_presses
from synth.simulate.batched.arrays import single_tables
from synth.simulate.batched.krylov import padded
from synth.simulate.batched.lane_orders import Number, Order
from synth.simulate.batched.pad import prepare
from synth.simulate.batched.product import (
    STORED_YEOH,
    barrier_product,
    bulk_product,
    contact_product,
    find_inverting,
    store_bulk,
    store_contact,
)
from synth.simulate.batched.run import OPTIONS, Asked, Run
from synth.simulate.contact_friction import FAR, contact_stiffness
from synth.simulate.material import uniform
from synth.simulate.options import SolverOptions
from synth.simulate.space import function_space
from synth.simulate.system import System, Unknowns
from synth.simulate.tables import barrier_tables, bulk_tables, face_tables, warp_array

BAR = {"shape": "cylinder", "radius_mm": 1.5, "length_mm": 4.0, "fillet_mm": 0.75, "rotation_deg": [90, 0, 30]}
BOX = {"shape": "box", "size_mm": [3.0, 2.5, 4.0], "fillet_mm": 0.75, "rotation_deg": [0, 0, 20]}
WIRE = {"shape": "torus", "radius_mm": 1.5, "tube_mm": 0.3}
MESH = brick(counts=(4, 4, 2))
TOLERANCE = 1e-9
AGREEMENT = 1e-6  # Of displacements, relative. Newton's method to 1e-9 leaves some 1e-10 (5e-11 was seen)


def draws(element: str) -> list[Scene]:
    """Eight draws: bodies, friction, shear, twist, several legs, one without touch, one with a stiffer contact."""
    parts: list[tuple[dict[str, Any], float, dict[str, Any]]] = [
        (SPHERE, 0.0, {"depth_mm": 0.6, "steps": 2}),
        (SPHERE, 0.4, {"depth_mm": 0.6, "shear_mm": [0.5, -0.2], "twist_deg": 8.0}),
        (BAR, 0.3, {"depth_mm": 0.5, "shear_mm": [0.2, 0.3]}),
        (BOX, 0.6, {"depth_mm": 0.4, "twist_deg": 10.0, "position_mm": [0.5, 0.3]}),
        (SPHERE, 0.5, {"depth_mm": -1.0, "shear_mm": [0.2, 0.3]}),
        (PUNCH, 0.8, {"depth_mm": 0.3, "then": [{"depth_mm": 0.2, "shear_mm": [-0.1, 0.1]}, {"depth_mm": 0.1}]}),
        ({**SPHERE, "radius_mm": 2.0}, 0.7, {"depth_mm": 0.3, "steps": 1}),
        (BAR, 0.0, {"depth_mm": 0.4, "position_mm": [-1.0, 0.5], "steps": 1}),
    ]
    common = {"numerics": {"element": element, "tolerance": TOLERANCE}}
    found = [scene(indenter=body, friction=mu, motion={"steps": 3, **motion}, **common) for body, mu, motion in parts]
    found[1] = found[1].model_copy(update={"numerics": found[1].numerics.model_copy(update={"penalty": 100.0})})
    return found


def alone(posed: Scene, mesh: PadMesh, folder: Path | None = None) -> Trajectory:
    """As `simulate`, every step to the scene's tolerance."""
    return simulate(posed, mesh, folder, options=OPTIONS)


def apart(a: Trajectory, b: Trajectory) -> float:
    """Largest relative distance of displacement and traction; the same outcome is asserted."""
    assert (a.status, a.reason, len(a.states)) == (b.status, b.reason, len(b.states))
    worst = 0.0
    for s, t in zip(a.states, b.states, strict=True):
        assert (s.depth_mm, s.shear_mm, s.twist_deg) == (t.depth_mm, t.shear_mm, t.twist_deg)
        for one, other in ((s.displacement, t.displacement), (s.traction, t.traction)):
            worst = max(worst, float(np.linalg.norm(one - other) / max(np.linalg.norm(one), 1e-3)))
        for name in ("force_n", "torque_nmm", "min_jacobian", "max_penetration_mm", "slip_ratio"):
            # Of forces of some 0.5 N and moments of some 1 N mm; a slipping area changes by whole points.
            assert getattr(t, name) == pytest.approx(getattr(s, name), rel=1e-5, abs=1e-7)
    return worst


@pytest.mark.parametrize("element", MIXED)
def test_many_at_once_agree_with_one_by_one(element: str) -> None:
    scenes = draws(element) if element == "p1p1" else [draws(element)[i] for i in (1, 3, 6)]
    for posed, result in zip(scenes, simulate_scenes(scenes, MESH, batch=2), strict=True):
        assert apart(alone(posed, MESH), result) < AGREEMENT


def test_company_order_and_lost_samples_change_no_bit() -> None:
    """Lanes are refilled, and what ran in one before leaves no trace."""
    scenes = draws("p1p1")
    given = simulate_scenes(scenes, MESH, batch=3)
    order = [6, 2, 7, 0, 3, 1, 5, 4]
    for i, result in zip(order, simulate_scenes([scenes[i] for i in order], MESH, batch=2), strict=True):
        assert same(result, given[i])
    numerics = {"edge_length_mm": 0.1, "max_step_mm": 0.5}
    lost = scene(indenter=WIRE, friction=0.2, motion={"depth_mm": 3.3, "steps": 4}, numerics=numerics)
    good = scene(friction=0.4, motion={"depth_mm": 0.4}, numerics=numerics)
    thin = brick(counts=(4, 4, 1))
    first, second = simulate_scenes([lost, good], thin)
    assert (first.status, "did not converge" in first.reason) == ("partial", True)
    assert same(second, simulate_scenes([good], thin)[0])


def test_a_lane_goes_back_to_its_snapshots_and_begins_afresh() -> None:
    press = Press.of(scene(friction=0.4), MESH)
    solver = Run(deque([(0, (press, None))]), iter([]), 1, prepare(press.scene, MESH, "cpu"), OPTIONS).solver
    contact, iterate = solver._arrays.contact, solver._arrays.fields.iterate
    changing = (iterate, contact.normal, contact.tangent, contact.anchor, contact.anchored)
    for keep, restore in ((Order.KEEP_PASS, Order.RESTORE_PASS), (Order.KEEP_STEP, Order.RESTORE_STEP)):
        for order, value in ((keep, 1), (restore, 2)):
            for array in changing:
                array.fill_(value)
            solver.begin_cycle(np.array([order]), np.zeros((1, len(Number))))
        assert all((array.numpy() == 1).all() for array in changing)
    contact.gap.zero_()
    solver.fill({0: press})
    assert (contact.gap.numpy() == FAR).all()
    assert not any(array.numpy().any() for array in (contact.normal, contact.tangent, contact.anchored))


def test_a_press_that_records_more_waits_for_a_run_with_room_for_it() -> None:
    scenes = [scene(friction=0.4, motion={"depth_mm": 0.2, "steps": steps}) for steps in (1, 1, 3, 1)]
    found = simulate_scenes(scenes, MESH, batch=2)
    assert [len(result.states) for result in found] == [2, 2, 4, 2]
    assert same(found[2], simulate_scenes([scenes[2]], MESH)[0])


def test_more_presses_are_asked_for_after_there_were_none() -> None:
    """As one that fails is followed by another: it comes where the last lane has just ended, or another still runs."""
    posed = scene(friction=0.4, motion={"depth_mm": 0.2})
    press = Press.of(posed, MESH)

    class Presses:
        waiting = 1

        def __iter__(self) -> Iterator[Asked]:
            return self

        def __next__(self) -> Asked:
            if self.waiting == 0:
                raise StopIteration
            self.waiting -= 1
            return press, None

    given, found = Presses(), []
    for number, result in simulate_presses(given, prepare(posed, MESH, "cpu"), batch=2):
        found.append(result)
        given.waiting = {0: 2, 1: 1}.get(number, 0)
    assert len(found) == 4
    assert all(same(result, found[0]) for result in found)


def test_indenters_that_find_no_point_are_told_apart_and_grids_may_be_unequal(tmp_path: Path) -> None:
    import pyvista as pv  # which need not be there for what runs on a GPU

    size = (8.0, 6.0, 2.5)
    needle = {"shape": "sphere", "radius_mm": 0.1}
    posed = scene(size, indenter=needle, motion={"depth_mm": 0.5, "steps": 2, "position_mm": (0.3, 0.2)})
    mesh = brick(size, (6, 5, 2))
    one, other = alone(posed, mesh), simulate_scenes([posed], mesh)[0]
    assert (other.status, "touches no contact point" in other.reason) == ("partial", True)
    assert apart(one, other) < AGREEMENT
    pv.Icosphere(radius=2.5, nsub=3).save(tmp_path / "large.stl")
    pv.Cube(x_length=2.0, y_length=1.5, z_length=1.0).triangulate().save(tmp_path / "small.stl")
    motion, numerics = {"depth_mm": 0.3, "shear_mm": [0.1, 0.1], "steps": 2}, {"tolerance": TOLERANCE}
    files = ("small", 0.25), ("large", 0.3), ("small", 0.25)
    bodies = ({"shape": "mesh", "file": f"{name}.stl", "cell_mm": cell} for name, cell in files)
    scenes = [scene(indenter=body, friction=0.4, motion=motion, numerics=numerics) for body in bodies]
    found = simulate_scenes(scenes, MESH, tmp_path, batch=1)
    for posed, result in zip(scenes[:2], found, strict=False):
        assert apart(alone(posed, MESH, tmp_path), result) < AGREEMENT
    assert same(found[0], found[2])


def test_curvature_of_edges_is_limited_as_for_one_press(tmp_path: Path) -> None:
    """A cube's corner; with all of the curvature another equilibrium was found."""
    import pyvista as pv  # which need not be there for what runs on a GPU

    pv.Cube(x_length=2.0, y_length=1.5, z_length=1.0).triangulate().save(tmp_path / "cube.stl")
    cube = {"shape": "mesh", "file": "cube.stl", "cell_mm": 0.25, "rotation_deg": [30.0, 20.0, 0.0]}
    motion = {"depth_mm": 0.5, "shear_mm": [0.1, 0.1], "steps": 2}
    posed = scene(indenter=cube, friction=0.4, motion=motion, numerics={"tolerance": TOLERANCE})
    one, other = alone(posed, MESH, tmp_path), simulate_scenes([posed], MESH, tmp_path)[0]
    assert apart(one, other) < AGREEMENT
    for s, t in zip(one.states, other.states, strict=True):
        assert t.newton_iterations == pytest.approx(s.newton_iterations, abs=2)


@pytest.mark.parametrize(
    ("element", "poisson_ratio", "stiffening"),
    [("p2p1", 0.4999, (0.0, 0.0)), ("p2p1", 0.4999, (0.3, 0.1)), ("p1p1", 0.45, (0.2, 0.0)), ("p2p1", 0.2, (0.0, 0.0))],
)
def test_the_product_is_the_tangent_times_the_vector(element, poisson_ratio, stiffening) -> None:
    """At a random state: contact that sticks and slips, pressures that hold dilation, elements near inverting."""
    rng = np.random.default_rng(1)
    mesh = brick((4.0, 3.0, 2.0), (3, 2, 2))
    space = function_space(mesh, ELEMENT[element]())
    material = uniform(len(mesh.tets), poisson_ratio, stiffening)
    body = System(space, material)
    bodies = indenters(scene(friction=0.3, motion={"depth_mm": 0.5, "shear_mm": [0.1, 0.0]}), 0.45)
    zero = body.zero()
    at_rest = body.residual(zero, bodies)
    body.update_contact_history(zero, at_rest, bodies, new_only=1)
    u = np.where(space.held, 0.0, 0.05 * rng.standard_normal(zero.u.shape))
    state = Unknowns(u, rng.uniform(-4.0, 0.0, zero.p.shape))
    tangent = dense(body, body.tangent(state, bodies, 0.7))

    given, zeros, launch = (partial(call, device="cpu") for call in (warp_array, wp.zeros, wp.launch))
    rows, elements, points = padded(len(body.free)), (len(mesh.tets), 1), at_rest.gap.shape
    tables, faces = bulk_tables(space, material, body.mixed, "cpu"), face_tables(space, "cpu")
    single = single_tables(space, body.free, rows, tables, "cpu")
    x = np.zeros((rows, 1), dtype=np.float32)
    x[: len(body.free), 0] = rng.standard_normal(len(body.free))
    vector, image = given(x, wp.float32), zeros((rows, 1), wp.float32)
    mask, displacement = wp.ones(1, dtype=wp.int32, device="cpu"), given(state.u[None], wp.vec3d)
    stored = zeros((len(mesh.tets), len(space.element.weights), STORED_YEOH, 1), wp.float32)
    inputs = [mask, displacement, given(state.p[None], wp.float64), tables, given(np.array([0.7]), wp.float64)]
    launch(store_bulk, elements, inputs, [stored])
    kernel = bulk_product(space.nodes.shape[1], body.mixed, space.element.stabilisation > 0, any(stiffening))
    launch(kernel, elements, [mask, single, stored, vector], [image])
    barrier = barrier_tables(space, material, "cpu")
    if barrier is not None:
        inverting = zeros(elements, wp.int32)
        launch(find_inverting, elements, [mask, displacement, barrier], [inverting])
        assert inverting.numpy().any()
        inputs = [mask, inverting, displacement, barrier, single, vector]
        launch(barrier_product, elements, inputs, [image])
    touching = zeros(points[:2], wp.int32)
    symmetric, remainder = (zeros(points, wp.mat33d) for _ in range(2))
    contact = zeros(points, wp.mat33f)
    inputs = [displacement, mask, faces, bodies, body.contact, given(np.array([np.inf]), wp.float64)]
    launch(contact_stiffness, points[:2], inputs, [touching, symmetric, remainder])
    assert (touching.numpy() == 2).any()
    launch(store_contact, points[:2], [mask, touching, faces.weight, symmetric, remainder], [contact])
    inputs = [mask, touching, single, contact, vector]
    launch(contact_product(space.faces.shape[1]), points[:2], inputs, [image])
    expected = tangent @ x[: len(body.free), 0].astype(np.float64)
    # Sums of some 100 products rounded to 6e-8, of terms some times larger than the sum.
    assert np.linalg.norm(image.numpy()[: len(body.free), 0] - expected) < 2e-6 * np.linalg.norm(expected)


def test_extrapolation_saves_iterations() -> None:
    """Three steps of the load path; without it each begins at the last state."""
    posed, mesh = scene(motion={"depth_mm": 0.6, "steps": 3}), brick(counts=(4, 4, 2))
    made = [simulate_scenes([posed], mesh, options=SolverOptions(extrapolate=ahead))[0] for ahead in (True, False)]
    ahead, behind = (sum(state.newton_iterations for state in result.states) for result in made)
    assert ahead < behind


def test_scenes_must_share_the_pad_which_serves_several_runs() -> None:
    refused(r"mm pad", simulate_scenes, [scene((8.0, 6.0, 3.0))], MESH)
    pad = prepare(scene(), MESH, "cpu")
    soft, stiffening, short = {"poisson_ratio": 0.45}, {"stiffening": [0.1, 0.0]}, {"max_step_mm": 0.05}
    for other in (scene(gel=soft), scene(gel=stiffening), scene(numerics=short)):
        refused("must share the gel's materials and all numerics", simulate_scenes, [scene(), other], MESH)
        refused("must share", list, simulate_presses([(Press.of(other, MESH), None)], pad))
    finer = Press.of(scene(), brick(counts=(6, 4, 2)))
    refused("must share a mesh", list, simulate_presses([(finer, None)], pad))
    posed = scene(friction=0.4, motion={"depth_mm": 0.2})
    pad, presses = prepare(posed, MESH, "cpu"), [(Press.of(posed, MESH), None)]
    (_, one), (_, other) = (next(simulate_presses(presses, pad)) for _ in range(2))
    assert same(one, other)
    assert list(simulate_presses([], pad)) == []


@pytest.mark.cuda
def test_on_a_gpu_the_same_as_on_the_cpu() -> None:
    if not wp.is_cuda_available():
        pytest.skip("no CUDA device")
    scenes = draws("p2p1")
    on_gpu = simulate_scenes(scenes, MESH, device="cuda", batch=3)
    for result, other in zip(simulate_scenes(scenes, MESH, batch=3), on_gpu, strict=True):
        assert apart(result, other) < AGREEMENT
