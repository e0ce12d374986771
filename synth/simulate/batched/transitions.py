"""What happens next to a lane, as Warp kernels of one thread a lane.

The rules are those of `synth.simulate.newton` and `synth.simulate.stepping`, whose constants they use; what differs
is that each lane follows them at its own pace, that passes are solved to a share of the full tolerance, and that where
the way is loose the full tolerance holds for what is recorded only. A step that ends at a recorded state, and every
pass but the last, is then solved as loosely as the way is: what they find is changed by the next pass. A state without
passes, or whose passes end early, because they fail or nothing is deep any more, is brought to the full tolerance
before it is recorded (POLISH); where that fails, the step is halved as if it had not been taken. The way goes on from
the loose state, so that it does not depend on which states are corrected.
"""

# Kernels are written in Warp's own language; their annotations only look like Python's.
# mypy: disable-error-code="valid-type, no-untyped-def"

import warp as wp

from synth.simulate import newton, stepping
from synth.simulate.batched.lanes import (
    ACCEPT,
    ADVANCE,
    AT_RECORD,
    BEGIN,
    COMPLETE,
    CORRECTING,
    CORRECTION,
    ENDED,
    FAILED,
    FIRST,
    FRESH,
    NO_CONTACT,
    NO_EQUILIBRIUM,
    POLISH,
    PREDICTOR,
    PREDICTOR_READY,
    READY,
    RECORD,
    RELAXED,
    RELAXING,
    RESET,
    RESTORE_RECORDED,
    RESTORED,
    ROLL_BACK,
    ROLLED_BACK,
    SEARCH,
    SOLVED,
    START,
    STEP,
    TAKE_TRIAL,
    Lanes,
    Presses,
    Settings,
)
from synth.simulate.batched.relaxation import FIRST_VISCOSITY, LEAST_BORNE, MAX_STEPS, evaluate_relaxation

wp.set_module_options({"enable_backward": False, "fast_math": False})

ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))
NOTHING = wp.constant(wp.float64(newton.NOTHING))
INDIFFERENT = wp.constant(wp.float64(newton.INDIFFERENT))
SHORTEST = wp.constant(wp.float64(newton.SHORTEST))
SHORTEST_STEP = wp.constant(wp.float64(stepping.SHORTEST_STEP))
GROWTH = wp.constant(wp.float64(stepping.GROWTH))
EASY = wp.constant(stepping.EASY)
FAILURES = wp.constant(stepping.FAILURES)
ENOUGH = wp.constant(wp.float64(stepping.ENOUGH))
PENETRATION = wp.constant(wp.float64(stepping.PENETRATION))
REACH = wp.constant(wp.float64(stepping.REACH))
MIN_TOLERANCE = wp.constant(wp.float64(1.0e-12))
"""Of a pass; rounding alone leaves some 1e-13."""
SUFFICIENT_DECREASE = wp.constant(wp.float64(1.0e-4))
STALL_ITERATIONS = wp.constant(5)
STALLED_RESIDUAL = wp.constant(wp.float64(0.5))
"""Newton's method ends after STALL_ITERATIONS iterations where the relative residual is still so large."""
NEAR = wp.constant(wp.float64(newton.NEAR))
SHORT = wp.constant(wp.float64(stepping.RELAXED))


@wp.kernel
def evaluate_trial(lanes: Lanes, settings: Settings):
    """After an evaluation: is the trial taken, and is it the solution?"""
    s = wp.tid()
    phase = lanes.phase[s]
    lanes.move[s] = 0
    norm = lanes.trial_norm[s]
    relative = norm / wp.max(lanes.trial_force[s], NOTHING)
    valid = lanes.trial_jacobian[s] > ZERO
    if phase == FRESH:
        lanes.phase[s] = FIRST
        return
    if phase == PREDICTOR:
        lanes.norm[s] = norm
        lanes.phase[s] = PREDICTOR_READY
        return
    if phase != START and phase != SEARCH and phase != RESTORED:
        return
    if phase == START and not valid:
        if lanes.predicted[s] == 1:
            lanes.predicted[s] = 0
            lanes.move[s] = RESET
        else:
            lanes.phase[s] = FAILED
        return
    if phase == START and lanes.relaxing[s] == RELAXING and lanes.iteration[s] == 0:
        lanes.held_force[s] = LEAST_BORNE * lanes.trial_held_force[s]
    if phase == SEARCH and lanes.relaxing[s] == RELAXING:
        evaluate_relaxation(lanes, s, valid)
        if lanes.phase[s] != SEARCH:
            return
    elif phase == SEARCH:
        scale = lanes.scale[s]
        if not (valid and (norm <= lanes.norm[s] * (ONE - SUFFICIENT_DECREASE * scale) or scale < INDIFFERENT)):
            lanes.scale[s] = wp.float64(0.5) * scale
            if lanes.scale[s] < SHORTEST:
                lanes.phase[s] = FAILED
            return
        lanes.move[s] = TAKE_TRIAL
        lanes.iteration[s] = lanes.iteration[s] + 1
    too_far = lanes.stage[s] == CORRECTION and lanes.trial_moved[s] > lanes.most_moved[s]
    lanes.norm[s] = norm
    lanes.relative[s] = relative
    lanes.jacobian[s] = lanes.trial_jacobian[s]
    iteration = lanes.iteration[s]
    limit = lanes.limit[s]
    spent = iteration == 2 * limit or (iteration >= limit and relative > NEAR)
    hopeless = iteration >= STALL_ITERATIONS and relative >= STALLED_RESIDUAL
    if lanes.relaxing[s] == RELAXING:
        spent = iteration >= MAX_STEPS
        hopeless = False
    if phase == RESTORED:
        lanes.phase[s] = CORRECTING
    elif too_far:
        lanes.phase[s] = FAILED
    elif relative <= lanes.tolerance[s] and (iteration > 0 or relative == ZERO):
        lanes.phase[s] = SOLVED
    elif (not wp.isfinite(relative)) or hopeless or spent:
        lanes.phase[s] = FAILED
    else:
        lanes.phase[s] = READY


