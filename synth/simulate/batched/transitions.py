"""What happens next to a lane, as Warp kernels of one thread a lane.

The rules are those of `synth.simulate.policy`; what differs is that each lane follows them at its own pace, that passes
are solved to a share of the full tolerance, and that where intermediate steps have a relaxed tolerance the full one
holds for what is recorded only. A step that ends at a recorded state, and every pass but the last, then has the relaxed
tolerance, and every pass of a deep object at least MULTIPLIER_TOLERANCE times the full one: what they find is changed
by the next pass. A state without passes, or whose passes end early, is brought to the full tolerance before it is
recorded (POLISH); where that fails, the step is halved. The path does not depend on which states are corrected. Nothing
limits a press's iterations or the turn of normals, and no direction is rough.
"""

from typing import Any

import warp as wp

from synth.simulate.batched import lanes as phases
from synth.simulate.batched.lanes import Lanes, Presses, Settings
from synth.simulate.contact import Indenters
from synth.simulate.distance import KINDS
from synth.simulate.policy import load_steps, multipliers, newton, requests


def _doubles(*values: float) -> list[Any]:
    return [wp.constant(wp.float64(value)) for value in values]


ZERO, ONE, MIN_TOLERANCE = _doubles(0.0, 1.0, 1.0e-12)  # of a pass: somewhat more than rounding leaves
FORCE_FLOOR, INDIFFERENT, SHORTEST = _doubles(requests.FORCE_FLOOR, newton.INDIFFERENT, newton.SHORTEST)
SUFFICIENT_DECREASE, STALLED_RESIDUAL, NEAR = _doubles(newton.SUFFICIENT_DECREASE, newton.STALLED_RESIDUAL, newton.NEAR)
MAX_STEPS, STALL_ITERATIONS = wp.constant(newton.MAX_STEPS), wp.constant(newton.STALL_ITERATIONS)
GROWTH, SHORTEST_STEP, PENETRATION = _doubles(load_steps.GROWTH, load_steps.SHORTEST_STEP, multipliers.PENETRATION)
MAX_ITERATIONS_TO_GROW = wp.constant(load_steps.MAX_ITERATIONS_TO_GROW)
FAILURES, MAX_FAILURES = wp.constant(multipliers.FAILURES), wp.constant(multipliers.MAX_FAILURES)
DEEP, SINKING, SUNK = _doubles(multipliers.DEEP, multipliers.SINKING, multipliers.SUNK)
MULTIPLIER_TOLERANCE, MAX_STIFFENING = _doubles(multipliers.MULTIPLIER_TOLERANCE, multipliers.MAX_STIFFENING)
MAX_MULTIPLIER_UPDATES, MAX_RELAXED_STEP = _doubles(multipliers.MAX_MULTIPLIER_UPDATES, load_steps.MAX_RELAXED_STEP)
MAX_CORRECTION_RATIO, MAX_RELAXED_UPDATE = _doubles(multipliers.MAX_CORRECTION_RATIO, multipliers.MAX_RELAXED_UPDATE)
MESH, MAX_DEEP_PASSES = wp.constant(KINDS["mesh"]), wp.constant(multipliers.MAX_DEEP_PASSES)
FIRST_VISCOSITY, LEAST_VISCOSITY = _doubles(newton.FIRST_VISCOSITY, newton.LEAST_VISCOSITY)
MOST_VISCOSITY, LEAST_SHARE = _doubles(newton.MOST_VISCOSITY, newton.LEAST_SHARE)
MIN_REACTION_RATIO, MAX_ERROR, AIM = _doubles(newton.MIN_REACTION_RATIO, newton.MAX_ERROR, newton.AIM)
FALL, FALL_AFTER_REFUSAL, RISE = _doubles(newton.FALL, newton.FALL_AFTER_REFUSAL, newton.RISE)


@wp.func
def next_viscosity(viscosity: wp.float64, error: wp.float64, refused: bool) -> wp.float64:
    """`synth.simulate.policy.newton.next_viscosity`."""
    if error <= MAX_ERROR:
        taken = viscosity * wp.clamp(error / AIM, wp.where(refused, FALL_AFTER_REFUSAL, FALL), RISE)
        if taken < LEAST_VISCOSITY:
            return ZERO
        return taken
    raised = wp.max(viscosity * wp.clamp(error / AIM, wp.float64(2.0), RISE), LEAST_VISCOSITY)
    return wp.min(raised, MOST_VISCOSITY)


