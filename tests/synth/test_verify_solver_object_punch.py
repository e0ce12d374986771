r"""A flat punch given as a triangle mesh, on a bonded layer, against the integral equation of `bonded_layer`.

The punch's edge has a fillet: it is flat up to r = c and falls away by (r - c)²/2ρ beyond, so that contact ends at a
radius a > c at which the pressure vanishes. That profile's right side of the integral equation is

.. math::  \frac{E}{π (1 - ν²)} \left[ δ - \frac{x}{ρ} \left( \sqrt{x² - c²} - c \arccos(c/x) \right)_{x > c} \right].
"""

from pathlib import Path

import numpy as np
import pytest
import pyvista as pv
from bonded_layer import body, compliance, gauss, growing, lowered, press, quarter_disc, wave_numbers
from scipy.optimize import brentq

from synth.simulate.element import p2p1

RADIUS, FILLET, CELL = 2.0, 0.12, 0.04
SIDES = 128
NU, DEPTH = 0.5, 0.005
"""Depth over thickness; the layer is linear there."""
POINTS = 400


def punch_on_a_layer(flat: float, fillet: float, depth: float, thickness: float) -> float:
    """Force over E of the punch, by Nyström's method; the contact radius is where the pressure's edge term vanishes."""
    nodes, weights = gauss(POINTS)
    wave, d_wave = wave_numbers()
    defect = 2 / (np.pi * thickness) * d_wave * (1 - compliance(wave, NU))

    def solved(contact: float) -> tuple[float, float]:
        t, dt = contact / 2 * (nodes + 1), contact / 2 * weights
        x = np.append(t, contact)
        cosines = np.cos(np.outer(x, wave / thickness))
        kernel = np.einsum("ik,k,jk->ij", cosines, defect, cosines[:-1], optimize=True) * dt
        beyond = np.maximum(x, flat)
        lost = beyond / fillet * (np.sqrt(beyond**2 - flat**2) - flat * np.arccos(flat / beyond))
        right = (depth - lost) / (np.pi * (1 - NU**2))
        phi = np.linalg.solve(np.eye(POINTS) - kernel[:-1], right[:-1])
        return 2 * np.pi * float(dt @ phi), float(right[-1] + kernel[-1] @ phi)

    contact = brentq(lambda a: solved(a)[1], flat, flat + fillet)
    return solved(float(contact))[0]


@pytest.mark.parametrize("ratio", [0.6, 1.0, 2.0])
def test_a_punch_as_a_mesh_presses_a_layer_as_the_theory_says(tmp_path: Path, ratio: float) -> None:
    """Flat radius over thickness of 0.6, 1 and 2; κ = 2.2, 3.6 and 9.1 of a sharp punch."""
    flat = RADIUS - FILLET
    thickness, cells = flat / ratio, 4
    file = tmp_path / "punch.stl"
    pv.Cylinder(radius=RADIUS, height=1.0, direction=(0, 0, 1), resolution=SIDES).triangulate().save(file)
    shape: dict[str, object] = {"shape": "mesh", "file": str(file), "fillet_mm": FILLET, "cell_mm": CELL}
    towards_edge = RADIUS - growing(0.0, RADIUS, cells, 1.8)[::-1]
    radii = np.concatenate([[0.0], towards_edge[1:], [RADIUS], growing(RADIUS, 2.5 * thickness, cells + 1, 1.8)])
    depths = np.concatenate([[0.0], growing(0.0, thickness, cells, 1.4)])
    depth = DEPTH * thickness
    found = press(body(quarter_disc(radii, depths), p2p1(), NU), lowered(shape, depth, thickness), (0.5, 10.0))
    # As for the analytic punch (`test_verify_solver_bonded_layer`): the smallest element costs up to 2.5 %.
    assert found == pytest.approx(punch_on_a_layer(flat, FILLET, depth, thickness), rel=0.03)
