"""Trajectories at once: what is recorded meets the full tolerance; passes that wander off are given up, as by one."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pads import SPHERE, brick, presses_of, same, scene, simulate_scenes

from synth.scene import Scene
from synth.simulate import Trajectory, simulate, stepping
from synth.simulate.batched import lanes as phases
from synth.simulate.batched import run as running
from synth.simulate.batched.pad import prepare
from synth.simulate.batched.run import Run
from synth.simulate.options import SolverOptions

MESH = brick(counts=(4, 4, 2))
TOLERANCE = 1e-8
STRICT_WAY, LOOSE_WAY = (SolverOptions(relaxed_tolerance=loose, forcing=1e-3) for loose in (0.0, 1e-2))


def pressed(penalty: float = 50.0, depth_mm: float = 0.6, steps: int = 2) -> Scene:
    """A ball that is pressed and dragged with friction. With a penalty of 3,000 nothing is deep enough to correct."""
    motion = {"depth_mm": depth_mm, "shear_mm": [0.15, -0.05] if steps > 1 else [0.0, 0.0], "steps": steps}
    numerics = {"element": "p1p1", "tolerance": TOLERANCE, "penalty": penalty}
    return scene(indenter=SPHERE, friction=0.5, motion=motion, numerics=numerics)


def led(posed: Scene, driver: SolverOptions, frames: frozenset[int] | None = None) -> Trajectory:
    """The only one of its batch."""
    return simulate_scenes([posed], MESH, options=driver, frames=None if frames is None else [frames])[0]


@pytest.mark.parametrize("penalty", [50.0, 3000.0])
def test_what_is_recorded_meets_the_full_tolerance(penalty: float) -> None:
    """After whole passes, and where none is needed, so that only a loose step came before."""
    one, other = led(pressed(penalty), STRICT_WAY), led(pressed(penalty), LOOSE_WAY)
    assert one.status == other.status == "complete"
    assert sum(s.newton_iterations for s in other.states) < sum(s.newton_iterations for s in one.states)
    for strict, loose in zip(one.states[1:], other.states[1:], strict=True):
        assert max(strict.residual, loose.residual) <= TOLERANCE
        distance = np.linalg.norm(strict.displacement - loose.displacement)
        # Friction remembers the way: a residual of 1e-2 of the force moved the surface of six balls by up to 4e-4.
        assert distance < 1e-3 * np.linalg.norm(strict.displacement)


def test_states_that_are_not_corrected_meet_it_too() -> None:
    """And the way does not depend on which are: the corrected one is the same to the bit."""
    every, last = led(pressed(), LOOSE_WAY), led(pressed(), LOOSE_WAY, frozenset({2}))
    assert max(state.residual for state in last.states) <= TOLERANCE
    assert last.states[1].max_penetration_mm > every.states[1].max_penetration_mm
    assert same(replace(last, states=last.states[2:]), replace(every, states=every.states[2:]))


def test_a_state_without_balance_to_the_full_tolerance_leaves_no_trace(monkeypatch: pytest.MonkeyPatch) -> None:
    """One iteration suffices for the way, but not even two for what is to be recorded: back to where the step began."""
    monkeypatch.setattr(running, "MAX_ITERATIONS", 1)
    posed = pressed(5000.0, depth_mm=0.2, steps=1)
    run = Run(presses_of([posed], MESH), prepare(posed, MESH, "cpu"), None, 1, SolverOptions(relaxed_tolerance=0.3))
    solver = run.solver
    fields, contact = solver._arrays.fields, solver._arrays.contact
    phase, stage = solver.lanes.phase, solver.lanes.stage
    begun, rejected, changed = [], [], []

    def memory() -> list[np.ndarray]:
        arrays = (fields.state_u, fields.state_p, contact.anchored, contact.anchor, contact.normal, contact.tangent)
        return [array.numpy().copy() for array in arrays]

    def look(part: str, kernel: str) -> None:
        if kernel == "choose_target" and (phase.numpy()[0], stage.numpy()[0]) == (phases.START, phases.STEP):
            begun[:] = memory()
        elif kernel == "finish_solve" and phase.numpy()[0] == phases.ROLLED_BACK:
            rejected[:] = memory()
        elif kernel == "finish_record" and rejected:
            changed.append(any((a != b).any() for a, b in zip(rejected, begun, strict=True)))
            assert all((a == b).all() for a, b in zip(memory(), begun, strict=True))
            rejected.clear()

    solver.watch = look
    ((_, result),) = run
    assert changed
    assert all(changed)
    assert (result.status, "did not converge" in result.reason, len(result.states)) == ("failed", True, 1)


def sliding(body: dict[str, Any]) -> Scene:
    """On its end. A pass at the last state wanders."""
    motion = {"depth_mm": 0.6, "shear_mm": [0.5, 0.6], "twist_deg": 10.0, "steps": 3, "position_mm": [0.4, 0.3]}
    return scene(indenter=body, friction=0.6, motion=motion, numerics={"element": "p2p1"})


def test_a_pass_that_goes_too_far_is_given_up() -> None:
    """As soon as it does; what is taken has stayed within reach, and the other passes take penetration away."""
    posed = sliding({"shape": "box", "size_mm": [3.0, 2.5, 4.0], "fillet_mm": 0.6, "rotation_deg": [0, 0, 20]})
    run = Run(presses_of([posed], MESH), prepare(posed, MESH, "cpu"), None, 1, STRICT_WAY)
    solver = run.solver
    lanes, fields = solver.lanes, solver._arrays.fields
    lost, solved, depths = [], 0, {}

    def look(part: str, kernel: str) -> None:
        nonlocal solved
        if kernel != "evaluate_trial" or lanes.stage.numpy()[0] != phases.CORRECTION:
            return
        phase, reach = lanes.phase.numpy()[0], lanes.most_moved.numpy()[0]
        moved = np.linalg.norm(fields.trial_u.numpy()[0] - fields.recorded_u.numpy()[0], axis=1).max()
        if phase in (phases.READY, phases.SOLVED, phases.FAILED):
            assert lanes.trial_moved.numpy()[0] == pytest.approx(moved, abs=1e-15)
        if phase in (phases.READY, phases.SOLVED):
            assert moved <= reach
            assert reach == pytest.approx(stepping.MAX_CORRECTION_RATIO * lanes.deepest.numpy()[0], rel=1e-12)
            depths.setdefault(lanes.target.numpy()[0], lanes.deepest.numpy()[0])
        if phase == phases.SOLVED:
            solved += 1
            assert lanes.relative.numpy()[0] <= 0.1 * posed.numerics.tolerance
        if phase == phases.FAILED:
            lost.append((lanes.iteration.numpy()[0], moved / reach))

    solver.watch = look
    ((_, result),) = run
    assert result.status == "complete"
    assert any(iteration < STRICT_WAY.correction_iterations and share > 1 for iteration, share in lost)
    assert solved >= len(depths) == 3
    for state, before in zip(result.states[1:], depths.values(), strict=True):
        assert state.max_penetration_mm < 0.5 * before


def test_so_does_the_solver_for_one_sample(monkeypatch: pytest.MonkeyPatch) -> None:
    solve, given = stepping.solve, []

    def watched(system: Any, start: Any, *others: Any) -> Any:
        found = solve(system, start, *others)
        if len(others) == 4:  # with a limit of iterations and a reach
            moved = np.linalg.norm(found.state.u - start.u, axis=1).max()
            given.append((found.converged, found.iterations, float(moved / others[3])))
        return found

    monkeypatch.setattr(stepping, "solve", watched)
    rod = {"shape": "cylinder", "radius_mm": 1.5, "length_mm": 4.0, "fillet_mm": 0.3}
    result = simulate(sliding(rod), brick(counts=(5, 5, 2)), options=STRICT_WAY)
    assert result.status == "complete"
    passes = [one for one in given if np.isfinite(one[2]) and one[2]]
    assert all(share <= 1 for converged, _, share in passes if converged)
    assert any(iterations < STRICT_WAY.correction_iterations and share > 1 for _, iterations, share in passes)
