"""The state of every slot of a batch: which step of its trajectory it is at, and what decides the next.

A slot is a place in the batch; one trajectory after another runs in it. All slots go through the same sequence of
kernels, a cycle, and each takes part in those kernels that its phase asks for, so that the host decides nothing within
a trajectory. Phases, in the order in which a load step passes through them:

    FRESH        undeformed, to be evaluated once; then FIRST, which remembers where the contact points are
    BEGIN        chooses the next target and the first iterate
    NUDGED       first iterate carried along with the indenter: the right side of its linear system is evaluated
    CARRY_READY  ... and linearised; CARRY: Krylov iterations of that system
    START        a first iterate to be evaluated
    READY        to be linearised; LINEAR: Krylov iterations of Newton's method
    SEARCH       a Newton direction to be tried
    SOLVED, LOST the outcome of Newton's method
    TOUCHED      a step that ends at a recorded state
    PASSING      before the next augmented-Lagrangian pass; REPAIR: a failed pass was undone, to be evaluated
    RECORD       a state to be written down
    BACK         no balance to the full tolerance at a recorded state: goes back to before the step
    ADVANCE      the step is accepted
    ENDED        waits for the host; IDLE: empty
"""

# Kernels are written in Warp's own language; their annotations only look like Python's.
# mypy: disable-error-code="valid-type, no-untyped-def"

import warp as wp

IDLE = wp.constant(0)
FRESH = wp.constant(1)
FIRST = wp.constant(2)
BEGIN = wp.constant(3)
NUDGED = wp.constant(4)
CARRY_READY = wp.constant(5)
CARRY = wp.constant(6)
START = wp.constant(7)
READY = wp.constant(8)
LINEAR = wp.constant(9)
SEARCH = wp.constant(10)
SOLVED = wp.constant(11)
LOST = wp.constant(12)
TOUCHED = wp.constant(13)
PASSING = wp.constant(14)
REPAIR = wp.constant(15)
RECORD = wp.constant(16)
ADVANCE = wp.constant(17)
ENDED = wp.constant(18)
BACK = wp.constant(19)

STEP, PASS, POLISH = wp.constant(0), wp.constant(1), wp.constant(2)
"""What Newton's method is solving: a load step, a pass at a recorded state, or that state to the full tolerance."""
RELAXING, RELAXED = wp.constant(1), wp.constant(2)
COMPLETE, NO_BALANCE, NO_CONTACT = wp.constant(0), wp.constant(1), wp.constant(2)
"""Why a trajectory ended."""
TAKE, FALL_BACK, UNDO, ACCEPT = wp.constant(1), wp.constant(2), wp.constant(3), wp.constant(4)
REVERT = wp.constant(5)
"""Moves of a slot's fields: trial to iterate; state to iterate; recorded solution to iterate; iterate to state; the
state before the last to state."""


@wp.struct
class Slots:
    """One number a slot, (B,).

    Attributes:
        job: the trajectory that runs in it.
        phase, stage: see the module.
        move: what becomes of its fields in this cycle.
        iteration, limit: of the present Newton solve; eased: of the load step's; total: since the last record.
        next, at, target, step, previous, has_previous: as `synth.simulate.stepping`'s samples.
        ratio: of the extrapolation.
        predicted: whether the first iterate is another than the last state.
        tolerance, scale: of Newton's method and its line search.
        norm, relative, jacobian: of the iterate: norm of the free residual, the same relative to the forces, smallest
            det F.
        trial_norm, trial_force, trial_jacobian: of the trial; trial_moved: of a pass, farthest that a node has gone
            from the solution before it, mm; most_moved: how far it may.
        relaxing: RELAXING while a step is relaxed (`synth.simulate.relaxation`), RELAXED when it was; viscosity: θ of
            the relaxation, else 0; trial_error: of its step, in units of the residual before; trial_borne, borne: norm
            of the forces on held nodes, and what it must leave of that.
        failures, done, share: of augmented-Lagrangian passes: those that failed, the shares of the others together, and
            the share of the next; share_now: of the one that begins. While relaxing, share is that of a step.
        keep: whether contact's memory is put aside in this cycle; kept: whether it is put aside; anchor: whether points
            that have come to touch are anchored for passes.
        deepest: penetration at the last evaluation, mm.
        records: states recorded; reason: why it ended.
    """

    job: wp.array(dtype=wp.int32)
    phase: wp.array(dtype=wp.int32)
    stage: wp.array(dtype=wp.int32)
    move: wp.array(dtype=wp.int32)
    iteration: wp.array(dtype=wp.int32)
    limit: wp.array(dtype=wp.int32)
    eased: wp.array(dtype=wp.int32)
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
    trial_error: wp.array(dtype=wp.float64)
    trial_borne: wp.array(dtype=wp.float64)
    borne: wp.array(dtype=wp.float64)
    failures: wp.array(dtype=wp.int32)
    done: wp.array(dtype=wp.float64)
    share: wp.array(dtype=wp.float64)
    share_now: wp.array(dtype=wp.float64)
    keep: wp.array(dtype=wp.int32)
    kept: wp.array(dtype=wp.int32)
    anchor: wp.array(dtype=wp.int32)
    deepest: wp.array(dtype=wp.float64)
    records: wp.array(dtype=wp.int32)
    reason: wp.array(dtype=wp.int32)


@wp.struct
class Jobs:
    """Every trajectory's way and body, (N, ...).

    Attributes:
        corners, ends, legs: `Path.corners` (N, K, 4), `Path.ends` (N, K) and their number.
        waypoints, kind_of, stops: (N, W) path lengths; 0 not recorded, 1 recorded, 2 corrected and recorded; number.
        press: path length of the press, mm; deepest: largest depth, at least 0.1 mm.
        over_pad: whether the body comes down on the contact face.
        position, reach, rotation: of the body, as `Path.pose` uses them.
        kind, grid, friction, sharpness: as `synth.simulate.contact.Indenters`; grid: number of its distance grid.
    """

    corners: wp.array2d(dtype=wp.vec4d)
    ends: wp.array2d(dtype=wp.float64)
    legs: wp.array(dtype=wp.int32)
    waypoints: wp.array2d(dtype=wp.float64)
    kind_of: wp.array2d(dtype=wp.int32)
    stops: wp.array(dtype=wp.int32)
    press: wp.array(dtype=wp.float64)
    deepest: wp.array(dtype=wp.float64)
    over_pad: wp.array(dtype=wp.int32)
    position: wp.array(dtype=wp.vec2d)
    reach: wp.array(dtype=wp.float64)
    rotation: wp.array(dtype=wp.mat33d)
    kind: wp.array(dtype=wp.int32)
    grid: wp.array(dtype=wp.int32)
    friction: wp.array(dtype=wp.float64)
    sharpness: wp.array(dtype=wp.float64)


@wp.struct
class Settings:
    """Of all trajectories: numerics of the scene, `synth.simulate.options.SolverOptions`, limits of Newton's method.

    forcing: of the linear residual, relative to the right side, at most; see `synth.simulate.batched.krylov`.
    """

    tolerance: wp.float64
    loose: wp.float64
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
def select(slots: Slots, phases: int, mask: wp.array(dtype=wp.int32)):
    """1 for slots whose phase is in the set."""
    s = wp.tid()
    mask[s] = (phases >> slots.phase[s]) & 1
