"""Newton's method without convergence, and what recorded states and passes keep to, of one press and of many."""

from collections import deque
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from pads import (
    SIZE,
    SPHERE,
    Found,
    brick,
    complete,
    found_by_newton,
    gentle,
    indenters,
    same,
    scene,
    simulate_scenes,
    system,
)

from synth.mesh import PadMesh
from synth.press.press import Press
from synth.scene import Scene
from synth.simulate import Trajectory, simulate
from synth.simulate.batched.lane_orders import Order
from synth.simulate.batched.pad import prepare
from synth.simulate.batched.run import Run
from synth.simulate.direct import DirectPress
from synth.simulate.options import STANDARD, SolverOptions
from synth.simulate.policy import load_steps, multipliers, newton
from synth.simulate.policy.newton import NEAR, Solution, solve
from synth.simulate.policy.requests import Asking, Evaluation
from synth.simulate.solve import direct_press
from synth.simulate.system import System

MESH = brick(counts=(4, 4, 2))
TOLERANCE = 1e-8
RELAXED = SolverOptions(relaxed_tolerance=1e-2)
BETWEEN = multipliers.MULTIPLIER_TOLERANCE * TOLERANCE
POLISHES = {"before the passes": (2e-3, BETWEEN), "after a pass": (0.06, TOLERANCE), "for no pass": (np.inf, TOLERANCE)}
"""PENETRATION and a polish's tolerance: the ball is 0.08 of its depth inside, after a pass less than 0.06."""
each = pytest.mark.parametrize("polish", list(POLISHES))
PRESSED = 0.3  # mm of depth, in one go
PAD = brick(SIZE, (4, 4, 2))
EXACT = 1e-9
STRICT_WAY, LOOSE_WAY = (SolverOptions(relaxed_tolerance=loose, forcing=1e-3) for loose in (0.0, 1e-2))


def pressed(friction: float = 0.5, steps: int = 2) -> Scene:
    motion = {"depth_mm": 0.6, "shear_mm": [0.15, -0.05], "steps": steps}
    return scene(friction=friction, motion=motion, numerics={"tolerance": TOLERANCE})


def residuals(result: Trajectory) -> list[float]:
    assert (result.status, result.reason) == ("complete", "")
    return [state.residual for state in result.states[1:]]


def test_wanted_states_meet_the_full_tolerance_and_others_the_relaxed_one() -> None:
    """The last one, alone wanted, is the same to the bit."""
    every, last = (simulate(pressed(steps=4), MESH, frames=f, options=RELAXED) for f in (None, frozenset({4})))
    assert max(residuals(every)) <= TOLERANCE
    *others, wanted = residuals(last)
    assert wanted <= TOLERANCE < max(others) <= RELAXED.relaxed_tolerance
    assert last.states[1].max_penetration_mm > every.states[1].max_penetration_mm
    assert same(replace(last, states=last.states[4:]), replace(every, states=every.states[4:]))


