"""Draws: their statistics, what they depend on, and what they do not."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from commands import refused
from scipy import stats

from synth.sampling import MAX_DRAWS, check_pairs, draw, draw_sensor, samples_of, stream
from synth.scene import Scene
from synth.scene.template import Template, load_scene, shipped_scenes

COUNT = 200
SURE = 1e-4
"""Probability at which a test of the right distribution would fail; with fixed seeds it fails always or never."""


def _draws(template: Template, seed: int = 3) -> list[Scene]:
    """Many trajectories; on one sensor, whose draws are tested by themselves and take the most time."""
    sensor = draw_sensor(template, seed, 0)
    return [draw(template, seed, trajectory, sensor=sensor) for trajectory in range(COUNT)]


def test_distributions_are_those_asked_for_and_choices_equally_likely(tiny: Path) -> None:
    """Kolmogorov-Smirnov against SciPy's distributions."""
    ranges = ["motion.twist_deg={ normal = [5.0, 2.0] }", "contact.friction={ log_uniform = [0.01, 1.0] }"]
    scenes = _draws(load_scene(tiny, ranges))
    for values, law in (
        ([s.motion.depth_mm for s in scenes], stats.uniform(0.1, 0.2)),
        ([s.motion.twist_deg for s in scenes], stats.norm(5, 2)),
        ([s.contact.friction for s in scenes], stats.loguniform(0.01, 1)),
    ):
        assert stats.kstest(values, law.cdf).pvalue > SURE
    sphere = '{ shape = "sphere", radius_mm = { uniform = [1, 2] } }'
    torus = '{ shape = "torus", radius_mm = 1, tube_mm = 0.3 }'
    choices = [f"contact.indenter={{ choice = [{sphere}, {torus}] }}", "motion.steps={ choice = [2, 3, 5] }"]
    scenes = _draws(load_scene(tiny, choices))
    for values in ([s.contact.indenter.shape for s in scenes], [s.motion.steps for s in scenes]):
        _, counts = np.unique(values, return_counts=True)
        assert stats.chisquare(counts).pvalue > SURE
    assert {s.motion.steps for s in scenes} == {2, 3, 5}
    radii = {s.contact.indenter.radius_mm for s in scenes if s.contact.indenter.shape == "sphere"}
    assert 1 <= min(radii) <= max(radii) <= 2
    assert len(radii) > COUNT / 3  # drawn anew each time, not once


def test_neighbouring_trajectories_two_axes_of_one_draw_and_two_seeds_do_not_correlate(tiny: Path) -> None:
    template = load_scene(tiny)
    position = np.array([s.motion.position_mm for s in _draws(template)])
    other = np.array([s.motion.position_mm for s in _draws(template, 4)])
    for a, b in ((position[:-1, 0], position[1:, 0]), (position[:, 0], position[:, 1]), (position[:, 0], other[:, 0])):
        assert stats.pearsonr(a, b).pvalue > SURE


def test_a_draw_is_a_function_of_scene_seed_and_number_as_streams_are_of_purpose(tiny: Path) -> None:
    template = load_scene(tiny)
    assert draw(template, 3, 7) == draw(load_scene(tiny), 3, 7)
    scenes = [draw(template, seed, 7, attempt) for seed, attempt in itertools.product((3, 4), (0, 1))]
    scenes.append(draw(load_scene(tiny, ["numerics.tolerance=1e-7"]), 3, 7))
    depths = {scene.motion.depth_mm for scene in scenes}
    assert len(depths) == 5
    common = [load_scene(tiny, ["sampling.common_draws=true", f"numerics.tolerance={x}"]) for x in (1e-6, 1e-7)]
    assert len({draw(one, 3, 7).motion.depth_mm for one in common} | depths) == 6
    assert draw(template, 10**30, 7) != draw(template, 0, 7)  # seeds of any size
    numbers = {
        float(stream(template, seed, purpose, *key).random())
        for seed in (0, 1)
        for purpose in ("noise", "pattern")
        for key in ((0,), (1,), (0, 0), (0, 1), (1, 0))
    }
    assert len(numbers) == 20


