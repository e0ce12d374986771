"""What the indenter exerts the window bears, and its work is the gel's energy and what friction takes.

Without friction the solver's steps are equilibria of an energy, so that only the trapezoidal rule of the account stands
between the two sides: an error that falls with the square of the step. With friction the mean of the tractions at both
ends makes it second order, too, except at points that begin to slip. The contact's springs hold (t_n² + |t_T|²) / 2ε
per area, ε the penalty; what rubbing loses is the tangential traction times the motion of the anchors.
"""

from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest
from integrals import own_integrals
from pads import ELEMENT, FILM, MIXED, SIZE, complete, contact_faces, pad, run, scene

from synth.arrays import FloatArray
from synth.mesh import PadMesh
from synth.press.press import Press
from synth.scene import Scene
from synth.simulate.contact_friction import Indenters
from synth.simulate.direct import DirectPress
from synth.simulate.material import pad_material
from synth.simulate.options import STANDARD
from synth.simulate.policy.load_steps import LoadSteps
from synth.simulate.space import Space, function_space
from synth.simulate.system import Residual, System, Unknowns

PRESS = {"depth_mm": 0.8}
DRAG = {"depth_mm": 0.8, "shear_mm": [1.2, 0.3]}
TWIST = {"depth_mm": 0.8, "shear_mm": [0.3, 0.2], "twist_deg": 40.0}
E_MPA = 0.2


@dataclass
class Account:
    """In E mm³: the work of the indenter, and where it went."""

    work: float = 0.0
    lost: float = 0.0
    springs: float = 0.0
    stored: float = 0.0
    last: SimpleNamespace | None = field(default=None, repr=False)

    @property
    def missing(self) -> float:
        return 1 - (self.stored + self.springs + self.lost) / self.work


class Ledger(System):
    """A system that enters every accepted load step into an account, by the trapezoidal rule."""

    account: Account

    def update_contact_history(self, state: Unknowns, at: Residual, indenter: Indenters, new_only: int = 0) -> None:
        if new_only:
            return super().update_contact_history(state, at, indenter, new_only)
        centre, rotation = indenter.centre.numpy()[0].copy(), indenter.rotation.numpy()[0].copy()
        force, moment = self.forces(state, at)[:2]
        along, whole = at.tangential.numpy()[0], at.traction.numpy()[0]
        about = {"force": force, "moment": moment - np.cross(centre, force), "rubbing": along @ rotation}
        now = SimpleNamespace(centre=centre, rotation=rotation, **about)
        weight = self._faces.weight.numpy()
        anchor, anchored = self.contact.anchor.numpy()[0].copy(), self.contact.anchored.numpy()[0] == 1
        super().update_contact_history(state, at, indenter)
        moved = self.contact.anchor.numpy()[0] - anchor
        moved[~(anchored & (self.contact.anchored.numpy()[0] == 1))] = 0.0
        account, before = self.account, self.account.last
        if before is not None:
            # The axial vector of a small rotation, to third order in its angle.
            turn = rotation @ before.rotation.T
            turned = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
            account.work += float((force + before.force) @ (centre - before.centre)) / 2
            account.work += float((now.moment + before.moment) @ turned) / 2
            # The anchor follows the slip, along which the traction on the gel points back.
            rubbed = ((now.rubbing + before.rubbing) / 2 * moved).sum(axis=-1)
            account.lost -= float((weight * rubbed).sum())
        account.springs = float((weight * (whole**2).sum(axis=-1)).sum() / (2 * indenter.stiffness.numpy()[0]))
        account.last = now


def landing(mesh: PadMesh, element: str) -> tuple[float, float]:
    """The contact point nearest to the pad's middle: there the ball touches from the start of its way."""
    shape = ELEMENT[element]().face_barycentric
    surface = contact_faces(mesh)
    points = np.einsum("qa,fac->fqc", shape, surface.nodes[surface.faces]).reshape(-1, 3)
    x, y, _ = points[np.argmin(np.linalg.norm(points, axis=1))]
    return float(x), float(y)


