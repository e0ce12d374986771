"""Constant arrays of a pad's elements and faces and of its indenter, as the kernels take them."""

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from synth.simulate.bulk import Bulk
from synth.simulate.contact import Faces, Indenters
from synth.simulate.distance import shape_vector
from synth.simulate.element import EDGES, barycentric_gradients
from synth.simulate.inversion_barrier import SAMPLE_DEGREE, BarrierTables
from synth.simulate.load_path import LoadPath, Pose
from synth.simulate.material import Material
from synth.simulate.space import Space


def warp_array(values: np.ndarray, dtype: type, device: str) -> wp.array:
    """A Warp array of contiguous values; vectors and matrices take the trailing axes."""
    return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)


def zeros_of(struct: Any, shape: Callable[[str], tuple[int, ...]], device: str) -> Any:
    """A Warp struct whose arrays are zeros; shape of each by its name."""
    made = struct()
    for name, variable in struct.vars.items():
        setattr(made, name, wp.zeros(shape(name), dtype=variable.type.dtype, device=device))
    return made


def bulk_tables(space: Space, material: Material, mixed: bool, d: str) -> Bulk:
    """The elements of a space with their material, on Warp device d."""
    mesh, element = space.mesh, space.element
    gradient = np.einsum("qak,ekd->eqad", element.derivative, barycentric_gradients(mesh.points, mesh.tets))
    mass = (np.ones((4, 4)) + np.eye(4)) / 20
    scale = (mesh.volumes * element.stabilisation / material.shear)[:, None, None]
    bulk = Bulk()
    bulk.nodes = warp_array(space.nodes, wp.int32, d)
    bulk.pressure_nodes = warp_array(space.pressure_nodes, wp.int32, d)
    bulk.gradient = warp_array(gradient, wp.vec3d, d)
    bulk.weight = warp_array(mesh.volumes[:, None] * element.weights, wp.float64, d)
    bulk.pressure_shape = warp_array(element.barycentric, wp.float64, d)
    bulk.stabilisation = warp_array(-scale * (mass - 1 / 16), wp.float64, d)
    bulk.shear = warp_array(material.shear, wp.float64, d)
    with np.errstate(divide="ignore"):  # without lateral strain (λ = 0) there is no pressure: 1 / inf in the kernel
        bulk.compliance = warp_array(1 / material.lame, wp.float64, d)
    bulk.mixed = int(mixed)
    bulk.hold = element.hold
    bulk.yeoh = warp_array(material.yeoh, wp.vec2d, d)
    return bulk


def laplace_table(space: Space, material: Material, pairs: np.ndarray) -> wp.array:
    """(m, np) integrals of μ g_a.g_b over the elements of a space, for pairs (np, 2) of local nodes."""
    mesh, element = space.mesh, space.element
    corner = barycentric_gradients(mesh.points, mesh.tets)
    metric = (material.shear * mesh.volumes)[:, None, None] * np.einsum("eci,edi->ecd", corner, corner)
    first, second = (element.derivative[:, pairs[:, i]] for i in range(2))
    form = np.einsum("q,qkc,qkd->kcd", element.weights, first, second).reshape(len(pairs), 16)
    return warp_array(metric.reshape(len(metric), 16) @ form.T, wp.float64, "cpu")


def barrier_tables(space: Space, material: Material, d: str) -> "BarrierTables | None":
    """Where `synth.simulate.inversion_barrier` looks, on Warp device d; None for linear elements, which cannot fold."""
    if space.element.order == 1:
        return None
    share, along = np.zeros((4, 10)), np.full((4, 10), -1)
    for i in range(4):
        share[i, :4], along[i, :4] = -1.0, np.arange(4)
        share[i, i] = 3.0
        for k, edge in enumerate(EDGES):
            if i in edge:
                share[i, 4 + k], along[i, 4 + k] = 4.0, sum(edge) - i
    n = SAMPLE_DEGREE
    steps = [(i, j, k) for i in range(n + 1) for j in range(n + 1 - i) for k in range(n + 1 - i - j)]
    at = np.array([(i, j, k, n - i - j - k) for i, j, k in steps]) / n
    barrier = BarrierTables()
    barrier.nodes = warp_array(space.nodes, wp.int32, d)
    barrier.at = warp_array(at, wp.vec4d, d)
    barrier.share = warp_array(share, wp.float64, d)
    barrier.along = warp_array(along, wp.int32, d)
    barrier.gradient = warp_array(barycentric_gradients(space.mesh.points, space.mesh.tets), wp.vec3d, d)
    barrier.weight = warp_array(material.shear * space.mesh.volumes / len(at), wp.float64, d)
    return barrier


def face_tables(space: Space, d: str) -> Faces:
    """The faces of a space that can touch, on Warp device d."""
    element = space.element
    a, b, c = (space.points[space.faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    faces = Faces()
    faces.nodes = warp_array(space.faces, wp.int32, d)
    faces.shape = warp_array(element.face_shape, wp.float64, d)
    faces.weight = warp_array(area[:, None] * element.face_weights, wp.float64, d)
    faces.points = warp_array(space.points, wp.vec3d, d)
    return faces


def pack_indenter(path: LoadPath, friction: float) -> Indenters:
    """The body of a path, on the CPU; `place_indenter` says where it is."""
    body, packed = path.body, Indenters()
    packed.kind = warp_array(np.array([body.kind], dtype=np.int32), wp.int32, "cpu")
    packed.shape = warp_array(np.array([body.shape]), shape_vector, "cpu")
    packed.coefficients = warp_array(body.coefficients[None], wp.float64, "cpu")
    packed.centre = wp.zeros(1, dtype=wp.vec3d, device="cpu")
    packed.rotation = wp.zeros(1, dtype=wp.mat33d, device="cpu")
    packed.friction = warp_array(np.array([friction], dtype=np.float64), wp.float64, "cpu")
    packed.sharpness = warp_array(np.array([body.sharpness]), wp.float64, "cpu")
    return packed


def place_indenter(packed: Indenters, pose: Pose) -> None:
    """Put a packed body where a pose says."""
    packed.centre.assign(pose.centre[None])
    packed.rotation.assign(pose.rotation[None])
