"""Where each slot's indenter is, and which, as Warp kernels: `synth.simulate.load_path` on the device."""

# Kernels are written in Warp's own language; their annotations only look like Python's.
# mypy: disable-error-code="valid-type, no-untyped-def"

import warp as wp

from synth.simulate import stepping
from synth.simulate.batched.slots import CARRY_READY, FRESH, IDLE, NUDGED, Jobs, Settings, Slots
from synth.simulate.contact import Indenters
from synth.simulate.distance import shape_vector

wp.set_module_options({"enable_backward": False, "fast_math": False})

STUCK = wp.constant(wp.float64(stepping.STICK_FRICTION))
NUDGE = wp.constant(wp.float64(stepping.PATH_DERIVATIVE_STEP))


@wp.func
def _corner(jobs: Jobs, j: int, s: wp.float64) -> wp.vec4d:
    """Depth, shear and twist at path length s, as `numpy.interp` finds them."""
    last = jobs.legs[j] - 1
    if s <= jobs.ends[j, 0]:
        return jobs.corners[j, 0]
    if s >= jobs.ends[j, last]:
        return jobs.corners[j, last]
    k = wp.int32(0)
    while jobs.ends[j, k + 1] <= s:
        k += 1
    a = jobs.corners[j, k]
    b = jobs.corners[j, k + 1]
    return (s - jobs.ends[j, k]) / (jobs.ends[j, k + 1] - jobs.ends[j, k]) * (b - a) + a


@wp.kernel
def place(slots: Slots, jobs: Jobs, indenters: Indenters):
    """Each slot's indenter at its target; on the way to a carried first iterate near its last state, and stuck."""
    i = wp.tid()
    phase = slots.phase[i]
    if phase == IDLE:
        return
    j = slots.job[i]
    at = slots.target[i]
    friction = jobs.friction[j]
    if phase == FRESH:
        at = wp.float64(0.0)
    if phase == NUDGED:
        at = slots.at[i] + NUDGE * (slots.target[i] - slots.at[i])
        friction = STUCK
    if phase == CARRY_READY:
        at = slots.at[i]
        friction = STUCK
    pose = _corner(jobs, j, at)
    place = jobs.position[j]
    indenters.centre[i] = wp.vec3d(place[0] + pose[1], place[1] + pose[2], pose[0] - jobs.reach[j])
    zero = wp.float64(0.0)
    angle = pose[3] * (wp.float64(3.14159265358979323846) / wp.float64(180.0))
    c = wp.cos(angle)
    n = wp.sin(angle)
    turn = wp.mat33d(c, -n, zero, n, c, zero, zero, zero, wp.float64(1.0))
    indenters.rotation[i] = turn * jobs.rotation[j]
    indenters.friction[i] = friction


@wp.kernel
def refill(
    assignment: wp.array(dtype=wp.int32),
    jobs: Jobs,
    shapes: wp.array(dtype=shape_vector),
    settings: Settings,
    slots: Slots,
    indenters: Indenters,
):
    """A new trajectory in each slot that is assigned one (-1: none; -2: none, and the slot is empty)."""
    s = wp.tid()
    j = assignment[s]
    if j == -2:
        slots.phase[s] = IDLE
    if j < 0:
        return
    slots.job[s] = j
    slots.phase[s] = FRESH
    slots.move[s] = 0
    slots.next[s] = 0
    slots.at[s] = wp.float64(0.0)
    slots.target[s] = wp.float64(0.0)
    slots.step[s] = settings.longest
    slots.has_previous[s] = 0
    slots.total[s] = 0
    slots.keep[s] = 0
    slots.kept[s] = 0
    slots.records[s] = 0
    slots.relaxing[s] = 0
    slots.viscosity[s] = wp.float64(0.0)
    indenters.kind[s] = jobs.kind[j]
    indenters.shape[s] = shapes[j]
    indenters.sharpness[s] = jobs.sharpness[j]


@wp.kernel
def take_grids(
    assignment: wp.array(dtype=wp.int32), jobs: Jobs, grids: wp.array2d(dtype=wp.float64), indenters: Indenters
):
    """The distance grids of mesh indenters that begin; grids: (g, cells) in the order of the slot's grid."""
    s, i = wp.tid()
    j = assignment[s]
    if j < 0:
        return
    y = indenters.coefficients.shape[2]
    z = indenters.coefficients.shape[3]
    indenters.coefficients[s, i // (y * z), (i // z) % y, i % z] = grids[jobs.grid[j], i]
