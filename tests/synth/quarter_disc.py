"""A quarter of a round layer under an axisymmetric indenter, with circles of elements around the contact.

Walls of symmetry at x = 0 and y = 0, bonded at z = thickness, free at the rim. The square grid's rings max(x, y) become
circles, so that few elements resolve a round contact; forces of the whole layer are four times the quarter's.
"""

import numpy as np
from bonded_layer import ball
from pads import indenters, scene
from problems import mapped, supported

from synth.arrays import BoolArray, FloatArray, Points
from synth.mesh import PadMesh
from synth.simulate.contact import Indenters
from synth.simulate.element import Element
from synth.simulate.material import uniform
from synth.simulate.newton import relative_residual, solve
from synth.simulate.system import System, Unknowns

TOLERANCE = 1e-7
"""Of the relative residual; a thousand times below the discretisation error."""


def quarter_disc(radii: FloatArray, depths: FloatArray) -> PadMesh:
    """The quarter with rings at radii (from 0) and planes at depths (from 0 to the thickness), mm.

    Ring k is a polygon of 2 k edges over the quarter; it encloses as much as the circle does.
    """
    rings, planes = len(radii) - 1, len(depths) - 1
    angle_of_edge = np.pi / 4 / np.arange(1, rings + 1)
    corners = np.append(0.0, radii[1:] * np.sqrt(angle_of_edge / np.sin(angle_of_edge)))

    def bend(cube: Points) -> Points:
        large, small = cube[:, :2].max(axis=1), cube[:, :2].min(axis=1)
        radius = np.interp(large * rings, np.arange(rings + 1), corners)
        angle = np.pi / 4 * small / np.where(large > 0, large, 1.0)
        along, across = radius * np.cos(angle), radius * np.sin(angle)
        first = cube[:, 0] >= cube[:, 1]
        depth = np.interp(cube[:, 2] * planes, np.arange(planes + 1), depths)
        return np.column_stack([np.where(first, along, across), np.where(first, across, along), depth])

    return mapped((rings, rings, planes), bend, float(depths[-1]))


def growing(start: float, length: float, count: int, ratio: float) -> FloatArray:
    """(count,) positions beyond start, to start + length, whose spacing grows by ratio."""
    share = np.cumsum(ratio ** np.arange(count))
    return np.asarray(start + length * share / share[-1])


def walls_and_window(points: Points) -> BoolArray:
    """Smooth walls at x = 0 and y = 0; glued to the window."""
    window = points[:, 2] == points[:, 2].max()
    return np.column_stack([window | (points[:, 0] == 0), window | (points[:, 1] == 0), window])


def body(mesh: PadMesh, element: Element, poisson_ratio: float) -> System:
    """The quarter's system for a material of E = 1."""
    return System(supported(mesh, element, walls_and_window), uniform(len(mesh.tets), poisson_ratio))


def lowered(shape: dict[str, object], depth: float, thickness: float) -> Indenters:
    """An indenter whose lowest point is `depth` past the face."""
    return indenters(scene((20.0, 20.0, thickness), indenter=shape, motion={"depth_mm": depth}), depth)


def press(quarter: System, indenter: Indenters, penalties: tuple[float, ...] = (20.0, 200.0), passes: int = 2) -> float:
    """Force of the whole layer over E, mm²: one step at rising penalties, then augmented-Lagrangian updates.

    The updates leave less than 0.5 % of the depth as penetration at these penalties, and so that much of the force.
    """
    state: Unknowns = quarter.zero()
    for k in range(len(penalties) + passes):
        if k < len(penalties):
            quarter.penalty = penalties[k]
        else:
            quarter.augment(indenter)
        solution = solve(quarter, state, indenter, TOLERANCE)
        assert solution.converged, f"solve {k}: residual {relative_residual(solution.residual):.1e}"
        state = solution.state
    return 4 * float(quarter.forces(state)[0][2])


def ball_ratio(
    element: Element, poisson_ratio: float, radius: float, depth: float, cells: int, thickness: float = 1.0
) -> float:
    """Force of a ball over the integral equation's: `cells` across the contact, beside it, and through the layer."""
    contact, force = ball(depth, radius, thickness, poisson_ratio)
    reach = 1.15 * contact
    radii = np.concatenate([np.linspace(0, reach, cells + 1), growing(reach, 2.5 * thickness, cells, 1.5)])
    depths = np.concatenate([[0.0], growing(0.0, thickness, cells, 1.3)])
    quarter = body(quarter_disc(radii, depths), element, poisson_ratio)
    shape = {"shape": "sphere", "radius_mm": radius}
    return press(quarter, lowered(shape, depth, thickness)) / force
