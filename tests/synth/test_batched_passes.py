"""Passes at recorded states that wander off: the solver for one sample and the batched one give them up alike."""

from typing import Any

import numpy as np
import pytest
from batches import presses_of
from pads import brick, scene

from synth.scene import Scene
from synth.simulate import simulate, stepping
from synth.simulate.batched import lanes as phases
from synth.simulate.batched.pad import prepare
from synth.simulate.batched.run import Run
from synth.simulate.options import SolverOptions

STRICT = SolverOptions(relaxed_tolerance=0.0, forcing=1e-3)
BOX = {"shape": "box", "size_mm": [3.0, 2.5, 4.0], "fillet_mm": 0.6, "rotation_deg": [0, 0, 20]}
ROD = {"shape": "cylinder", "radius_mm": 1.5, "length_mm": 4.0, "fillet_mm": 0.3}


def sliding(body: dict[str, Any]) -> Scene:
    """On its end. A pass at the last state wanders."""
    motion = {"depth_mm": 0.6, "shear_mm": [0.5, 0.6], "twist_deg": 10.0, "steps": 3, "position_mm": [0.4, 0.3]}
    return scene(indenter=body, friction=0.6, motion=motion, numerics={"element": "p2p1"})


def test_a_pass_that_goes_too_far_is_given_up() -> None:
    """As soon as it does; what is taken has stayed within reach, and the other passes take penetration away."""
    posed = sliding(BOX)
    mesh = brick(counts=(4, 4, 2))
    run = Run(presses_of([posed], mesh), prepare(posed, mesh, "cpu"), None, 1, STRICT)
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
    assert any(iteration < STRICT.correction_iterations and share > 1 for iteration, share in lost)
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
    result = simulate(sliding(ROD), brick(counts=(5, 5, 2)), options=STRICT)
    assert result.status == "complete"
    passes = [(converged, iterations, share) for converged, iterations, share in given if np.isfinite(share) and share]
    assert all(share <= 1 for converged, _, share in passes if converged)
    assert any(iterations < STRICT.correction_iterations and share > 1 for _, iterations, share in passes)
