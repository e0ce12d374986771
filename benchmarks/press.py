"""What the benchmarks of the simulation share: a ball on a pad, a timed press, and the error of the contact face."""

import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from benchmarks.probe import probe
from synth.arrays import FloatArray
from synth.scene import Scene
from synth.simulate import Trajectory

PAD_MM = (20.0, 15.0, 4.0)
SHORT_S, REPEATS = 2.0, 3
"""A press that takes less is timed so often; the median counts."""


def ball_scene(radius_mm: float, friction: float, motion: dict[str, Any]) -> Scene:
    """A rigid ball on a nearly incompressible pad of PAD_MM; light and camera are there because a scene has them."""
    gel = {"size_mm": PAD_MM, "youngs_modulus_kpa": 200.0, "poisson_ratio": 0.4999}
    light = {"position_mm": [0, 0, 0.1], "size_mm": [1, 1], "color": [1, 1, 1], "power": 1}
    camera = {"width": 16, "height": 16, "fx": 9, "fy": 9, "cx": 8, "cy": 8, "position_mm": [0, 0, 90]}
    return Scene.model_validate(
        {
            "name": "benchmark",
            "sensor": {"gel": gel, "pattern": {"kind": "none"}, "lights": [light], "camera": camera},
            "contact": {"indenter": {"shape": "sphere", "radius_mm": radius_mm}, "friction": friction},
            "motion": motion,
        }
    )


def timed(press: Callable[[], Trajectory]) -> tuple[Trajectory, float]:
    """Run a press.

    The solver runs on one thread, so that its processor time is the wall time on an idle core and repeats on a busy
    machine.

    Returns:
        The trajectory, and processor time in s: the median of REPEATS if it is shorter than SHORT_S.
    """
    taken: list[float] = []
    while not taken or (taken[0] < SHORT_S and len(taken) < REPEATS):
        began = time.process_time()
        trajectory = press()
        taken.append(time.process_time() - began)
    return trajectory, statistics.median(taken)


def face_grid(size_mm: Sequence[float], counts: tuple[int, int]) -> FloatArray:
    """(n, 2) x and y, mm, of a regular grid of points on the undeformed contact face, its edges among them."""
    x, y = (np.linspace(-length / 2, length / 2, n) for length, n in zip(size_mm[:2], counts, strict=True))
    return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)


def face_displacement(trajectory: Trajectory, points: FloatArray, states: Sequence[int]) -> FloatArray:
    """(k, n, 3) mm: displacement of points (n, 2) of the contact face in some states, by the mesh's shape functions."""
    matrix = probe(trajectory.space, points)
    found = [matrix @ trajectory.states[state].displacement for state in states]
    return np.array(found).reshape(len(states), len(points), 3)


def root_mean_square(field: FloatArray) -> FloatArray:
    """(k,) root mean square over n points of the lengths of the vectors in a (k, n, d) field."""
    return np.asarray(np.sqrt((field**2).sum(axis=2).mean(axis=1)))