class Losing:
    """Newton's method for passes and polishes, which ends `most` polishes after three to six iterations."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, most: int, polish: str = "before the passes") -> None:
        self.lost, self._most = 0, most
        penetration, self._tolerance = POLISHES[polish]
        monkeypatch.setattr(multipliers, "PENETRATION", penetration)
        monkeypatch.setattr(multipliers, "solve", self)

    def __call__(self, at: Evaluation, tolerance: float, *limits: Any) -> Asking[Solution]:
        if limits or tolerance != self._tolerance or self.lost == self._most:
            return (yield from solve(at, tolerance, *limits))
        self.lost += 1
        return (yield from solve(at, 0.0, 3))


def memory(press: DirectPress) -> list[np.ndarray]:
    """What the next step goes on from: the state, contact, and the place on the path."""
    places = np.array([press.steps.at, press.steps.next, len(press.states)])
    return [press.state.u.copy(), press.state.p.copy(), *press.system.saved_contact().values(), places]


def followed(press: DirectPress, losing: Losing, monkeypatch: pytest.MonkeyPatch) -> tuple[Trajectory, int]:
    """Where a press ends, and in how many steps; a step that loses its record must leave no trace."""
    policy, count = press.steps, [0]
    advance = policy._advance

    def step() -> Asking[None]:
        before, lost, length = memory(press), losing.lost, policy.target() - policy.at
        allowed = policy.step  # of the next step, unless this one, half as long again, is longer
        yield from advance()
        count[0] += 1
        if losing.lost > lost:
            assert all((a == b).all() for a, b in zip(memory(press), before, strict=True))
            assert policy.step == length / 2
        else:
            assert policy.step <= max(allowed, load_steps.GROWTH * length)

    monkeypatch.setattr(policy, "_advance", step)
    return press.run(), count[0]


@each
def test_a_lost_record_leaves_no_trace_and_is_tried_again(monkeypatch: pytest.MonkeyPatch, polish: str) -> None:
    losing = Losing(monkeypatch, most=1, polish=polish)
    result, _ = followed(direct_press(Press.of(pressed(), MESH), options=RELAXED), losing, monkeypatch)
    assert losing.lost == 1
    assert len(result.states) == 3
    assert max(residuals(result)) <= TOLERANCE


@each
def test_a_record_that_is_always_lost_ends_the_path(monkeypatch: pytest.MonkeyPatch, polish: str) -> None:
    """Each loss halves what is left of the path, so that SHORTEST_STEP is soon reached."""
    losing = Losing(monkeypatch, most=1000, polish=polish)
    posed = pressed(steps=1)
    result, steps = followed(direct_press(Press.of(posed, MESH), options=RELAXED), losing, monkeypatch)
    assert (result.status, "did not converge" in result.reason, len(result.states)) == ("failed", True, 1)
    # The last step is shorter than max_step_mm / 64; each loss is followed by one good step of half its length.
    halvings = 1 + np.log2(1 / load_steps.SHORTEST_STEP)
    assert losing.lost <= halvings
    assert steps <= 0.8 / posed.numerics.max_step_mm + 2 * halvings


def test_a_step_that_fails_late_ends_the_press(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(load_steps, "MAX_PRESS_ITERATIONS", 10)
    _, steps = followed(direct_press(Press.of(pressed(), MESH)), Losing(monkeypatch, most=0), monkeypatch)
    losing = Losing(monkeypatch, most=1)
    result, lost_steps = followed(direct_press(Press.of(pressed(), MESH)), losing, monkeypatch)
    assert (result.status, "did not converge" in result.reason, losing.lost) == ("failed", True, 1)
    assert lost_steps < steps


def test_relaxed_steps_end_where_tight_ones_do_and_save_iterations() -> None:
    """With the standard options; friction remembers the load path, and so its error."""
    posed = gentle(friction=0.4)
    given = (STANDARD, SolverOptions(relaxed_tolerance=0.0))
    relaxed, tight = (simulate(posed, brick(), options=options) for options in given)
    assert max(residuals(relaxed) + residuals(tight)) <= posed.numerics.tolerance
    assert sum(s.newton_iterations for s in relaxed.states) < sum(s.newton_iterations for s in tight.states)
    for one, other in zip(relaxed.states[1:], tight.states[1:], strict=True):
        # Forces wrong by some share of their norm move a linear body by that share of its displacement. A record
        # is solved anew, and remembers of it what the anchors do: a fortieth was seen, of 1e-2 a twentieth.
        most = STANDARD.relaxed_tolerance / 4
        assert np.linalg.norm(one.displacement - other.displacement) < most * np.linalg.norm(other.displacement)
        assert np.linalg.norm(np.subtract(one.force_n, other.force_n)) < most * np.linalg.norm(other.force_n)
    posed = scene(friction=0.0, motion={"depth_mm": 0.6, "steps": 1}, numerics={"max_step_mm": 0.1})
    exact = replace(STANDARD, reuse_factors=False)  # rough directions save time, not iterations
    counts = []
    for relaxed, extrapolate in product((exact.relaxed_tolerance, 0.0), (True, False)):
        options = replace(exact, relaxed_tolerance=relaxed, extrapolate=extrapolate)
        found = complete(posed, MESH, options=options)
        counts.append(sum(state.newton_iterations for state in found.states))
    standard, unpredicted, tight, plain = counts
    assert standard < min(tight, unpredicted)
    assert max(tight, unpredicted) < plain


@pytest.fixture(scope="module")
def body() -> System:
    return system(PAD, 0.49)


def press(body: System, tolerance: float = EXACT, **limits: Any) -> Found:
    body.forget_factor()
    return found_by_newton(body, body.zero(), indenters(scene(), PRESSED), tolerance, **limits)


def test_a_press_converges_and_a_start_in_equilibrium_costs_one_iteration(body: System) -> None:
    found = press(body)
    assert found.converged
    assert 2 <= found.iterations <= 12
    assert found.relative <= EXACT
    # A start that happens to be within the tolerance is improved once; no force costs nothing.
    assert found_by_newton(body, found.state, indenters(scene(), PRESSED), EXACT).iterations == 1
    away = indenters(scene(motion={"depth_mm": -1.0}), 0.0)
    assert found_by_newton(body, body.zero(), away, EXACT).iterations == 0


def test_the_limit_is_kept_far_from_equilibrium_doubled_near_it_and_too_far_is_none(body, monkeypatch) -> None:
    free = press(body)
    needed = free.iterations
    for limit in (1, needed):
        found = press(body, limit=limit)
        assert found.iterations == limit
        assert found.converged == (limit == needed)
        assert (found.relative > NEAR) == (limit == 1)
    found = press(body, limit=needed - 1)
    assert (found.iterations, found.converged) == (needed, True)
    never = press(body, 1e-30, limit=needed)
    assert not never.converged
    assert needed < never.iterations <= 2 * needed
    moved = float(np.linalg.norm(free.state.u, axis=1).max())
    for share in (0.5, 4.0):
        found = press(body, reach_mm=share * moved)
        assert found.converged == (share > 1)
        assert (found.iterations == free.iterations) == (share > 1)
    assert (found.state.u == free.state.u).all()
    monkeypatch.setattr(newton, "SHORTEST", 2.0)  # no step is short enough to be taken
    assert not press(body).converged


def test_double_factor_solves_to_double_precision() -> None:
    options = SolverOptions(single_precision=False, reuse_factors=False)
    made = direct_press(Press.of(scene(numerics={"element": "p2p1"}), PAD), options=options)
    body = made.system
    tangent = body.tangent(body.zero(), made.indenter)
    right = np.random.default_rng(0).standard_normal(len(body.free))
    step = body.newton_step(tangent, right)
    solution = np.concatenate([step.u.ravel(), step.p])[body.free]
    upper = body.matrix(tangent.values)
    left = upper @ solution + upper.T @ solution - upper.diagonal() * solution + right
    # A backward stable solve leaves some 1e-16 of |K| |x|, which at a Poisson ratio of 0.4999 is 1e4 times |r|.
    assert np.linalg.norm(left) < 1e-10 * np.linalg.norm(right)


def dragged(penalty: float = 50.0, depth_mm: float = 0.6, steps: int = 2) -> Scene:
    """A ball that is pressed and dragged with friction. With a penalty of 3,000 nothing is deep enough to correct."""
    motion = {"depth_mm": depth_mm, "shear_mm": [0.15, -0.05] if steps > 1 else [0.0, 0.0], "steps": steps}
    numerics = {"element": "p1p1", "tolerance": TOLERANCE, "penalty": penalty}
    return scene(indenter=SPHERE, friction=0.5, motion=motion, numerics=numerics)


def led(posed: Scene, mesh: PadMesh, options: SolverOptions, frames: frozenset[int] | None = None) -> Trajectory:
    return simulate_scenes([posed], mesh, options=options, frames=None if frames is None else [frames])[0]


@pytest.mark.parametrize("penalty", [50.0, 3000.0])
def test_what_is_recorded_meets_the_full_tolerance(penalty: float) -> None:
    """After whole passes, and where none is needed, so that only a loose step came before."""
    one, other = led(dragged(penalty), MESH, STRICT_WAY), led(dragged(penalty), MESH, LOOSE_WAY)
    assert one.status == other.status == "complete"
    assert sum(s.newton_iterations for s in other.states) < sum(s.newton_iterations for s in one.states)
    for strict, loose in zip(one.states[1:], other.states[1:], strict=True):
        assert max(strict.residual, loose.residual) <= TOLERANCE
        distance = np.linalg.norm(strict.displacement - loose.displacement)
        # Friction remembers the way: a residual of 1e-2 of the force moved the surface of six balls by up to 4e-4.
        assert distance < 1e-3 * np.linalg.norm(strict.displacement)


def test_the_path_does_not_depend_on_which_states_are_corrected() -> None:
    """The corrected one is the same to the bit; another has the relaxed tolerance."""
    every, last = led(dragged(), MESH, LOOSE_WAY), led(dragged(), MESH, LOOSE_WAY, frozenset({2}))
    assert last.states[2].residual <= TOLERANCE < last.states[1].residual <= LOOSE_WAY.relaxed_tolerance
    assert last.states[1].max_penetration_mm > every.states[1].max_penetration_mm
    assert same(replace(last, states=last.states[2:]), replace(every, states=every.states[2:]))


def test_a_state_without_balance_to_the_full_tolerance_leaves_no_trace(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is to be recorded never converges: back to where the step began."""
    posed = dragged(5000.0, depth_mm=0.2, steps=1)
    pressed = (0, (Press.of(posed, MESH), None))
    run = Run(deque([pressed]), iter([]), 1, prepare(posed, MESH, "cpu"), SolverOptions(relaxed_tolerance=0.3))
    arrays = run.solver._arrays
    fields, contact = arrays.fields, arrays.contact

    def lost(at: Evaluation, tolerance: float, *_: Any) -> Asking[Solution]:
        return (yield from solve(at, 0.0, 1))

    monkeypatch.setattr(multipliers, "solve", lost)
    begun: list[np.ndarray] = []
    rejected = []

    def memory() -> list[np.ndarray]:
        held = (fields.state, contact.anchored, contact.anchor, contact.normal, contact.tangent)
        return [array.numpy().copy() for array in held]

    evaluate = run.solver._solve_and_evaluate

    def look_and_evaluate() -> None:
        order = arrays.orders.numpy()[0]
        if order & Order.BEGIN:
            if order & Order.RESTORE_STEP and not order & Order.ACCEPT:
                rejected.append(all((a == b).all() for a, b in zip(memory(), begun, strict=True)))
            begun[:] = memory()
        evaluate()

    monkeypatch.setattr(run.solver, "_solve_and_evaluate", look_and_evaluate)
    found = list(run.turn())
    while any(run.lanes):
        found += run.turn()
    ((_, result),) = found
    assert rejected
    assert all(rejected)
    assert (result.status, "did not converge" in result.reason, len(result.states)) == ("failed", True, 1)


