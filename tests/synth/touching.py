"""A gel touched by an indenter with a random state of contact: every branch of the contact law in one evaluation."""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from pads import ELEMENT, crooked, indenters, scene, system

from synth.arrays import BoolArray, FloatArray
from synth.simulate.contact_friction import Indenters
from synth.simulate.system import Residual, System, Unknowns

MESH = crooked()
PENALTY = 7.0
RADIUS = 1.3
SLIP, STICK = 0.05, 10.0
"""Friction coefficients at which, with the random anchors below, nearly every point slips or sticks."""
INDENTERS: dict[str, dict[str, Any]] = {
    "sphere": {"shape": "sphere", "radius_mm": RADIUS, "rotation_deg": [10.0, 20.0, 30.0]},
    "mesh": {
        "shape": "mesh",
        "file": str(Path(__file__).parents[2] / "scenes/objects/cube.stl"),
        "size_mm": 2.4,
        "cell_mm": 0.3,
        "fillet_mm": 0.4,
        "rotation_deg": [10.0, 20.0, 30.0],
    },
    "torus": {"shape": "torus", "radius_mm": 0.9, "tube_mm": 0.4, "rotation_deg": [10.0, 20.0, 30.0]},
}


@dataclass
class Touch:
    """A gel pressed by a turned ball, cube or ring."""

    body: System
    state: Unknowns
    indenters: Indenters
    friction: float
    residual: Residual = field(init=False)

    def __post_init__(self) -> None:
        self.evaluate()

    def evaluate(self, state: Unknowns | None = None) -> FloatArray:
        self.residual = self.body.residual(state or self.state, self.indenters)
        return self.residual.free

    @property
    def points(self) -> FloatArray:
        """(f, q, 3) positions of the contact points."""
        space = self.body.space
        return np.einsum("qa,fac->fqc", space.element.face_shape, (space.points + self.state.u)[space.faces])

    @property
    def local(self) -> FloatArray:
        """(f, q, 3) the contact points in the indenter's frame."""
        return np.asarray((self.points - self.centre) @ self.rotation)

    @cached_property
    def rotation(self) -> FloatArray:
        return np.asarray(self.indenters.rotation.numpy()[0])

    @cached_property
    def centre(self) -> FloatArray:
        return np.asarray(self.indenters.centre.numpy()[0])

    @property
    def anchored(self) -> BoolArray:
        """(f, q) whether the points touched at the last accepted step."""
        return np.asarray(self.body.contact.anchored.numpy()[0] == 1)

    @property
    def tractions(self) -> tuple[FloatArray, FloatArray]:
        """(f, q, 3) normal and tangential, of the last evaluation."""
        along = self.residual.tangential.numpy()[0]
        return self.residual.traction.numpy()[0] - along, along

    @property
    def mode(self) -> np.ndarray:
        """(f, q) at the last evaluation: 0 off, 1 stick, 2 slip."""
        normal, along = self.tractions
        pressure = np.linalg.norm(normal, axis=-1)
        slip = np.linalg.norm(along, axis=-1) >= self.friction * pressure * (1 - 1e-9)
        return np.where(pressure > 0, 1 + slip, 0)


def touch(friction: float, shape: str = "sphere", multipliers: bool = True, fresh: float = 0, element="p1p1") -> Touch:
    """The gel with random displacements and multipliers; a share `fresh` of the points was off before the step."""
    rng = np.random.default_rng(1)
    body = system(MESH, 0.4999, element=ELEMENT[element]())
    posed = scene(MESH.size_mm, indenter=INDENTERS[shape], motion={"depth_mm": 0.5})
    zero = body.zero()
    state = Unknowns(0.03 * rng.standard_normal(zero.u.shape), rng.standard_normal(zero.p.shape))
    state.u[body.space.held] = 0.0
    made = Touch(body, state, indenters(posed, 0.5), friction)
    made.indenters.friction.fill_(friction)
    made.indenters.stiffness.fill_(PENALTY)
    local, contact = made.local, body.contact
    count = local.shape[:2]
    spread = 0.01 if friction == STICK else 0.15
    contact.anchor.assign((local + spread * rng.standard_normal(local.shape))[None])
    contact.place.assign((local + spread * rng.standard_normal(local.shape))[None])
    contact.gap.assign(rng.uniform(0.02, 0.2, (1, *count)))
    contact.anchored.assign((rng.random((1, *count)) >= fresh).astype(np.int32))
    if multipliers:
        old = made.anchored
        contact.normal.assign((0.3 * rng.random(count) * old)[None])
        contact.tangent.assign((0.1 * rng.standard_normal(local.shape) * old[..., None])[None])
    made.evaluate()
    return made


def sphere_law(made: Touch) -> tuple[FloatArray, FloatArray]:
    """Normal and tangential traction (f, q, 3) of a ball by the formulas of `synth.simulate.contact_friction`."""
    contact, rotation = made.body.contact, made.rotation
    away = made.points - made.centre
    distance = np.linalg.norm(away, axis=-1, keepdims=True)
    n, gap = away / distance, distance - RADIUS
    pressure = np.maximum(contact.normal.numpy()[0][..., None] - PENALTY * gap, 0.0)
    before, place = contact.gap.numpy()[0][..., None], contact.place.numpy()[0]
    touched = place + before / (before - np.minimum(gap, 0.0)) * (made.local - place)  # where the gap closed
    anchor = np.where(made.anchored[..., None], contact.anchor.numpy()[0], touched)
    trial = contact.tangent.numpy()[0] @ rotation.T - PENALTY * (away - anchor @ rotation.T)
    trial = trial - (trial * n).sum(-1, keepdims=True) * n
    length = np.linalg.norm(trial, axis=-1, keepdims=True)
    share = np.minimum(1.0, made.friction * pressure / np.maximum(length, 1e-300))
    return pressure * n, np.where(pressure > 0, share * trial, 0.0)