@wp.func
def evaluate_relaxation(lanes: Lanes, s: int, valid: bool):
    """A step of a relaxation is taken where it errs little; else the next is shorter, from where this began."""
    error = wp.float64(1.0e30)
    if valid and wp.isfinite(lanes.trial_error[s]):
        error = lanes.trial_error[s]
    lanes.iteration[s] = lanes.iteration[s] + 1
    if error <= MAX_ERROR:
        lanes.move[s] = phases.TAKE_TRIAL
        lanes.part[s] = ONE
    else:
        if lanes.viscosity[s] >= MOST_VISCOSITY:
            lanes.part[s] = wp.float64(0.5) * lanes.part[s]
        lanes.phase[s] = phases.START
        if lanes.iteration[s] >= MAX_STEPS or lanes.part[s] < LEAST_SHARE:
            lanes.phase[s] = phases.FAILED
    if lanes.phase[s] == phases.SEARCH and lanes.trial_held_force[s] < lanes.held_force[s]:
        lanes.phase[s] = phases.FAILED
    lanes.viscosity[s] = next_viscosity(lanes.viscosity[s], error, lanes.relaxing[s] == 2)
    lanes.relaxing[s] = wp.where(error <= MAX_ERROR, 1, 2)


@wp.kernel
def evaluate_trial(lanes: Lanes):
    """After an evaluation: is the trial taken, and is it the solution?"""
    s = wp.tid()
    phase = lanes.phase[s]
    lanes.move[s] = 0
    norm = lanes.trial_norm[s]
    relative = norm / wp.max(lanes.trial_force[s], FORCE_FLOOR)
    valid = lanes.trial_jacobian[s] > ZERO
    if phase == phases.FRESH:
        lanes.phase[s] = phases.FIRST
        return
    if phase == phases.PREDICTOR:
        lanes.norm[s] = norm
        lanes.phase[s] = phases.PREDICTOR_READY
        return
    if phase != phases.START and phase != phases.SEARCH and phase != phases.RESTORED:
        return
    if phase == phases.START and not valid:
        if lanes.predicted[s] == 1:
            lanes.predicted[s] = 0
            lanes.move[s] = phases.RESET
        else:
            lanes.phase[s] = phases.FAILED
        return
    if phase == phases.START and lanes.relaxing[s] > 0 and lanes.iteration[s] == 0:
        lanes.held_force[s] = MIN_REACTION_RATIO * lanes.trial_held_force[s]
    if phase == phases.SEARCH and lanes.relaxing[s] > 0:
        evaluate_relaxation(lanes, s, valid)
        if lanes.phase[s] != phases.SEARCH:
            return
    elif phase == phases.SEARCH:
        scale = lanes.scale[s]
        if not (valid and (norm <= lanes.norm[s] * (ONE - SUFFICIENT_DECREASE * scale) or scale < INDIFFERENT)):
            lanes.scale[s] = wp.float64(0.5) * scale
            if lanes.scale[s] < SHORTEST:
                lanes.phase[s] = phases.FAILED
            return
        lanes.move[s] = phases.TAKE_TRIAL
        lanes.iteration[s] = lanes.iteration[s] + 1
    too_far = (
        lanes.stage[s] == phases.CORRECTION and lanes.trial_moved[s] > lanes.most_moved[s] and lanes.relaxing[s] == 0
    )
    lanes.norm[s] = norm
    lanes.relative[s] = relative
    lanes.jacobian[s] = lanes.trial_jacobian[s]
    iteration, limit = lanes.iteration[s], lanes.limit[s]
    spent = iteration == 2 * limit or (iteration >= limit and relative > NEAR)
    stalled = iteration >= STALL_ITERATIONS and relative >= STALLED_RESIDUAL
    if lanes.relaxing[s] > 0:
        spent = iteration >= MAX_STEPS
        stalled = False
    if phase == phases.RESTORED:
        lanes.phase[s] = phases.CORRECTING
    elif too_far:
        lanes.phase[s] = phases.FAILED
    elif relative <= lanes.tolerance[s] and (iteration > 0 or relative == ZERO):
        lanes.phase[s] = phases.SOLVED
    elif (not wp.isfinite(relative)) or stalled or spent:
        lanes.phase[s] = phases.FAILED
    else:
        lanes.phase[s] = phases.READY


@wp.func
def _is_deep(lanes: Lanes, presses: Presses, s: int) -> bool:
    """Whether the gel reaches further into an object than DEEP; during a pass, before it."""
    j = lanes.press[s]
    return presses.kind[j] == MESH and lanes.deepest[s] > DEEP * presses.deepest[j]


