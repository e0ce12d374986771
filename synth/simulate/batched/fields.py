"""Moves of the lanes' fields between state, iterate, trial and snapshots, and of contact's memory, as Warp kernels."""

import warp as wp

from synth.simulate.batched.lane_orders import Number, Order
from synth.simulate.policy.requests import PATH_DERIVATIVE_STEP

PATH_DERIVATIVES = wp.constant(wp.float64(1.0 / PATH_DERIVATIVE_STEP))
"""The rigid-motion predictor's step over the one that was solved for."""


@wp.struct
class Fields:
    """Values of all unknowns, (B, 3 n + k): three displacements a node in mm, then the pressures in units of E.

    Attributes:
        state, previous: the last two accepted states of the path.
        iterate, trial: of Newton's method and its line search.
        after_step, before_pass: snapshots of the iterate.
    """

    state: wp.array2d(dtype=wp.float64)
    previous: wp.array2d(dtype=wp.float64)
    iterate: wp.array2d(dtype=wp.float64)
    trial: wp.array2d(dtype=wp.float64)
    after_step: wp.array2d(dtype=wp.float64)
    before_pass: wp.array2d(dtype=wp.float64)


@wp.func
def node_value(values: wp.array2d(dtype=wp.float64), s: int, node: int) -> wp.vec3d:
    """A node's part of values (B, 3 n + k)."""
    return wp.vec3d(values[s, 3 * node], values[s, 3 * node + 1], values[s, 3 * node + 2])


@wp.kernel
def compute_trial(
    mask: wp.array(dtype=wp.int32),
    share: wp.array(dtype=wp.float64),
    step: wp.array2d(dtype=wp.float32),
    row: wp.array(dtype=wp.int32),
    fields: Fields,
    residual: wp.array2d(dtype=wp.float64),
    viscous: wp.array2d(dtype=wp.float64),
):
    """One thread per (lane, value): what is evaluated, and zeros for its residual and viscous force.

    That is the iterate and a share of the step (B, rows). row: where a value is in it, -1 where it is held.
    """
    s, i = wp.tid()
    if mask[s] == 0:
        return
    x = fields.iterate[s, i]
    if row[i] >= 0 and share[s] != wp.float64(0.0):
        x += share[s] * wp.float64(step[s, row[i]])
    fields.trial[s, i] = x
    residual[s, i] = wp.float64(0.0)
    viscous[s, i] = wp.float64(0.0)


@wp.kernel
def to_solution(mask: wp.array(dtype=wp.int32), orders: wp.array(dtype=wp.int32), fields: Fields):
    """One thread per (lane, value): the iterate that a solve has ended with, and snapshots of it."""
    s, i = wp.tid()
    if mask[s] == 0:
        return
    order = orders[s]
    x = fields.iterate[s, i]
    if (order & Order.TAKE) != 0:
        x = fields.trial[s, i]
    if (order & (Order.RESTORE_PASS | Order.REPEAT)) != 0:
        x = fields.before_pass[s, i]
    fields.iterate[s, i] = x
    if (order & Order.KEEP_STEP) != 0:
        fields.after_step[s, i] = x
    if (order & Order.KEEP_PASS) != 0:
        fields.before_pass[s, i] = x


@wp.kernel
def to_start(
    mask: wp.array(dtype=wp.int32),
    orders: wp.array(dtype=wp.int32),
    numbers: wp.array2d(dtype=wp.float64),
    step: wp.array2d(dtype=wp.float32),
    row: wp.array(dtype=wp.int32),
    fields: Fields,
):
    """One thread per (lane, value): the end of a step is accepted, and the next one begins.

    step, row: the rigid-motion predictor's, as for `compute_trial`.
    """
    s, i = wp.tid()
    if mask[s] == 0:
        return
    order = orders[s]
    ratio = numbers[s, Number.RATIO]
    x = fields.iterate[s, i]
    if (order & Order.RESTORE_STEP) != 0:
        x = fields.after_step[s, i]
    if (order & Order.ACCEPT) != 0:
        fields.previous[s, i] = fields.state[s, i]
        fields.state[s, i] = x
    if (order & Order.BEGIN) != 0:
        x = fields.state[s, i]
        if ratio != wp.float64(0.0):
            x += ratio * (x - fields.previous[s, i])
    if (order & Order.PREDICT) != 0:
        x = fields.state[s, i]
        if row[i] >= 0:
            x += PATH_DERIVATIVES * wp.float64(step[s, row[i]])
    fields.iterate[s, i] = x


@wp.struct
class ContactMemory:
    """What corrections of a recorded state change of contact, (B, f, nq): see `synth.simulate.contact_friction`.

    gap, tangential: of the last evaluation; the others are arrays of `ContactState`.
    """

    normal: wp.array3d(dtype=wp.float64)
    tangent: wp.array3d(dtype=wp.vec3d)
    anchor: wp.array3d(dtype=wp.vec3d)
    anchored: wp.array3d(dtype=wp.int32)
    gap: wp.array3d(dtype=wp.float64)
    tangential: wp.array3d(dtype=wp.vec3d)


@wp.kernel
def copy_memory(mask: wp.array(dtype=wp.int32), source: ContactMemory, target: ContactMemory):
    """One thread per (lane, face, point): save contact's memory, or restore it."""
    s, f, q = wp.tid()
    if mask[s] == 0:
        return
    target.normal[s, f, q] = source.normal[s, f, q]
    target.tangent[s, f, q] = source.tangent[s, f, q]
    target.anchor[s, f, q] = source.anchor[s, f, q]
    target.anchored[s, f, q] = source.anchored[s, f, q]
    target.gap[s, f, q] = source.gap[s, f, q]
    target.tangential[s, f, q] = source.tangential[s, f, q]
