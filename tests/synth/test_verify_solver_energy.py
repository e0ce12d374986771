"""The indenter's work is the gel's energy and what friction takes, whatever the element, the layers and the path.

Without friction the solver's steps are equilibria of an energy, so that only the trapezoidal rule of the account stands
between the two sides: an error that falls with the square of the step. Friction's return map ends each step on the
cone; the account's mean of the tractions at both ends makes it second order, too, except at points that begin to slip.
"""

import numpy as np
import pytest
from energy_ledger import Account, accounted
from layered_pad import FILM, pad
from pads import ELEMENT, MIXED, SIZE, contact_faces, scene

from synth.mesh import PadMesh

PRESS = {"depth_mm": 0.8}
DRAG = {"depth_mm": 0.8, "shear_mm": [1.2, 0.3]}
TWIST = {"depth_mm": 0.8, "shear_mm": [0.3, 0.2], "twist_deg": 40.0}


def landing(mesh: PadMesh, element: str) -> tuple[float, float]:
    """The contact point nearest to the pad's middle: there the ball touches from the start of its way."""
    shape = ELEMENT[element]().face_barycentric
    surface = contact_faces(mesh)
    points = np.einsum("qa,fac->fqc", shape, surface.nodes[surface.faces]).reshape(-1, 3)
    x, y, _ = points[np.argmin(np.linalg.norm(points, axis=1))]
    return float(x), float(y)


def account(
    element: str, steps: int, motion: dict, friction: float = 0.0, layers: bool = False, nu: float = 0.4999
) -> Account:
    mesh = pad(layers)
    case = scene(
        SIZE,
        gel={"poisson_ratio": nu, "layers": [FILM] if layers else []},
        friction=friction,
        motion={**motion, "steps": steps, "position_mm": landing(mesh, element)},
        numerics={"element": element, "tolerance": 1e-8, "max_step_mm": 1.0, "edge_length_mm": None},
    )
    return accounted(case, mesh)


@pytest.mark.parametrize(("layers", "nu"), [(False, 0.2), (False, 0.4999), (False, 0.5), (True, 0.4999), (True, 0.5)])
@pytest.mark.parametrize("element", MIXED)
def test_work_of_a_press_is_stored(element: str, layers: bool, nu: float) -> None:
    entry = account(element, 20, PRESS, layers=layers, nu=nu)
    # F grows as δ^q, q = 1.5 to 2 or more on a thin layer: the trapezoidal rule takes q (q + 1) / 12 n² too much work.
    assert entry.lost == 0
    assert 0 < entry.missing < 3 * 4 / (12 * 20**2)


@pytest.mark.parametrize("element", MIXED)
def test_work_of_a_drag_without_friction_is_stored(element: str) -> None:
    """Across the elements' edges and back: the contact's points come and go, and no energy with them."""
    back = {**DRAG, "then": [{"depth_mm": 0.5, "shear_mm": [0.0, 0.0]}]}
    entry = account(element, 48, back)
    assert entry.lost == 0
    # Each point that touches or leaves puts a kink into the force, so that the error falls unevenly with the step.
    # What is left at the end is a third of what was put in, so that 0.3 % of that count as 1 %.
    assert abs(entry.missing) < 0.012


@pytest.mark.parametrize(
    ("motion", "friction", "layers"), [(DRAG, 0.5, False), (DRAG, 2.0, True), (TWIST, 0.2, False), (TWIST, 0.2, True)]
)
@pytest.mark.parametrize("element", MIXED)
def test_work_is_stored_or_rubbed_away(element: str, motion: dict, friction: float, layers: bool) -> None:
    entry = account(element, 20, motion, friction, layers)
    assert entry.lost > 0.003 * entry.work
    # Second order, with 8 to 10 steps of 0.16 mm or 4 degrees a leg: measured 0.1 to 0.8 %.
    assert abs(entry.missing) < 0.012


@pytest.mark.parametrize("motion", [DRAG, TWIST])
def test_account_closes_with_the_square_of_the_step(motion: dict) -> None:
    coarse, fine = (account("p1p1", steps, motion, 0.5).missing for steps in (10, 40))
    # A quarter of the step, a sixteenth of the error; half of that for points that begin to slip within a step.
    assert abs(fine) < abs(coarse) / 8
