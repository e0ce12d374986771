"""Boundary-value problems for the verification of the solver: other supports than the window, dead loads, loading.

The solver holds displacement components at the value they have at the start, so that prescribed motion is a `held`
mask and a start; dead loads are nodal forces. Everything for E = 1.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from pads import brick, far_away

from synth.arrays import BoolArray, FloatArray, Points
from synth.mesh import PadMesh
from synth.simulate.element import Element
from synth.simulate.material import Material
from synth.simulate.newton import relative_residual, solve
from synth.simulate.space import Space, function_space
from synth.simulate.system import System, Unknowns

TIGHT = 1e-10
"""Tolerance of the relative residual: what is compared with closed forms should not show Newton's method."""


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


def equilibrium(
    space: Space,
    material: Material,
    prescribed: FloatArray | None = None,
    load: FloatArray | None = None,
    steps: int = 1,
    guess: Unknowns | None = None,
    tolerance: float = TIGHT,
) -> tuple[System, Unknowns, FloatArray]:
    """Find the equilibrium of a body without contact under prescribed displacements and dead loads, in equal steps.

    Args:
        space: whose held components move to `prescribed`.
        material: of its elements.
        prescribed: (n, 3) mm, read where held; default zero.
        load: (n, 3) nodal forces in E mm².
        steps: in how many equal parts; each starts from the last state extrapolated.
        guess: first iterate of a single step, instead of the undeformed state.
        tolerance: of Newton's method.

    Returns:
        the system, its state, and all nodal forces (n, 3): what the supports exert, zero elsewhere.
    """
    goal = np.zeros_like(space.points) if prescribed is None else prescribed
    body = System(space, material, load=load)
    state = guess or body.zero()
    before = state
    for k in range(1, steps + 1):
        body.load = None if load is None else load * (k / steps)
        ahead = state.plus(Unknowns(state.u - before.u, state.p - before.p), 1.0)
        start = Unknowns(np.where(space.held, goal * (k / steps), ahead.u), ahead.p)
        solution = solve(body, start, far_away(), tolerance)
        assert solution.converged, f"step {k} of {steps}: residual {relative_residual(solution.residual):.1e}"
        before, state = state, solution.state
    return body, state, body.residual(state, far_away()).reaction


def face_load(space: Space, on: Callable[[Points], BoolArray], traction: FloatArray) -> FloatArray:
    """(n, 3) nodal forces of a constant traction (3,) on the boundary faces whose nodes all satisfy `on`.

    A linear face gives a third of its force to each vertex; a straight quadratic one to each middle of an edge.
    """
    faces = space.faces[on(space.points)[space.faces].all(axis=1)]
    a, b, c = (space.points[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    bearing = faces if faces.shape[1] == 3 else faces[:, 3:]
    load = np.zeros_like(space.points)
    np.add.at(load, bearing, (area[:, None, None] / 3 * traction))
    return load