@wp.kernel
def finish_solve(lanes: Lanes, presses: Presses, settings: Settings):
    """After Newton's method: accept, halve, or end the step; count the pass or undo it."""
    s = wp.tid()
    phase = lanes.phase[s]
    lanes.move[s] = 0
    if phase != SOLVED and phase != FAILED:
        return
    lanes.total[s] = lanes.total[s] + lanes.iteration[s]
    if lanes.stage[s] == CORRECTION:
        if phase == SOLVED:
            lanes.done[s] = lanes.done[s] + lanes.share[s]
            lanes.share[s] = wp.min(ONE, wp.float64(2.0) * lanes.share[s])
            lanes.phase[s] = CORRECTING
        else:
            lanes.failures[s] = lanes.failures[s] + 1
            lanes.share[s] = wp.float64(0.5) * lanes.share[s]
            lanes.move[s] = RESTORE_RECORDED
            lanes.phase[s] = RESTORED
        return
    polish = lanes.stage[s] == POLISH
    step = lanes.target[s] - lanes.at[s]
    if phase == FAILED and lanes.relaxing[s] == 0 and not polish and step <= SHORT * settings.longest:
        lanes.relaxing[s] = RELAXING
        lanes.viscosity[s] = FIRST_VISCOSITY
        lanes.share[s] = ONE
        lanes.iteration[s] = 0
        lanes.predicted[s] = 0
        lanes.move[s] = RESET
        lanes.phase[s] = START
        return
    lanes.viscosity[s] = ZERO
    if lanes.relaxing[s] == RELAXING:
        lanes.relaxing[s] = RELAXED
    if phase == FAILED:
        lanes.step[s] = wp.float64(0.5) * (lanes.target[s] - lanes.at[s])
        lanes.has_previous[s] = 0
        lanes.phase[s] = BEGIN
        if polish:
            lanes.move[s] = ROLL_BACK
            lanes.phase[s] = ROLLED_BACK
        if lanes.step[s] < SHORTEST_STEP * settings.longest:
            lanes.reason[s] = NO_EQUILIBRIUM
            lanes.phase[s] = ENDED
        return
    if polish:
        lanes.phase[s] = RECORD
        return
    lanes.step_iterations[s] = lanes.iteration[s]
    lanes.move[s] = ACCEPT
    j = lanes.press[s]
    stop = lanes.next[s]
    lanes.phase[s] = ADVANCE
    if lanes.target[s] == presses.waypoints[j, stop] and presses.kind_of[j, stop] > 0:
        lanes.phase[s] = AT_RECORD


@wp.kernel
def check_contact(lanes: Lanes, presses: Presses, sums: wp.array2d(dtype=wp.float64)):
    """At a recorded state: end where the press bears on nothing; else put contact's memory aside, to correct it."""
    s = wp.tid()
    lanes.keep[s] = 0
    lanes.anchor[s] = 0
    if lanes.phase[s] != AT_RECORD:
        return
    j = lanes.press[s]
    lanes.kept[s] = 0
    if lanes.target[s] == presses.press_end[j] and presses.over_pad[j] == 1 and sums[s, 2] <= NOTHING:
        lanes.reason[s] = NO_CONTACT
        lanes.phase[s] = ENDED
        return
    lanes.keep[s] = 1
    lanes.kept[s] = 1
    lanes.failures[s] = 0
    lanes.share[s] = ONE
    lanes.done[s] = ZERO
    lanes.phase[s] = CORRECTING
    if presses.kind_of[j, lanes.next[s]] == 2:
        lanes.anchor[s] = 1


