"""Moves of the lanes' fields between state, iterate, trial and snapshots, and of contact's memory, as Warp kernels."""

from typing import Any

import warp as wp

from synth.simulate.batched.lane_orders import Number, Order
from synth.simulate.contact_friction import FAR, ContactState


@wp.struct
class Fields:
    """Displacement (B, n) mm and pressure (B, k) in units of E.

    Attributes:
        state, previous: the last two accepted states of the path.
        iterate, trial: of Newton's method and its line search.
        after_step, before_pass: snapshots of the iterate.
    """

    state_u: wp.array2d(dtype=wp.vec3d)
    state_p: wp.array2d(dtype=wp.float64)
    previous_u: wp.array2d(dtype=wp.vec3d)
    previous_p: wp.array2d(dtype=wp.float64)
    iterate_u: wp.array2d(dtype=wp.vec3d)
    iterate_p: wp.array2d(dtype=wp.float64)
    trial_u: wp.array2d(dtype=wp.vec3d)
    trial_p: wp.array2d(dtype=wp.float64)
    after_step_u: wp.array2d(dtype=wp.vec3d)
    after_step_p: wp.array2d(dtype=wp.float64)
    before_pass_u: wp.array2d(dtype=wp.vec3d)
    before_pass_p: wp.array2d(dtype=wp.float64)


@wp.kernel
def clear_fields(mask: wp.array(dtype=wp.int32), fields: Fields):
    """One thread per (lane, node and then pressure): the undeformed state in fresh lanes."""
    s, i = wp.tid()
    if mask[s] == 0:
        return
    count = fields.state_u.shape[1]
    if i < count:
        fields.state_u[s, i] = wp.vec3d()
        fields.previous_u[s, i] = wp.vec3d()
    else:
        fields.state_p[s, i - count] = wp.float64(0.0)
        fields.previous_p[s, i - count] = wp.float64(0.0)


@wp.func
def node_step(step: wp.array2d(dtype=wp.float32), s: int, row: int) -> wp.vec3d:
    """A node's part of a step (B, rows), from its first row on."""
    return wp.vec3d(wp.float64(step[s, row]), wp.float64(step[s, row + 1]), wp.float64(step[s, row + 2]))


@wp.kernel
def compute_trial(
    orders: wp.array(dtype=wp.int32),
    numbers: wp.array2d(dtype=wp.float64),
    found: wp.array(dtype=wp.int32),
    mask: wp.array(dtype=wp.int32),
    step: wp.array2d(dtype=wp.float32),
    node_row: wp.array(dtype=wp.int32),
    pressure_row: wp.array(dtype=wp.int32),
    fields: Fields,
    force: wp.array2d(dtype=wp.vec3d),
    viscous: wp.array2d(dtype=wp.vec3d),
    volume: wp.array2d(dtype=wp.float64),
):
    """One thread per (lane, node and then pressure): what is evaluated, and zeros for its residual and viscous force.

    That is the iterate; a share of the step further where it is tried, all of it where it was found in this cycle.
    step: (B, rows); node_row: first row of a node's displacement or -1 where it is held.
    """
    s, i = wp.tid()
    if mask[s] == 0:
        return
    scale = wp.float64(0.0)
    if (orders[s] & Order.TRY) != 0:
        scale = numbers[s, Number.SHARE]
    if found[s] == 1:
        scale = wp.float64(1.0)
    count = fields.state_u.shape[1]
    if i < count:
        u = fields.iterate_u[s, i]
        row = node_row[i]
        if row >= 0 and scale != wp.float64(0.0):
            u += scale * node_step(step, s, row)
        fields.trial_u[s, i] = u
        force[s, i] = wp.vec3d()
        viscous[s, i] = wp.vec3d()
    else:
        k = i - count
        p = fields.iterate_p[s, k]
        if scale != wp.float64(0.0):
            p += scale * wp.float64(step[s, pressure_row[k]])
        fields.trial_p[s, k] = p
        volume[s, k] = wp.float64(0.0)


