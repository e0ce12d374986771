"""From a scene and a mesh to a trajectory: the stage's entry points."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from synth.arrays import BoolArray, FloatArray
from synth.errors import InputError
from synth.mesh import PadMesh, check_mesh, face_of
from synth.press.load_path import LoadPath
from synth.press.measure import Distance
from synth.press.press import Press
from synth.press.resolution import ELEMENTS
from synth.scene import Gel, RoundGel, Scene
from synth.simulate.direct import DirectPress
from synth.simulate.material import pad_material
from synth.simulate.options import STANDARD, SolverOptions
from synth.simulate.policy.load_steps import LoadSteps
from synth.simulate.space import Space, function_space
from synth.simulate.system import System
from synth.simulate.trajectory import State, Trajectory

VICINITY = 6.0
"""Distance from the body within which a round gel may move, over its thickness or a film's shear lag, whichever is
longer: what is left there moves some 1 %."""
POSES = 9
"""Poses of the load path that the distance is taken from, besides its corners."""


def simulate(
    scene: Scene,
    mesh: PadMesh,
    folder: Path | None = None,
    frames: frozenset[int] | None = None,
    options: SolverOptions = STANDARD,
) -> Trajectory:
    """Press, shear and twist a fully drawn scene's indenter into its pad, on a given mesh of it.

    `folder` is what a mesh indenter's file name is relative to; for `frames`, `options` and further errors see
    `simulate_press`. InputError where the indenter cannot be built.
    """
    return simulate_press(Press.of(scene, mesh, folder), frames, options=options)


def simulate_press(
    press: Press,
    frames: frozenset[int] | None = None,
    on_progress: Callable[[float], None] | None = None,
    options: SolverOptions = STANDARD,
) -> Trajectory:
    """Simulate one press; of a round gel only the vicinity of the contact is solved for, see `Vicinity`.

    `frames` are the numbers of the states that are wanted, default all. The others are part of the trajectory, but keep
    the penalty's penetration and the load path's relaxed tolerance; those that are wanted are the same to the bit,
    unless one of them misses the full tolerance and its step is halved. `on_progress` is told after each step what
    share of the load path is done. InputError where the mesh is of another pad, or no element can be built on it.
    """
    gel, whole = press.scene.sensor.gel, space_of(press)
    if not (isinstance(gel, RoundGel) and press.path.may_touch):
        return direct_press(press, frames, options, whole).run(on_progress)
    # A film pulls as far as its shear lag, √(E t h / G) with the gel's thickness h and G = E / 3 of the gel.
    film = sum(layer.youngs_modulus_kpa * layer.thickness_mm for layer in gel.layers) / gel.youngs_modulus_kpa
    near = Vicinity(whole, press.path, max(gel.depth_mm, (3 * film * gel.depth_mm) ** 0.5))
    found = direct_press(press, frames, options, near.space).run(on_progress)
    return replace(found, states=tuple(map(near.widened, found.states)), space=whole)


def direct_press(
    press: Press, frames: frozenset[int] | None = None, options: SolverOptions = STANDARD, space: Space | None = None
) -> DirectPress:
    """A press at the start of its load path, on a part of its gel's space, default all of it; see `simulate_press`."""
    scene, gel, numerics = press.scene, press.scene.sensor.gel, press.scene.numerics
    space = space or space_of(press)
    system = System(space, pad_material(gel, space.mesh), options)
    modulus_mpa = gel.youngs_modulus_kpa / 1000
    steps = LoadSteps(press.path, space.mesh.size_mm, scene.contact.friction > 0, numerics, options, frames)
    return DirectPress(system, press.path, scene.contact.friction, modulus_mpa, steps)


def space_of(press: Press) -> Space:
    """The space of a press's whole gel; errors as for `simulate_press`."""
    _check_pad(press.scene.sensor.gel, press.mesh)
    check_mesh(press.mesh)
    return function_space(press.mesh, ELEMENTS[press.scene.numerics.element]())


