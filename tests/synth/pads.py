"""Small pads, scenes and boundary-value problems for the tests of mesh and simulation.

`brick` is a structured box whose mesh is its own mirror image in x and in y, so that symmetry can be tested to
rounding, and free of the mesher's randomness. The solver holds displacement components at the value they have at the
start, so that prescribed motion is a `held` mask and a start; dead loads are nodal forces. Everything for E = 1.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from tiny_scene import home

from synth.arrays import BoolArray, FloatArray, Points
from synth.mesh import PadMesh, pad_mesh
from synth.mesh.element import Element, p1p1, p2p1
from synth.mesh.graded import kuhn_tets
from synth.press.indenter import rigid_body
from synth.press.load_path import LoadPath
from synth.press.press import Press
from synth.scene import Gel, Numerics, Scene
from synth.simulate import Trajectory, simulate
from synth.simulate.batched import simulate_presses
from synth.simulate.batched.pad import prepare
from synth.simulate.contact_friction import Indenters
from synth.simulate.direct import DirectPress, DirectSolver, led
from synth.simulate.material import Material, uniform
from synth.simulate.options import SolverOptions
from synth.simulate.policy import newton
from synth.simulate.policy.requests import Do
from synth.simulate.solve import direct_press
from synth.simulate.space import Space, function_space
from synth.simulate.system import Residual, System, Tangent, Unknowns
from synth.simulate.tables import pack_indenter, place_indenter
from synth.surface import ContactFaces

SIZE = (8.0, 6.0, 4.0)
SPHERE = {"shape": "sphere", "radius_mm": 3.0}
PUNCH = {"shape": "cylinder", "radius_mm": 2.0, "length_mm": 6.0, "fillet_mm": 0.5}
DRAG: dict[str, Any] = {"depth_mm": 0.6, "shear_mm": [0.8, -0.3], "twist_deg": 10.0, "position_mm": [0.4, 0.2]}
DRAG["steps"] = 4
FILM = {"thickness_mm": 1.0, "youngs_modulus_kpa": 2000.0, "poisson_ratio": 0.499, "stiffening": (0.1, 0.02)}
ELEMENT: dict[str, Callable[[], Element]] = {
    "p1": lambda: replace(p1p1(), name="p1", stabilisation=0.0),
    "p1p1": p1p1,
    "p2p1": p2p1,
}
MIXED = ["p1p1", "p2p1"]  # Names of the elements that have a pressure field, to be a test's parameters


def contact_faces(mesh: PadMesh) -> ContactFaces:
    return function_space(mesh, p1p1()).surface


def brick(size: tuple[float, float, float] = SIZE, counts: tuple[int, int, int] = (4, 4, 3)) -> PadMesh:
    """Box of counts cells, six tetrahedra each (Kuhn), every other cell mirrored; even counts give a symmetric mesh."""
    axes = [np.linspace(-size[axis] / 2, size[axis] / 2, counts[axis] + 1) for axis in (0, 1)]
    axes.append(np.linspace(0.0, size[2], counts[2] + 1))
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return PadMesh(points, kuhn_tets(*counts), size)


def crooked(size: tuple[float, float, float] = (3.0, 2.0, 2.0), seed: int = 0) -> PadMesh:
    """A small brick whose nodes are moved within their faces at random, for tests that symmetry must not help."""
    straight = brick(size, (3, 2, 2))
    half = np.array([size[0] / 2, size[1] / 2])
    low, high = np.array([-half[0], -half[1], 0.0]), np.array([half[0], half[1], size[2]])
    move = 0.12 * np.random.default_rng(seed).standard_normal(straight.points.shape)
    move[(straight.points == low) | (straight.points == high)] = 0.0
    mesh = PadMesh(straight.points + move, straight.tets, size)
    assert mesh.volumes.min() > 0
    return mesh


def layered(mesh: PadMesh, interface: float = 1.0) -> PadMesh:
    """The same pad in two layers, which meet at z = interface."""
    layer = (mesh.points[mesh.tets].mean(axis=1)[:, 2] > interface).astype(np.int32)
    assert 0 < layer.sum() < len(layer)
    return PadMesh(mesh.points, mesh.tets, mesh.size_mm, layer)


def pad(layers: bool) -> PadMesh:
    """Plain, or with the first of four planes of cells for a film."""
    return layered(brick(SIZE, (4, 4, 4))) if layers else brick()


def scene(size: tuple[float, float, float] = SIZE, **parts: Any) -> Scene:
    """A scene of a bare pad, P1/P1 by default. parts: gel, indenter, friction, motion, numerics as in a scene file."""
    return Scene.model_validate({
        "name": "pad",
        "sensor": {
            "gel": {"size_mm": size, "youngs_modulus_kpa": 200.0, "poisson_ratio": 0.4999, **parts.get("gel", {})},
            "pattern": {"kind": "none"},
            "lights": [{"position_mm": [0, 0, 0.1], "size_mm": [1, 1], "color": [1, 1, 1], "power": 1}],
            "camera": {"width": 16, "height": 16, "fx": 9, "fy": 9, "cx": 8, "cy": 8, "position_mm": [0, 0, 90]},
        },
        "contact": {"indenter": parts.get("indenter", SPHERE), "friction": parts.get("friction", 0.0)},
        "motion": {"depth_mm": 0.5, "steps": 1, **parts.get("motion", {})},
        "numerics": {
            **({} if parts.get("gel", {}).get("layers") else {"edge_length_mm": min(size) / 4}),
            "element": "p1p1", **parts.get("numerics", {}),
        },
    })  # fmt: skip


def gentle(**parts: Any) -> Scene:
    """A scene of a ball that presses, shears and twists with friction; parts as in `scene`."""
    return scene(**{"friction": 0.4, "motion": DRAG, **parts})


def same(a: Trajectory, b: Trajectory) -> bool:
    assert (a.status, a.reason, len(a.states)) == (b.status, b.reason, len(b.states))
    return all(
        (s.displacement == t.displacement).all() and (s.traction == t.traction).all() and s.summary() == t.summary()
        for s, t in zip(a.states, b.states, strict=True)
    )


def complete(posed: Scene, mesh: PadMesh, folder: Path | None = None, **options: Any) -> Trajectory:
    result = simulate(posed, mesh, folder, **options)
    assert (result.status, result.reason) == ("complete", "")
    return result


def system(mesh: PadMesh, poisson_ratio: float, element: Element | None = None) -> System:
    space = function_space(mesh, element or p1p1())
    return System(space, uniform(len(mesh.tets), poisson_ratio))


def run(posed: Scene, mesh: PadMesh) -> DirectPress:
    """A press at the end of a scene's path, which it must have reached."""
    # The full tolerance for all steps: the state in which the path ends is looked at, beside the recorded ones.
    press = direct_press(Press.of(posed, mesh), options=SolverOptions(relaxed_tolerance=0.0))
    ended = press.run()
    assert (ended.status, ended.reason) == ("complete", "")
    return press


