"""Finite-element simulation of a gel pad under a rigid indenter."""

import warp

warp.config.log_level = warp.LOG_ERROR  # no banner, no compiler chatter in the user's output

from synth.simulate.solve import simulate  # noqa: E402
from synth.simulate.trajectory import State, Trajectory  # noqa: E402

__all__ = ["State", "Trajectory", "simulate"]
