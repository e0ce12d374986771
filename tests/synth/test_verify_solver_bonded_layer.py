"""Small indentation of a bonded layer against the integral equation, and of a thick pad against Hertz.

Elements, contact and multipliers together, at depths at which the layer is linear. `bonded_layer`, which solves the
integral equation, is itself held against published values.
"""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
import pyvista as pv
from bonded_layer import (
    ball,
    ball_ratio,
    body,
    compliance,
    disc,
    flat_and_sphere,
    growing,
    kappa,
    lowered,
    press,
    punch_disc,
    respond,
    waves,
)
from pads import scene
from scipy.optimize import brentq

from synth.arrays import FloatArray
from synth.mesh.element import p1p1, p2p1
from synth.press.press import MeshRule
from synth.simulate import simulate

LINEAR = 0.005
"""Depth over thickness; finite strain changes the force by some 0.2 % there (see the vanishing depth below)."""
PUNCH = {0.2: 1.281, 0.4: 1.684, 0.6: 2.213, 0.8: 2.860, 1.0: 3.619, 1.5: 6.003, 2.0: 9.149}
"""κ(a/h) of an incompressible layer: Lebedev & Ufliand (1958), Hayes et al. (1972)."""
RADIUS, FILLET, CELL = 2.0, 0.12, 0.04
NU, DEPTH = 0.5, 0.005  # Depth over thickness; the layer is linear there
POINTS = 400


@pytest.mark.parametrize(
    ("radius", "nu"), [(20.0, 0.5), (80.0, 0.5), (320.0, 0.5), (80.0, 0.4999), (80.0, 0.3), (80.0, 0.2), (80.0, 0.0)]
)
def test_ball_on_a_layer(radius: float, nu: float) -> None:
    """Contact radii of 0.4, 0.8 and 1.9 thicknesses, where an incompressible layer is 1.4 to 10 times a half space."""
    # Four elements across the contact leave 0.1 to 1 %; foams (nu < 0.3), without a pressure field, half as much again.
    assert ball_ratio(p2p1(), nu, radius, LINEAR, 4) == pytest.approx(1.0, abs=0.012 if nu >= 0.3 else 0.015)


@pytest.mark.slow
@pytest.mark.parametrize(("radius", "depth", "thickness"), [(3.0, 0.1, 3.0), (6.0, 0.05, 2.5)])
def test_a_target_of_force_holds_for_a_shallow_touch(radius: float, depth: float, thickness: float) -> None:
    """By the mesh rule of a scene, where the default leaves 3 to 6 % of the force."""
    numerics = {"element": "auto", "edge_length_mm": None, "target_error_percent": 1.0}
    touch = scene((20.0, 20.0, thickness), indenter={"shape": "sphere", "radius_mm": radius}, friction=0.0,
                  motion={"depth_mm": depth, "steps": 1}, numerics=numerics)  # fmt: skip
    force = simulate(touch, MeshRule.of(touch).resolution(touch).mesh).states[-1].force_n[2]
    _, exact = ball(depth, radius, thickness, touch.sensor.gel.poisson_ratio, partial(flat_and_sphere, radius=radius))
    # 1 % is asked of the finite elements. The rest is finite strain: 0.5 % at contacts of a fifth of the radius.
    assert force / exact == pytest.approx(touch.sensor.gel.youngs_modulus_kpa / 1000, rel=0.015)


@pytest.mark.parametrize("nu", [0.2, 0.5])
def test_linear_elements_approach_the_layer_from_above(nu: float) -> None:
    """Twice as many elements halve P1/P1's error at least: 5 % with 4 across the contact, 2.5 % with 8."""
    coarse, fine = (ball_ratio(p1p1(), nu, 80.0, LINEAR, cells) - 1 for cells in (4, 8))
    assert 0 < fine < 0.6 * coarse
    assert fine < 0.035


def test_ball_approaches_linear_theory_as_the_depth_vanishes() -> None:
    """What finite strain and the ball's roundness take from the force vanishes with the depth, and faster than √δ."""
    shallow, middle, deep = (ball_ratio(p2p1(), 0.5, 20.0, depth, 4) for depth in (LINEAR, 0.02, 0.08))
    # The discretisation error is the same share of all three, whose meshes follow the contact radius. With a law δ^q
    # the first difference over the second is (4^q - 1) / (16^q - 1): 1/3 for q = 1/2, 1/2 for q -> 0.
    assert 0 < shallow - middle < 0.45 * (shallow - deep)
    assert 0.005 < shallow - deep < 0.03


