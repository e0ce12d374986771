"""What all trajectories of a batch share: the discrete pad and its preconditioner on a device."""

from dataclasses import dataclass

import numpy as np

from synth.mesh import PadMesh, check_mesh
from synth.scene import Scene
from synth.simulate.batched.gemm import Dense
from synth.simulate.batched.preconditioner import Preconditioner, inverse, stiffness
from synth.simulate.contact import Indenters
from synth.simulate.indenter import RigidBody
from synth.simulate.load_path import LoadPath
from synth.simulate.material import Material, pad_material
from synth.simulate.solve import ELEMENTS
from synth.simulate.space import Space, function_space
from synth.simulate.system import System
from synth.simulate.tables import pack_indenter, place_indenter

AWAY_MM = 1e3
"""Where an indenter touches nothing."""


@dataclass(frozen=True)
class Pad:
    """The pad of a batch; free: (k,) numbers of the unknowns that are not held, displacements first."""

    space: Space
    material: Material
    free: np.ndarray
    preconditioner: Preconditioner
    device: str

    @property
    def mixed(self) -> bool:
        """Whether there is a pressure field."""
        return self.material.mixed and self.space.element.has_pressure

    @property
    def yeoh(self) -> bool:
        """Whether the material stiffens."""
        return bool(self.material.yeoh.any())


def prepare(scene: Scene, mesh: PadMesh, device: str, products: Dense | None = None) -> Pad:
    """Prepare the pad of a scene, for all scenes of the same mesh, materials and element.

    `products` apply the preconditioner; by default they are the Warp device's own. InputError for CUDA without cuBLAS
    or cuSOLVER.
    """
    check_mesh(mesh)
    material = pad_material(scene.sensor.gel, mesh)
    space = function_space(mesh, ELEMENTS[scene.numerics.element]())
    system = System(space, material)
    preconditioner = Preconditioner(inverse(stiffness(system, _away(scene)), device), device, products)
    return Pad(space, material, system.free, preconditioner, device)


def _away(scene: Scene) -> Indenters:
    """A ball that touches nothing."""
    ball = RigidBody(0, np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]), np.eye(3), 1.0, np.zeros((1, 1, 1)), 1.0)
    path = LoadPath(scene.motion.model_copy(update={"depth_mm": -AWAY_MM}), ball)
    packed = pack_indenter(path, 0.0)
    place_indenter(packed, path.pose(0.0))
    return packed
