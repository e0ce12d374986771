"""Benchmarks: error against run time."""

from synth.bench.run import run_bench

__all__ = ["run_bench"]
