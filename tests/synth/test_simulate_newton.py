"""Newton's method: convergence, and how it ends where there is none."""

import numpy as np
import pytest
from pads import SIZE, brick, indenters, scene, system

from synth.simulate.newton import NEAR, Solution, relative_residual, solve
from synth.simulate.options import SolverOptions
from synth.simulate.press import Press
from synth.simulate.solve import stepper_of
from synth.simulate.system import System

PRESSED = 0.3
"""mm of depth, in one go."""
MESH = brick(SIZE, (4, 4, 2))
EXACT = 1e-9


@pytest.fixture(scope="module")
def body() -> System:
    return system(MESH, 0.49)


def press(body: System, tolerance: float = EXACT, **limits: float) -> Solution:
    """From rest as the first time, without the last solve's factor."""
    body.forget_factor()
    return solve(body, body.zero(), indenters(scene(), PRESSED), tolerance, **limits)


def test_a_press_converges(body: System) -> None:
    found = press(body)
    assert found.converged
    assert 2 <= found.iterations <= 12
    assert relative_residual(body.residual(found.state, indenters(scene(), PRESSED))) <= EXACT


def test_the_limit_is_kept_and_said(body: System) -> None:
    """Far from equilibrium."""
    needed = press(body).iterations
    for limit in (1, needed):
        found = press(body, limit=limit)
        assert found.iterations == limit
        assert found.converged == (limit == needed)
        assert (relative_residual(found.residual) > NEAR) == (limit == 1)


def test_a_solve_that_is_near_goes_on_beyond_the_limit_to_twice_its_iterations(body: System) -> None:
    needed = press(body).iterations
    found = press(body, limit=needed - 1)
    assert (found.iterations, found.converged) == (needed, True)
    never = press(body, 1e-30, limit=needed)
    assert not never.converged
    assert needed < never.iterations <= 2 * needed


def test_a_start_in_equilibrium_costs_one_iteration_and_no_force_costs_none(body: System) -> None:
    """A start that happens to be within the tolerance is improved once."""
    first = press(body)
    assert solve(body, first.state, indenters(scene(), PRESSED), EXACT).iterations == 1
    away = indenters(scene(motion={"depth_mm": -1.0}), 0.0)
    assert solve(body, body.zero(), away, EXACT).iterations == 0


def test_a_solve_that_goes_too_far_has_not_converged(body: System) -> None:
    """And ends there."""
    free = press(body)
    moved = float(np.linalg.norm(free.state.u, axis=1).max())
    for share in (0.5, 4.0):
        found = press(body, reach_mm=share * moved)
        assert found.converged == (share > 1)
        assert (found.iterations == free.iterations) == (share > 1)
    assert (found.state.u == free.state.u).all()


def test_double_factor_solves_to_double_precision() -> None:
    options = SolverOptions(single_precision=False, reuse_factors=False)
    stepper = stepper_of(Press.of(scene(numerics={"element": "p2p1"}), MESH), options=options)
    body = stepper.system
    tangent = body.tangent(body.zero(), stepper.indenter)
    right = np.random.default_rng(0).standard_normal(len(body.free))
    step = body.newton_step(tangent, right)
    solution = np.concatenate([step.u.ravel(), step.p])[body.free]
    upper = body.matrix(tangent.values)
    left = upper @ solution + upper.T @ solution - upper.diagonal() * solution + right
    # A backward stable solve leaves some 1e-16 of |K| |x|, which at a Poisson ratio of 0.4999 is 1e4 times |r|.
    assert np.linalg.norm(left) < 1e-10 * np.linalg.norm(right)
