"""A nearly incompressible press against an independent, more accurate solution: the element does not lock."""

import numpy as np
import pytest
from pads import brick, scene

from synth.mesh import PadMesh
from synth.simulate import simulate

SIZE = (20.0, 15.0, 4.0)
REFERENCE = {1.2: 1.893, 2.0: 4.807}
"""Newton at a depth in mm: a ball of R = 4 mm, without friction, E = 0.2 MPa, nu = 0.4999.

From another program of ours, with Taylor-Hood P2/P1 elements (26933 unknowns: Kuhn mesh graded to five elements over
the 3.3 mm around the contact, three layers graded to the face) and a plain penalty. Penalties of 80 and 320 MPa/mm
gave 1.888 and 1.893 N, 4.788 and 4.807 N; a mesh coarser by a fifth changes these by less than 0.5 %.
"""


def graded(counts: tuple[int, int, int]) -> PadMesh:
    """Elements narrower by half near the middle (20 x 16 x 5: 0.75 and 1.5 mm), layers thinner toward the contact."""
    even = brick(SIZE, counts)
    half = np.array([SIZE[0] / 2, SIZE[1] / 2, SIZE[2]])
    share = even.points / half
    # Linear plus a higher power: monotone, ends kept, slopes of 0.55 in the middle and 0.6 at the face.
    across, depth = share[:, :2], share[:, 2]
    points = half * np.column_stack([0.55 * across + 0.45 * across**3, 0.6 * depth + 0.4 * depth**2])
    points[depth == 1, 2] = SIZE[2]
    return PadMesh(points, even.tets, SIZE)


# Linear elements of this size are 4 % too stiff, for want of resolution at the contact's edge; quadratic ones twice as
# wide were within 0.7 %.
@pytest.mark.parametrize(
    ("element", "counts", "close"), [("p1p1", (20, 16, 5), 0.15), ("p2p1", (10, 8, 3), 0.03)], ids=["p1p1", "p2p1"]
)
def test_press_at_nu_04999_does_not_lock(element: str, counts: tuple[int, int, int], close: float) -> None:
    ball, motion = {"shape": "sphere", "radius_mm": 4.0}, {"depth_mm": 2.0, "steps": 5}
    gel, numerics = {"youngs_modulus_kpa": 200.0, "poisson_ratio": 0.4999}, {"element": element}
    result = simulate(scene(SIZE, gel=gel, indenter=ball, motion=motion, numerics=numerics), graded(counts))
    assert result.status == "complete"
    forces = {round(state.depth_mm, 9): state.force_n for state in result.states}
    for depth, force in REFERENCE.items():
        assert forces[depth][2] == pytest.approx(force, rel=close)
        assert np.hypot(*forces[depth][:2]) < 1e-5 * forces[depth][2]
