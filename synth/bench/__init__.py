"""Benchmarks: error against run time of simulation, rendering and flow; the error budget; pairs per second."""

from synth.bench.every import run_all
from synth.bench.flow import run_flow
from synth.bench.light import run_light
from synth.bench.render import run_render
from synth.bench.scale import run_scale

__all__ = ["run_all", "run_flow", "run_light", "run_render", "run_scale"]
