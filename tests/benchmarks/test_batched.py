"""`benchmarks batched`: a short run, and the surface errors of its presses, on the CPU."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import batched
from benchmarks.batched import PLACES_MM, main, nth_ball, random_ball, reference_mesh, steady, surface_error
from benchmarks.rows import Row, read
from synth.errors import InputError

PRESS: Row = {"depth_mm": 0.3, "drag_mm": 0.0, "steps": 1, "step_mm": None, "smallest_mm": 2.0, "largest_mm": 6.0}
CASE: Row = {**PRESS, "growth": 2.0, "loose": 0.0, "reference_across": 2, "press": 0}


@pytest.mark.parametrize("limits", [(2.0, 6.0), (3.0, 3.5)])
def test_presses_are_what_they_are_said_to_be(limits: tuple[float, float]) -> None:
    rng, case = np.random.default_rng(0), {**PRESS, "smallest_mm": limits[0], "largest_mm": limits[1], "drag_mm": 0.5}
    for scene in (random_ball(rng, case) for _ in range(20)):
        assert limits[0] <= scene.contact.indenter.radius_mm <= limits[1]
        assert (np.abs(scene.motion.position_mm) <= PLACES_MM).all()
        assert np.hypot(*scene.motion.shear_mm) == pytest.approx(0.5)


def test_errors_fall_with_the_elements(monkeypatch: pytest.MonkeyPatch) -> None:
    """And are none on the mesh of the reference."""
    coarse, finer = (surface_error({**CASE, "cells": cells}) for cells in ("6x4x1", "8x6x2"))
    assert coarse["surface_error_percent"] > finer["surface_error_percent"] > 0
    monkeypatch.setattr(batched, "mesh_of", lambda case: reference_mesh(nth_ball(0, PRESS), 2))
    same = surface_error({**CASE, "loose": 1e-3})
    assert (same["surface_error_percent"], same["force_error_percent"]) == (0, 0)


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--out", str(tmp_path), "--device", "cpu", "--cells", "4", "4", "1", "--depth", "0.3"]
    assert main([*options, "--batch", "2", "--runs", "2", "--seconds", "0.1"]) == 0
    rows = read(tmp_path / "batched.csv")
    assert [row["run"] for row in rows] == [0, 1]
    for row in rows:
        assert row["presses"] == row["complete"] >= 1
        assert row["presses_per_s"] > 0
        assert 0 < row["krylov_busy"] <= 1
        assert {"ms_residual", "ms_tangent", "ms_krylov", "ms_product", "ms_preconditioner", "ms_stepping"} <= set(row)
    assert "ms_residual" in capsys.readouterr().out
    # Another way to intermediate steps leaves another state, since friction remembers it: 0.02 to 0.14 % here.
    press = ["--out", str(tmp_path), "--cells", "8", "6", "2", "--depth", "0.5", "--radii", "5", "6", "--errors", "1"]
    for way in ([], ["--step", "0.05"], ["--loose", "0.1"]):
        assert main([*press, "--across", "4", *way]) == 0
    found: list[dict[str, Any]] = read(tmp_path / "batched_errors.csv")
    assert all(5 <= row["radius_mm"] <= 6 for row in found)
    assert len({row["surface_error_percent"] for row in found}) == 3
    with pytest.raises(InputError, match="even numbers"):
        main([*options, "--cells", "5", "4", "1"])


def test_the_rate_begins_with_the_second_batch() -> None:
    assert steady([1.0, 2.0, 2.5, 3.0, 3.5], 2) == pytest.approx(3 / 1.5)
    assert steady([1.0, 2.0, 3.0], 8) == 1, "too short for that: from its first half on"
    assert steady([2.0], 8) == 0.5
