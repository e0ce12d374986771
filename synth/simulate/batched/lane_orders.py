"""Orders to the lanes of a batch, and the indenters that they move.

A lane is a place in the batch; one press after another runs in it, led by its own step policy on the host. What the
policies of all lanes want of a cycle is gathered into one set of bits and one row of numbers a lane, so that a kernel
is launched once for all lanes that want the same. The order in which a cycle does what it is told is that of the bits.
"""

from enum import IntEnum

import warp as wp

from synth.simulate.contact_friction import Indenters
from synth.simulate.policy import requests


class Order:
    """What a lane is to do in a cycle, in this order; see `synth.simulate.policy.requests`.

    Integers, since Python takes long to combine flags of an Enum.
    """

    TAKE = 1 << 0
    RESTORE_PASS = 1 << 1  # the iterate and its multipliers
    REPEAT = 1 << 2
    KEEP_STEP = 1 << 3
    KEEP_PASS = 1 << 4
    ANCHOR = 1 << 5
    FORCE = 1 << 6
    RECORD = 1 << 7
    RESTORE_STEP = 1 << 8
    ACCEPT = 1 << 9
    AUGMENT = 1 << 10
    BEGIN = 1 << 11  # the iterate is the last state, extrapolated
    PREDICT = 1 << 12  # the iterate is the last state, moved by the rigid-motion predictor
    SOLVE = 1 << 13
    STICKING = 1 << 14  # where nothing slides
    EVALUATE = 1 << 15
    TRY = 1 << 16  # evaluates a share of the direction further; a direction that is found is tried in its cycle


class Number(IntEnum):
    """Columns of the numbers that go with orders."""

    AT, RATIO, SHARE, VISCOSITY, TURN, STIFFNESS, NORM, GOAL, RECORD = range(9)


class Seen(IntEnum):
    """Columns of what a lane answers with: an Evaluation, a linear solve, and from FORCE on sums over what touches.

    Those are force (3), moment (3), touching and slipping area.
    """

    FREE, FORCES, REACTION, JACOBIAN, DEEPEST, MOVED, ERROR, DONE, FINITE, FORCE = range(10)


@wp.struct
class Presses:
    """The load path and body of each lane's press, (B, ...).

    Attributes:
        corners, ends: `LoadPath.corners` (B, K, 4) and `LoadPath.ends` (B, K), infinite behind the last corner.
        origin, axes: of `LoadPath.frame`; zeros and the identity for flat pads and domes.
        position, rotation: of the body, as `LoadPath.pose` uses them; reach: the body's less the face's z, mm.
        friction: as `synth.simulate.contact_friction.Indenters`.
    """

    corners: wp.array2d(dtype=wp.vec4d)
    ends: wp.array2d(dtype=wp.float64)
    origin: wp.array(dtype=wp.vec3d)
    axes: wp.array(dtype=wp.mat33d)
    position: wp.array(dtype=wp.vec2d)
    reach: wp.array(dtype=wp.float64)
    rotation: wp.array(dtype=wp.mat33d)
    friction: wp.array(dtype=wp.float64)


@wp.kernel
def select(orders: wp.array(dtype=wp.int32), wanted: int, mask: wp.array(dtype=wp.int32)):
    """1 for lanes with any of the wanted orders."""
    s = wp.tid()
    mask[s] = wp.where((orders[s] & wanted) != 0, 1, 0)


STICK_FRICTION = wp.constant(wp.float64(requests.STICK_FRICTION))


@wp.func
def _corner(presses: Presses, j: int, s: wp.float64) -> wp.vec4d:
    """Depth, shear and twist at path length s, as `numpy.interp` finds them."""
    k = wp.int32(0)
    while presses.ends[j, k + 1] <= s:
        k += 1
    a = presses.corners[j, k]
    b = presses.corners[j, k + 1]
    return (s - presses.ends[j, k]) / (presses.ends[j, k + 1] - presses.ends[j, k]) * (b - a) + a


@wp.kernel
def place_indenters(
    orders: wp.array(dtype=wp.int32),
    numbers: wp.array2d(dtype=wp.float64),
    presses: Presses,
    indenters: Indenters,
):
    """Each lane's indenter where it is to be, and its friction."""
    i = wp.tid()
    pose = _corner(presses, i, numbers[i, Number.AT])
    place = presses.position[i]
    local = wp.vec3d(place[0] + pose[1], place[1] + pose[2], pose[0] - presses.reach[i])
    indenters.centre[i] = presses.origin[i] + presses.axes[i] * local
    zero = wp.float64(0.0)
    angle = pose[3] * (wp.float64(3.14159265358979323846) / wp.float64(180.0))
    c = wp.cos(angle)
    n = wp.sin(angle)
    turn = wp.mat33d(c, -n, zero, n, c, zero, zero, zero, wp.float64(1.0))
    indenters.rotation[i] = presses.axes[i] * (turn * presses.rotation[i])
    indenters.friction[i] = presses.friction[i]
    if (orders[i] & Order.STICKING) != 0:
        indenters.friction[i] = STICK_FRICTION
