"""Random instances of a scene: what sample i shows depends on (scene, seed, i) alone.

With `sampling.common_draws` the scene's hash is left out of what follows.

Sample i belongs to trajectory i // samples_per_trajectory, and a trajectory to a sensor in the same way. A clip shows
all states of its trajectory, a pair two of them. Each level has its own random streams, seeded by the scene's hash, the
job's seed, the level's name, its number and the attempt: a draw that cannot be used is drawn again. Workers, batches
and resumption do not enter.
"""

import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from synth.errors import InputError
from synth.render.thin_lens import check_views
from synth.scene import Render, Scene, Sensor
from synth.scene.template import Chooser, Template, replaced
from synth.scene.validation import validated

TRAJECTORY_PARTS = ("contact", "motion")
"""Drawn anew for every trajectory; everything else belongs to the sensor."""
MAX_DRAWS = 10
"""Most instances of a sensor, and of a trajectory on it, an object's retries included, before the samples are given
up."""


@dataclass(frozen=True)
class SensorInstance:
    """The parts of a scene, by name, that all trajectories of one sensor share; None where no instance can be used.

    `rejected` says why earlier instances, or all of them, could not be used.
    """

    content: dict[str, Any] | None
    rejected: tuple[str, ...]


@dataclass(frozen=True)
class SampleFrames:
    """One sample's place: its trajectory, sensor and frames (states of the trajectory, 0 undeformed)."""

    index: int
    trajectory: int
    sensor: int
    frames: tuple[int, ...]


def stream(template: Template, seed: int, purpose: str, *numbers: int) -> np.random.Generator:
    """The random numbers of one purpose of a job; see the module's docstring."""
    scene = 0 if template.sampling.common_draws else int(template.hash, 16)
    entropy = [scene, seed, zlib.crc32(purpose.encode()), *numbers]
    return np.random.default_rng(np.random.SeedSequence(entropy))


def sensor_of(template: Template, trajectory: int) -> int:
    """Number of the sensor of a trajectory."""
    return trajectory // template.sampling.trajectories_per_sensor


def draw_sensor(template: Template, seed: int, sensor: int) -> SensorInstance:
    """The first instance of a sensor that fits the schema and keeps its lights out of the camera's view."""
    rejected: list[str] = []
    for attempt in range(MAX_DRAWS):
        choose = _chooser(stream(template, seed, "sensor", sensor, attempt))
        content = {part: replaced(template.content[part], choose) for part in _parts(template, of_trajectory=False)}
        try:
            validated(content.get("render", {}), str(template.source), Render, "render")
            check_views(validated(content["sensor"], str(template.source), Sensor, "sensor"))
        except InputError as error:
            rejected.append(str(error))
            continue
        return SensorInstance(content, tuple(rejected))
    return SensorInstance(None, tuple(rejected))


def draw(
    template: Template, seed: int, trajectory: int, attempt: int = 0, sensor: SensorInstance | None = None
) -> Scene:
    """The scene of one trajectory, by its number, of a job's seed.

    `attempt` is how many instances of contact and motion were of no use; `sensor` is the instance of the trajectory's
    sensor, where the caller has it. InputError where this instance breaks the schema (the tail of a `normal`, say), or
    no instance of the sensor can be used.
    """
    sensor = sensor or draw_sensor(template, seed, sensor_of(template, trajectory))
    if sensor.content is None:
        raise InputError(sensor.rejected[-1])
    rng = stream(template, seed, "contact", trajectory, attempt)
    own = {part: replaced(template.content[part], _chooser(rng)) for part in _parts(template, of_trajectory=True)}
    indenter = own["contact"]["indenter"]
    if indenter.get("rotation_deg") == "any":
        indenter["rotation_deg"] = _orientation(rng)
    return validated({**sensor.content, **own}, str(template.source), Scene)


def samples_of(template: Template, seed: int, trajectory: int, steps: int) -> list[SampleFrames]:
    """All samples of a trajectory with that many recorded states: a clip of all of them, or pairs.

    The first pair shows the undeformed gel and the last state. Each further state, drawn at random, makes a pair with
    every one before it: few states are rendered for many pairs.
    """
    sensor, count = sensor_of(template, trajectory), template.sampling.samples_per_trajectory
    if template.sampling.kind == "clips":
        return [SampleFrames(trajectory, trajectory, sensor, tuple(range(steps + 1)))]
    rng = stream(template, seed, "pairs", trajectory)
    shown = [0, steps, *(1 + rng.permutation(steps - 1)).tolist()]
    frames = [(state, other) for k, state in enumerate(shown) for other in rng.permutation(shown[:k]).tolist()]
    return [
        SampleFrames(trajectory * count + k, trajectory, sensor, (min(pair), max(pair)))
        for k, pair in enumerate(frames[:count])
    ]


def check_pairs(scene: Scene) -> None:
    """Refuse a trajectory that has fewer different pairs than it is to give."""
    asked, steps = scene.sampling.samples_per_trajectory, scene.motion.steps
    most = steps * (steps + 1) // 2
    if asked > most:
        raise InputError(
            f"sampling.pairs_per_trajectory = {asked}: motion.steps = {steps} gives {steps + 1} states, which make "
            f"{most} different pairs; give at most {most}, or more steps"
        )


def _chooser(rng: np.random.Generator) -> Chooser:
    def choose(kind: str, arguments: list[Any]) -> Any:
        match kind:
            case "uniform":
                return float(rng.uniform(*arguments))
            case "normal":
                return float(rng.normal(*arguments))
            case "log_uniform":
                return float(np.exp(rng.uniform(*np.log(arguments))))
            case _:
                return arguments[int(rng.integers(len(arguments)))]

    return choose


def _orientation(rng: np.random.Generator) -> list[float]:
    """Angles about x, then y, then z (degrees) of a rotation from the uniform distribution on SO(3).

    Its density is proportional to the cosine of the angle about y, which lies between -90 and 90 degrees.
    """
    x, z = rng.uniform(-180, 180, 2)
    return [float(x), float(np.degrees(np.arcsin(rng.uniform(-1, 1)))), float(z)]


def _parts(template: Template, *, of_trajectory: bool) -> list[str]:
    """Names of the template's parts of one level, in an order that the file's does not enter."""
    return sorted(part for part in template.content if (part in TRAJECTORY_PARTS) == of_trajectory)
