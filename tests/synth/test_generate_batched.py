"""Samples by the batched solver: the same whatever ran beside them, and the single solver's within its tolerance."""

import os
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import pyvista as pv
from commands import refused
from processes_of import end_family, needs_proc, started
from tiny_scene import TEXT, fingerprint, job_context, write_tiny

from synth.dataset.manifest import Failure
from synth.dataset.reader import read_dataset
from synth.dataset.shard import Shard
from synth.errors import InputError
from synth.pipeline import batched_simulation
from synth.pipeline.attempts import Attempts
from synth.pipeline.batched_simulation import in_batches
from synth.pipeline.generate import Scheduling, generate
from synth.pipeline.overlapped import prefetched
from synth.pipeline.producer import Producer
from synth.pipeline.records import JobContext, Outcome, SimulatedTrajectory, Task
from synth.planning import plan, predict
from synth.press.press import MeshRule, edge_radius_mm
from synth.press.resolution import accuracy, shared_mesh, shared_spacing_mm
from synth.render.variant import Variant
from synth.sampling import MAX_DRAWS, draw, draw_sensor, sensor_of
from synth.scene import BoxGel, Numerics, Scene
from synth.scene.template import Template, load_scene
from synth.simulate.solve import simulate_press

SPHERE = '{ shape = "sphere", radius_mm = { uniform = [1.5, 2.5] } }'
BOX = '{ shape = "box", size_mm = [{ uniform = [1.4, 2.4] }, 2.4, 2.4], fillet_mm = { uniform = [0.68, 1.1] } }'
NEEDLE = '{ shape = "sphere", radius_mm = 0.06 }'
BATCHED = (
    TEXT.replace("edge_length_mm = 1.25", 'solver = "batched", cells = [6, 4, 2]')
    .replace("[8.0, 6.0, 2.5]", "[8.0, 6.0, { choice = [2.5, 2.2] }]")
    .replace(SPHERE, f"{{ choice = [{SPHERE}, {BOX}, {NEEDLE}] }}")
    .replace("steps = 2", "steps = 3")
    .replace("position_mm = [{ uniform = [-1.0, 1.0] }", "position_mm = [{ normal = [0.0, 3.0] }")
)
SAMPLES, SEED = 10, 9  # Five trajectories of three sensors and two pads; draws of every kind fail

pytestmark = pytest.mark.usefixtures("one_cache")
GEL = BoxGel(size_mm=(20.0, 15.0, 4.0), youngs_modulus_kpa=200.0)


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Template:
    return load_scene(write_tiny(tmp_path_factory.mktemp("scene"), BATCHED))


