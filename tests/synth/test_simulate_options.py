"""Options of the solver that no scene has: each does what it is there for."""

from dataclasses import replace

import numpy as np
from pads import brick, scene

from synth.simulate import simulate
from synth.simulate.options import STANDARD, SolverOptions
from synth.simulate.press import Press
from synth.simulate.solve import stepper_of

MESH = brick()
PLAIN = SolverOptions(relaxed_tolerance=0.0, extrapolate=False, single_precision=False, reuse_factors=False)


def test_relaxed_and_extrapolated_steps_save_iterations() -> None:
    """Fails with the options not handed on by `simulate`, and with either without effect."""
    posed = scene(friction=0.0, motion={"depth_mm": 0.6, "steps": 1}, numerics={"max_step_mm": 0.1})
    exact = replace(STANDARD, reuse_factors=False)  # rough directions save time, not iterations
    counts = []
    for options in (exact, replace(exact, relaxed_tolerance=0.0), replace(exact, extrapolate=False), PLAIN):
        found = simulate(posed, MESH, options=options)
        assert found.status == "complete"
        counts.append(sum(state.newton_iterations for state in found.states))
    standard, tight, unpredicted, plain = counts
    assert standard < min(tight, unpredicted)
    assert max(tight, unpredicted) < plain


def test_double_factor_solves_to_double_precision() -> None:
    """Fails with single left out of `direct_factor`'s arguments: 1e-6."""
    stepper = stepper_of(Press.of(scene(numerics={"element": "p2p1"}), MESH), options=PLAIN)
    system = stepper.system
    tangent = system.tangent(system.zero(), stepper.indenter)
    right = np.random.default_rng(0).standard_normal(len(system.free))
    step = system.newton_step(tangent, right)
    solution = np.concatenate([step.u.ravel(), step.p])[system.free]
    upper = system.matrix(tangent.values)
    left = upper @ solution + upper.T @ solution - upper.diagonal() * solution + right
    # A backward stable solve leaves some 1e-16 of |K| |x|, which at a Poisson ratio of 0.4999 is 1e4 times |r|.
    assert np.linalg.norm(left) < 1e-10 * np.linalg.norm(right)
