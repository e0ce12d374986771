"""Pose and body of each lane's indenter, as Warp kernels: `synth.simulate.load_path` on the device."""

import warp as wp

from synth.simulate import stepping
from synth.simulate.batched.lanes import FRESH, IDLE, PREDICTOR, PREDICTOR_READY, Lanes, Presses, Settings
from synth.simulate.contact import Indenters

wp.set_module_options({"enable_backward": False, "fast_math": False})

STICK_FRICTION = wp.constant(wp.float64(stepping.STICK_FRICTION))
PATH_DERIVATIVE_STEP = wp.constant(wp.float64(stepping.PATH_DERIVATIVE_STEP))


@wp.func
def _corner(presses: Presses, j: int, s: wp.float64) -> wp.vec4d:
    """Depth, shear and twist at path length s, as `numpy.interp` finds them."""
    last = presses.legs[j] - 1
    if s <= presses.ends[j, 0]:
        return presses.corners[j, 0]
    if s >= presses.ends[j, last]:
        return presses.corners[j, last]
    k = wp.int32(0)
    while presses.ends[j, k + 1] <= s:
        k += 1
    a = presses.corners[j, k]
    b = presses.corners[j, k + 1]
    return (s - presses.ends[j, k]) / (presses.ends[j, k + 1] - presses.ends[j, k]) * (b - a) + a


@wp.kernel
def place_indenters(lanes: Lanes, presses: Presses, indenters: Indenters):
    """Each lane's indenter at its target; for a predictor near its last state, where it does not slip."""
    i = wp.tid()
    phase = lanes.phase[i]
    if phase == IDLE:
        return
    j = lanes.press[i]
    at = lanes.target[i]
    friction = presses.friction[j]
    if phase == FRESH:
        at = wp.float64(0.0)
    if phase == PREDICTOR:
        at = lanes.at[i] + PATH_DERIVATIVE_STEP * (lanes.target[i] - lanes.at[i])
        friction = STICK_FRICTION
    if phase == PREDICTOR_READY:
        at = lanes.at[i]
        friction = STICK_FRICTION
    pose = _corner(presses, j, at)
    place = presses.position[j]
    local = wp.vec3d(place[0] + pose[1], place[1] + pose[2], pose[0] - presses.reach[j])
    indenters.centre[i] = presses.origin[j] + presses.axes[j] * local
    zero = wp.float64(0.0)
    angle = pose[3] * (wp.float64(3.14159265358979323846) / wp.float64(180.0))
    c = wp.cos(angle)
    n = wp.sin(angle)
    turn = wp.mat33d(c, -n, zero, n, c, zero, zero, zero, wp.float64(1.0))
    indenters.rotation[i] = presses.axes[j] * (turn * presses.rotation[j])
    indenters.friction[i] = friction


@wp.kernel
def fill_lanes(
    assignment: wp.array(dtype=wp.int32), presses: Presses, settings: Settings, lanes: Lanes, indenters: Indenters
):
    """A new trajectory in each lane that is assigned one (-1: none; -2: none, and the lane is empty)."""
    s = wp.tid()
    j = assignment[s]
    if j == -2:
        lanes.phase[s] = IDLE
    if j < 0:
        return
    lanes.press[s] = j
    lanes.phase[s] = FRESH
    lanes.move[s] = 0
    lanes.next[s] = 0
    lanes.at[s] = wp.float64(0.0)
    lanes.target[s] = wp.float64(0.0)
    lanes.step[s] = settings.longest
    lanes.has_previous[s] = 0
    lanes.total[s] = 0
    lanes.save[s] = 0
    lanes.records[s] = 0
    lanes.relaxing[s] = 0
    lanes.viscosity[s] = wp.float64(0.0)
    indenters.kind[s] = presses.kind[j]
    indenters.shape[s] = presses.shape[j]
    indenters.sharpness[s] = presses.sharpness[j]


@wp.kernel
def copy_grids(assignment: wp.array(dtype=wp.int32), presses: Presses, indenters: Indenters):
    """One thread per (lane, cell): the distance grids of mesh indenters that begin."""
    s, i = wp.tid()
    j = assignment[s]
    if j < 0:
        return
    y = indenters.coefficients.shape[2]
    z = indenters.coefficients.shape[3]
    indenters.coefficients[s, i // (y * z), (i // z) % y, i % z] = presses.grids[presses.grid[j], i]
