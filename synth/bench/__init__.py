"""Benchmarks: error against run time, and whether the error budget holds."""

from synth.bench.budget import run_budget
from synth.bench.run import run_bench

__all__ = ["run_bench", "run_budget"]
