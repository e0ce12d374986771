"""Where the indenter's work goes over a trajectory: elastic energy, contact penalty, friction.

The contact's springs hold (t_n² + |t_T|²) / 2ε per area, ε the penalty: a part of the elastic energy that belongs to
the discretisation. What rubbing loses is the tangential traction times the motion of the anchors.
"""

from dataclasses import dataclass, field

import numpy as np
from integrals import own_integrals

from synth.arrays import FloatArray
from synth.mesh import PadMesh
from synth.scene import Scene
from synth.simulate.contact import Indenters
from synth.simulate.indenter import rigid_body
from synth.simulate.load_path import LoadPath
from synth.simulate.material import pad_material
from synth.simulate.solve import ELEMENTS
from synth.simulate.space import function_space
from synth.simulate.stepping import Stepper
from synth.simulate.system import System, Unknowns


@dataclass(frozen=True)
class Moment:
    """The indenter and its load at one accepted step; `rubbing` (f, q, 3) is the tangential traction in its frame."""

    centre: FloatArray
    rotation: FloatArray
    force: FloatArray
    moment: FloatArray
    rubbing: FloatArray


@dataclass
class Account:
    """In E mm³: the work of the indenter, and where it went."""

    work: float = 0.0
    lost: float = 0.0
    springs: float = 0.0
    stored: float = 0.0
    last: Moment | None = field(default=None, repr=False)

    @property
    def missing(self) -> float:
        """Share of the work that is in none of the others."""
        return 1 - (self.stored + self.springs + self.lost) / self.work


class Ledger(System):
    """A system that enters every accepted load step into an account, by the trapezoidal rule."""

    account: Account

    def update_contact_history(self, state: Unknowns, indenter: Indenters) -> None:
        """As the solver's, with the bookkeeping around it."""
        centre, rotation = indenter.centre.numpy()[0].copy(), indenter.rotation.numpy()[0].copy()
        force, moment = self.forces(state)[:2]
        along, whole = self.tangential.numpy()[0], self.traction.numpy()[0]
        now = Moment(centre, rotation, force, moment - np.cross(centre, force), along @ rotation)
        weight = self._faces.weight.numpy()
        anchor, anchored = self.contact.anchor.numpy()[0].copy(), self.contact.anchored.numpy()[0] == 1
        super().update_contact_history(state, indenter)
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
        account.springs = float((weight * (whole**2).sum(axis=-1)).sum()) / (2 * self.penalty)
        account.last = now


def accounted(scene: Scene, mesh: PadMesh) -> Account:
    """Run a scene, whose trajectory must be complete, and close the account with the energy of its last state."""
    gel, numerics = scene.sensor.gel, scene.numerics
    material = pad_material(gel, mesh)
    ledger = Ledger(function_space(mesh, ELEMENTS[numerics.element]()), material, penalty=numerics.penalty)
    ledger.account = Account()
    path = LoadPath(scene.motion, rigid_body(scene.contact.indenter))
    stepper = Stepper(ledger, path, scene.contact.friction, numerics, gel.youngs_modulus_kpa / 1000)
    ended = stepper.run()
    assert (ended.status, ended.reason) == ("complete", "")
    ledger.account.stored = own_integrals(ledger.space).energy(material, stepper.state.u, stepper.state.p)
    return ledger.account
