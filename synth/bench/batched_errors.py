"""How wrong presses of `synth.bench.batched` are on its mesh, against one refined around each press.

Relative L2 error of the contact face's displacement on a grid of points, and of the force; both by the solver for one
sample, which gives what the batched one does (`tests/synth/test_simulate_batched.py`). The judged press is led along
its path as the benchmark's, the reference as in `synth.simulate`.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from synth.arrays import FloatArray
from synth.bench.batched_presses import RADII_MM, SIZE_MM, ball_scene
from synth.mesh import Focus, PadMesh
from synth.scene import Scene
from synth.simulate import Trajectory, simulate
from synth.simulate.driver import STANDARD, Driver
from synth.simulate.probe import probe
from synth.simulate.resolution import graded_mesh

ACROSS = 10
"""Elements across the contact in the reference, whose own error is some 1 % (`synth bench fem`)."""
POINTS = (81, 61)
"""Of the grid, along x and y."""


def surface_errors(
    mesh: PadMesh,
    count: int,
    depth_mm: float,
    radii_mm: Sequence[float] = RADII_MM,
    across: int = ACROSS,
    driver: Driver = STANDARD,
    step_mm: float | None = None,
) -> Iterator[dict[str, Any]]:
    """Of the first presses of the benchmark.

    Args:
        mesh: that is judged.
        count: of presses.
        depth_mm: of each.
        radii_mm: of the balls, smallest and largest.
        across: elements across the contact in the reference.
        driver: of Newton's method on the mesh that is judged.
        step_mm: longest load step there; default the scenes'.

    Yields:
        Of each press its ball, whether both simulations are complete, and errors in per cent, None where one is not.
    """
    rng = np.random.default_rng(0)
    half = np.array(SIZE_MM[:2]) / 2
    axes = [np.linspace(-side, side, points) for side, points in zip(half, POINTS, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    for _ in range(count):
        scene = ball_scene(rng, depth_mm, 0.0, 1, radii_mm)
        numerics = scene.numerics.model_copy(update={} if step_mm is None else {"max_step_mm": step_mm})
        judged = scene.model_copy(update={"numerics": numerics})
        found, truth = simulate(judged, mesh, driver=driver), simulate(scene, reference_mesh(scene, across))
        complete = found.status == truth.status == "complete"
        wrong = _apart(_surface(found, points), _surface(truth, points)) if complete else None
        force = found.states[-1].force_n[2] / truth.states[-1].force_n[2] - 1 if complete else None
        indenter = scene.contact.indenter.model_dump()
        yield {
            "radius_mm": round(indenter["radius_mm"], 3),
            "position_mm": [round(float(x), 3) for x in scene.motion.position_mm],
            "friction": round(scene.contact.friction, 3),
            "elements": len(mesh.tets),
            "reference_elements": len(truth.space.mesh.tets),
            "complete": complete,
            "surface_error_percent": None if wrong is None else round(100 * wrong, 2),
            "force_error_percent": None if force is None else round(100 * force, 2),
        }


def reference_mesh(scene: Scene, across: int) -> PadMesh:
    """Refined over the square that holds the ball's contact."""
    radius, depth = scene.contact.indenter.model_dump()["radius_mm"], scene.motion.depth_mm
    reach = float(np.sqrt(max(2 * radius * depth - depth**2, 0.9 * radius**2)))
    place = scene.motion.position_mm
    return graded_mesh(scene.sensor.gel, Focus((place[0], place[1]), (reach, reach)), across)[0]


def _surface(trajectory: Trajectory, points: FloatArray) -> FloatArray:
    return np.asarray(probe(trajectory.space, points) @ trajectory.states[-1].displacement)


def _apart(one: FloatArray, truth: FloatArray) -> float:
    return float(np.linalg.norm(one - truth) / np.linalg.norm(truth))
