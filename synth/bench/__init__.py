"""Benchmarks: error against run time of simulation, and the error budget."""

from synth.bench.budget import run_budget
from synth.bench.run import run_bench

__all__ = ["run_bench", "run_budget"]
