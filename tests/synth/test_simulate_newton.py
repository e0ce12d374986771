"""Newton's method: convergence, and how it ends where there is none."""

import numpy as np
from pads import SIZE, brick, indenters, scene, system

from synth.simulate.newton import NEAR, relative_residual, solve

PRESSED = 0.3
"""mm of depth, in one go."""
MESH = brick(SIZE, (4, 4, 2))
EXACT = np.full(1, 1e-9)
ALL = np.ones(1, dtype=bool)


def test_a_press_converges() -> None:
    """Fails with a tolerance a thousand times larger."""
    body, ball = system(MESH, 0.49), indenters(scene(), PRESSED)
    found = solve(body, body.zero(), ball, ALL, EXACT)
    assert found.converged.all()
    assert 2 <= found.iterations[0] <= 12
    again = body.balance(found.state, ball, ALL)
    assert relative_residual(again)[0] <= EXACT[0]


def test_the_limit_is_kept_and_said() -> None:
    """Far from balance. Fails with one iteration more than the limit, and with what is left counted as converged."""
    body, ball = system(MESH, 0.49), indenters(scene(), PRESSED)
    needed = int(solve(body, body.zero(), ball, ALL, EXACT).iterations[0])
    assert needed > 2
    for limit in (1, needed):
        body.begin()  # as the first time, without the last solve's factor
        found = solve(body, body.zero(), ball, ALL, EXACT, limit=limit)
        assert found.iterations[0] == limit
        assert found.converged[0] == (limit == needed)
        assert (found.residual[0] > NEAR) == (limit == 1)


def test_a_solve_that_is_near_goes_on_beyond_the_limit_to_twice_its_iterations() -> None:
    """Fails with the limit kept there, and without a second limit."""
    body, ball = system(MESH, 0.49), indenters(scene(), PRESSED)
    needed = int(solve(body, body.zero(), ball, ALL, EXACT).iterations[0])
    body.begin()
    found = solve(body, body.zero(), ball, ALL, EXACT, limit=needed - 1)
    assert found.iterations[0] == needed
    assert found.converged[0]
    body.begin()
    never = solve(body, body.zero(), ball, ALL, np.full(1, 1e-30), limit=needed)
    assert not never.converged[0]
    assert needed < never.iterations[0] <= 2 * needed


def test_a_balanced_start_costs_one_iteration_and_no_force_costs_none() -> None:
    """A start that happens to be within the tolerance is improved once. Fails with `iterations > 0` left out."""
    body, ball = system(MESH, 0.49), indenters(scene(), PRESSED)
    first = solve(body, body.zero(), ball, ALL, EXACT)
    assert solve(body, first.state, ball, ALL, EXACT).iterations[0] == 1
    away = indenters(scene(motion={"depth_mm": -1.0}), 0.0)
    assert solve(body, body.zero(), away, ALL, EXACT).iterations[0] == 0


def test_a_sample_that_goes_too_far_has_not_converged() -> None:
    """And ends there; the other one does not know of it."""
    # Fails with a reach that both share, and with one that is left out.
    both, exact = np.ones(2, dtype=bool), np.full(2, 1e-9)
    body, ball = system(MESH, 0.49, batch=2), indenters(scene(), PRESSED, batch=2)
    free = solve(body, body.zero(), ball, both, exact)
    moved = float(np.linalg.norm(free.state.u, axis=2).max())
    body.begin()
    found = solve(body, body.zero(), ball, both, exact, reach_mm=np.array([0.5 * moved, 4 * moved]))
    assert found.converged.tolist() == [False, True]
    assert found.iterations[0] < found.iterations[1] == free.iterations[1]
    assert (found.state.u[1] == free.state.u[1]).all()
