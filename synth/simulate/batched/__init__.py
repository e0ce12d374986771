"""Simulation of many presses at once on one mesh, for GPUs: the same laws and rules as for one press alone."""

from synth.simulate.batched.run import simulate_presses

__all__ = ["simulate_presses"]