def presses_of(scenes: Sequence[Scene], mesh: PadMesh, folder: Path | None = None) -> list[Press]:
    return [Press.of(scene, mesh, folder) for scene in scenes]


def simulate_scenes(
    scenes: Sequence[Scene],
    mesh: PadMesh,
    folder: Path | None = None,
    device: str = "cpu",
    frames: Sequence[frozenset[int]] | None = None,
    **options: Any,
) -> list[Trajectory]:
    asked = zip(presses_of(scenes, mesh, folder), frames or [None] * len(scenes), strict=True)
    found = dict(simulate_presses(asked, prepare(scenes[0], mesh, device), **options))
    assert sorted(found) == list(range(len(scenes)))
    return [found[number] for number in range(len(scenes))]


def dense(body: System, tangent: Tangent) -> FloatArray:
    """(k, k) the whole derivative of the free residual: symmetric part and remainder."""
    upper = body.matrix(tangent.values).toarray()
    assert not np.tril(upper, -1).any()
    whole = upper + np.triu(upper, 1).T
    rest = tangent.remainder
    return np.asarray(whole if rest is None else whole + rest.toarray())


def indenters(posed: Scene, at: float) -> Indenters:
    """The kernels' view of a scene's indenter at a path length (mm)."""
    path = LoadPath(posed.motion, rigid_body(posed.contact.indenter))
    packed = pack_indenter(path, posed.contact.friction, posed.numerics.penalty)
    place_indenter(packed, path.pose(at))
    return packed


def far_away() -> Indenters:
    return indenters(scene(motion={"depth_mm": -40.0}), 0.0)


TIGHT = 1e-10  # Tolerance of the relative residual: what is compared with closed forms should not show Newton's method


def mapped(counts: tuple[int, int, int], to: Callable[[Points], Points], thickness: float) -> PadMesh:
    """The unit cube [0, 1]³ of counts cells, its nodes moved to `to` of them; bonded where z = thickness."""
    cube = brick((1.0, 1.0, 1.0), counts)
    points = to(cube.points + np.array([0.5, 0.5, 0.0]))
    size = (float(np.ptp(points[:, 0])), float(np.ptp(points[:, 1])), thickness)
    mesh = PadMesh(points, cube.tets, size)
    assert mesh.volumes.min() > 0
    return mesh


def supported(mesh: PadMesh, element: Element, held: Callable[[Points], BoolArray]) -> Space:
    """The space held where `held`, a function of the nodes (n, 3), says so (n, 3)."""
    space = function_space(mesh, element)
    return replace(space, held=held(space.points))