@pytest.fixture(scope="module")
def whole(template: Template, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole") / "d"
    summary = generate(template, SAMPLES, out, SEED, scheduling=Scheduling(batch=8))
    assert (summary.made, summary.given_up) == (SAMPLES, [])
    return out


@pytest.fixture(scope="module")
def context(template: Template, tmp_path_factory: pytest.TempPathFactory) -> JobContext:
    return job_context(template, SAMPLES, tmp_path_factory.mktemp("context"), SEED)


def _tasks(numbers: Iterable[int]) -> Iterator[Task]:
    return ((number, (2 * number, 2 * number + 1)) for number in numbers)


def test_batch_and_shards_change_no_bit(template: Template, whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "d"
    for number, batch in ((1, 1), (0, 3)):
        generate(template, SAMPLES, out, SEED, scheduling=Scheduling(batch=batch, shard=Shard(number, 2)))
    assert fingerprint(out) == fingerprint(whole)


def test_bodies_that_processes_make_are_the_same(
    template: Template, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a GPU, where objects' bodies would keep it waiting; from the solver's thread, beside the renderers."""
    monkeypatch.setattr(batched_simulation, "_are_slow", lambda context: True)
    environment, script = dict(os.environ), sys.modules["__main__"]
    generate(template, SAMPLES, tmp_path / "d", SEED, scheduling=Scheduling(batch=3, workers=2))
    assert fingerprint(tmp_path / "d") == fingerprint(whole)
    assert (dict(os.environ), sys.modules["__main__"]) == (environment, script)


@needs_proc
def test_killed_with_workers_and_gone_on_with_alone(template: Template, whole: Path, tmp_path: Path) -> None:
    """The driver with solver and renderer is killed; nobody is left behind, what is on record stays."""
    out = tmp_path / "d"
    process = started(template.source, out, "--n", str(SAMPLES), "--seed", str(SEED), "--workers", "2")
    end_family(process, signal.SIGKILL)
    before = (out / "manifest.jsonl").read_text().splitlines()
    assert 0 < len(before) < SAMPLES
    generate(template, SAMPLES, out, SEED, scheduling=Scheduling(batch=2, workers=1))
    assert set(before) <= set((out / "manifest.jsonl").read_text().splitlines())
    assert fingerprint(out) == fingerprint(whole)


def test_one_trajectory_alone_is_the_same_failed_draws_are_replaced_and_the_mesh_is_told(context, whole) -> None:
    """As a task of a cluster. Its second draw can be used."""
    outcome, dataset = Producer(context).produce(4, (8, 9)), read_dataset(whole)
    assert [failure.stage for failure in outcome.failures] == ["simulate"]
    assert [entry.sha256 for entry in outcome.entries] == [dataset.entry(index).sha256 for index in (8, 9)]
    failures = dataset.failures
    kinds = Counter((failure["stage"], failure["last_good_state"] is None) for failure in failures)
    # Broken schema; a body that cannot be built; a body that finds no contact point, with the state before.
    assert set(kinds) == {("draw", True), ("simulate", True), ("simulate", False)}
    for first in {failure["index"] for failure in failures}:
        draws = [failure["draw"] for failure in failures if failure["index"] == first]
        assert draws == list(range(len(draws)))
    told = [dataset.entry(index).diagnostics for index in range(SAMPLES)]
    assert len({each["mesh"] for each in told}) == 2  # of two pads
    first, scene = told[0], dataset.scene_of(0)
    assert first["mesh"] == shared_mesh(scene.sensor.gel, scene.numerics).hash
    assert first["predicted_error_px"] == round(accuracy(scene).error_px, 4)
    assert first["predicted_error_percent"] is None, "nothing is known of P1/P1 elements"


def test_a_batch_agrees_with_the_single_solver_and_hopeless_trajectories_are_given_up(context: JobContext) -> None:
    """On the same meshes: the same draws fail for the same reasons, and what is left is the same motion."""
    results = {found.number: found for group in in_batches(context, _tasks(range(5)), 4) for found in group}
    assert sorted(results) == list(range(5))
    for task in _tasks(range(5)):
        template = context.plan.template
        alone = _alone(Attempts(context, task, draw_sensor(template, SEED, sensor_of(template, task[0]))))
        together = results[task[0]]
        assert together.scene == alone.scene
        assert _said(together.failures) == _said(alone.failures)
        assert together.states.keys() == alone.states.keys()
        for number, state in alone.states.items():
            other, scale = together.states[number], np.linalg.norm(state.displacement)
            # At a tolerance of 1e-3 between recorded states, which friction remembers: 6e-5 at most was seen.
            assert np.linalg.norm(other.displacement - state.displacement) <= 2e-4 * scale
            np.testing.assert_allclose(other.force_n, state.force_n, rtol=0, atol=1e-3 * np.linalg.norm(state.force_n))
    hopeless = [f"contact.indenter={NEEDLE}", "motion.position_mm=[0.3, 0.2]"]
    planned = plan(load_scene(context.plan.template.source, hopeless))
    ((result,),) = in_batches(replace(context, plan=planned), _tasks([0]), 2)
    assert isinstance(result, Outcome)
    assert (result.given_up, len(result.failures)) == ((0, 1), MAX_DRAWS)


def test_an_object_whose_press_fails_is_pressed_again_with_rounder_edges(template: Template, tmp_path: Path) -> None:
    pv.Cube().triangulate().save(tmp_path / "cube.stl")
    cube = f'contact.indenter={{shape="mesh",file="{tmp_path}/cube.stl",size_mm=2.0}}'
    objects = load_scene(template.source, [cube, "motion.position_mm=[0.0,0.0]"])
    attempts = Attempts(job_context(objects, 2, tmp_path, SEED), (0, (0, 1)), draw_sensor(objects, SEED, 0))
    failed: Any = SimpleNamespace(status="partial", reason="made up", states=[SimpleNamespace(summary=dict)])
    presses = [tried.press for tried in iter(attempts.next, None) if attempts.simulated(tried, failed) is None]
    radii = [edge_radius_mm(press.scene, press.mesh) for press in presses]
    # After the retries another instance follows, and its own retries.
    retries = [1, 1.5, 2.25, 1.8, 1]
    np.testing.assert_allclose(np.divide(radii, radii[0]), [*retries, *retries])
    stiffness = [50, 200, 200, 150, 100]
    assert [press.scene.numerics.penalty for press in presses] == [*stiffness, *stiffness]


def _said(failures: Iterable[Failure]) -> list[tuple[object, ...]]:
    return [(failure.index, failure.draw, failure.stage, failure.reason) for failure in failures]


def _alone(attempts: Attempts) -> SimulatedTrajectory:
    """By the single solver, as `Producer` does it."""
    while (attempt := attempts.next()) is not None:
        simulated = attempts.simulated(attempt, simulate_press(attempt.press, attempt.frames))
        if simulated is not None:
            return simulated
    raise AssertionError("no draw could be used")


def test_items_made_ahead_come_in_order_with_errors_and_no_more_than_there_is_room_for() -> None:
    made: list[int] = []

    def counting(count: int) -> Iterator[int]:
        for number in range(count):
            made.append(number)
            yield number
        raise InputError("no more")

    with prefetched(counting(5), 2) as items:
        assert [next(items) for _ in range(5)] == list(range(5))
        refused("no more", next, items)
    made.clear()
    before = threading.active_count()
    with prefetched(counting(100), 3) as items:
        assert next(items) == 0
        time.sleep(0.3)
        assert len(made) <= 5  # one taken, three in line, one in hand
    assert threading.active_count() == before
    assert len(made) <= 6


def test_the_shared_mesh_is_even_and_the_predicted_error_falls_with_its_spacing(template: Template) -> None:
    """Planes through the thickness: the first element is as high as the others are wide, as far as growth allows."""
    numerics = Numerics(solver="batched", cells=(16, 12, 2))
    mesh = shared_mesh(GEL, numerics)
    assert mesh is shared_mesh(GEL.model_copy(update={"youngs_modulus_kpa": 100.0}), numerics)
    assert len(mesh.tets) == 6 * 16 * 12 * 2
    x, y, z = (np.unique(mesh.points[:, axis]) for axis in range(3))
    np.testing.assert_allclose(np.diff(x), 1.25, atol=1e-9)  # coordinates are multiples of 2e-10 mm
    np.testing.assert_allclose(np.diff(y), 1.25, atol=1e-9)
    assert z[1] == pytest.approx(max(1.25, 4.0 / 3.2), abs=1e-6)  # 1 + growth of at most 2.2
    assert shared_spacing_mm(GEL, numerics) == pytest.approx(1.25, abs=1e-6)
    # By the model's exponent of 1.6, at equal proportions of the elements; and the rule says the same.
    drawn = draw(template, SEED, 1)
    fine = drawn.model_copy(update={"numerics": drawn.numerics.model_copy(update={"cells": (16, 12, 2)})})
    coarse, better = accuracy(drawn), accuracy(fine)
    ratio = _spacing_of(drawn) / _spacing_of(fine)
    assert ratio > 1.5
    # Coordinates are multiples of 2e-10 mm.
    assert coarse.error_px / better.error_px == pytest.approx(ratio**1.6, rel=1e-8)
    assert better.across > coarse.across >= 0
    found = MeshRule.of(fine, is_batched=True).resolution(fine)
    assert (found.across, found.error_px, found.through) == (better.across, better.error_px, 2)
    assert len(found.mesh.tets) == 6 * 16 * 12 * 2


def _spacing_of(drawn: Scene) -> float:
    """Of the mesh itself: width, or where the elements are higher than wide the geometric mean of both."""
    x, y, z = (np.unique(shared_mesh(drawn.sensor.gel, drawn.numerics).points[:, axis]) for axis in range(3))
    wide = float(np.sqrt((x[1] - x[0]) * (y[1] - y[0])))
    return float(np.sqrt(wide * max(wide, z[1] - z[0])))


def test_plan_says_what_is_batched_and_wrong_numbers_are_refused(template: Template, tmp_path: Path) -> None:
    planned = plan(template, Variant("cuda_ad_rgb", ""))
    batched = next(decision for decision in planned.decisions if decision.feature == "batched simulation")
    assert batched.runs
    assert "sensor.gel.size_mm[2]" in batched.reason
    assert predict(planned).resolution.startswith("6 x 4 x 2 elements for all trajectories of a pad")
    alike = load_scene(template.source, ["sensor.gel.size_mm=[8.0, 6.0, 2.5]"])
    assert "another" not in plan(alike, Variant("cuda_ad_rgb", "")).decisions[0].reason
    for wrong in ("[5, 4, 2]", "[6, 2, 2]", "[6, 4, 0]", "[6, 4]"):
        refused(r"numerics\.cells", load_scene, template.source, [f"numerics.cells={wrong}"])
    refused("batch = 0", generate, template, 1, tmp_path / "d", scheduling=Scheduling(batch=0))
