"""Newton's method with a residual line search.

A saddle-point problem has no energy to descend, so the search looks at the residual's norm; a step is also halved until
det F > 0 everywhere.
"""

from dataclasses import dataclass

import numpy as np

from synth.simulate.contact import Indenters
from synth.simulate.linear import norm
from synth.simulate.system import System
from synth.simulate.unknowns import Residual, Unknowns

MAX_ITERATIONS = 20
PATIENCE = 5
"""Iterations that may take rough directions. Far from the solution, or where a nearly incompressible gel is sheared as
a whole (Cook's membrane), directions that are 1 % off do not get there in MAX_ITERATIONS."""
LOOSE = 1e-5
"""A tolerance above it is reached with rough directions."""
NEAR = 1e-2
"""Relative residual below which a smaller tolerance is approached with exact directions: the last iterations then
surpass it by as much as ever. Above, changes of the contact set count for more than 1 % of a direction. Below it, a
solve may also take up to twice its iterations: whether the last of them just met the tolerance, rounding would decide,
and a pass that is given up leads to another balance."""
SHORTEST = 1 / 1024
"""Shortest step of the line search."""
NOTHING = 1e-6
"""Force in E mm² that is none: where the indenter has slid off, only rounding (about 1e-13) is left to compare with."""
INDIFFERENT = 0.3
"""Below this step length any valid state is taken: a kink of the contact set can make every step raise the residual."""
LATE, HOPELESS = 5, 0.5
"""After so many iterations a solve ends whose relative residual is still so large."""
DECREASE = 1e-4
"""Share of the predicted decrease of the residual that a step of the line search must reach (Armijo's condition)."""


@dataclass(frozen=True)
class Solution:
    """Outcome of a solve.

    Attributes:
        state: the last iterate (meaningless where not converged).
        residual: of that state.
        converged: whether the tolerance was met.
        iterations: that were taken.
    """

    state: Unknowns
    residual: Residual
    converged: bool
    iterations: int


def relative_residual(residual: Residual) -> float:
    """Norm of the free residual over the norm of all nodal forces, which counts as NOTHING at least."""
    return norm(residual.free) / max(norm(residual.reaction), NOTHING)


def solve(
    system: System,
    start: Unknowns,
    indenter: Indenters,
    tolerance: float,
    limit: int = MAX_ITERATIONS,
    reach_mm: float = np.inf,
) -> Solution:
    """Find the equilibrium near a first iterate.

    Args:
        system: the pad.
        start: first iterate.
        indenter: where it is.
        tolerance: of `relative_residual`.
        limit: most iterations; twice as many where the equilibrium is near.
        reach_mm: farthest that a node may go from the first iterate; a solve that goes farther has not converged.
    """
    state, residual = start, system.residual(start, indenter)
    iterations = 0
    while residual.smallest_jacobian > 0:
        relative = relative_residual(residual)
        if relative <= tolerance and (iterations > 0 or relative == 0):
            return Solution(state, residual, True, iterations)
        hopeless = not np.isfinite(relative) or (iterations >= LATE and relative >= HOPELESS)
        if hopeless or iterations == 2 * limit or (iterations >= limit and relative > NEAR):
            break
        rough = iterations < PATIENCE and (tolerance > LOOSE or relative > NEAR)
        step = system.newton_step(system.tangent(state, indenter), residual.free, rough)
        found = _line_search(system, state, residual, step, indenter) if np.isfinite(step.u).all() else None
        if found is None:
            break
        state, residual = found
        iterations += 1
        if np.linalg.norm(state.u - start.u, axis=1).max() > reach_mm:
            break
    return Solution(state, residual, False, iterations)


def _line_search(
    system: System, state: Unknowns, residual: Residual, step: Unknowns, indenter: Indenters
) -> tuple[Unknowns, Residual] | None:
    """The state after the longest step that is taken, and its residual; None where no step is."""
    before, scale = norm(residual.free), 1.0
    while scale >= SHORTEST:
        trial = state.plus(step, scale)
        after = system.residual(trial, indenter)
        falls = norm(after.free) <= before * (1 - DECREASE * scale)
        if after.smallest_jacobian > 0 and (falls or scale < INDIFFERENT):
            return trial, after
        scale /= 2
    return None