class LoadedSystem(System):
    """A system under dead loads (n, 3), nodal forces in E mm²."""

    load: FloatArray

    def residual(self, state: Unknowns, indenter: Indenters) -> Residual:
        found = super().residual(state, indenter)
        full = np.concatenate([self.load.ravel(), np.zeros_like(state.p)])
        return replace(found, free=found.free - full[self.free], nodal_forces=found.nodal_forces - self.load)


@dataclass(frozen=True)
class Found:
    """Where Newton's method ended."""

    state: Unknowns
    residual: Residual
    relative: float
    converged: bool
    iterations: int


def found_by_newton(
    body: System, start: Unknowns, indenter: Indenters, tolerance: float, limit: int = 20, reach_mm: float = np.inf
) -> Found:
    """Newton's method from a state."""
    solver = DirectSolver(body, indenter)
    at = solver.start(start)
    solver.answer(Do.KEEP_PASS)
    solution = led(newton.solve(at, tolerance, limit, reach_mm), solver.answer)
    last = solver.iterate
    return Found(last.state, last.residual, solution.at.relative, solution.converged, solution.iterations)


def equilibrium(
    space: Space,
    material: Material,
    prescribed: FloatArray | None = None,
    load: FloatArray | None = None,
    steps: int = 1,
    guess: Unknowns | None = None,
    tolerance: float = TIGHT,
) -> tuple[System, Unknowns, FloatArray]:
    """The equilibrium without contact under prescribed displacements (n, 3) mm where held and dead loads (n, 3) E mm².

    Returns the system, its state, and all nodal forces (n, 3), which the supports exert.
    """
    goal = np.zeros_like(space.points) if prescribed is None else prescribed
    body = LoadedSystem(space, material)
    state = guess or body.zero()
    before = state
    for k in range(1, steps + 1):
        body.load = np.zeros_like(space.points) if load is None else load * (k / steps)
        ahead = state.plus(Unknowns(state.u - before.u, state.p - before.p), 1.0)
        start = Unknowns(np.where(space.held, goal * (k / steps), ahead.u), ahead.p)
        solution = found_by_newton(body, start, far_away(), tolerance)
        assert solution.converged, f"step {k} of {steps}: residual {solution.relative:.1e}"
        before, state = state, solution.state
    return body, state, body.residual(state, far_away()).nodal_forces


def area_vectors(points: Points, faces: np.ndarray) -> FloatArray:
    """(f, 3) mm², each along its face's normal by the right-hand rule."""
    a, b, c = (points[faces[:, i]] for i in range(3))
    return np.asarray(np.cross(b - a, c - a) / 2)


def areas(points: Points, faces: np.ndarray) -> FloatArray:
    return np.asarray(np.linalg.norm(area_vectors(points, faces), axis=1))


def face_load(space: Space, on: Callable[[Points], BoolArray], traction: FloatArray) -> FloatArray:
    """(n, 3) nodal forces of a constant traction (3,) on the boundary faces whose nodes all satisfy `on`."""
    faces = space.faces[on(space.points)[space.faces].all(axis=1)]
    # A linear face gives a third of its force to each vertex; a straight quadratic one to each middle of an edge.
    bearing = faces if faces.shape[1] == 3 else faces[:, 3:]
    load = np.zeros_like(space.points)
    np.add.at(load, bearing, (areas(space.points, faces)[:, None, None] / 3 * traction))
    return load


CAPSULE = {"shape": "capsule", "radius_mm": 5.0, "thickness_mm": 2.0, "length_mm": 2.0, "youngs_modulus_kpa": 200.0}


def capsule(gel: dict[str, Any] | None = None, **parts: Any) -> Scene:
    """A scene with a ball of 2 mm pressed on a capsule; parts: indenter, friction, motion, numerics as in a file."""
    motion = {"depth_mm": 0.5, "steps": 1, **parts.pop("motion", {})}
    content = {**scene((10.0, 10.0, 7.0), **parts).model_dump(), "motion": motion}
    content["numerics"] |= {"edge_length_mm": 1.5, "element": "auto", **parts.get("numerics", {})}
    content["sensor"]["gel"] = {**CAPSULE, **(gel or {})}
    if "indenter" not in parts:
        content["contact"]["indenter"] = {"shape": "sphere", "radius_mm": 2.0}
    return Scene.model_validate(content)


@functools.cache
def capsule_mesh(gel: Gel, edge_mm: float = 1.5) -> PadMesh:
    """Of fTetWild, kept for the session."""
    return pad_mesh(gel, Numerics(edge_length_mm=edge_mm), [home() / "capsules"])
