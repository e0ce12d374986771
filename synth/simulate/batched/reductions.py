"""Sums over a lane's nodes and faces, as Warp kernels: norms of the residual, forces, and what a record holds."""

import warp as wp

from synth.simulate.batched.fields import Fields, node_value
from synth.simulate.batched.lane_orders import Number, Seen
from synth.simulate.contact_friction import Faces, Indenters, position

BLOCK = 256
"""Threads that sum a lane's residual."""
SLIPS = wp.constant(wp.float64(1.0 - 1.0e-6))
"""Share of the friction limit from which a point counts as slipping, as in `System.slip_ratio`."""
SCALARS = wp.constant(8)
"""A record's numbers before its fields: force (3), moment (3), touching and slipping area."""


@wp.struct
class SurfaceTables:
    """See `synth.simulate.tables.nodal_weights`."""

    hat: wp.array2d(dtype=wp.float64)
    number: wp.array2d(dtype=wp.int32)
    area: wp.array(dtype=wp.float64)


@wp.kernel
def evaluations(
    mask: wp.array(dtype=wp.int32),
    residual: wp.array2d(dtype=wp.float64),
    viscous: wp.array2d(dtype=wp.float64),
    nodes: int,
    jacobian: wp.array2d(dtype=wp.float64),
    gap: wp.array2d(dtype=wp.float64),
    row: wp.array(dtype=wp.int32),
    fields: Fields,
    right: wp.array2d(dtype=wp.float32),
    share: wp.array(dtype=wp.float64),
    numbers: wp.array2d(dtype=wp.float64),
    seen: wp.array2d(dtype=wp.float64),
):
    """One block per lane: what an Evaluation holds, see `synth.simulate.policy.requests`.

    Its error is the norm of r(u + t δ) - (1 - t) r(u) + t θ L δ over that of r(u). gap: (B, points); row: of each value
    in Krylov vectors, -1 where it is held; right: (B, at least rows), first -r(u) over its norm, the linear solve's
    right side.
    """
    s, thread = wp.tid()
    if mask[s] == 0:
        return
    left = (wp.float64(1.0) - share[s]) * numbers[s, Number.NORM]
    free = wp.float64(0.0)
    whole = wp.float64(0.0)
    held = wp.float64(0.0)
    missed = wp.float64(0.0)
    smallest = wp.float64(1.0e30)
    farthest = wp.float64(0.0)
    deepest = wp.float64(0.0)
    for i in range(thread, nodes, wp.block_dim()):
        moved = node_value(fields.trial, s, i) - node_value(fields.before_pass, s, i)
        farthest = wp.max(farthest, wp.length_sq(moved))
        force = node_value(residual, s, i)
        square = wp.length_sq(force)
        whole += square
        first = row[3 * i]
        if first >= 0:
            free += square
            before = wp.vec3d(wp.vec3f(right[s, first], right[s, first + 1], right[s, first + 2]))
            missed += wp.length_sq(force + node_value(viscous, s, i) + left * before)
        else:
            held += square
    for i in range(3 * nodes + thread, residual.shape[1], wp.block_dim()):
        free += residual[s, i] * residual[s, i]
        rest = residual[s, i] + left * wp.float64(right[s, row[i]])
        missed += rest * rest
    for i in range(thread, jacobian.shape[1], wp.block_dim()):
        smallest = wp.min(smallest, jacobian[s, i])
    for i in range(thread, gap.shape[1], wp.block_dim()):
        deepest = wp.max(deepest, -gap[s, i])
    free = wp.tile_extract(wp.tile_sum(wp.tile(free)), 0)
    whole = wp.tile_extract(wp.tile_sum(wp.tile(whole)), 0)
    held = wp.tile_extract(wp.tile_sum(wp.tile(held)), 0)
    missed = wp.tile_extract(wp.tile_sum(wp.tile(missed)), 0)
    smallest = wp.tile_extract(wp.tile_min(wp.tile(smallest)), 0)
    farthest = wp.tile_extract(wp.tile_max(wp.tile(farthest)), 0)
    deepest = wp.tile_extract(wp.tile_max(wp.tile(deepest)), 0)
    if thread == 0:
        seen[s, Seen.FREE] = wp.sqrt(free)
        seen[s, Seen.FORCES] = wp.sqrt(whole)
        seen[s, Seen.REACTION] = wp.sqrt(held)
        seen[s, Seen.JACOBIAN] = smallest
        seen[s, Seen.MOVED] = wp.sqrt(farthest)
        seen[s, Seen.DEEPEST] = deepest
        seen[s, Seen.ERROR] = wp.sqrt(missed) / numbers[s, Number.NORM]


