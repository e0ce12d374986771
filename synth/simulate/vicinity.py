"""The part of a round gel that a press moves.

One mesh serves all draws of a round gel, and most of it never moves: in a thin layer bonded to its window a
displacement dies away by half with each thickness of distance. Elements farther away are left out, and nodes on the cut
are held.
"""

from dataclasses import replace

import numpy as np

from synth.arrays import BoolArray, FloatArray
from synth.simulate.load_path import LoadPath
from synth.simulate.measure import Distance
from synth.simulate.space import Space
from synth.simulate.trajectory import State

REACH = 6.0
"""Distance from the body within which gel may move, over the gel's thickness: what is left there moves some 1 %."""
POSES = 9
"""Poses of the load path that the distance is taken from, besides its corners."""


class Vicinity:
    """The elements of a gel near the path of a body.

    Attributes:
        space: of these elements, held as the whole gel's and on the cut.
    """

    def __init__(self, whole: Space, path: LoadPath, thickness_mm: float) -> None:
        """Cut the vicinity of a path out of the space of a gel."""
        near = _distance(whole.mesh.points, path) <= REACH * thickness_mm
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
