"""Where the unknowns of a pad are in the vectors of the batched linear solver, and tables in single precision.

Rows: three for each free node's displacement, then the pressures, then rows that fill up, which stay zero.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp

from synth.arrays import FloatArray
from synth.simulate.batched.product import SingleTables
from synth.simulate.batched.reductions import SurfaceTables
from synth.simulate.bulk import Bulk
from synth.simulate.space import Space
from synth.simulate.tables import warp_array
from synth.surface import broken_linear_face


@dataclass(frozen=True)
class UnknownRows:
    """See the module's docstring; Warp arrays.

    Attributes:
        free: (rows,) number of the unknown, displacements of all nodes first; -1 where there is none.
        node_row: (n,) first row of a node, -1 where it is held. pressure_row: (k,).
        face_row: (f, ns) first rows of a face's nodes. face_shape: (nq, ns) float32.
        single: tables of the elements.
    """

    free: wp.array
    node_row: wp.array
    pressure_row: wp.array
    face_row: wp.array
    face_shape: wp.array
    single: SingleTables


def number_rows(space: Space, free: np.ndarray, rows: int, bulk: Bulk, device: str) -> UnknownRows:
    """Number the free unknowns (k,), displacements first, of a space in vectors of so many rows.

    Raises:
        ValueError: a node is held in some directions only.
    """
    nodes, element, mixed = len(space.points), space.element, bool(bulk.mixed)
    row = np.full(3 * nodes + (space.pressures if mixed else 0), -1, dtype=np.int32)
    row[free] = np.arange(len(free))
    moving, pressure_row = row[: 3 * nodes].reshape(nodes, 3), row[3 * nodes :]
    if not ((moving >= 0).all(axis=1) | (moving < 0).all(axis=1)).all():
        raise ValueError("a batch needs nodes that are held in all directions or in none")
    padded = np.full(rows, -1, dtype=np.int32)
    padded[: len(free)] = free
    single = SingleTables()
    single.row = warp_array(moving[space.nodes, 0], wp.int32, device)
    empty = np.zeros((0, 4), dtype=np.int32)
    single.pressure_row = warp_array(pressure_row[space.pressure_nodes] if mixed else empty, wp.int32, device)
    single.gradient = warp_array(bulk.gradient.numpy().astype(np.float32), wp.vec3f, device)
    single.pressure_shape = warp_array(element.barycentric.astype(np.float32), wp.float32, device)
    single.stabilisation = warp_array(bulk.stabilisation.numpy().astype(np.float32), wp.float32, device)
    return UnknownRows(
        free=warp_array(padded, wp.int32, device),
        node_row=warp_array(moving[:, 0], wp.int32, device),
        pressure_row=warp_array(pressure_row, wp.int32, device),
        face_row=warp_array(moving[space.faces, 0], wp.int32, device),
        face_shape=warp_array(element.face_shape.astype(np.float32), wp.float32, device),
        single=single,
    )


def surface_tables(space: Space, weight: FloatArray, device: str) -> SurfaceTables:
    """How points of the coated face, of weights (f, nq) in mm², give tractions to its nodes, as in `System.forces`."""
    element, coated, tables = space.element, space.coated, SurfaceTables()
    hat = element.face_shape if element.order == 1 else broken_linear_face(element.face_barycentric)
    number = np.full(space.faces.shape, -1, dtype=np.int32)
    number[coated] = np.searchsorted(space.surface_nodes, space.faces[coated])
    area = np.zeros(len(space.surface_nodes))
    np.add.at(area, number[coated], np.einsum("fq,qa->fa", weight[coated], hat))
    tables.hat = warp_array(hat, wp.float64, device)
    tables.number = warp_array(number, wp.int32, device)
    tables.area = warp_array(area, wp.float64, device)
    return tables
