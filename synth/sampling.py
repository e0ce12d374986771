"""One concrete draw: what sample i shows depends on (scene, seed, i) alone.

Sample i belongs to trajectory i // pairs_per_trajectory, and a trajectory to a sensor in the same way. Each level has its
own random streams, seeded by the scene's hash, the job's seed, the level's name, its number and (for a trajectory that
had to be redrawn) the attempt. Workers, batches and resumption do not enter.
"""

import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from synth.scene import Sampling, Scene
from synth.template import Template

TRAJECTORY_PARTS = ("contact", "motion")
"""Drawn anew for every trajectory; everything else belongs to the sensor."""


def stream(template: Template, seed: int, purpose: str, *numbers: int) -> np.random.Generator:
    """The random stream of one purpose."""
    entropy = [int(template.hash, 16), seed, zlib.crc32(purpose.encode()), *numbers]
    return np.random.default_rng(np.random.SeedSequence(entropy))


def draw(template: Template, seed: int, trajectory: int, attempt: int = 0) -> Scene:
    """The scene of one trajectory.

    Raises:
        InputError: the draw breaks the schema (a wide `normal`, say).
    """
    sensor = trajectory // _sampling(template).trajectories_per_sensor
    streams = {
        True: stream(template, seed, "contact", trajectory, attempt),
        False: stream(template, seed, "sensor", sensor),
    }

    def resolver(kind: str, arguments: list[Any], where: str) -> Any:
        return _drawn(kind, arguments, streams[where.split(".")[0] in TRAJECTORY_PARTS])

    return template.resolve(resolver)


def _drawn(kind: str, arguments: list[Any], rng: np.random.Generator) -> Any:
    match kind:
        case "uniform":
            return float(rng.uniform(*arguments))
        case "normal":
            return float(rng.normal(*arguments))
        case "log_uniform":
            return float(np.exp(rng.uniform(*np.log(arguments))))
        case _:
            return arguments[int(rng.integers(len(arguments)))]


def _sampling(template: Template) -> Sampling:
    return template.corners[0].sampling


@dataclass(frozen=True)
class Pair:
    """One sample's place: its trajectory, sensor and frames (states of the trajectory, 0 undeformed)."""

    index: int
    trajectory: int
    sensor: int
    frames: tuple[int, int]


def pairs_of(template: Template, seed: int, trajectory: int, steps: int) -> list[Pair]:
    """All samples of a trajectory with that many recorded states.

    The first shows the undeformed gel and the last state; the others are drawn from all other pairs i < j.
    """
    sampling = _sampling(template)
    count = sampling.pairs_per_trajectory
    others = [(i, j) for i in range(steps) for j in range(i + 1, steps + 1) if (i, j) != (0, steps)]
    rng = stream(template, seed, "pairs", trajectory)
    order = [others[k] for k in rng.permutation(len(others))]
    frames = [(0, steps), *order]
    first = trajectory * count
    sensor = trajectory // sampling.trajectories_per_sensor
    return [Pair(first + k, trajectory, sensor, frames[k % len(frames)]) for k in range(count)]
