"""Simulation of many trajectories at once on one mesh, for GPUs: the same kernels, laws and rules as one by one."""

from synth.simulate.batched.many import simulate_many

__all__ = ["simulate_many"]