@wp.kernel
def contact_forces(
    mask: wp.array(dtype=wp.int32),
    u: wp.array2d(dtype=wp.vec3d),
    faces: Faces,
    indenters: Indenters,
    traction: wp.array3d(dtype=wp.vec3d),
    tangential: wp.array3d(dtype=wp.vec3d),
    sums: wp.array2d(dtype=wp.float64),
):
    """One thread per (lane, face): adds the indenter's force, moment about the origin, touching and slipping area."""
    s, f = wp.tid()
    if mask[s] == 0:
        return
    zero = wp.float64(0.0)
    force = wp.vec3d()
    moment = wp.vec3d()
    touching = zero
    slipping = zero
    for q in range(traction.shape[2]):
        t = traction[s, f, q]
        square = wp.length_sq(t)
        if square > zero:
            w = faces.weight[f, q]
            force += w * t
            moment += w * wp.cross(position(faces, u, s, f, q), t)
            along = wp.length(tangential[s, f, q])
            pressure = wp.sqrt(wp.max(square - along * along, zero))
            if pressure > zero:
                touching += w
                if along >= SLIPS * (indenters.friction[s] * pressure):
                    slipping += w
    if touching == zero:
        return
    for i in range(3):
        wp.atomic_add(sums, s, i, force[i])
        wp.atomic_add(sums, s, 3 + i, moment[i])
    wp.atomic_add(sums, s, 6, touching)
    wp.atomic_add(sums, s, 7, slipping)


@wp.kernel
def write_record(
    mask: wp.array(dtype=wp.int32),
    numbers: wp.array2d(dtype=wp.float64),
    iterate: wp.array2d(dtype=wp.float64),
    nodes: int,
    sums: wp.array2d(dtype=wp.float64),
    records: wp.array3d(dtype=wp.float64),
):
    """One thread per (lane, number of a record): its scalars and displacement, and zeros for its tractions.

    records: (B, R, SCALARS + 3 n + 3 surface): force, moment, areas, then the displacement of all nodes and the
    traction at the surface's nodes.
    """
    s, i = wp.tid()
    if mask[s] == 0:
        return
    r = int(numbers[s, Number.RECORD])
    if i < SCALARS:
        records[s, r, i] = sums[s, i]
    elif i < SCALARS + 3 * nodes:
        records[s, r, i] = iterate[s, i - SCALARS]
    else:
        records[s, r, i] = wp.float64(0.0)


@wp.kernel
def write_tractions(
    mask: wp.array(dtype=wp.int32),
    numbers: wp.array2d(dtype=wp.float64),
    faces: Faces,
    surface: SurfaceTables,
    traction: wp.array3d(dtype=wp.vec3d),
    nodes: int,
    records: wp.array3d(dtype=wp.float64),
):
    """One thread per (lane, face): adds its share to the tractions at the surface's nodes, see `System.forces`."""
    s, f = wp.tid()
    if mask[s] == 0 or surface.number[f, 0] < 0:
        return
    r = int(numbers[s, Number.RECORD])
    for a in range(surface.number.shape[1]):
        share = wp.vec3d()
        for q in range(surface.hat.shape[0]):
            share += (faces.weight[f, q] * surface.hat[q, a]) * traction[s, f, q]
        node = surface.number[f, a]
        if wp.length_sq(share) > wp.float64(0.0):
            for k in range(3):
                wp.atomic_add(records, s, r, SCALARS + 3 * nodes + 3 * node + k, share[k] / surface.area[node])