@pytest.mark.parametrize(("element", "nu", "ratio", "cells", "tolerance"), [
    (p2p1, 0.5, 0.4, 4, 0.03),
    (p2p1, 0.5, 1.0, 4, 0.03),
    (p2p1, 0.5, 2.0, 4, 0.03),
    (p2p1, 0.3, 1.0, 4, 0.03),
    (p1p1, 0.5, 1.0, 8, 0.08),
])  # fmt: skip
def test_flat_punch_on_a_layer(element, nu, ratio, cells, tolerance) -> None:
    """A cylinder whose fillet is a four hundredth of its radius; κ = 1.7, 3.6 and 9.1 where incompressible."""
    radius, thickness = 4.0, 4.0 / ratio
    quarter = body(punch_disc(radius, thickness, cells, 1.8 if element is p2p1 else 1.5), element(), nu)
    shape: dict[str, object] = {"shape": "cylinder", "radius_mm": radius + 0.005, "fillet_mm": 0.01, "length_mm": 4.0}
    depth = LINEAR * thickness
    force = press(quarter, lowered(shape, depth, thickness), (5.0, 100.0))
    half_space = 2 * radius * depth / (1 - nu**2)
    # The pressure's singularity at the edge costs a share of the energy that is proportional to the smallest element:
    # 0.08 a of P2/P1 (0 to 2.5 %), 0.04 a of P1/P1, which has half the order.
    assert force / half_space == pytest.approx(kappa(radius, thickness, nu), rel=tolerance)


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.5])
def test_hertz_for_a_thick_pad(nu: float) -> None:
    """A pad 25 contact radii thick and wide: Hertz, and the 3 to 5 % that the window adds, 1 + 2/π ∫ (1 - L) a/h."""
    contact, radius, thickness = 0.1, 10.0, 2.5
    depth, reach = contact**2 / radius, 1.2 * contact
    radii = np.concatenate([np.linspace(0, reach, 5), growing(reach, thickness, 5, 1.9)])
    depths = np.concatenate([[0.0], growing(0.0, thickness, 6, 2.0)])
    quarter = body(disc(radii, depths), p2p1(), nu)
    force = press(quarter, lowered({"shape": "sphere", "radius_mm": radius}, depth, thickness), (50.0, 1000.0))
    hertz = 4 / 3 / (1 - nu**2) * np.sqrt(radius) * depth**1.5
    x, dx = waves()
    window = 1 + 2 / np.pi * dx @ (1 - compliance(x, nu)) * contact / thickness
    # As for the layer: 4 elements across the contact, first plane at 0.4 a: up to 1.5 %.
    assert force / hertz == pytest.approx(window, rel=0.02)


@pytest.mark.parametrize("ratio", PUNCH)
def test_flat_punch_is_as_tabulated(ratio: float) -> None:
    assert kappa(3.0 * ratio, 3.0) == pytest.approx(PUNCH[ratio], abs=5e-4)  # the table's last digit


def punch_on_a_layer(flat: float, fillet: float, depth: float, thickness: float) -> float:
    r"""Force over E of a punch that is flat up to r = c and falls away by (r - c)²/2ρ beyond.

    Contact ends at a radius a > c at which the pressure vanishes. The right side of the integral equation is

    .. math:: \frac{E}{π (1 - ν²)} \left[ δ - \frac{x}{ρ} \left(\sqrt{x² - c²} - c \arccos(c/x) \right)_{x > c}\right]
    """

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
    quarter, depth = body(punch_disc(RADIUS, thickness, 4, 1.8), p2p1(), NU), DEPTH * thickness
    found = press(quarter, lowered(shape, depth, thickness), (0.5, 10.0))
    # As for the analytic punch: the smallest element costs up to 2.5 %.
    assert found == pytest.approx(punch_on_a_layer(flat, FILLET, depth, thickness), rel=0.03)
