"""`benchmarks agreement` and `batched`: the CPU against itself and with a GPU's rounding, and the rate of presses."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp
from commands import refused, said

from benchmarks import batched
from benchmarks.__main__ import main
from benchmarks.agreement import WANTED, Noisy, compare, drawn_of, one_by_one, summary, together
from benchmarks.batched import PLACES_MM, nth_ball, random_ball, reference_mesh, steady, surface_error
from benchmarks.rows import Row, read
from synth.scene import MeshIndenter
from synth.scene.template import load_scene
from synth.simulate.batched.pad import prepare
from synth.simulate.batched.run import OPTIONS

TINY = ["numerics.element=p1p1", "sensor.camera.width=32", "sensor.camera.height=24", "motion.steps=2"]
PRESS: Row = {"depth_mm": 0.3, "drag_mm": 0.0, "steps": 1, "step_mm": None, "smallest_mm": 2.0, "largest_mm": 6.0}
CASE: Row = {**PRESS, "growth": 2.0, "relaxed": 0.0, "reference_across": 2, "press": 0}


def run(out: Path, *options: str) -> Row:
    small = ["agreement", "--out", str(out), "--device", "cpu", "--trajectories", "4"]
    status = main([*small, *(f"--set={change}" for change in TINY), *options])
    found = summary(read(out / "agreement.csv"))
    assert status == (found["within 1e-6"] < 4)
    return found


def test_noise_has_the_size_that_was_asked_for() -> None:
    size, wanted = 400, wp.array([1, 0, 1], dtype=wp.int32, device="cpu")
    unit = wp.array(np.eye(size, dtype=np.float32), device="cpu")
    ones, noisy = wp.array(np.ones((3, size), dtype=np.float32), device="cpu"), Noisy(0.1)
    first, second = (wp.zeros((3, size), dtype=wp.float32, device="cpu") for _ in range(2))
    noisy.product(unit, ones, first, wanted)
    noisy.product(unit, ones, second, wanted)
    off = np.concatenate([first.numpy()[[0, 2]], second.numpy()[[0, 2]]]) - 1
    # A standard deviation from 400 draws is known to 1 / sqrt(800) = 3.5 %.
    np.testing.assert_allclose(off.std(axis=1), 0.1, rtol=0.15)
    assert np.abs(np.corrcoef(off) - np.eye(4)).max() < 0.2
    assert (first.numpy()[1] == 0).all()


def test_the_cpu_agrees_with_itself(tmp_path: Path) -> None:
    """A trajectory's bits depend neither on its neighbours nor on its lane."""
    found = run(tmp_path)
    assert (found["draws"], found["end alike"], found["complete"], found["within 1e-6"]) == (4, 4, 4, 4)
    assert found["displacement, largest"] == found["traction, largest"] == found["flow_px, largest"] == 0
    assert found["iterations"] == found["cpu_iterations"] > 4


def test_noise_in_the_directions_stays_within_what_is_wanted(tmp_path: Path) -> None:
    """Loose intermediate steps let friction remember the noise, rougher directions leave more of it."""
    changes: tuple[list[str], ...] = [], ["--forcing", "0.03"], ["--relaxed", "1e-3"]
    found, rough, relaxed = (run(tmp_path / str(n), "--noise", "3e-4", *one) for n, one in enumerate(changes))
    assert found["end alike"] == rough["end alike"] == relaxed["end alike"] == 4
    assert 0 < found["displacement, largest"] <= WANTED
    assert found["displacement, median"] < rough["displacement, median"]
    assert 2 * found["displacement, median"] < relaxed["displacement, median"]
    # At most some ten px of flow, within 1e-6 of them.
    assert found["mean_flow_px, largest"] <= found["flow_px, largest"] < 1e-4