def check_shared(scenes: Sequence[Scene], mesh: PadMesh) -> None:
    """Refuse scenes of another pad than the mesh's, or that differ in materials or in numerics other than penalty."""
    first = scenes[0]
    for scene in scenes:
        _check_pad(scene.sensor.gel, mesh)
        numerics = scene.numerics.model_copy(update={"penalty": first.numerics.penalty})
        if (_elastic(scene.sensor.gel), numerics) != (_elastic(first.sensor.gel), first.numerics):
            raise InputError("the scenes of a batch must share the gel's materials and all numerics but the penalty")


def _check_pad(gel: Gel, mesh: PadMesh) -> None:
    own, other = f"{gel.size_mm} mm {face_of(gel)}", f"{mesh.size_mm} mm {mesh.face}"
    if own != other:
        raise InputError(f"the mesh is of a {other}, the scene's is a {own}")
    if mesh.layer.max() != len(gel.layers):
        raise InputError(f"the mesh has {mesh.layer.max()} layers over the gel, the scene's has {len(gel.layers)}")


def _elastic(gel: Gel) -> tuple[float, ...]:
    """What the deformation depends on: Young's modulus of the gel itself only scales forces."""
    layers = [
        (layer.thickness_mm, layer.youngs_modulus_kpa / gel.youngs_modulus_kpa, layer.poisson_ratio, *layer.stiffening)
        for layer in gel.layers
    ]
    return (gel.poisson_ratio, *gel.stiffening, *(value for layer in layers for value in layer))


class Vicinity:
    """The elements of a round gel near the path of a body.

    One mesh serves all trajectories, and most of it never moves: in a thin layer bonded to its window a displacement
    dies away by half with each thickness of distance. Elements farther away are left out, and nodes on the cut are
    held.

    Attributes:
        space: of these elements, held as the whole gel's and on the cut.
    """

    def __init__(self, whole: Space, path: LoadPath, decay_mm: float) -> None:
        """Cut the vicinity of a path out of the space of a gel in which displacements die away over such a length."""
        near = _distance(whole.mesh.points, path) <= VICINITY * decay_mm
        kept = np.asarray(near[whole.mesh.tets].any(axis=1))
        self._whole, self._nodes = whole, np.unique(whole.nodes[kept])
        self.space = _part(whole, kept, self._nodes)

    def widened(self, state: State) -> State:
        """A state of `space` as one of the whole gel."""
        displacement, traction = np.zeros_like(self._whole.points), np.zeros_like(self._whole.surface.nodes)
        displacement[self._nodes] = state.displacement
        touched = self._nodes[self.space.surface_nodes]
        traction[np.searchsorted(self._whole.surface_nodes, touched)] = state.traction
        return replace(state, displacement=displacement, traction=traction)


def _distance(points: FloatArray, path: LoadPath) -> FloatArray:
    """(n,) mm from points (n, 3) to the body on its path."""
    poses = [path.pose(float(s)) for s in np.unique([*path.ends, *np.linspace(0.0, path.length_mm, POSES)])]
    body = Distance(path.body, np.array([pose.centre for pose in poses]), np.array([pose.rotation for pose in poses]))
    return np.min([body(points, np.full(len(points), k))[1] for k in range(len(poses))], axis=0)


def _part(whole: Space, kept: BoolArray, nodes: np.ndarray) -> Space:
    """The space of the kept elements, whose displacement nodes are `nodes`, sorted."""
    mesh = whole.mesh
    vertices = nodes[nodes < len(mesh.points)]
    number = np.full(len(whole.points), -1, dtype=np.int32)
    number[nodes] = np.arange(len(nodes))
    beyond = np.zeros(len(whole.points), dtype=bool)
    beyond[whole.nodes[~kept]] = True
    pressures, pressure_nodes = np.unique(whole.pressure_nodes[kept], return_inverse=True)
    faces = number[whole.faces]
    return replace(
        whole,
        mesh=replace(mesh, points=mesh.points[vertices], tets=number[mesh.tets[kept]], layer=mesh.layer[kept]),
        points=whole.points[nodes],
        nodes=np.ascontiguousarray(number[whole.nodes[kept]]),
        pressure_nodes=pressure_nodes.reshape(-1, 4).astype(np.int32),
        pressures=len(pressures),
        held=whole.held[nodes] | beyond[nodes, None],
        faces=np.ascontiguousarray(faces[(faces >= 0).all(axis=1)]),
    )
