"""What all trajectories of a batch share: the discrete pad and its preconditioner on a device.

The preconditioner is the inverse of the undeformed pad's stiffness, as one dense matrix.

All lanes share a mesh, so that K_0^{-1} times all their vectors is one matrix product. The inverse is found in double
precision, on CUDA by cuSOLVER, and applied in TF32 (`synth.simulate.batched.krylov`): a preconditioner that changes a
little with its argument, which flexible GMRES allows for.
"""

import ctypes
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy.sparse
import warp as wp

from synth.errors import InputError
from synth.mesh import PadMesh, check_mesh
from synth.press.indenter import RigidBody
from synth.press.load_path import LoadPath
from synth.press.resolution import ELEMENTS
from synth.scene import Scene
from synth.simulate.batched.gemm import Dense, call, dense
from synth.simulate.batched.krylov import Krylov, flat, padded, round_rows
from synth.simulate.contact import Indenters
from synth.simulate.material import Material, pad_material
from synth.simulate.space import Space, function_space
from synth.simulate.system import System
from synth.simulate.tables import pack_indenter, place_indenter

FLOAT64 = 1  # CUDA_R_64F
COLUMNS = 1024  # of the inverse that are found at a time on a GPU, to save memory


def stiffness(system: System, away: Indenters) -> scipy.sparse.csr_array:
    """(k, k) the undeformed pad's tangent over the free unknowns; `away`: an indenter that touches nothing."""
    values = system.tangent(system.zero(), away).values
    upper = system.matrix(np.asarray(values, dtype=np.float64))
    return upper + scipy.sparse.triu(upper, 1).T


def inverse(matrix: scipy.sparse.csr_array, device: str) -> wp.array:
    """(rows, rows) of a symmetric matrix (k, k): its inverse in TF32, then zeros to the length of Krylov vectors.

    2 k³ flops in float64: on a CPU 15 s for 13,000 unknowns at 300 GFLOP/s. InputError where memory does not suffice,
    or for CUDA without cuSOLVER; numpy.linalg.LinAlgError for a singular matrix.
    """
    k, where = matrix.shape[0], wp.get_device(device)
    try:
        full = wp.array(matrix.toarray(), dtype=wp.float64, device=where)
        found = wp.zeros((padded(k), padded(k)), dtype=wp.float32, device=where)
        if where.is_cuda:
            _invert_by_cusolver(full, found)
        else:
            wp.launch(round_rows, (k, k), inputs=[np.linalg.inv(full.numpy()), 0, found], device=where)
    except (MemoryError, RuntimeError) as error:
        raise InputError(
            f"the batched solver inverts a matrix of {k:,} unknowns, which takes {12e-9 * k * k:.1f} GB: {error}; "
            'simulate with numerics.solver = "single"'
        ) from error
    return found


def _invert_by_cusolver(factors: wp.array, found: wp.array) -> None:
    """LU factors, then unit vectors as right sides. cuSOLVER counts by columns, which symmetry makes the same."""
    n, device = len(factors), factors.device
    handle, settings, here, there = ctypes.c_void_p(), ctypes.c_void_p(), ctypes.c_size_t(), ctypes.c_size_t()
    pivots, info = wp.empty(n, dtype=wp.int64, device=device), wp.zeros(1, dtype=wp.int32, device=device)
    left, order, told = (ctypes.c_void_p(each.ptr) for each in (factors, pivots, info))
    size, run = ctypes.c_int64(n), partial(call, "cusolver")
    with wp.ScopedDevice(device):
        run("cusolverDnCreate", ctypes.byref(handle))
        run("cusolverDnCreateParams", ctypes.byref(settings))
        run("cusolverDnSetStream", handle, ctypes.c_void_p(device.stream.cuda_stream))
        try:
            given = (handle, settings, size, size, FLOAT64, left, size)
            run("cusolverDnXgetrf_bufferSize", *given, FLOAT64, ctypes.byref(here), ctypes.byref(there))
            room, host = wp.empty(here.value, dtype=wp.uint8, device=device), ctypes.create_string_buffer(there.value)
            run("cusolverDnXgetrf", *given, order, FLOAT64, ctypes.c_void_p(room.ptr), here, host, there, told)
            if info.numpy()[0]:
                raise np.linalg.LinAlgError("Singular matrix")
            for first in range(0, n, COLUMNS):
                columns = wp.array(np.eye(min(COLUMNS, n - first), n, first), dtype=wp.float64, device=device)
                right = (
                    ctypes.c_int64(len(columns)),
                    FLOAT64,
                    left,
                    size,
                    order,
                    FLOAT64,
                    ctypes.c_void_p(columns.ptr),
                )
                run("cusolverDnXgetrs", handle, settings, 0, size, *right, size, told)
                wp.launch(round_rows, columns.shape, inputs=[columns, first, found], device=device)
            wp.synchronize_device(device)
        finally:
            run("cusolverDnDestroyParams", settings)
            run("cusolverDnDestroy", handle)


class Preconditioner:
    """K_0^{-1} on a device, of `inverse`."""

    def __init__(self, matrix: wp.array, products: Dense | None = None) -> None:
        self.matrix, self.rows = matrix, matrix.shape[0]
        self.dense = products or dense(str(matrix.device))

    def apply(self, krylov: Krylov) -> None:
        """`preconditioned` = K_0^{-1} `current`, at least where a solve is running."""
        given, found = flat(krylov.current), flat(krylov.preconditioned)
        self.dense.product(self.matrix, given, found, krylov.running)


AWAY_MM = 1e3
"""Where an indenter touches nothing."""


@dataclass(frozen=True)
class Pad:
    """The pad of a batch, prepared for a scene; free: (k,) numbers of the unknowns not held, displacements first."""

    scene: Scene
    space: Space
    material: Material
    free: np.ndarray
    preconditioner: Preconditioner
    device: str

    @property
    def mixed(self) -> bool:
        return self.material.mixed and self.space.element.has_pressure

    @property
    def yeoh(self) -> bool:
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
    preconditioner = Preconditioner(inverse(stiffness(system, _away(scene)), device), products)
    return Pad(scene, space, material, system.free, preconditioner, device)


def _away(scene: Scene) -> Indenters:
    ball = RigidBody(0, np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]), np.eye(3), 1.0, np.zeros((1, 1, 1)), 1.0)
    path = LoadPath(scene.motion.model_copy(update={"depth_mm": -AWAY_MM}), ball)
    packed = pack_indenter(path, 0.0)
    place_indenter(packed, path.pose(0.0))
    return packed
