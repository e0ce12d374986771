r"""A flat punch given as a triangle mesh, on a bonded layer, against the integral equation of `bonded_layer`.

The punch's edge has a fillet: it is flat up to r = c and falls away by (r - c)²/2ρ beyond, so that contact ends at a
radius a > c at which the pressure vanishes. That profile's right side of the integral equation is

.. math::  \frac{E}{π (1 - ν²)} \left[ δ - \frac{x}{ρ} \left( \sqrt{x² - c²} - c \arccos(c/x) \right)_{x > c} \right].
"""

from pathlib import Path

import numpy as np
import pytest
import pyvista as pv
from bonded_layer import body, disc_under_punch, lowered, press, respond
from scipy.optimize import brentq

from synth.arrays import FloatArray
from synth.simulate.element import p2p1

RADIUS, FILLET, CELL = 2.0, 0.12, 0.04
NU, DEPTH = 0.5, 0.005
"""Depth over thickness; the layer is linear there."""
POINTS = 400


def punch_on_a_layer(flat: float, fillet: float, depth: float, thickness: float) -> float:
    """Force over E of the punch; the contact radius is where the pressure's edge term vanishes."""

    def right(x: FloatArray) -> FloatArray:
        beyond = np.maximum(x, flat)
        lost = beyond / fillet * (np.sqrt(beyond**2 - flat**2) - flat * np.arccos(flat / beyond))
        return np.asarray((depth - lost)[:, None])

    contact = brentq(lambda a: respond(a, thickness, NU, right, POINTS)[1][0], flat, flat + fillet)
    return float(respond(contact, thickness, NU, right, POINTS)[0][0])


@pytest.mark.parametrize("ratio", [0.6, 1.0, 2.0])
def test_a_punch_as_a_mesh_presses_a_layer_as_the_theory_says(tmp_path: Path, ratio: float) -> None:
    """Flat radius over thickness of 0.6, 1 and 2; κ = 2.2, 3.6 and 9.1 of a sharp punch."""
    flat = RADIUS - FILLET
    thickness, file = flat / ratio, tmp_path / "punch.stl"
    pv.Cylinder(radius=RADIUS, height=1.0, direction=(0, 0, 1), resolution=128).triangulate().save(file)
    shape: dict[str, object] = {"shape": "mesh", "file": str(file), "fillet_mm": FILLET, "cell_mm": CELL}
    quarter, depth = body(disc_under_punch(RADIUS, thickness, 4, 1.8), p2p1(), NU), DEPTH * thickness
    found = press(quarter, lowered(shape, depth, thickness), (0.5, 10.0))
    # As for the analytic punch (`test_verify_solver_bonded_layer`): the smallest element costs up to 2.5 %.
    assert found == pytest.approx(punch_on_a_layer(flat, FILLET, depth, thickness), rel=0.03)
