"""Relaxation of a slot, as Warp functions: the rules and constants are those of `synth.simulate.relaxation`."""

# Kernels are written in Warp's own language; their annotations only look like Python's.
# mypy: disable-error-code="valid-type, no-untyped-def"

import warp as wp

from synth.simulate import relaxation
from synth.simulate.batched.slots import LOST, SEARCH, START, TAKE, Slots

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
def judge_relaxation(slots: Slots, s: int, valid: bool):
    """A step of a relaxation is taken where it errs little; else the next is shorter, from where this began."""
    error = wp.float64(1.0e30)
    if valid and wp.isfinite(slots.trial_error[s]):
        error = slots.trial_error[s]
    slots.iteration[s] = slots.iteration[s] + 1
    if error <= MAX_ERROR:
        slots.move[s] = TAKE
        slots.share[s] = ONE
    else:
        if slots.viscosity[s] >= MOST_VISCOSITY:
            slots.share[s] = wp.float64(0.5) * slots.share[s]
        slots.phase[s] = START
        if slots.iteration[s] >= MAX_STEPS or slots.share[s] < LEAST_SHARE:
            slots.phase[s] = LOST
    if slots.phase[s] == SEARCH and slots.trial_borne[s] < slots.borne[s]:
        slots.phase[s] = LOST
    slots.viscosity[s] = next_viscosity(slots.viscosity[s], error)
