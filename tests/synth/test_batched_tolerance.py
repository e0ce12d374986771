"""Many trajectories at once: what is recorded meets the full tolerance, however loosely the way to it is solved."""

from dataclasses import replace

import numpy as np
import pytest
from batches import presses_of, simulate_scenes
from pads import SPHERE, brick, same, scene

from synth.scene import Scene
from synth.simulate import Trajectory
from synth.simulate.batched import lanes as phases
from synth.simulate.batched import run as running
from synth.simulate.batched.pad import prepare
from synth.simulate.options import SolverOptions

MESH = brick(counts=(4, 4, 2))
TOLERANCE = 1e-8
LOOSE = 1e-2
STRICT_WAY, LOOSE_WAY = (
    SolverOptions(relaxed_tolerance=0.0, forcing=1e-3),
    SolverOptions(relaxed_tolerance=LOOSE, forcing=1e-3),
)


def pressed(penalty: float = 50.0, depth_mm: float = 0.6, steps: int = 2) -> Scene:
    """A ball that is pressed and dragged with friction. With a penalty of 3,000 nothing is deep enough to correct."""
    motion = {"depth_mm": depth_mm, "shear_mm": [0.0, 0.0], "steps": steps}
    if steps > 1:
        motion["shear_mm"] = [0.15, -0.05]
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
    pad = prepare(posed, MESH, "cpu")
    run = running.Run(presses_of([posed], MESH), pad, None, 1, SolverOptions(relaxed_tolerance=0.3))
    solver = run.solver
    fields, contact = solver._arrays.fields, solver._arrays.contact
    phase, stage = solver.lanes.phase, solver.lanes.stage
    begun: list[np.ndarray] = []
    rejected: list[np.ndarray] = []
    changed: list[bool] = []

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
