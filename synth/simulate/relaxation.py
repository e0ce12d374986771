r"""Equilibrium by relaxation, where Newton's method does not find it: pseudo-transient continuation.

Past a limit point (a corner that slips from one place of the gel to the next) the nearest equilibrium is not where
Newton's method looks, and the residual rises on the way to it. A gel with a viscosity of its own moves there by itself:

.. math::  θ L \dot u + r(u) = 0, \qquad L_{ab} = \int μ \, g_a \cdot g_b \, I

is followed by implicit steps of one linearisation each, (K + θ L) δ = -r, with θ (one over the step in time) chosen so
that the residual with the viscous force, r(u + δ) + θ L δ, which is zero for a linear r, is at most MAX_ERROR of r(u).
As the gel comes to rest θ falls to zero and the steps become Newton's (Kelley & Keyes, SIAM J. Numer. Anal. 35, 1998).
The pressure has no viscosity, so that the volume is kept throughout. Nothing here asks the residual to fall.
"""

import numpy as np

from synth.arrays import BoolArray, FloatArray
from synth.simulate.contact import Indenters
from synth.simulate.newton import Solution, relative_residual
from synth.simulate.system import System
from synth.simulate.unknowns import Balance, Unknowns

MAX_STEPS = 300
"""See docs/reports/objects.md: with 100 a fifteenth of the presses of objects ended early, with 1000 time is lost."""
FIRST_VISCOSITY = 1.0
"""θ of the first step: the viscous stress of a step is then the elastic one of its strain."""
LEAST_VISCOSITY = 1e-3
"""A smaller θ is none."""
MOST_VISCOSITY = 1e3
"""At this θ a step that errs too much is halved instead."""
LEAST_SHARE = 1 / 256
MAX_ERROR, AIM = 0.5, 0.2
"""Largest error of a step that is taken, and what the next θ aims at."""
LEAST_BORNE = 0.25
"""A relaxation fails that leaves less than this share of the reaction: the body has slipped between contact points."""
FALL, RISE = 0.1, 6.0
"""Largest change of θ from one step to the next, down and up."""


def relax(
    system: System,
    start: Unknowns,
    indenters: Indenters,
    active: BoolArray,
    tolerance: FloatArray,
) -> Solution:
    """Let the active samples come to rest; arguments and result as of `synth.simulate.newton.solve`."""
    state, balance = start, system.balance(start, indenters, active)
    running = active & (balance.smallest_jacobian > 0)
    borne = LEAST_BORNE * _reaction(system, balance)
    converged = np.zeros_like(active)
    iterations = np.zeros(len(active), dtype=int)
    viscosity, share = np.full(len(active), FIRST_VISCOSITY), np.ones(len(active))
    for _ in range(MAX_STEPS):
        if not running.any():
            break
        tangent = system.tangent(state, indenters, running, viscosity)
        step = system.newton_step(tangent, balance.free, running)
        trial = state.plus(step, np.where(running, share, 0.0))
        after = system.balance(trial, indenters, running)
        iterations[running] += 1
        error = after.free - (1 - share)[:, None] * balance.free
        error = np.linalg.norm(error + system.viscous_force(state, trial, running, viscosity), axis=1)
        error /= np.maximum(np.linalg.norm(balance.free, axis=1), np.finfo(float).tiny)
        error[~(after.smallest_jacobian > 0) | ~np.isfinite(error)] = np.inf
        good = running & (error <= MAX_ERROR)
        state, balance = trial.where(good, state), after.where(good, balance)
        share = np.where(good, 1.0, np.where(viscosity < MOST_VISCOSITY, share, share / 2))
        viscosity = next_viscosity(viscosity, error)
        running &= ~(good & (_reaction(system, balance) < borne)) & (share >= LEAST_SHARE)
        converged |= running & good & (relative_residual(balance) <= tolerance)
        running &= ~converged
    return Solution(state, balance, converged, iterations, relative_residual(balance))


def _reaction(system: System, balance: Balance) -> FloatArray:
    """(B,) norm of the forces on held nodes, E mm²: what the gel bears, wherever the indenter is by now."""
    return np.asarray(np.linalg.norm(balance.reaction[:, system.space.held.any(axis=1)], axis=(1, 2)))


def next_viscosity(viscosity: FloatArray, error: FloatArray) -> FloatArray:
    """θ (B,) after steps of these errors (B,)."""
    taken = viscosity * np.clip(error / AIM, FALL, RISE)
    taken[taken < LEAST_VISCOSITY] = 0.0
    refused = np.maximum(viscosity * np.clip(error / AIM, 2.0, RISE), LEAST_VISCOSITY)
    return np.asarray(np.where(error <= MAX_ERROR, taken, np.minimum(refused, MOST_VISCOSITY)))
