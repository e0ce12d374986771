"""What happens next to a slot, as Warp kernels of one thread a slot.

The rules are those of `synth.simulate.newton` and `synth.simulate.stepping`, whose constants they use; what differs
is that each slot follows them at its own pace, that passes are solved to a share of the full tolerance, and that where
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
from synth.simulate.batched.relaxing import FIRST_VISCOSITY, LEAST_BORNE, MAX_STEPS, judge_relaxation
from synth.simulate.batched.slots import (
    ACCEPT,
    ADVANCE,
    BACK,
    BEGIN,
    CARRY_READY,
    COMPLETE,
    ENDED,
    FALL_BACK,
    FIRST,
    FRESH,
    LOST,
    NO_BALANCE,
    NO_CONTACT,
    NUDGED,
    PASS,
    PASSING,
    POLISH,
    READY,
    RECORD,
    RELAXED,
    RELAXING,
    REPAIR,
    REVERT,
    SEARCH,
    SOLVED,
    START,
    STEP,
    TAKE,
    TOUCHED,
    UNDO,
    Jobs,
    Settings,
    Slots,
)

wp.set_module_options({"enable_backward": False, "fast_math": False})

ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))
NOTHING = wp.constant(wp.float64(newton.FORCE_FLOOR))
INDIFFERENT = wp.constant(wp.float64(newton.INDIFFERENT))
SHORTEST = wp.constant(wp.float64(newton.SHORTEST))
SHORTEST_STEP = wp.constant(wp.float64(stepping.SHORTEST_STEP))
GROWTH = wp.constant(wp.float64(stepping.GROWTH))
EASY = wp.constant(stepping.MAX_ITERATIONS_TO_GROW)
FAILURES = wp.constant(stepping.FAILURES)
ENOUGH = wp.constant(wp.float64(stepping.MAX_MULTIPLIER_UPDATES))
PENETRATION = wp.constant(wp.float64(stepping.PENETRATION))
REACH = wp.constant(wp.float64(stepping.MAX_CORRECTION_RATIO))
TIGHTEST = wp.constant(wp.float64(1.0e-12))
"""Of a pass; rounding alone leaves some 1e-13."""
DECREASE = wp.constant(wp.float64(newton.SUFFICIENT_DECREASE))
LATE = wp.constant(newton.STALL_ITERATIONS)
HOPELESS = wp.constant(wp.float64(newton.STALLED_RESIDUAL))
"""Newton's method ends after LATE iterations where the relative residual is still so large."""
NEAR = wp.constant(wp.float64(newton.NEAR))
SHORT = wp.constant(wp.float64(stepping.MAX_RELAXED_STEP))


@wp.kernel
def judge(slots: Slots, settings: Settings):
    """After an evaluation: is the trial taken, and is it the solution?"""
    s = wp.tid()
    phase = slots.phase[s]
    slots.move[s] = 0
    norm = slots.trial_norm[s]
    relative = norm / wp.max(slots.trial_force[s], NOTHING)
    valid = slots.trial_jacobian[s] > ZERO
    if phase == FRESH:
        slots.phase[s] = FIRST
        return
    if phase == NUDGED:
        slots.norm[s] = norm
        slots.phase[s] = CARRY_READY
        return
    if phase != START and phase != SEARCH and phase != REPAIR:
        return
    if phase == START and not valid:
        if slots.predicted[s] == 1:
            slots.predicted[s] = 0
            slots.move[s] = FALL_BACK
        else:
            slots.phase[s] = LOST
        return
    if phase == START and slots.relaxing[s] == RELAXING and slots.iteration[s] == 0:
        slots.borne[s] = LEAST_BORNE * slots.trial_borne[s]
    if phase == SEARCH and slots.relaxing[s] == RELAXING:
        judge_relaxation(slots, s, valid)
        if slots.phase[s] != SEARCH:
            return
    elif phase == SEARCH:
        scale = slots.scale[s]
        if not (valid and (norm <= slots.norm[s] * (ONE - DECREASE * scale) or scale < INDIFFERENT)):
            slots.scale[s] = wp.float64(0.5) * scale
            if slots.scale[s] < SHORTEST:
                slots.phase[s] = LOST
            return
        slots.move[s] = TAKE
        slots.iteration[s] = slots.iteration[s] + 1
    too_far = slots.stage[s] == PASS and slots.trial_moved[s] > slots.most_moved[s]
    slots.norm[s] = norm
    slots.relative[s] = relative
    slots.jacobian[s] = slots.trial_jacobian[s]
    iteration = slots.iteration[s]
    limit = slots.limit[s]
    spent = iteration == 2 * limit or (iteration >= limit and relative > NEAR)
    hopeless = iteration >= LATE and relative >= HOPELESS
    if slots.relaxing[s] == RELAXING:
        spent = iteration >= MAX_STEPS
        hopeless = False
    if phase == REPAIR:
        slots.phase[s] = PASSING
    elif too_far:
        slots.phase[s] = LOST
    elif relative <= slots.tolerance[s] and (iteration > 0 or relative == ZERO):
        slots.phase[s] = SOLVED
    elif (not wp.isfinite(relative)) or hopeless or spent:
        slots.phase[s] = LOST
    else:
        slots.phase[s] = READY


