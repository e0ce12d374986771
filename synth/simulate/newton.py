"""Newton's method with a residual line search, for a batch of independent samples with masks.

A saddle-point problem has no energy to descend, so the search looks at the residual's norm; a step is also halved until
det F > 0 everywhere. One sample's failure stops that sample only.
"""

from dataclasses import dataclass

import numpy as np

from synth.arrays import BoolArray, FloatArray
from synth.simulate.contact import Indenters
from synth.simulate.system import System
from synth.simulate.unknowns import Balance, Unknowns

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


@dataclass(frozen=True)
class Solution:
    """Outcome per sample.

    Attributes:
        state: the last iterate (meaningless where not converged).
        balance: its residual.
        converged: (B,) bool.
        iterations: (B,) int.
        residual: (B,) norm of the free residual over the norm of all nodal forces.
    """

    state: Unknowns
    balance: Balance
    converged: BoolArray
    iterations: np.ndarray
    residual: FloatArray

    def where(self, mask: BoolArray, other: "Solution") -> "Solution":
        """This where mask (B,) is true, else other."""
        return Solution(
            self.state.where(mask, other.state),
            self.balance.where(mask, other.balance),
            np.where(mask, self.converged, other.converged),
            np.where(mask, self.iterations, other.iterations),
            np.where(mask, self.residual, other.residual),
        )


def relative_residual(balance: Balance) -> FloatArray:
    """(B,) norm of the free residual over the norm of all nodal forces, which counts as NOTHING at least."""
    force = np.linalg.norm(balance.reaction.reshape(len(balance.free), -1), axis=1)
    return np.asarray(np.linalg.norm(balance.free, axis=1) / np.maximum(force, NOTHING))


def solve(
    system: System,
    start: Unknowns,
    indenters: Indenters,
    active: BoolArray,
    tolerance: FloatArray,
    limit: int = MAX_ITERATIONS,
    reach_mm: FloatArray | float = np.inf,
) -> Solution:
    """Bring the active samples into balance.

    Args:
        system: the pad.
        start: first iterates.
        indenters: where they are.
        active: (B,) bool.
        tolerance: (B,) of `relative_residual`.
        limit: most iterations; twice as many where the balance is near.
        reach_mm: (B,) farthest that a node may go from the first iterate; a sample that goes farther has not converged.
    """
    state, balance = start, system.balance(start, indenters, active)
    running = active & (balance.smallest_jacobian > 0)
    converged = np.zeros_like(active)
    iterations = np.zeros(len(active), dtype=int)
    for iteration in range(2 * limit + 1):
        relative = relative_residual(balance)
        done = running & (relative <= tolerance) & ((iterations > 0) | (relative == 0))
        converged |= done
        running &= ~done & np.isfinite(relative)
        if iteration >= 5:
            running &= relative < 0.5
        if iteration >= limit:
            running &= relative <= NEAR
        if iteration == 2 * limit or not running.any():
            break
        tangent = system.tangent(state, indenters, running)
        rough = (iteration < PATIENCE) & ((tolerance > LOOSE) | (relative > NEAR))
        step = system.newton_step(tangent, balance.free, running, rough)
        running &= np.isfinite(step.u).all(axis=(1, 2))
        state, balance, running = _line_search(system, state, balance, step, indenters, running)
        iterations[running] += 1
        running &= np.linalg.norm(state.u - start.u, axis=2).max(axis=1) <= reach_mm
    return Solution(state, balance, converged, iterations, relative_residual(balance))


def _line_search(
    system: System, state: Unknowns, balance: Balance, step: Unknowns, indenters: Indenters, running: BoolArray
) -> tuple[Unknowns, Balance, BoolArray]:
    before = np.linalg.norm(balance.free, axis=1)
    scale = np.ones(len(running))
    pending = running.copy()
    while pending.any():
        trial = state.plus(step, np.where(pending, scale, 0.0))
        after = system.balance(trial, indenters, pending)
        valid = pending & (after.smallest_jacobian > 0)
        norm = np.linalg.norm(after.free, axis=1)
        good = valid & ((norm <= before * (1 - 1e-4 * scale)) | (scale < INDIFFERENT))
        state = trial.where(good, state)
        balance = after.where(good, balance)
        pending &= ~good
        scale[pending] /= 2
        lost = pending & (scale < SHORTEST)
        pending &= ~lost
        running = running & ~lost
    return state, balance, running
