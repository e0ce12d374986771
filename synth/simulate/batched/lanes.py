"""The state of every lane of a batch: where it is on its load path, and what decides the next step.

A lane is a place in the batch; one trajectory after another runs in it. All lanes go through the same sequence of
kernels, a cycle, and each takes part in those kernels that its phase asks for, so that the host decides nothing within
a trajectory. These are the phases, in the order in which a load step passes through them:

    FRESH             undeformed, to be evaluated once; then FIRST, which stores where the contact points are
    BEGIN             chooses the next target and the first iterate
    PREDICTOR         rigid-motion predictor: the right side of its linear system is evaluated
    PREDICTOR_READY   its system is to be linearised; PREDICTOR_LINEAR: Krylov iterations of it
    START             a first iterate is to be evaluated
    READY             an iterate is to be linearised; LINEAR: Krylov iterations of Newton's method
    SEARCH            a Newton direction is to be tried
    SOLVED, FAILED    the outcome of Newton's method
    AT_RECORD         a step has ended at a recorded state
    CORRECTING        before the next augmented-Lagrangian pass; RESTORED: a failed pass was undone, to be evaluated
    RECORD            a state is to be written down
    ROLLED_BACK       a recorded state did not converge to the full tolerance: the lane is back before the step
    ADVANCE           the step is accepted
    ENDED             waits for the host; IDLE: the lane is empty
"""

import warp as wp

from synth.simulate.contact import Indenters
from synth.simulate.distance import shape_vector
from synth.simulate.policy import requests

IDLE, FRESH, FIRST, BEGIN, PREDICTOR, PREDICTOR_READY, PREDICTOR_LINEAR, START, READY, LINEAR = range(10)
SEARCH, SOLVED, FAILED, AT_RECORD, CORRECTING, RESTORED, RECORD, ADVANCE, ENDED, ROLLED_BACK = range(10, 20)
STEP, CORRECTION, POLISH = range(3)
"""What Newton's method is solving: a load step, a pass at a recorded state, or that state to the full tolerance."""
COMPLETE, NO_EQUILIBRIUM, NO_CONTACT, TOO_DEEP = range(4)
"""Why a trajectory ended."""
TAKE_TRIAL, RESET, RESTORE_RECORDED, REPEAT_RECORDED, ACCEPT, ROLL_BACK = range(1, 7)
"""Moves of a lane's fields: trial to iterate; state to iterate; recorded solution to iterate, with its multipliers or
without; iterate to state; the state before the last to state."""


@wp.struct
class Lanes:
    """One number a lane, (B,).

    Attributes:
        press: the one that runs in it.
        phase, stage: see the module.
        move: what becomes of its fields in this cycle.
        iteration, limit: of the present Newton solve; step_iterations: of the load step; total: since the last record.
        next, at, target, step, previous, has_previous: as in `synth.simulate.policy.load_steps.LoadSteps`.
        ratio: of the extrapolation.
        predicted: whether the first iterate is another than the last state.
        tolerance, scale: of Newton's method and its line search.
        norm, relative, jacobian: of the iterate: norm of the free residual, the same relative to the forces, smallest
            det F.
        trial_norm, trial_force, trial_jacobian: of the trial; trial_moved: of a pass, farthest that a node has gone
            from the solution before it, mm; most_moved: how far it may.
        relaxing: 1 while a step or pass is relaxed (`synth.simulate.policy.newton`), 2 after a refused step of it;
            viscosity: its θ, else 0; part: of the linear step that is tried; trial_error: its error over the residual
            before.
        trial_held_force: norm of the forces on held nodes; held_force: the least that a relaxation must leave of it.
        passes, failures, done, share: of augmented-Lagrangian passes: their number, those that failed, the shares of
            the others together, and the share of the next; new_share: of the one that begins; sharpness: of the
            indenter, before it.
        save: whether contact's memory is saved in this cycle; anchor: whether points that have come to touch are
            anchored for passes.
        deepest: penetration at the last evaluation, mm.
        records: states recorded; reason: why it ended.
    """

    press: wp.array(dtype=wp.int32)
    phase: wp.array(dtype=wp.int32)
    stage: wp.array(dtype=wp.int32)
    move: wp.array(dtype=wp.int32)
    iteration: wp.array(dtype=wp.int32)
    limit: wp.array(dtype=wp.int32)
    step_iterations: wp.array(dtype=wp.int32)
    total: wp.array(dtype=wp.int32)
    next: wp.array(dtype=wp.int32)
    at: wp.array(dtype=wp.float64)
    target: wp.array(dtype=wp.float64)
    step: wp.array(dtype=wp.float64)
    previous: wp.array(dtype=wp.float64)
    has_previous: wp.array(dtype=wp.int32)
    ratio: wp.array(dtype=wp.float64)
    predicted: wp.array(dtype=wp.int32)
    tolerance: wp.array(dtype=wp.float64)
    scale: wp.array(dtype=wp.float64)
    norm: wp.array(dtype=wp.float64)
    relative: wp.array(dtype=wp.float64)
    jacobian: wp.array(dtype=wp.float64)
    trial_norm: wp.array(dtype=wp.float64)
    trial_force: wp.array(dtype=wp.float64)
    trial_jacobian: wp.array(dtype=wp.float64)
    trial_moved: wp.array(dtype=wp.float64)
    most_moved: wp.array(dtype=wp.float64)
    relaxing: wp.array(dtype=wp.int32)
    viscosity: wp.array(dtype=wp.float64)
    part: wp.array(dtype=wp.float64)
    trial_error: wp.array(dtype=wp.float64)
    trial_held_force: wp.array(dtype=wp.float64)
    held_force: wp.array(dtype=wp.float64)
    passes: wp.array(dtype=wp.int32)
    failures: wp.array(dtype=wp.int32)
    sharpness: wp.array(dtype=wp.float64)
    done: wp.array(dtype=wp.float64)
    share: wp.array(dtype=wp.float64)
    new_share: wp.array(dtype=wp.float64)
    save: wp.array(dtype=wp.int32)
    anchor: wp.array(dtype=wp.int32)
    deepest: wp.array(dtype=wp.float64)
    records: wp.array(dtype=wp.int32)
    reason: wp.array(dtype=wp.int32)