@wp.kernel
def choose_pass(lanes: Lanes, presses: Presses, settings: Settings):
    """Another pass, the full tolerance, or the record."""
    s = wp.tid()
    lanes.new_share[s] = ZERO
    if lanes.phase[s] != CORRECTING:
        return
    j = lanes.press[s]
    too_deep = lanes.deepest[s] > PENETRATION * presses.deepest[j]
    over = lanes.failures[s] == FAILURES or lanes.done[s] >= ENOUGH or not too_deep
    over = over or presses.kind_of[j, lanes.next[s]] == 1
    if over and lanes.relative[s] <= settings.tolerance:
        lanes.phase[s] = RECORD
        return
    lanes.tolerance[s] = settings.tolerance
    if over:
        lanes.stage[s] = POLISH
        lanes.limit[s] = settings.limit
    else:
        lanes.new_share[s] = lanes.share[s]
        lanes.stage[s] = CORRECTION
        lanes.most_moved[s] = REACH * lanes.deepest[s]
        lanes.limit[s] = settings.correction_limit
        lanes.tolerance[s] = wp.max(settings.closer * settings.tolerance, MIN_TOLERANCE)
        if lanes.done[s] + lanes.share[s] < ENOUGH:
            lanes.tolerance[s] = wp.max(settings.loose, lanes.tolerance[s])
    lanes.iteration[s] = 0
    lanes.predicted[s] = 0
    lanes.phase[s] = START


@wp.kernel
def finish_record(lanes: Lanes):
    """After the record, or the way back."""
    s = wp.tid()
    if lanes.phase[s] == ROLLED_BACK:
        lanes.phase[s] = BEGIN
    if lanes.phase[s] == RECORD:
        lanes.records[s] = lanes.records[s] + 1
        lanes.total[s] = 0
        lanes.phase[s] = ADVANCE


@wp.func
def _turns(presses: Presses, j: int, before: wp.float64, now: wp.float64) -> bool:
    """`Path.turns_between`."""
    turns = wp.int32(0)
    for k in range(presses.legs[j]):
        if presses.ends[j, k] > before and presses.ends[j, k] <= now:
            turns = wp.int32(1)
    return turns == 1


@wp.kernel
def choose_target(lanes: Lanes, presses: Presses, settings: Settings):
    """After an accepted step its length and the next waypoint; then the next target and its first iterate's kind."""
    s = wp.tid()
    j = lanes.press[s]
    lanes.move[s] = 0
    phase = lanes.phase[s]
    if phase == ADVANCE:
        target = lanes.target[s]
        taken = target - lanes.at[s]
        lanes.previous[s] = lanes.at[s]
        lanes.has_previous[s] = settings.extrapolate
        if lanes.relaxing[s] == RELAXED:
            lanes.has_previous[s] = 0
        lanes.at[s] = target
        if target == presses.waypoints[j, lanes.next[s]]:
            lanes.next[s] = lanes.next[s] + 1
        if lanes.step_iterations[s] <= EASY:
            lanes.step[s] = wp.min(settings.longest, GROWTH * wp.max(taken, lanes.step[s] / GROWTH))
        phase = BEGIN
        if lanes.next[s] == presses.stops[j]:
            lanes.reason[s] = COMPLETE
            phase = ENDED
    elif phase == FIRST:
        phase = BEGIN
    if phase == BEGIN:
        at = lanes.at[s]
        goal = presses.waypoints[j, lanes.next[s]]
        parts = wp.ceil((goal - at) / lanes.step[s] - wp.float64(1.0e-9))
        lanes.target[s] = goal
        lanes.tolerance[s] = settings.tolerance
        if parts > ONE:
            lanes.target[s] = at + (goal - at) / parts
        if parts > ONE or presses.kind_of[j, lanes.next[s]] > 0:
            lanes.tolerance[s] = wp.max(settings.loose, settings.tolerance)
        lanes.stage[s] = STEP
        lanes.iteration[s] = 0
        lanes.limit[s] = settings.limit
        lanes.relaxing[s] = 0
        lanes.ratio[s] = ZERO
        lanes.predicted[s] = 0
        lanes.move[s] = RESET
        phase = START
        if lanes.has_previous[s] == 1 and not _turns(presses, j, lanes.previous[s], at):
            lanes.ratio[s] = (lanes.target[s] - at) / (at - lanes.previous[s])
            lanes.predicted[s] = 1
        elif presses.friction[j] > ZERO and at > ZERO:
            phase = PREDICTOR
    lanes.phase[s] = phase
