"""Equilibrium by relaxation: the same as Newton's method's where that finds one, and one where it finds none."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pads import scene

from synth.mesh import Counts, Focus, graded_box
from synth.simulate import simulate, stepping
from synth.simulate.newton import Solution, solve
from synth.simulate.relaxation import AIM, LEAST_VISCOSITY, MAX_ERROR, MOST_VISCOSITY, next_viscosity

SIZE = (12.0, 10.0, 3.0)
MESH = graded_box(SIZE, Focus((0.0, 0.0), (2.0, 2.0)), Counts((4, 4), (2, 2), 2))
OBJECTS = Path(__file__).parents[2] / "scenes" / "objects"


def pressed(indenter: dict[str, Any], friction: float) -> Any:
    moves = {"depth_mm": 0.9, "position_mm": [0.1, 0.2], "shear_mm": [0.6, 0.3], "twist_deg": 5.0, "steps": 2}
    drawn = scene(SIZE, indenter=indenter, friction=friction, motion=moves, numerics={"element": "auto"})
    return simulate(drawn, MESH, OBJECTS)


def test_relaxation_finds_the_equilibrium_of_newtons_method(monkeypatch: pytest.MonkeyPatch) -> None:
    ball = {"shape": "sphere", "radius_mm": 3.0}
    expected = pressed(ball, 0.5)

    def unlucky(*arguments: Any) -> Solution:
        """Newton's method that does not converge in load steps, where it is called without a limit."""
        found = solve(*arguments)
        return replace(found, converged=False) if len(arguments) == 4 else found

    monkeypatch.setattr(stepping, "MAX_RELAXED_STEP", 1.0)
    monkeypatch.setattr(stepping, "solve", unlucky)
    relaxed = pressed(ball, 0.5)
    assert relaxed.status == "complete"
    for one, other in zip(expected.states[1:], relaxed.states[1:], strict=True):
        assert one.newton_iterations != other.newton_iterations
        scale = np.abs(one.displacement).max()
        np.testing.assert_allclose(other.displacement, one.displacement, atol=2e-3 * scale)


def test_relaxation_goes_on_where_newtons_method_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """A key that lies askew, whose corners slip over the contact points."""
    key = {"shape": "mesh", "file": "key.stl", "size_mm": 8.0, "rotation_deg": [66.81, 34.57, 121.22]}
    trajectory = pressed(key, 0.3)
    assert trajectory.status == "complete"
    assert all(state.residual < 1e-5 and state.min_jacobian > 0 for state in trajectory.states)
    monkeypatch.setattr(stepping, "MAX_RELAXED_STEP", 0.0)
    assert pressed(key, 0.3).status == "partial"


def test_viscosity_follows_the_error() -> None:
    errors = (AIM, AIM / 2, 0.0, 2 * MAX_ERROR, np.inf)
    same, less, least, more, most = (next_viscosity(1.0, error) for error in errors)
    assert same == pytest.approx(1.0)
    assert least < less < same < more <= most
    assert next_viscosity(LEAST_VISCOSITY, 0.0) == 0.0
    assert next_viscosity(MOST_VISCOSITY, np.inf) == MOST_VISCOSITY
