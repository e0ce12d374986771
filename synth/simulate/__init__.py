"""Finite-element simulation of a gel pad under a rigid indenter."""

from synth.warp_start import start_warp

start_warp()

from synth.simulate.solve import simulate  # noqa: E402
from synth.simulate.trajectory import State, Trajectory  # noqa: E402

__all__ = ["State", "Trajectory", "simulate"]
