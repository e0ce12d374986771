"""Samples of a trajectory: draw, mesh, simulate, render, flow, files. What a worker does, in whatever process.

    drawing      the draws of a trajectory until one can be used
    batches      many trajectories simulated at once
    studio       radiance of their frames
    finishing    flow, the cameras' noise, encoding, writing
    producer     all of it for one trajectory

What a sample holds depends on (scene, seed, index) alone, not on which other trajectories the process has made.
"""

from synth.mesh import flat_surface
from synth.produce.batches import in_batches
from synth.produce.finishing import Developed, finish
from synth.produce.producer import Producer, develop
from synth.produce.records import Failure, Outcome, Task, Workplace
from synth.produce.studio import FINER_DOME, SUBDIVISIONS, Studio

__all__ = [
    "FINER_DOME",
    "SUBDIVISIONS",
    "Developed",
    "Failure",
    "Outcome",
    "Producer",
    "Studio",
    "Task",
    "Workplace",
    "develop",
    "finish",
    "flat_surface",
    "in_batches",
]
