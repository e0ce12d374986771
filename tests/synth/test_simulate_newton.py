"""Newton's method: convergence, and how it ends where there is none."""

import numpy as np
from pads import SIZE, brick, indenters, scene, system

from synth.simulate.newton import NEAR, relative_residual, solve

PRESSED = 0.3
"""mm of depth, in one go."""
MESH = brick(SIZE, (4, 4, 2))
EXACT = 1e-9


def test_a_press_converges() -> None:
    """Fails with a tolerance a thousand times larger."""
    body, ball = system(MESH, 0.49), indenters(scene(), PRESSED)
    found = solve(body, body.zero(), ball, EXACT)
    assert found.converged
    assert 2 <= found.iterations <= 12
    again = body.residual(found.state, ball)
    assert relative_residual(again) <= EXACT


def test_the_limit_is_kept_and_said() -> None:
    """Far from equilibrium. Fails with an iteration more than the limit, and with what is left counted as converged."""
    body, ball = system(MESH, 0.49), indenters(scene(), PRESSED)
    needed = solve(body, body.zero(), ball, EXACT).iterations
    assert needed > 2
    for limit in (1, needed):
        body.forget_factor()  # as the first time, without the last solve's factor
        found = solve(body, body.zero(), ball, EXACT, limit=limit)
        assert found.iterations == limit
        assert found.converged == (limit == needed)
        assert (relative_residual(found.residual) > NEAR) == (limit == 1)


def test_a_solve_that_is_near_goes_on_beyond_the_limit_to_twice_its_iterations() -> None:
    """Fails with the limit kept there, and without a second limit."""
    body, ball = system(MESH, 0.49), indenters(scene(), PRESSED)
    needed = solve(body, body.zero(), ball, EXACT).iterations
    body.forget_factor()
    found = solve(body, body.zero(), ball, EXACT, limit=needed - 1)
    assert found.iterations == needed
    assert found.converged
    body.forget_factor()
    never = solve(body, body.zero(), ball, 1e-30, limit=needed)
    assert not never.converged
    assert needed < never.iterations <= 2 * needed


def test_a_start_in_equilibrium_costs_one_iteration_and_no_force_costs_none() -> None:
    """A start that happens to be within the tolerance is improved once. Fails with `iterations > 0` left out."""
    body, ball = system(MESH, 0.49), indenters(scene(), PRESSED)
    first = solve(body, body.zero(), ball, EXACT)
    assert solve(body, first.state, ball, EXACT).iterations == 1
    away = indenters(scene(motion={"depth_mm": -1.0}), 0.0)
    assert solve(body, body.zero(), away, EXACT).iterations == 0


def test_a_solve_that_goes_too_far_has_not_converged() -> None:
    """And ends there. Fails with a reach that is left out."""
    body, ball = system(MESH, 0.49), indenters(scene(), PRESSED)
    free = solve(body, body.zero(), ball, EXACT)
    moved = float(np.linalg.norm(free.state.u, axis=1).max())
    for share in (0.5, 4.0):
        body.forget_factor()
        found = solve(body, body.zero(), ball, EXACT, reach_mm=share * moved)
        assert found.converged == (share > 1)
        assert (found.iterations == free.iterations) == (share > 1)
    assert (found.state.u == free.state.u).all()
