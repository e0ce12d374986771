"""What all trajectories of a batch share: the discrete pad and its preconditioner on a device.

The preconditioner is the inverse of the undeformed pad's stiffness, as one dense matrix.

All lanes share a mesh, so that K_0^{-1} times all their vectors is one matrix product. The inverse is found in double
precision, on CUDA by cuSOLVER, and applied in bfloat16 (`synth.simulate.batched.krylov`): a preconditioner that changes
a little with its argument, which flexible GMRES allows for.
"""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import scipy.sparse
import warp as wp

from synth.mesh import PadMesh, check_mesh
from synth.press.indenter import RigidBody
from synth.press.load_path import LoadPath
from synth.press.resolution import ELEMENTS
from synth.scene import Scene
from synth.simulate.batched.gpu import Dense, inverse
from synth.simulate.contact_friction import Indenters
from synth.simulate.material import Material, pad_material
from synth.simulate.space import Space, function_space
from synth.simulate.system import System
from synth.simulate.tables import pack_indenter, place_indenter

ON_HOST = ("contact_friction", "inversion_barrier", "stiffness")
"""Modules whose kernels on the CPU find the undeformed pad's stiffness for a GPU."""


def load_kernels() -> None:
    """Load what simulation on a GPU needs of Warp; on a new machine modules are compiled, all at once."""
    wp.init()  # which no two threads may do at once
    with ThreadPoolExecutor() as threads:
        beside = [threads.submit(wp.load_module, f"synth.simulate.{name}", "cpu") for name in ON_HOST]
        wp.load_module("synth.simulate", "cuda", recursive=True, max_workers=os.cpu_count() or 1)
        for each in beside:
            each.result()


def stiffness(system: System, away: Indenters) -> scipy.sparse.csr_array:
    """(k, k) the undeformed pad's tangent over the free unknowns; `away`: an indenter that touches nothing."""
    values = system.tangent(system.zero(), away).values
    upper = system.matrix(np.asarray(values, dtype=np.float64))
    return upper + scipy.sparse.triu(upper, 1).T


AWAY_MM = 1e3
"""Where an indenter touches nothing."""


@dataclass(frozen=True)
class Pad:
    """The pad of a batch, prepared for a scene.

    Attributes:
        free: (k,) numbers of the unknowns not held, displacements first.
        inverse: (rows, rows) K_0^{-1} on the device, of `synth.simulate.batched.gpu.inverse`.
        products: what applies it; None for the Warp device's own.
    """

    scene: Scene
    space: Space
    material: Material
    free: np.ndarray
    inverse: wp.array
    products: Dense | None
    device: str

    @property
    def mixed(self) -> bool:
        return self.material.mixed and self.space.element.has_pressure

    @property
    def yeoh(self) -> bool:
        return bool(self.material.yeoh.any())


def prepare(scene: Scene, mesh: PadMesh, device: str, products: Dense | None = None) -> Pad:
    """Prepare the pad of a scene, for all scenes of the same mesh, materials and element.

    `products` are the pad's, see `Pad`. InputError for CUDA without cuSOLVER.
    """
    check_mesh(mesh)
    material = pad_material(scene.sensor.gel, mesh)
    space = function_space(mesh, ELEMENTS[scene.numerics.element]())
    system = System(space, material)
    matrix = inverse(stiffness(system, _away(scene)), device)
    return Pad(scene, space, material, system.free, matrix, products, device)


def _away(scene: Scene) -> Indenters:
    ball = RigidBody(0, np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]), np.eye(3), 1.0, np.zeros((1, 1, 1)), 1.0)
    path = LoadPath(scene.motion.model_copy(update={"depth_mm": -AWAY_MM}), ball)
    packed = pack_indenter(path, 0.0, 1.0)
    place_indenter(packed, path.pose(0.0))
    return packed