def test_trajectories_and_redraws_share_their_sensor_alone_and_too_many_pairs_are_refused(tiny: Path) -> None:
    template = load_scene(tiny, ["sampling.trajectories_per_sensor=3"])
    scenes = [draw(template, 0, trajectory, attempt) for trajectory in range(9) for attempt in (0, 1)]
    for first in (0, 6, 12):
        assert len({s.sensor for s in scenes[first : first + 6]}) == 1
    assert len({s.sensor for s in scenes}) == 3
    assert len({s.motion for s in scenes}) == 18
    assert len({s.contact for s in scenes}) == 18
    check_pairs(load_scene(tiny, ["sampling.pairs_per_trajectory=3"]).corners[0])  # three states: 01, 02, 12
    four = load_scene(tiny, ["sampling.pairs_per_trajectory=4"]).corners[0]
    refused(r"^sampling\.pairs_per_trajectory = 4: motion\.steps = 2 .* at most 3", check_pairs, four)


def test_a_sensor_that_cannot_be_used_is_drawn_again_and_at_last_says_why(tiny: Path) -> None:
    """Half of the draws of a vignetting around 0 are negative."""
    template = load_scene(tiny, ["sensor.camera.vignetting={ normal = [0.0, 0.1] }"])
    draws = [draw_sensor(template, 0, sensor) for sensor in range(40)]
    rejected = sum(len(found.rejected) for found in draws)
    assert 15 < rejected < 85  # 40 expected, standard deviation sqrt(40 * 2) = 9: five of them
    for sensor, found in enumerate(draws):
        assert found == draw_sensor(template, 0, sensor)
        assert found.content is not None
        assert all("sensor.camera.vignetting = -" in reason for reason in found.rejected)
        scene = draw(template, 0, 2 * sensor)
        assert scene.sensor.camera.vignetting >= 0
        assert scene.sensor == draw(template, 0, 2 * sensor + 1).sensor
    template = load_scene(tiny, ["sensor.lights.0.position_mm=[{ normal = [3.9, 1.0] }, 0.0, 2.0]"])
    draws = [draw_sensor(template, 0, sensor) for sensor in range(10)]
    reasons = [reason for found in draws for reason in found.rejected]
    assert reasons
    assert all("between the camera and the gel" in reason for reason in reasons)
    template = load_scene(tiny, ["sensor.camera.vignetting={ normal = [0.0, 1e9] }"])
    found = draw_sensor(template, 0, 0)
    assert found.content is None
    assert len(found.rejected) == MAX_DRAWS
    refused(r"sensor\.camera\.vignetting", draw, template, 0, 0)


@pytest.mark.parametrize(
    ("pairs", "steps", "states"), [(1, 1, 2), (2, 2, 3), (3, 6, 3), (4, 6, 4), (6, 3, 4), (7, 6, 5), (21, 6, 7)]
)
def test_pairs_are_distinct_begin_with_the_whole_motion_and_share_states(
    tiny: Path, pairs: int, steps: int, states: int
) -> None:
    template = load_scene(tiny, [f"sampling.pairs_per_trajectory={pairs}", "sampling.trajectories_per_sensor=2"])
    for trajectory in range(4):
        found = samples_of(template, 0, trajectory, steps)
        assert [pair.index for pair in found] == list(range(trajectory * pairs, (trajectory + 1) * pairs))
        assert {(pair.trajectory, pair.sensor) for pair in found} == {(trajectory, trajectory // 2)}
        assert found[0].frames == (0, steps)
        assert len({pair.frames for pair in found}) == pairs
        assert len({frame for pair in found for frame in pair.frames}) == states
        assert all(0 <= i < j <= steps for i, j in (pair.frames for pair in found))
        assert found == samples_of(template, 0, trajectory, steps)


@pytest.mark.parametrize("name", shipped_scenes())
def test_every_draw_of_a_shipped_scene_is_usable_at_once(name: str) -> None:
    template = load_scene(name)
    per_sensor = template.corners[0].sampling.trajectories_per_sensor
    for sensor in range(200 // per_sensor):
        found = draw_sensor(template, 0, sensor)
        assert found.rejected == ()
        for trajectory in range(sensor * per_sensor, (sensor + 1) * per_sensor):
            assert draw(template, 0, trajectory, sensor=found).name == name
