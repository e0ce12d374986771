"""Constant arrays of a pad's elements and faces and of its indenter, as the kernels take them."""

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from synth.arrays import FloatArray
from synth.mesh.element import EDGES
from synth.mesh.pad import barycentric_gradients
from synth.press.load_path import LoadPath, Pose
from synth.simulate.bulk import Bulk
from synth.simulate.contact_friction import Faces, Indenters
from synth.simulate.inversion_barrier import SAMPLE_DEGREE, BarrierTables
from synth.simulate.material import Material
from synth.simulate.space import Space
from synth.surface import broken_linear_face


def warp_array(values: ArrayLike, dtype: type, device: str) -> wp.array:
    """A Warp array of contiguous values; vectors and matrices take the trailing axes."""
    return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)


def zeros_of(struct: Any, shape: Callable[[str], tuple[int, ...]], device: str) -> Any:
    """A Warp struct whose arrays are zeros; shape of each by its name."""
    made = struct()
    for name, variable in struct.vars.items():
        setattr(made, name, wp.zeros(shape(name), dtype=variable.type.dtype, device=device))
    return made


def struct_of(struct: Any, device: str, **values: Any) -> Any:
    """A Warp struct of numbers and of arrays, which are given the types that it declares."""
    made = struct()
    for name, value in values.items():
        kind = struct.vars[name].type
        setattr(made, name, warp_array(value, kind.dtype, device) if isinstance(kind, wp.array) else value)
    return made


def bulk_tables(space: Space, material: Material, mixed: bool, d: str) -> Bulk:
    """The elements of a space with their material, on Warp device d."""
    mesh, element = space.mesh, space.element
    gradient = np.einsum("qak,ekd->eqad", element.derivative, barycentric_gradients(mesh.points, mesh.tets))
    mass = (np.ones((4, 4)) + np.eye(4)) / 20
    scale = (mesh.volumes * element.stabilisation / material.shear)[:, None, None]
    with np.errstate(divide="ignore"):  # without lateral strain (λ = 0) there is no pressure: 1 / inf in the kernel
        compliance = 1 / material.lame
    tables = {
        "nodes": space.nodes,
        "pressure_nodes": space.pressure_nodes,
        "gradient": gradient,
        "weight": mesh.volumes[:, None] * element.weights,
        "pressure_shape": element.barycentric,
        "stabilisation": -scale * (mass - 1 / 16),
    }
    law = {"shear": material.shear, "compliance": compliance, "hold": element.hold, "yeoh": material.yeoh}
    return struct_of(Bulk, d, mixed=int(mixed), **tables, **law)


def laplace_table(space: Space, material: Material, pairs: np.ndarray) -> wp.array:
    """(m, np) integrals of μ g_a.g_b over the elements of a space, for pairs (np, 2) of local nodes."""
    mesh, element = space.mesh, space.element
    corner = barycentric_gradients(mesh.points, mesh.tets)
    metric = (material.shear * mesh.volumes)[:, None, None] * np.einsum("eci,edi->ecd", corner, corner)
    first, second = (element.derivative[:, pairs[:, i]] for i in range(2))
    form = np.einsum("q,qkc,qkd->kcd", element.weights, first, second).reshape(len(pairs), 16)
    return warp_array(metric.reshape(len(metric), 16) @ form.T, wp.float64, "cpu")


def barrier_tables(space: Space, material: Material, d: str) -> "BarrierTables | None":
    """The sample points of `synth.simulate.inversion_barrier`, on Warp device d; None for linear elements."""
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
    gradient = barycentric_gradients(space.mesh.points, space.mesh.tets)
    weight = material.shear * space.mesh.volumes / len(at)
    shapes = {"share": share, "along": along, "gradient": gradient}
    return struct_of(BarrierTables, d, nodes=space.nodes, at=at, weight=weight, **shapes)


def face_tables(space: Space, d: str) -> Faces:
    """The faces of a space that can touch, on Warp device d."""
    element = space.element
    a, b, c = (space.points[space.faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    weight = area[:, None] * element.face_weights
    return struct_of(Faces, d, nodes=space.faces, shape=element.face_shape, weight=weight, points=space.points)


def nodal_weights(space: Space, weight: FloatArray) -> dict[str, np.ndarray]:
    """How points of the coated face, of weights (f, nq) in mm², give tractions to its nodes.

    `hat` (nq, ns) are functions by which a face's points share in its nodes: piecewise linear ones, since the shape
    functions themselves would weigh P2 corners by 0. `number` (f, ns) is that of a face's nodes among the surface's, -1
    on other faces, which would water down the rim; `area` (s,) mm² is each node's.
    """
    element, coated = space.element, space.coated
    hat = element.face_shape if element.order == 1 else broken_linear_face(element.face_barycentric)
    number = np.full(space.faces.shape, -1, dtype=np.int32)
    number[coated] = np.searchsorted(space.surface_nodes, space.faces[coated])
    area = np.zeros(len(space.surface_nodes))
    np.add.at(area, number[coated], np.einsum("fq,qa->fa", weight[coated], hat))
    return {"hat": hat, "number": number, "area": area}


def pack_indenter(path: LoadPath, friction: float, penalty: float) -> Indenters:
    """The body of a path, on the CPU; `place_indenter` says where it is.

    penalty: the contact stiffness of a blunt body, E per mm.
    """
    body, nowhere = path.body, {"centre": np.zeros((1, 3)), "rotation": np.zeros((1, 3, 3))}
    shape = {"kind": [body.kind], "shape": [body.shape], "coefficients": [body.coefficients]}
    return struct_of(Indenters, "cpu", friction=[friction], stiffness=[penalty * body.sharpness], **shape, **nowhere)


def place_indenter(packed: Indenters, pose: Pose) -> None:
    packed.centre.assign(pose.centre[None])
    packed.rotation.assign(pose.rotation[None])
