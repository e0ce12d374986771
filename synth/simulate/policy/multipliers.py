"""Augmented-Lagrangian passes: multiplier update and solve, until nearly all penetration and elastic slip are gone."""

from dataclasses import dataclass

from synth.press.distance import KINDS
from synth.press.indenter import RigidBody
from synth.press.load_path import LoadPath
from synth.simulate.policy.newton import Solution, relax, solve
from synth.simulate.policy.requests import Asking, Augment, Do

MAX_MULTIPLIER_UPDATES = 2.0
"""Whole updates of the multipliers at a recorded state, in all. Not every contact point of a face on a curved body can
come to rest on the surface, so that more updates make the tractions uneven."""
FAILURES, MAX_FAILURES = 3, 8
"""Failed updates after which the passes end, the second number where they begin deeper than SINKING or are patient; an
object's deeper than DEEP go on. Updates are halved after a failure and doubled after a success: where a whole one
upsets Newton's method a part of it does not. What is left after the first number can be 2 % of the force."""
DEEP = 0.02
"""Share of the press depth (at least 0.1 mm). A triangle mesh that penetrates by more gets up to MAX_DEEP_PASSES
passes, failed ones included. After the first success each pass doubles the contact stiffness, to at most
MAX_STIFFENING times the body's own: multipliers alone converge slowly at sharp edges (after Nocedal & Wright,
Numerical Optimization, framework 17.3). The press ends if that does not suffice."""
MAX_DEEP_PASSES, MAX_STIFFENING = 16, 8.0
SINKING, SUNK = 0.05, 0.2
"""Shares of the press depth (at least 0.1 mm). A press of another shape ends that would have to record a penetration by
more than the second: it bears on what cannot give way, such as a round gel's held rim."""
PENETRATION = 2e-3
"""Passes end when no contact point is deeper inside the indenter than this share of the press depth."""
MAX_CORRECTION_RATIO = 3.0
"""A pass fails that moves a node, in any iteration, farther than so many times the deepest penetration, which is what
it is to take away: at edges that slip Newton's method can wander off to another equilibrium."""
MAX_RELAXED_UPDATE = 1 / 4
"""A pass that fails and begins deeper than DEEP is relaxed when it is less than this share of a whole update."""


MULTIPLIER_TOLERANCE = 20.0
"""Tolerance of states that multipliers are updated from, over the full one: two updates do not forget what they began
with."""


def allowed_share(body: RigidBody) -> float:
    """Share of the press depth that a recorded state may penetrate."""
    return DEEP if body.kind == KINDS["mesh"] else SUNK


@dataclass(frozen=True)
class Passes:
    """How the passes of a press are solved.

    Attributes:
        tolerance: of what is recorded; relaxed_tolerance: of intermediate steps.
        limit: most iterations of a pass that is not near its equilibrium.
        patient: whether more updates may fail, for forces within a percent.
    """

    path: LoadPath
    tolerance: float
    relaxed_tolerance: float
    limit: int
    closer: float = 1.0
    patient: bool = False

    def run(self, solution: Solution) -> Asking[Solution]:
        """Passes by whole updates, or as large a share of them as converges; the iterations of all are counted.

        Of two whole updates the last is solved to the full tolerance; passes that begin deeper than DEEP never are.
        The contact stiffness may end up raised.
        """
        scale, between = self.path.depth_scale_mm, min(self.relaxed_tolerance, MULTIPLIER_TOLERANCE * self.tolerance)
        is_mesh = self.path.body.kind == KINDS["mesh"]
        share, stiffening, done, failures, passes = 1.0, 1.0, 0.0, 0, 0
        if solution.at.deepest_mm > PENETRATION * scale:
            solution = yield from polish(solution, between)
        while solution.converged and solution.at.deepest_mm > PENETRATION * scale:
            deepest = solution.at.deepest_mm
            deep = is_mesh and deepest > DEEP * scale
            allowed = MAX_FAILURES if self.patient or deepest > SINKING * scale else FAILURES
            if passes >= MAX_DEEP_PASSES if deep else done >= MAX_MULTIPLIER_UPDATES or failures >= allowed:
                break
            passes += 1
            stiffer = min(2 * stiffening, MAX_STIFFENING) if deep and done > 0 else stiffening
            yield Do.KEEP_PASS
            start = yield Augment(share, stiffer)
            tolerance = (
                between if deep or done + share < MAX_MULTIPLIER_UPDATES else max(self.closer * self.tolerance, 1e-12)
            )
            better = yield from solve(start, tolerance, self.limit, MAX_CORRECTION_RATIO * deepest)
            if not better.converged and deep and share < MAX_RELAXED_UPDATE:
                start = yield Do.REPEAT
                better = (yield from relax(start, tolerance)).after(better)
            if better.converged:
                solution, stiffening, done = better.after(solution), stiffer, done + share
                share = min(1.0, 2 * share)
            else:
                yield Do.RESTORE_PASS
                solution = solution.after(better)
                failures, share = failures + 1, share / 2
        return solution


def polish(solution: Solution, tolerance: float) -> Asking[Solution]:
    """Bring a solution, the iterate, to a tolerance where it is not there yet."""
    if not solution.converged or solution.at.relative <= tolerance:
        return solution
    return (yield from solve(solution.at, tolerance)).after(solution)