@wp.kernel
def apply_predictor(
    mask: wp.array(dtype=wp.int32),
    share: wp.float64,
    step: wp.array2d(dtype=wp.float32),
    node_row: wp.array(dtype=wp.int32),
    pressure_row: wp.array(dtype=wp.int32),
    fields: Fields,
):
    """One thread per (lane, node and then pressure): the first iterate, the state and 1/share times step."""
    s, i = wp.tid()
    if mask[s] == 0:
        return
    count = fields.state_u.shape[1]
    if i < count:
        row = node_row[i]
        u = fields.state_u[s, i]
        if row >= 0:
            u += (wp.float64(1.0) / share) * node_step(step, s, row)
        fields.iterate_u[s, i] = u
    else:
        k = i - count
        p = fields.state_p[s, k] + (wp.float64(1.0) / share) * wp.float64(step[s, pressure_row[k]])
        fields.iterate_p[s, k] = p


@wp.func
def _to_solution(
    order: int,
    s: int,
    i: int,
    iterate: wp.array2d(dtype=Any),
    trial: wp.array2d(dtype=Any),
    after_step: wp.array2d(dtype=Any),
    before_pass: wp.array2d(dtype=Any),
):
    x = iterate[s, i]
    if (order & Order.TAKE) != 0:
        x = trial[s, i]
    if (order & (Order.RESTORE_PASS | Order.REPEAT)) != 0:
        x = before_pass[s, i]
    iterate[s, i] = x
    if (order & Order.KEEP_STEP) != 0:
        after_step[s, i] = x
    if (order & Order.KEEP_PASS) != 0:
        before_pass[s, i] = x


@wp.kernel
def to_solution(mask: wp.array(dtype=wp.int32), orders: wp.array(dtype=wp.int32), f: Fields):
    """One thread per (lane, node and then pressure): the iterate that a solve has ended with, and snapshots of it."""
    s, i = wp.tid()
    if mask[s] == 0:
        return
    order = orders[s]
    count = f.state_u.shape[1]
    if i < count:
        _to_solution(order, s, i, f.iterate_u, f.trial_u, f.after_step_u, f.before_pass_u)
    else:
        _to_solution(order, s, i - count, f.iterate_p, f.trial_p, f.after_step_p, f.before_pass_p)


@wp.func
def _to_start(
    order: int,
    ratio: wp.float64,
    s: int,
    i: int,
    state: wp.array2d(dtype=Any),
    previous: wp.array2d(dtype=Any),
    iterate: wp.array2d(dtype=Any),
    after_step: wp.array2d(dtype=Any),
):
    x = iterate[s, i]
    if (order & Order.RESTORE_STEP) != 0:
        x = after_step[s, i]
    if (order & Order.ACCEPT) != 0:
        previous[s, i] = state[s, i]
        state[s, i] = x
    if (order & Order.BEGIN) != 0:
        x = state[s, i]
        if ratio != wp.float64(0.0):
            x += ratio * (x - previous[s, i])
    iterate[s, i] = x


@wp.kernel
def to_start(
    mask: wp.array(dtype=wp.int32), orders: wp.array(dtype=wp.int32), numbers: wp.array2d(dtype=wp.float64), f: Fields
):
    """One thread per (lane, node and then pressure): the end of a step is accepted, and the next one begins."""
    s, i = wp.tid()
    if mask[s] == 0:
        return
    order = orders[s]
    count, ratio = f.state_u.shape[1], numbers[s, Number.RATIO]
    if i < count:
        _to_start(order, ratio, s, i, f.state_u, f.previous_u, f.iterate_u, f.after_step_u)
    else:
        _to_start(order, ratio, s, i - count, f.state_p, f.previous_p, f.iterate_p, f.after_step_p)


@wp.kernel
def clear_contact(mask: wp.array(dtype=wp.int32), contact: ContactState):
    """One thread per (lane, face, point): nothing touched before in a fresh lane, not even what touches at once."""
    s, f, q = wp.tid()
    if mask[s] == 0:
        return
    contact.normal[s, f, q] = wp.float64(0.0)
    contact.tangent[s, f, q] = wp.vec3d()
    contact.anchored[s, f, q] = 0
    contact.gap[s, f, q] = FAR


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


@wp.kernel
def copy_multipliers(
    mask: wp.array(dtype=wp.int32),
    normal: wp.array3d(dtype=wp.float64),
    tangent: wp.array3d(dtype=wp.vec3d),
    to_normal: wp.array3d(dtype=wp.float64),
    to_tangent: wp.array3d(dtype=wp.vec3d),
):
    """One thread per (lane, face, point): before a pass, or after one that failed."""
    s, f, q = wp.tid()
    if mask[s] == 1:
        to_normal[s, f, q] = normal[s, f, q]
        to_tangent[s, f, q] = tangent[s, f, q]
