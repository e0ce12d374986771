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

from dataclasses import dataclass, replace
from math import inf, isfinite

from synth.simulate.policy.requests import Asking, Do, Evaluation, Solve, Try

MAX_ITERATIONS = 20
NEAR = 1e-2
"""Relative residual below which the equilibrium is near: a solve may take up to twice its iterations, so that rounding
does not decide whether the last met the tolerance."""
MAX_TURN = 0.1
"""`max_turn` of `contact_stiffness` until NEAR: iterates are far deeper in edges than equilibria, and the gap's
second derivative misleads there."""
SHORTEST = 1 / 1024
"""Shortest step of the line search."""
INDIFFERENT = 0.3
"""Below this step length any valid state is taken: a kink of the contact set can make every step raise the residual."""
STALL_ITERATIONS, STALLED_RESIDUAL = 5, 0.5
"""A solve ends after so many iterations if its relative residual is still as large as the second number."""
SUFFICIENT_DECREASE = 1e-4
"""Share of the predicted decrease of the residual that a step of the line search must reach (Armijo's condition)."""


@dataclass(frozen=True)
class Solution:
    """Outcome of a solve: what was seen of the iterate, which means nothing where it has not converged."""

    at: Evaluation
    converged: bool
    iterations: int

    def after(self, earlier: "Solution") -> "Solution":
        """The same outcome with an earlier solve's iterations added."""
        return replace(self, iterations=self.iterations + earlier.iterations)


def solve(at: Evaluation, tolerance: float, limit: int = MAX_ITERATIONS, reach_mm: float = inf) -> Asking[Solution]:
    """Find the equilibrium near the iterate, whose evaluation is `at`, to a tolerance of `Evaluation.relative`.

    `limit` is the most iterations; twice as many where the equilibrium is near. A solve that takes a node farther than
    `reach_mm` from the snapshot before a pass has not converged.
    """
    iterations = 0
    while at.smallest_jacobian > 0:
        if at.relative <= tolerance and (iterations > 0 or at.relative == 0):
            return Solution(at, True, iterations)
        stalled = not isfinite(at.relative) or (iterations >= STALL_ITERATIONS and at.relative >= STALLED_RESIDUAL)
        if stalled or iterations == 2 * limit or (iterations >= limit and at.relative > NEAR):
            break
        turn = MAX_TURN if at.relative > NEAR else inf
        finite: bool = yield Solve(at.relative, tolerance, iterations, max_turn=turn)
        after = (yield from _line_search(at)) if finite else None
        if after is None:
            break
        at = after
        iterations += 1
        if at.moved_mm > reach_mm:
            break
    return Solution(at, False, iterations)


def _line_search(before: Evaluation) -> Asking[Evaluation | None]:
    """Take the longest step that may be taken; None where none may."""
    share = 1.0
    while share >= SHORTEST:
        after: Evaluation = yield Try(share)
        falls = after.free <= before.free * (1 - SUFFICIENT_DECREASE * share)
        if after.smallest_jacobian > 0 and (falls or share < INDIFFERENT):
            yield Do.TAKE
            return after
        share /= 2
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


def relax(at: Evaluation, tolerance: float) -> Asking[Solution]:
    """Let the iterate come to rest; arguments and result as for `solve`."""
    least = MIN_REACTION_RATIO * at.reaction
    viscosity, share, iterations, refused = FIRST_VISCOSITY, 1.0, 0, False
    while at.smallest_jacobian > 0 and iterations < MAX_STEPS and share >= LEAST_SHARE:
        yield Solve(at.relative, tolerance, iterations, viscosity)
        after: Evaluation = yield Try(share, viscosity)
        iterations += 1
        error = after.error if after.smallest_jacobian > 0 and isfinite(after.error) else inf
        if error <= MAX_ERROR:
            yield Do.TAKE
            at, share = after, 1.0
            if at.reaction < least:
                break
            if at.relative <= tolerance:
                return Solution(at, True, iterations)
        elif viscosity >= MOST_VISCOSITY:
            share /= 2
        viscosity, refused = next_viscosity(viscosity, error, refused), error > MAX_ERROR
    return Solution(at, False, iterations)


def next_viscosity(viscosity: float, error: float, refused: bool = False) -> float:
    """θ after a step of this error, and whether the step before it was refused."""
    if error <= MAX_ERROR:
        taken = viscosity * min(max(error / AIM, FALL_AFTER_REFUSAL if refused else FALL), RISE)
        return taken if taken >= LEAST_VISCOSITY else 0.0
    return min(max(viscosity * min(max(error / AIM, 2.0), RISE), LEAST_VISCOSITY), MOST_VISCOSITY)
