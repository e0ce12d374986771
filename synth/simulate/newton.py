r"""Newton's method with a residual line search.

A saddle-point problem has no energy to descend, so the search looks at the residual's norm; a step is also halved until
det F > 0 everywhere.

Where it does not find an equilibrium, relaxation may (pseudo-transient continuation). Past a limit point (a corner that
slips from one place of the gel to the next) the nearest equilibrium is not where Newton's method looks, and the
residual rises before it. A gel with a viscosity of its own moves there by itself:

.. math::  θ L \dot u + r(u) = 0, \qquad L_{ab} = \int μ \, g_a \cdot g_b \, I

is followed by implicit steps of one linearisation each, (K + θ L) δ = -r, with θ (one over the step in time) chosen so
that the residual with the viscous force, r(u + δ) + θ L δ, which is zero for a linear r, is at most MAX_ERROR of r(u).
As the gel comes to rest θ falls to zero and the steps become Newton's (Kelley & Keyes, SIAM J. Numer. Anal. 35, 1998).
The pressure has no viscosity, so that the volume is kept throughout. Nothing here asks the residual to fall.
"""

from dataclasses import dataclass

import numpy as np

from synth.simulate.contact import Indenters
from synth.simulate.linear import norm
from synth.simulate.system import Residual, System, Unknowns

MAX_ITERATIONS = 20
MAX_ROUGH_ITERATIONS = 5
"""Iterations after which directions are exact: far from the solution rough ones may not get there at all."""
ROUGH_ABOVE = 1e-5
"""A tolerance above it is reached with rough directions and earlier factors."""
NEAR = 1e-2
"""Relative residual below which the equilibrium is near: MAX_TURN ends, directions are exact for a smaller tolerance,
and a solve may take up to twice its iterations, so that rounding does not decide whether the last met the tolerance."""
MAX_TURN = 0.1
"""`max_turn` of `contact_stiffness` until NEAR: iterates are far deeper in edges than equilibria, and the gap's
second derivative misleads there."""
SHORTEST = 1 / 1024
"""Shortest step of the line search."""
FORCE_FLOOR = 1e-6
"""Force in E mm² that is none: where the indenter has slid off, only rounding is left to compare with."""
INDIFFERENT = 0.3
"""Below this step length any valid state is taken: a kink of the contact set can make every step raise the residual."""
STALL_ITERATIONS, STALLED_RESIDUAL = 5, 0.5
"""A solve ends after so many iterations if its relative residual is still as large as the second number."""
SUFFICIENT_DECREASE = 1e-4
"""Share of the predicted decrease of the residual that a step of the line search must reach (Armijo's condition)."""


@dataclass(frozen=True)
class Solution:
    """Outcome of a solve; `state` is the last iterate, which means nothing where it has not converged."""

    state: Unknowns
    residual: Residual
    converged: bool
    iterations: int


def relative_residual(residual: Residual) -> float:
    """Norm of the free residual over the norm of all nodal forces, which counts as FORCE_FLOOR at least."""
    return norm(residual.free) / max(norm(residual.nodal_forces), FORCE_FLOOR)


def solve(
    system: System,
    start: Unknowns,
    indenter: Indenters,
    tolerance: float,
    limit: int = MAX_ITERATIONS,
    reach_mm: float = np.inf,
) -> Solution:
    """Find the equilibrium near a first iterate, to a tolerance of `relative_residual`.

    `limit` is the most iterations; twice as many where the equilibrium is near. A solve that takes a node farther than
    `reach_mm` from the first iterate has not converged.
    """
    state, residual = start, system.residual(start, indenter)
    iterations = 0
    while residual.smallest_jacobian > 0:
        relative = relative_residual(residual)
        if relative <= tolerance and (iterations > 0 or relative == 0):
            return Solution(state, residual, True, iterations)
        stalled = not np.isfinite(relative) or (iterations >= STALL_ITERATIONS and relative >= STALLED_RESIDUAL)
        if stalled or iterations == 2 * limit or (iterations >= limit and relative > NEAR):
            break
        rough = iterations < MAX_ROUGH_ITERATIONS and (tolerance > ROUGH_ABOVE or relative > NEAR)
        turn = MAX_TURN if relative > NEAR else np.inf
        reuse = rough or tolerance > ROUGH_ABOVE
        step = system.newton_step(system.tangent(state, indenter, turn=turn), residual.free, rough, reuse)
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
        falls = norm(after.free) <= before * (1 - SUFFICIENT_DECREASE * scale)
        if after.smallest_jacobian > 0 and (falls or scale < INDIFFERENT):
            return trial, after
        scale /= 2
    return None


MAX_STEPS = 150
"""Steps of a relaxation at most."""
FIRST_VISCOSITY = 1.0
"""θ of the first step: the viscous stress of a step is then the elastic one of its strain."""
LEAST_VISCOSITY = 1e-3
"""A smaller θ is none."""
MOST_VISCOSITY = 1e3
"""At this θ a step that errs too much is halved instead."""
LEAST_SHARE = 1 / 256
MAX_ERROR, AIM = 0.5, 0.2
"""Largest error of a step that is taken, and what the next θ aims at."""
MIN_REACTION_RATIO = 0.25
"""A relaxation fails that leaves less than this share of the reaction: the body has slipped between contact points."""
FALL, FALL_AFTER_REFUSAL, RISE = 0.1, 0.5, 6.0
"""Largest change of θ from one step to the next: down, down from the step after a refused one, and up."""


def relax(system: System, start: Unknowns, indenter: Indenters, tolerance: float) -> Solution:
    """Let a state come to rest; arguments and result as for `solve`."""
    state, residual = start, system.residual(start, indenter)
    least = MIN_REACTION_RATIO * _reaction(system, residual)
    viscosity, share, iterations, refused = FIRST_VISCOSITY, 1.0, 0, False
    while residual.smallest_jacobian > 0 and iterations < MAX_STEPS and share >= LEAST_SHARE:
        tangent = system.tangent(state, indenter, viscosity)
        step = system.newton_step(tangent, residual.free, reuse=tolerance > ROUGH_ABOVE)
        trial = state.plus(step, share)
        after = system.residual(trial, indenter)
        iterations += 1
        missed = norm(after.free - (1 - share) * residual.free + system.viscous_force(state, trial, viscosity))
        error = missed / max(norm(residual.free), np.finfo(float).tiny)
        if not (after.smallest_jacobian > 0 and np.isfinite(error)):
            error = np.inf
        if error <= MAX_ERROR:
            state, residual, share = trial, after, 1.0
            if _reaction(system, residual) < least:
                break
            if relative_residual(residual) <= tolerance:
                return Solution(state, residual, True, iterations)
        elif viscosity >= MOST_VISCOSITY:
            share /= 2
        viscosity, refused = next_viscosity(viscosity, error, refused), error > MAX_ERROR
    return Solution(state, residual, False, iterations)


def _reaction(system: System, residual: Residual) -> float:
    """Norm of the forces on held nodes, E mm²: what the gel bears, wherever the indenter is by now."""
    return norm(residual.nodal_forces[system.space.held.any(axis=1)])


def next_viscosity(viscosity: float, error: float, refused: bool = False) -> float:
    """θ after a step of this error, and whether the step before it was refused."""
    if error <= MAX_ERROR:
        taken = viscosity * min(max(error / AIM, FALL_AFTER_REFUSAL if refused else FALL), RISE)
        return taken if taken >= LEAST_VISCOSITY else 0.0
    return min(max(viscosity * min(max(error / AIM, 2.0), RISE), LEAST_VISCOSITY), MOST_VISCOSITY)