def sliding(body: dict[str, Any]) -> Scene:
    motion = {"depth_mm": 0.6, "shear_mm": [0.5, 0.6], "twist_deg": 10.0, "steps": 3, "position_mm": [0.4, 0.3]}
    return scene(indenter=body, friction=0.6, motion=motion, numerics={"element": "p2p1"})


@pytest.mark.parametrize("is_batched", [False, True], ids=["single", "batched"])
def test_a_pass_that_goes_too_far_is_given_up(monkeypatch: pytest.MonkeyPatch, is_batched: bool) -> None:
    """As soon as it does; what is taken has stayed within reach, and the other passes take penetration away."""
    given = []

    def watched(at: Evaluation, tolerance: float, *limits: Any) -> Asking[Solution]:
        found = yield from solve(at, tolerance, *limits)
        if limits:  # of iterations, and a reach
            given.append((found.converged, found.iterations, found.at.moved_mm / limits[1]))
        return found

    monkeypatch.setattr(multipliers, "solve", watched)
    rod = {"shape": "cylinder", "radius_mm": 1.5, "length_mm": 4.0, "fillet_mm": 0.3}
    posed, mesh = sliding(rod), brick(counts=(5, 5, 2))
    result = (led if is_batched else simulate)(posed, mesh, options=STRICT_WAY)
    assert result.status == "complete"
    passes = [one for one in given if np.isfinite(one[2]) and one[2]]
    assert all(share <= 1 for converged, _, share in passes if converged)
    assert any(iterations < STRICT_WAY.correction_iterations and share > 1 for _, iterations, share in passes)