@wp.struct
class Presses:
    """Every press's load path and body, (N, ...).

    Attributes:
        corners, ends, legs: `LoadPath.corners` (N, K, 4), `LoadPath.ends` (N, K) and their number.
        waypoints, kind_of, stops: (N, W) path lengths; 0 not recorded, 1 recorded, 2 corrected and recorded; number.
        press_end: path length of the press, mm; deepest: largest depth, at least 0.1 mm.
        over_pad: whether the body comes down on the contact face.
        origin, axes: of `LoadPath.frame`; zeros and the identity for flat pads and domes.
        position, rotation: of the body, as `LoadPath.pose` uses them; reach: the body's less the face's z, mm.
        kind, shape, friction: as `synth.simulate.contact.Indenters`; sharpness: times the contact stiffness, E per mm.
        grid, grids: number of its distance grid among the different ones (g, cells).
    """

    corners: wp.array2d(dtype=wp.vec4d)
    ends: wp.array2d(dtype=wp.float64)
    legs: wp.array(dtype=wp.int32)
    waypoints: wp.array2d(dtype=wp.float64)
    kind_of: wp.array2d(dtype=wp.int32)
    stops: wp.array(dtype=wp.int32)
    press_end: wp.array(dtype=wp.float64)
    deepest: wp.array(dtype=wp.float64)
    over_pad: wp.array(dtype=wp.int32)
    origin: wp.array(dtype=wp.vec3d)
    axes: wp.array(dtype=wp.mat33d)
    position: wp.array(dtype=wp.vec2d)
    reach: wp.array(dtype=wp.float64)
    rotation: wp.array(dtype=wp.mat33d)
    kind: wp.array(dtype=wp.int32)
    shape: wp.array(dtype=shape_vector)
    grid: wp.array(dtype=wp.int32)
    grids: wp.array2d(dtype=wp.float64)
    friction: wp.array(dtype=wp.float64)
    sharpness: wp.array(dtype=wp.float64)


@wp.struct
class Settings:
    """Of all trajectories: numerics of the scene, `synth.simulate.options.SolverOptions`, limits of Newton's method.

    forcing: of the linear residual, relative to the right side, at most; see `synth.simulate.batched.krylov`.
    """

    tolerance: wp.float64
    relaxed_tolerance: wp.float64
    closer: wp.float64
    longest: wp.float64
    limit: int
    correction_limit: int
    extrapolate: int
    forcing: wp.float32


def bits(*phases: int) -> int:
    """A set of phases."""
    return sum(1 << phase for phase in phases)


@wp.kernel
def select(lanes: Lanes, phases: int, mask: wp.array(dtype=wp.int32)):
    """1 for lanes whose phase is in the set."""
    s = wp.tid()
    mask[s] = (phases >> lanes.phase[s]) & 1


STICK_FRICTION = wp.constant(wp.float64(requests.STICK_FRICTION))
PATH_DERIVATIVE_STEP = wp.constant(wp.float64(requests.PATH_DERIVATIVE_STEP))


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