@wp.kernel
def finish_solve(lanes: Lanes, presses: Presses, settings: Settings, indenters: Indenters):
    """After Newton's method: accept, halve, or end the step; count the pass or undo it."""
    s = wp.tid()
    phase = lanes.phase[s]
    lanes.move[s] = 0
    if phase != phases.SOLVED and phase != phases.FAILED:
        return
    lanes.total[s] = lanes.total[s] + lanes.iteration[s]
    correction = lanes.stage[s] == phases.CORRECTION
    polish = lanes.stage[s] == phases.POLISH
    relaxed = lanes.relaxing[s] > 0
    small = lanes.target[s] - lanes.at[s] <= MAX_RELAXED_STEP * settings.longest
    if correction:
        small = lanes.share[s] < MAX_RELAXED_UPDATE and _is_deep(lanes, presses, s)
    if phase == phases.FAILED and not relaxed and not polish and small:
        lanes.relaxing[s] = 1
        lanes.viscosity[s] = FIRST_VISCOSITY
        lanes.part[s] = ONE
        lanes.iteration[s] = 0
        lanes.predicted[s] = 0
        lanes.move[s] = wp.where(correction, phases.REPEAT_RECORDED, phases.RESET)
        lanes.phase[s] = phases.START
        return
    lanes.relaxing[s] = 0
    lanes.viscosity[s] = ZERO
    if correction:
        if phase == phases.SOLVED:
            lanes.done[s] = lanes.done[s] + lanes.share[s]
            lanes.share[s] = wp.min(ONE, wp.float64(2.0) * lanes.share[s])
            lanes.phase[s] = phases.CORRECTING
        else:
            indenters.sharpness[s] = lanes.sharpness[s]
            lanes.failures[s] = lanes.failures[s] + 1
            lanes.share[s] = wp.float64(0.5) * lanes.share[s]
            lanes.move[s] = phases.RESTORE_RECORDED
            lanes.phase[s] = phases.RESTORED
        return
    if phase == phases.FAILED:
        lanes.step[s] = wp.where(relaxed, wp.float64(0.25), wp.float64(0.5)) * (lanes.target[s] - lanes.at[s])
        lanes.has_previous[s] = 0
        lanes.phase[s] = phases.BEGIN
        if polish:
            lanes.move[s] = phases.ROLL_BACK
            lanes.phase[s] = phases.ROLLED_BACK
        if lanes.step[s] < SHORTEST_STEP * settings.longest:
            lanes.reason[s] = phases.NO_EQUILIBRIUM
            lanes.phase[s] = phases.ENDED
        return
    if polish:
        lanes.phase[s] = phases.RECORD
        return
    lanes.step_iterations[s] = lanes.iteration[s]
    lanes.has_previous[s] = wp.where(relaxed, 0, settings.extrapolate)
    lanes.move[s] = phases.ACCEPT
    j = lanes.press[s]
    stop = lanes.next[s]
    lanes.phase[s] = phases.ADVANCE
    if lanes.target[s] == presses.waypoints[j, stop] and presses.kind_of[j, stop] > 0:
        lanes.phase[s] = phases.AT_RECORD


@wp.kernel
def check_contact(lanes: Lanes, presses: Presses, sums: wp.array2d(dtype=wp.float64)):
    """At a recorded state: end where the indenter meets no resistance; else save contact's memory, to correct it."""
    s = wp.tid()
    lanes.save[s] = 0
    lanes.anchor[s] = 0
    if lanes.phase[s] != phases.AT_RECORD:
        return
    j = lanes.press[s]
    axes = presses.axes[j]
    force = sums[s, 0] * axes[0, 2] + sums[s, 1] * axes[1, 2] + sums[s, 2] * axes[2, 2]
    if lanes.target[s] == presses.press_end[j] and presses.over_pad[j] == 1 and force <= FORCE_FLOOR:
        lanes.reason[s] = phases.NO_CONTACT
        lanes.phase[s] = phases.ENDED
        return
    lanes.save[s] = 1
    lanes.failures[s] = 0
    lanes.passes[s] = 0
    lanes.share[s] = ONE
    lanes.done[s] = ZERO
    lanes.phase[s] = phases.CORRECTING
    if presses.kind_of[j, lanes.next[s]] == 2:
        lanes.anchor[s] = 1


