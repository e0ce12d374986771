r"""Equilibrium by relaxation, where Newton's method does not find it: pseudo-transient continuation.

Past a limit point (a corner that slips from one place of the gel to the next) the nearest equilibrium is not where
Newton's method looks, and the residual rises before it. A gel with a viscosity of its own moves there by itself:

.. math::  θ L \dot u + r(u) = 0, \qquad L_{ab} = \int μ \, g_a \cdot g_b \, I

is followed by implicit steps of one linearisation each, (K + θ L) δ = -r, with θ (one over the step in time) chosen so
that the residual with the viscous force, r(u + δ) + θ L δ, which is zero for a linear r, is at most MAX_ERROR of r(u).
As the gel comes to rest θ falls to zero and the steps become Newton's (Kelley & Keyes, SIAM J. Numer. Anal. 35, 1998).
The pressure has no viscosity, so that the volume is kept throughout. Nothing here asks the residual to fall.
"""

import numpy as np

from synth.simulate.contact import Indenters
from synth.simulate.linear import norm
from synth.simulate.newton import Solution, relative_residual
from synth.simulate.system import Residual, System, Unknowns

MAX_STEPS = 300
"""Presses of objects need some hundred; see docs/decisions.md."""
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
FALL, RISE = 0.1, 6.0
"""Largest change of θ from one step to the next, down and up."""


def relax(system: System, start: Unknowns, indenter: Indenters, tolerance: float) -> Solution:
    """Let a state come to rest; arguments and result as of `synth.simulate.newton.solve`."""
    state, residual = start, system.residual(start, indenter)
    least = MIN_REACTION_RATIO * _reaction(system, residual)
    viscosity, share, iterations = FIRST_VISCOSITY, 1.0, 0
    while residual.smallest_jacobian > 0 and iterations < MAX_STEPS and share >= LEAST_SHARE:
        step = system.newton_step(system.tangent(state, indenter, viscosity), residual.free)
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
        viscosity = next_viscosity(viscosity, error)
    return Solution(state, residual, False, iterations)


def _reaction(system: System, residual: Residual) -> float:
    """Norm of the forces on held nodes, E mm²: what the gel bears, wherever the indenter is by now."""
    return norm(residual.reaction[system.space.held.any(axis=1)])


def next_viscosity(viscosity: float, error: float) -> float:
    """θ after a step of this error."""
    if error <= MAX_ERROR:
        taken = viscosity * min(max(error / AIM, FALL), RISE)
        return taken if taken >= LEAST_VISCOSITY else 0.0
    refused = max(viscosity * min(max(error / AIM, 2.0), RISE), LEAST_VISCOSITY)
    return min(refused, MOST_VISCOSITY)