@wp.kernel
def conclude(slots: Slots, jobs: Jobs, settings: Settings):
    """After Newton's method: accept, halve, or end the step; count the pass or undo it."""
    s = wp.tid()
    phase = slots.phase[s]
    slots.move[s] = 0
    if phase != SOLVED and phase != LOST:
        return
    slots.total[s] = slots.total[s] + slots.iteration[s]
    if slots.stage[s] == PASS:
        if phase == SOLVED:
            slots.done[s] = slots.done[s] + slots.share[s]
            slots.share[s] = wp.min(ONE, wp.float64(2.0) * slots.share[s])
            slots.phase[s] = PASSING
        else:
            slots.failures[s] = slots.failures[s] + 1
            slots.share[s] = wp.float64(0.5) * slots.share[s]
            slots.move[s] = UNDO
            slots.phase[s] = REPAIR
        return
    polish = slots.stage[s] == POLISH
    step = slots.target[s] - slots.at[s]
    if phase == LOST and slots.relaxing[s] == 0 and not polish and step <= SHORT * settings.longest:
        slots.relaxing[s] = RELAXING
        slots.viscosity[s] = FIRST_VISCOSITY
        slots.share[s] = ONE
        slots.iteration[s] = 0
        slots.predicted[s] = 0
        slots.move[s] = FALL_BACK
        slots.phase[s] = START
        return
    slots.viscosity[s] = ZERO
    if slots.relaxing[s] == RELAXING:
        slots.relaxing[s] = RELAXED
    if phase == LOST:
        slots.step[s] = wp.float64(0.5) * (slots.target[s] - slots.at[s])
        slots.has_previous[s] = 0
        slots.phase[s] = BEGIN
        if polish:
            slots.move[s] = REVERT
            slots.phase[s] = BACK
        if slots.step[s] < SHORTEST_STEP * settings.longest:
            slots.reason[s] = NO_BALANCE
            slots.phase[s] = ENDED
        return
    if polish:
        slots.phase[s] = RECORD
        return
    slots.eased[s] = slots.iteration[s]
    slots.move[s] = ACCEPT
    j = slots.job[s]
    stop = slots.next[s]
    slots.phase[s] = ADVANCE
    if slots.target[s] == jobs.waypoints[j, stop] and jobs.kind_of[j, stop] > 0:
        slots.phase[s] = TOUCHED


@wp.kernel
def bear(slots: Slots, jobs: Jobs, sums: wp.array2d(dtype=wp.float64)):
    """At a recorded state: end where the press bears on nothing; else put contact's memory aside, to correct it."""
    s = wp.tid()
    slots.keep[s] = 0
    slots.anchor[s] = 0
    if slots.phase[s] != TOUCHED:
        return
    j = slots.job[s]
    slots.kept[s] = 0
    if slots.target[s] == jobs.press[j] and jobs.over_pad[j] == 1 and sums[s, 2] <= NOTHING:
        slots.reason[s] = NO_CONTACT
        slots.phase[s] = ENDED
        return
    slots.keep[s] = 1
    slots.kept[s] = 1
    slots.failures[s] = 0
    slots.share[s] = ONE
    slots.done[s] = ZERO
    slots.phase[s] = PASSING
    if jobs.kind_of[j, slots.next[s]] == 2:
        slots.anchor[s] = 1