@wp.kernel
def choose_pass(lanes: Lanes, presses: Presses, settings: Settings, indenters: Indenters):
    """Another pass, the full tolerance, the record, or the end where passes leave the body too deep."""
    s = wp.tid()
    lanes.new_share[s] = ZERO
    if lanes.phase[s] != phases.CORRECTING:
        return
    j = lanes.press[s]
    corrected = presses.kind_of[j, lanes.next[s]] == 2
    deep = _is_deep(lanes, presses, s)
    allowed = wp.where(lanes.deepest[s] > SINKING * presses.deepest[j], MAX_FAILURES, FAILURES)
    over = lanes.failures[s] >= allowed or lanes.done[s] >= MAX_MULTIPLIER_UPDATES
    if deep:
        over = lanes.passes[s] >= MAX_DEEP_PASSES
    if corrected and over and (deep or lanes.deepest[s] > SUNK * presses.deepest[j]):
        lanes.reason[s] = phases.TOO_DEEP
        lanes.phase[s] = phases.ENDED
        return
    over = over or lanes.deepest[s] <= PENETRATION * presses.deepest[j] or not corrected
    if over and lanes.relative[s] <= settings.tolerance:
        lanes.phase[s] = phases.RECORD
        return
    lanes.tolerance[s] = settings.tolerance
    if over:
        lanes.stage[s] = phases.POLISH
        lanes.limit[s] = settings.limit
    else:
        lanes.new_share[s] = lanes.share[s]
        lanes.passes[s] = lanes.passes[s] + 1
        lanes.sharpness[s] = indenters.sharpness[s]
        if deep and lanes.done[s] > ZERO:
            indenters.sharpness[s] = wp.min(wp.float64(2.0) * lanes.sharpness[s], MAX_STIFFENING * presses.sharpness[j])
        lanes.stage[s] = phases.CORRECTION
        lanes.most_moved[s] = MAX_CORRECTION_RATIO * lanes.deepest[s]
        lanes.limit[s] = settings.correction_limit
        lanes.tolerance[s] = wp.max(settings.closer * settings.tolerance, MIN_TOLERANCE)
        if lanes.done[s] + lanes.share[s] < MAX_MULTIPLIER_UPDATES:
            lanes.tolerance[s] = wp.max(settings.relaxed_tolerance, lanes.tolerance[s])
        if deep:
            lanes.tolerance[s] = wp.max(MULTIPLIER_TOLERANCE * settings.tolerance, lanes.tolerance[s])
    lanes.iteration[s] = 0
    lanes.predicted[s] = 0
    lanes.phase[s] = phases.START


@wp.kernel
def finish_record(mask: wp.array(dtype=wp.int32), lanes: Lanes, presses: Presses, indenters: Indenters):
    """After a record or a rolled-back step: resets the contact stiffness, and the lane goes on."""
    s = wp.tid()
    if mask[s] == 1:
        indenters.sharpness[s] = presses.sharpness[lanes.press[s]]
    if lanes.phase[s] == phases.ROLLED_BACK:
        lanes.phase[s] = phases.BEGIN
    if lanes.phase[s] == phases.RECORD:
        lanes.records[s] = lanes.records[s] + 1
        lanes.total[s] = 0
        lanes.phase[s] = phases.ADVANCE


@wp.func
def _turns(presses: Presses, j: int, before: wp.float64, now: wp.float64) -> bool:
    """`LoadPath.turns_between`."""
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
    if phase == phases.ADVANCE:
        target = lanes.target[s]
        taken = target - lanes.at[s]
        lanes.previous[s] = lanes.at[s]
        lanes.at[s] = target
        if target == presses.waypoints[j, lanes.next[s]]:
            lanes.next[s] = lanes.next[s] + 1
        if lanes.step_iterations[s] <= MAX_ITERATIONS_TO_GROW:
            lanes.step[s] = wp.min(settings.longest, GROWTH * wp.max(taken, lanes.step[s] / GROWTH))
        phase = phases.BEGIN
        if lanes.next[s] == presses.stops[j]:
            lanes.reason[s] = phases.COMPLETE
            phase = phases.ENDED
    elif phase == phases.FIRST:
        phase = phases.BEGIN
    if phase == phases.BEGIN:
        at = lanes.at[s]
        goal = presses.waypoints[j, lanes.next[s]]
        parts = wp.ceil((goal - at) / lanes.step[s] - wp.float64(1.0e-9))
        lanes.target[s] = goal
        lanes.tolerance[s] = settings.tolerance
        if parts > ONE:
            lanes.target[s] = at + (goal - at) / parts
        if parts > ONE or presses.kind_of[j, lanes.next[s]] > 0:
            lanes.tolerance[s] = wp.max(settings.relaxed_tolerance, settings.tolerance)
        lanes.stage[s] = phases.STEP
        lanes.iteration[s] = 0
        lanes.limit[s] = settings.limit
        lanes.ratio[s] = ZERO
        lanes.predicted[s] = 0
        lanes.move[s] = phases.RESET
        phase = phases.START
        if lanes.has_previous[s] == 1 and not _turns(presses, j, lanes.previous[s], at):
            lanes.ratio[s] = (lanes.target[s] - at) / (at - lanes.previous[s])
            lanes.predicted[s] = 1
        elif presses.friction[j] > ZERO and at > ZERO:
            phase = phases.PREDICTOR
    lanes.phase[s] = phase
