"""What all trajectories of a batch share: the discrete pad and its preconditioner on a device.

The preconditioner is the inverse of the undeformed pad's stiffness, as one dense matrix.

All lanes share a mesh, so that K_0^{-1} times all their vectors is one matrix product. The inverse is found in double
precision, on CUDA by cuSOLVER, and applied in TF32 (`synth.simulate.batched.krylov`): a preconditioner that changes a
little with its argument, which flexible GMRES allows for.
"""

import ctypes
from dataclasses import dataclass

import numpy as np
import scipy.sparse
import warp as wp

from synth.arrays import FloatArray
from synth.mesh import PadMesh, check_mesh
from synth.scene import Scene
from synth.simulate.batched.gemm import Dense, call, dense
from synth.simulate.batched.krylov import Krylov, flat, padded, round_matrix
from synth.simulate.contact import Indenters
from synth.simulate.indenter import RigidBody
from synth.simulate.load_path import LoadPath
from synth.simulate.material import Material, pad_material
from synth.simulate.solve import ELEMENTS
from synth.simulate.space import Space, function_space
from synth.simulate.system import System
from synth.simulate.tables import pack_indenter, place_indenter


def stiffness(system: System, away: Indenters) -> FloatArray:
    """(k, k) the undeformed pad's tangent over the free unknowns; `away`: an indenter that touches nothing."""
    values = system.tangent(system.zero(), away).values
    upper = system.matrix(np.asarray(values, dtype=np.float64))
    return np.asarray((upper + scipy.sparse.triu(upper, 1).T).toarray())


def inverse(matrix: FloatArray, device: str) -> FloatArray:
    """(k, k) of a symmetric float64 matrix; 2 k³ flops on a CPU: 15 s for 13,000 unknowns at 300 GFLOP/s.

    InputError for CUDA without cuSOLVER, numpy.linalg.LinAlgError for a singular matrix.
    """
    where = wp.get_device(device)
    return _inverse_by_cusolver(matrix, where) if where.is_cuda else np.asarray(np.linalg.inv(matrix), np.float64)


def _inverse_by_cusolver(matrix: FloatArray, device: wp.Device) -> FloatArray:
    """LU factors, then the identity as right side. cuSOLVER counts by columns, which symmetry makes the same."""
    n = len(matrix)
    factors, found = (wp.array(each, dtype=wp.float64, device=device) for each in (matrix, np.eye(n)))
    pivots, info = wp.empty(n, dtype=wp.int32, device=device), wp.zeros(1, dtype=wp.int32, device=device)
    handle, size = ctypes.c_void_p(), ctypes.c_int()
    left, right, order, told = (ctypes.c_void_p(each.ptr) for each in (factors, found, pivots, info))
    with wp.ScopedDevice(device):
        call("cusolver", "cusolverDnCreate", ctypes.byref(handle))
        call("cusolver", "cusolverDnSetStream", handle, ctypes.c_void_p(device.stream.cuda_stream))
        call("cusolver", "cusolverDnDgetrf_bufferSize", handle, n, n, left, n, ctypes.byref(size))
        room = wp.empty(size.value, dtype=wp.float64, device=device)
        call("cusolver", "cusolverDnDgetrf", handle, n, n, left, n, ctypes.c_void_p(room.ptr), order, told)
        singular = info.numpy()[0]
        call("cusolver", "cusolverDnDgetrs", handle, 0, n, n, left, n, order, right, n, told)
        values = found.numpy()
        call("cusolver", "cusolverDnDestroy", handle)
    if singular:
        raise np.linalg.LinAlgError("Singular matrix")
    return np.asarray(values)


class Preconditioner:
    """K_0^{-1} (k, k), float64, on a device, filled up with zeros to as many rows as the Krylov vectors have."""

    def __init__(self, inverse: FloatArray, device: str, products: Dense | None = None) -> None:
        self.rows = padded(len(inverse))
        filled = np.zeros((self.rows, self.rows), dtype=np.float32)
        filled[: len(inverse), : len(inverse)] = inverse
        self.matrix = wp.array(filled, dtype=wp.float32, device=device)
        wp.launch(round_matrix, self.matrix.shape, inputs=[self.matrix], device=device)
        self.dense = products or dense(device)

    def apply(self, krylov: Krylov) -> None:
        """`preconditioned` = K_0^{-1} `current`, at least where a solve is running."""
        given, found = flat(krylov.current), flat(krylov.preconditioned)
        self.dense.product(self.matrix, given, found, krylov.running)


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