@wp.kernel
def choose_pass(slots: Slots, jobs: Jobs, settings: Settings):
    """Another pass, the full tolerance, or the record."""
    s = wp.tid()
    slots.share_now[s] = ZERO
    if slots.phase[s] != PASSING:
        return
    j = slots.job[s]
    too_deep = slots.deepest[s] > PENETRATION * jobs.deepest[j]
    over = slots.failures[s] == FAILURES or slots.done[s] >= ENOUGH or not too_deep
    over = over or jobs.kind_of[j, slots.next[s]] == 1
    if over and slots.relative[s] <= settings.tolerance:
        slots.phase[s] = RECORD
        return
    slots.tolerance[s] = settings.tolerance
    if over:
        slots.stage[s] = POLISH
        slots.limit[s] = settings.limit
    else:
        slots.share_now[s] = slots.share[s]
        slots.stage[s] = PASS
        slots.most_moved[s] = REACH * slots.deepest[s]
        slots.limit[s] = settings.correction_limit
        slots.tolerance[s] = wp.max(settings.closer * settings.tolerance, TIGHTEST)
        if slots.done[s] + slots.share[s] < ENOUGH:
            slots.tolerance[s] = wp.max(settings.loose, slots.tolerance[s])
    slots.iteration[s] = 0
    slots.predicted[s] = 0
    slots.phase[s] = START


@wp.kernel
def recorded(slots: Slots):
    """After the record, or the way back."""
    s = wp.tid()
    if slots.phase[s] == BACK:
        slots.phase[s] = BEGIN
    if slots.phase[s] == RECORD:
        slots.records[s] = slots.records[s] + 1
        slots.total[s] = 0
        slots.phase[s] = ADVANCE


@wp.func
def _turns(jobs: Jobs, j: int, before: wp.float64, now: wp.float64) -> bool:
    """`Path.turns_between`."""
    turns = wp.int32(0)
    for k in range(jobs.legs[j]):
        if jobs.ends[j, k] > before and jobs.ends[j, k] <= now:
            turns = wp.int32(1)
    return turns == 1


@wp.kernel
def control(slots: Slots, jobs: Jobs, settings: Settings):
    """After an accepted step its length and the next waypoint; then the next target and its first iterate's kind."""
    s = wp.tid()
    j = slots.job[s]
    slots.move[s] = 0
    phase = slots.phase[s]
    if phase == ADVANCE:
        target = slots.target[s]
        taken = target - slots.at[s]
        slots.previous[s] = slots.at[s]
        slots.has_previous[s] = settings.extrapolate
        if slots.relaxing[s] == RELAXED:
            slots.has_previous[s] = 0
        slots.at[s] = target
        if target == jobs.waypoints[j, slots.next[s]]:
            slots.next[s] = slots.next[s] + 1
        if slots.eased[s] <= EASY:
            slots.step[s] = wp.min(settings.longest, GROWTH * wp.max(taken, slots.step[s] / GROWTH))
        phase = BEGIN
        if slots.next[s] == jobs.stops[j]:
            slots.reason[s] = COMPLETE
            phase = ENDED
    elif phase == FIRST:
        phase = BEGIN
    if phase == BEGIN:
        at = slots.at[s]
        goal = jobs.waypoints[j, slots.next[s]]
        parts = wp.ceil((goal - at) / slots.step[s] - wp.float64(1.0e-9))
        slots.target[s] = goal
        slots.tolerance[s] = settings.tolerance
        if parts > ONE:
            slots.target[s] = at + (goal - at) / parts
        if parts > ONE or jobs.kind_of[j, slots.next[s]] > 0:
            slots.tolerance[s] = wp.max(settings.loose, settings.tolerance)
        slots.stage[s] = STEP
        slots.iteration[s] = 0
        slots.limit[s] = settings.limit
        slots.relaxing[s] = 0
        slots.ratio[s] = ZERO
        slots.predicted[s] = 0
        slots.move[s] = FALL_BACK
        phase = START
        if slots.has_previous[s] == 1 and not _turns(jobs, j, slots.previous[s], at):
            slots.ratio[s] = (slots.target[s] - at) / (at - slots.previous[s])
            slots.predicted[s] = 1
        elif jobs.friction[j] > ZERO and at > ZERO:
            phase = NUDGED
    slots.phase[s] = phase
