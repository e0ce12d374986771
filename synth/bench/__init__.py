"""Benchmarks: error against run time of simulation and rendering, whether the error budget holds, pairs per second."""

from synth.bench.budget import run_budget
from synth.bench.light import run_light
from synth.bench.render import run_render
from synth.bench.run import run_bench
from synth.bench.scale import run_scale

__all__ = ["run_bench", "run_budget", "run_light", "run_render", "run_scale"]
