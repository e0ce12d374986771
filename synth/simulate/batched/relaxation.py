"""Relaxation of a lane, as Warp functions: the rules and constants are those of `synth.simulate.relaxation`."""

import warp as wp

from synth.simulate import relaxation
from synth.simulate.batched.lanes import FAILED, SEARCH, START, TAKE_TRIAL, Lanes

wp.set_module_options({"enable_backward": False, "fast_math": False})

ZERO, ONE = wp.constant(wp.float64(0.0)), wp.constant(wp.float64(1.0))
MAX_STEPS = wp.constant(relaxation.MAX_STEPS)
FIRST_VISCOSITY = wp.constant(wp.float64(relaxation.FIRST_VISCOSITY))
LEAST_VISCOSITY = wp.constant(wp.float64(relaxation.LEAST_VISCOSITY))
MOST_VISCOSITY = wp.constant(wp.float64(relaxation.MOST_VISCOSITY))
LEAST_SHARE = wp.constant(wp.float64(relaxation.LEAST_SHARE))
LEAST_BORNE = wp.constant(wp.float64(relaxation.MIN_REACTION_RATIO))
MAX_ERROR, AIM = wp.constant(wp.float64(relaxation.MAX_ERROR)), wp.constant(wp.float64(relaxation.AIM))
FALL, RISE = wp.constant(wp.float64(relaxation.FALL)), wp.constant(wp.float64(relaxation.RISE))


@wp.func
def next_viscosity(viscosity: wp.float64, error: wp.float64) -> wp.float64:
    """`synth.simulate.relaxation.next_viscosity`."""
    if error <= MAX_ERROR:
        taken = viscosity * wp.clamp(error / AIM, FALL, RISE)
        if taken < LEAST_VISCOSITY:
            return ZERO
        return taken
    refused = wp.max(viscosity * wp.clamp(error / AIM, wp.float64(2.0), RISE), LEAST_VISCOSITY)
    return wp.min(refused, MOST_VISCOSITY)


@wp.func
def evaluate_relaxation(lanes: Lanes, s: int, valid: bool):
    """A step of a relaxation is taken where it errs little; else the next is shorter, from where this began."""
    error = wp.float64(1.0e30)
    if valid and wp.isfinite(lanes.trial_error[s]):
        error = lanes.trial_error[s]
    lanes.iteration[s] = lanes.iteration[s] + 1
    if error <= MAX_ERROR:
        lanes.move[s] = TAKE_TRIAL
        lanes.part[s] = ONE
    else:
        if lanes.viscosity[s] >= MOST_VISCOSITY:
            lanes.part[s] = wp.float64(0.5) * lanes.part[s]
        lanes.phase[s] = START
        if lanes.iteration[s] >= MAX_STEPS or lanes.part[s] < LEAST_SHARE:
            lanes.phase[s] = FAILED
    if lanes.phase[s] == SEARCH and lanes.trial_held_force[s] < lanes.held_force[s]:
        lanes.phase[s] = FAILED
    lanes.viscosity[s] = next_viscosity(lanes.viscosity[s], error)