def account(element: str, steps: int, motion: dict, friction=0.0, layers=False, nu=0.4999) -> Account:
    """Run a scene, whose trajectory must be complete, and close the account with the energy of its last state."""
    mesh = pad(layers)
    posed = scene(
        SIZE,
        gel={"poisson_ratio": nu, "layers": [FILM] if layers else []},
        friction=friction,
        motion={**motion, "steps": steps, "position_mm": landing(mesh, element)},
        numerics={"element": element, "tolerance": 1e-8, "max_step_mm": 1.0, "edge_length_mm": None},
    )
    numerics, material = posed.numerics, pad_material(posed.sensor.gel, mesh)
    ledger = Ledger(function_space(mesh, ELEMENT[element]()), material)
    ledger.account = Account()
    path = Press.of(posed, mesh).path
    steps = LoadSteps(path, SIZE, friction > 0, numerics, STANDARD)
    press = DirectPress(ledger, path, friction, E_MPA, steps)
    ended = press.run()
    assert (ended.status, ended.reason) == ("complete", "")
    ledger.account.stored = own_integrals(ledger.space).energy(material, press.state.u, press.state.p)
    return ledger.account


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


SLIDE = {"depth_mm": 0.8, "shear_mm": [0.5, -0.3], "twist_deg": 10.0, "position_mm": [0.4, 0.2], "steps": 3}
LEGS = [{"depth_mm": z, "shear_mm": shear} for z, shear in ((3, (3.1, 0.1)), (3, (2.5, 0.1)), (2.8, (2.5, 0.4)))]
BESIDE = {"depth_mm": -0.1, "position_mm": [4.0, 0.2], "shear_mm": [3.1, 0.1], "then": LEGS, "steps": 5}
"""Down beside the pad, into its side face, and along it."""


def case(element: str, nu: float, friction: float, motion: dict, layers: bool = False) -> Scene:
    gel = {"poisson_ratio": nu, "stiffening": (0.1, 0.02), "layers": [FILM] if layers else []}
    numerics = {"element": element, "tolerance": 1e-9, "edge_length_mm": None}
    return scene(SIZE, gel=gel, numerics=numerics, friction=friction, motion=motion)


def check(space: Space, displacement: FloatArray, internal: FloatArray, force: FloatArray, moment: FloatArray) -> None:
    """Reactions (from nodal forces `internal`) against the indenter's force and moment, all over E."""
    # Newton stops at 1e-9 of the nodal forces; their sum over some 1e3 nodes, on arms of 5 mm, may be 1e3 as much.
    scale = float(1e-6 * np.linalg.norm(internal))
    assert np.linalg.norm(force) > 1e3 * scale
    held = internal * space.held
    np.testing.assert_allclose(held.sum(axis=0), -force, atol=scale)
    np.testing.assert_allclose(np.cross(space.points + displacement, held).sum(axis=0), -moment, atol=scale)
    inside = np.ones(len(space.points), dtype=bool)
    inside[space.faces] = False
    inside[space.held[:, 0]] = False
    np.testing.assert_allclose(internal[inside], 0.0, atol=scale)


@pytest.mark.parametrize("friction", [0.0, 0.6])
@pytest.mark.parametrize("element", MIXED)
def test_recorded_displacement_and_force_belong_together(element: str, friction: float) -> None:
    """Of a foam, whose stress is the displacement's alone: what the user gets, with multipliers and all."""
    posed, mesh = case(element, 0.2, friction, SLIDE), pad(False)
    result = complete(posed, mesh)
    rule, material = own_integrals(result.space), pad_material(posed.sensor.gel, mesh)
    for state in result.states[1:]:
        internal = rule.forces(rule.stress(material, state.displacement, np.zeros(0)))
        force, moment = np.array(state.force_n) / E_MPA, np.array(state.torque_nmm) / E_MPA
        check(result.space, state.displacement, internal, force, moment)


@pytest.mark.parametrize(
    ("nu", "motion", "friction", "layers"),
    [(0.4999, SLIDE, 0.6, True), (0.5, SLIDE, 0.0, True), (0.5, SLIDE, 0.6, False), (0.4999, BESIDE, 0.6, False)],
)
@pytest.mark.parametrize("element", MIXED)
def test_window_bears_what_the_indenter_does(element, nu, motion, friction, layers) -> None:
    """With a pressure field, a stiff film, and from the side."""
    posed, mesh = case(element, nu, friction, motion, layers), pad(layers)
    press = run(posed, mesh)
    body, state = press.system, press.state
    press.place(press.path.length_mm)
    residual = body.residual(state, press.indenter)
    force, moment = body.forces(state, residual)[:2]
    rule, material = own_integrals(body.space), pad_material(posed.sensor.gel, mesh)
    check(body.space, state.u, rule.forces(rule.stress(material, state.u, state.p)), force, moment)
    if motion is BESIDE:
        sideways = residual.traction.numpy()[0][
            (body.space.points[body.space.faces][:, :, 0] == SIZE[0] / 2).all(axis=1)
        ]
        assert sideways.any()