def test_outcomes_are_counted() -> None:
    drawn = drawn_of(load_scene("gelsight_mini", ['numerics.solver="batched"', "numerics.cells=[4,4,1]", *TINY]), 3, 5)
    missing = {"indenter": MeshIndenter(shape="mesh", file="nothing.stl", scale=1.0)}
    contact = {"contact": drawn[2].scene.contact.model_copy(update=missing)}
    drawn[2] = replace(drawn[2], folder=Path("nowhere"), scene=drawn[2].scene.model_copy(update=contact))
    first = together(drawn, prepare(drawn[0].scene, drawn[0].mesh, "cpu"), OPTIONS)
    complete, other, unbuilt = first
    assert complete.status == other.status == "complete"
    assert "nothing.stl" in str(unbuilt)
    second = [replace(complete, reason="lost"), *one_by_one(drawn[1:], OPTIONS, 2)]
    rows = list(map(compare, drawn, first, second))
    assert [row["same"] for row in rows] == [False, True, True]
    assert [row["status"] for row in rows] == ["complete", "complete", "unbuilt"]
    assert [row["cpu_status"] for row in rows] == ["partial", "complete", "unbuilt"]
    assert rows[0]["cpu_reason"] == "lost"
    found = summary(rows)
    assert (found["draws"], found["end alike"], found["complete"]) == (3, 2, 1)
    assert summary(rows[:1])["displacement, largest"] is None


@pytest.mark.parametrize(("options", "told"), [
    (["--device", "cuda", "--noise", "0.1"], "use cpu"),
    (["--device", "cpu", "--trajectories", "0"], "at least 1"),
    (["--device", "cpu", "--set", "motion.depth_mm={normal=[0.2, 1e9]}"], "none of 16 draws"),
])  # fmt: skip
def test_what_cannot_be_compared(options: list[str], told: str, tmp_path: Path, capsys) -> None:
    assert told in said(capsys, main, "agreement", "--out", tmp_path, *options, status=2)


@pytest.mark.parametrize("limits", [(2.0, 6.0), (3.0, 3.5)])
def test_presses_are_what_they_are_said_to_be(limits: tuple[float, float]) -> None:
    rng, case = np.random.default_rng(0), {**PRESS, "smallest_mm": limits[0], "largest_mm": limits[1], "drag_mm": 0.5}
    for scene in (random_ball(rng, case) for _ in range(20)):
        assert limits[0] <= scene.contact.indenter.radius_mm <= limits[1]
        assert (np.abs(scene.motion.position_mm) <= PLACES_MM).all()
        assert np.hypot(*scene.motion.shear_mm) == pytest.approx(0.5)


def test_errors_fall_with_the_elements(monkeypatch: pytest.MonkeyPatch) -> None:
    coarse, finer = (surface_error({**CASE, "cells": cells}) for cells in ("6x4x1", "8x6x2"))
    assert coarse["surface_error_percent"] > finer["surface_error_percent"] > 0
    monkeypatch.setattr(batched, "mesh_of", lambda case: reference_mesh(nth_ball(0, PRESS), 2))
    same = surface_error({**CASE, "relaxed": 1e-3})
    assert (same["surface_error_percent"], same["force_error_percent"]) == (0, 0)


def test_the_command_and_its_rate_from_the_second_batch_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--out", str(tmp_path), "--device", "cpu", "--cells", "4", "4", "1", "--depth", "0.3"]
    shown = said(capsys, batched.main, *options, "--batch", 2, "--runs", 2, "--seconds", 0.1)
    assert "ms_residual" in shown
    rows = read(tmp_path / "batched.csv")
    assert [row["run"] for row in rows] == [0, 1]
    for row in rows:
        assert row["presses"] == row["complete"] >= 1
        assert row["presses_per_s"] > 0
        assert 0 < row["krylov_busy"] <= 1
        assert {"ms_residual", "ms_tangent", "ms_krylov", "ms_product", "ms_preconditioner", "ms_stepping"} <= set(row)
    # Another way to intermediate steps leaves another state, since friction remembers it: 0.02 to 0.14 % here.
    press = ["--out", str(tmp_path), "--cells", "8", "6", "2", "--depth", "0.5", "--radii", "5", "6", "--errors", "1"]
    for way in ([], ["--step", "0.05"], ["--relaxed", "0.1"]):
        assert batched.main([*press, "--across", "4", *way]) == 0
    found: list[dict[str, Any]] = read(tmp_path / "batched_errors.csv")
    assert all(5 <= row["radius_mm"] <= 6 for row in found)
    assert len({row["surface_error_percent"] for row in found}) == 3
    refused("even numbers", batched.main, [*options, "--cells", "5", "4", "1"])
    assert steady([1.0, 2.0, 2.5, 3.0, 3.5], 2) == pytest.approx(3 / 1.5)
    assert steady([1.0, 2.0, 3.0], 8) == 1, "too short for that: from its first half on"
    assert steady([2.0], 8) == 0.5
